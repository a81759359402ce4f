"""The timed way of a trace through one GPU: chunks are added in order, then it is finished.

trace ──► place texels ──► coalesce ──► CTAs ──► SMs, L1s, network, L2, DRAM ──► cycles, counters
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from cachesim.coalesce import groups_of, placement_of, program_of
from cachesim.config import L1, FetchPath, Gpu
from cachesim.timing import engine, machine, records
from cachesim.timing.feed import Feed
from cachesim.timing.outcome import Snapshot, passes_of, raw_counters
from cachesim.timing.results import PassTiming
from traces.errors import InputError, WorkError, unknown
from traces.placement import place
from traces.texture import MAX_MIPS
from traces.trace import Chunk, Trace

FETCH_PATHS: tuple[FetchPath, ...] = ("texture", "readonly", "global")
#: Cycles between two calls of a progress function.
_PAUSE = 1 << 18


class Clock:
    """One trace's timed way through one GPU.

    fetch_path, layout: those used. pairs: (pass, texture) of each `MAX_MIPS` groups of counters.
    """

    def __init__(
        self,
        trace: Trace,
        gpu: Gpu,
        fetch_path: str | None = None,
        layout: str | None = None,
        layouts: Mapping[str, str] | None = None,
        *,
        on_cycle: Callable[[int], None] = lambda cycle: None,
    ) -> None:
        """on_cycle: called now and then with the present cycle.

        Raises:
            InputError: unknown fetch path or layout, a trace or a GPU that timing cannot run.
        """
        self._trace, self._gpu = trace, gpu
        default = gpu.lane_address_path if trace.is_lane_address else "texture"
        self.fetch_path = fetch_path or default
        if self.fetch_path not in FETCH_PATHS:
            raise unknown("fetch path", self.fetch_path, FETCH_PATHS)
        self.layout = None if trace.is_lane_address else layout or gpu.texture_layout
        address_map = place(trace.textures, self.layout, overrides=layouts) if self.layout else None
        self.pairs = groups_of(trace)
        self.num_groups = max(1, len(self.pairs)) * MAX_MIPS
        self.state = machine.build(gpu, self.fetch_path, self.num_groups)
        texture = gpu.l1_texture if self.fetch_path == "texture" else None
        self.l1: L1 = texture or gpu.l1
        shift = self.l1.sector_bytes.bit_length() - 1
        narrow = address_map is not None and address_map.footprint_bytes >> shift < 1 << 32
        self._feed = Feed(
            trace, gpu, program_of(trace), placement_of(address_map),
            address_map.base_address >> shift if narrow and address_map else 0, narrow,
            self.num_groups, self.fetch_path, self.l1.line_bytes, self.l1.sector_bytes,
        )  # fmt: skip
        self._on_cycle = on_cycle
        self._launch = -1
        self._padding = int(trace.manifest.get("padding_warps", 0))
        self._before: Snapshot | None = None
        self.launches: list[PassTiming] = []

    @property
    def lane_fetches(self) -> npt.NDArray[np.int64]:
        """(groups,) lane fetches coalesced so far."""
        return self._feed.lane_fetches

    @property
    def num_rows(self) -> int:
        return self._feed.num_rows

    @property
    def cycles(self) -> int:
        """Core cycles so far."""
        return int(self.state.pool.machine[0]["now"])

    def add(self, chunk: Chunk) -> None:
        """Queue a chunk's CTAs, and run what can run."""
        if chunk.launch != self._launch:
            self.finish()
            self._launch = chunk.launch
            self._before = Snapshot.take(self.state)
            launch = self._trace.launches[chunk.launch]
            self.state = self._feed.begin(self.state, launch, self._padding)
        self.state = self._feed.add(self.state, chunk)
        self._run()

    def finish(self) -> None:
        """Run what is left of the last launch."""
        if self._launch < 0:
            return
        self.state.pool.machine[0]["complete"] = 1
        self._run()
        assert self._before is not None
        launch = self._trace.launches[self._launch]
        self._close_accounts()
        after = Snapshot.take(self.state)
        self.launches.append(
            passes_of(launch.pass_name, self._before, after, self._gpu, self.state)
        )
        machine.forget_lines(self.state.l1)
        if self._gpu.gl1 is not None:
            machine.forget_lines(self.state.gl1)
        self._launch = -1

    def _close_accounts(self) -> None:
        """Book the cycles that sleeping SMs have not booked yet."""
        now = self.cycles
        state = self.state
        for sm in state.sms:
            state.reasons[int(sm["last_reason"])] += now - 1 - int(sm["last_step"])
            sm["last_step"] = now - 1
            sm["last_reason"] = records.R_IDLE

    def _run(self) -> None:
        while True:
            why = engine.run(self.state, self.cycles + _PAUSE)
            if why in (engine.DONE, engine.NEEDS_CTAS):
                return
            if why == engine.NEEDS_POOL:
                self.state = machine.larger_pool(self.state)
            elif why == engine.STUCK:
                raise WorkError(f"the timing model is stuck: {self.describe_stuck()}")
            self._on_cycle(self.cycles)

    def describe_stuck(self) -> str:
        """The queues that hold requests although nothing moves."""
        state = self.state
        found = []
        for name, tags in (
            ("l1", state.l1),
            ("gl1", state.gl1),
            ("l2", state.l2),
            ("llc", state.llc),
        ):
            for queue in ("in", "delay", "miss", "down", "fill", "out"):
                held = tags.nodes[f"{queue}_count"]
                if held.sum():
                    found.append(
                        f"{name}.{queue} {int(held.sum())} (instance {int(held.argmax())})"
                    )
        for name, net in (("request network", state.up), ("reply network", state.down)):
            for side, ports, count in (
                ("in", net.inputs, "in_count"),
                ("out", net.outputs, "count"),
            ):
                if ports[count].sum():
                    found.append(f"{name} {side} {int(ports[count].sum())}")
        blocked = int(state.sms["num_blocked"].sum())
        return f"cycle {self.cycles}, {blocked} warps wait; " + (
            "; ".join(found) or "all queues empty"
        )

    def drain(self) -> int:
        """Let what is still on its way to memory arrive. Returns requests left, 0 if all is well."""
        for _ in range(64):
            if self.state.pool.machine[0]["in_flight"] == 0:
                break
            self.state.pool.machine[0]["live_ctas"] = 1
            engine.run(self.state, self.cycles + 4096)
        self.state.pool.machine[0]["live_ctas"] = 0
        return int(self.state.pool.machine[0]["in_flight"])

    def raw(self) -> dict[str, dict[str, int]]:
        """GPGPU-Sim's own counters."""
        return raw_counters(self.state, self.launches)


__all__ = ["Clock", "InputError"]
