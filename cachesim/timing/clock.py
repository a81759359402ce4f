"""The timed way of a trace through one GPU: chunks are added in order, then it is finished.

trace ──► place texels ──► coalesce ──► CTAs ──► SMs, L1s, network, L2, DRAM ──► cycles, counters
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cachesim.addressing import addressing
from cachesim.coalesce import groups_of, placement_of, program_of
from cachesim.config import L1, Gpu
from cachesim.counts import ACCESSES, CountedLevel
from cachesim.report import ConservationError, DramCounters
from cachesim.timing import engine, machine, records
from cachesim.timing.feed import Feed
from cachesim.timing.outcome import Snapshot, dirty_sectors, passes_of, raw_counters
from cachesim.timing.results import PassTiming, TimingResult
from cachesim.timing.room import with_more_room
from traces.errors import WorkError
from traces.texture import MAX_MIPS
from traces.trace import Chunk, Launch, Trace

#: Cycles between two calls of a progress function.
_PAUSE = 1 << 18
#: Cycles between two samples of a timeline's counters.
_SAMPLE = 256


class Timeline(Protocol):
    """What a clock tells a timeline, in core cycles."""

    def event(
        self, name: str, category: str, start_cycle: int, duration_cycles: int, track: str
    ) -> None:
        """Something that took a while."""

    def counter(self, name: str, cycle: int, value: float) -> None:
        """A value from this cycle on."""


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
        timeline: Timeline | None = None,
        on_cycle: Callable[[int], None] = lambda cycle: None,
    ) -> None:
        """timeline: told each launch. on_cycle: called now and then with the present cycle.

        Raises:
            InputError: unknown fetch path or layout, a trace or a GPU that timing cannot run.
        """
        self._trace, self._gpu = trace, gpu
        self.fetch_path, self.layout, address_map = addressing(
            trace, gpu, fetch_path, layout, layouts
        )
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
        self._timeline = timeline
        self._shown: dict[str, int] = {}
        self._timings = {"coalesce": 0.0, "clock": 0.0}
        self._launch = -1
        self._padding = int(trace.manifest.get("padding_warps", 0))
        self._before: Snapshot | None = None
        self.launches: list[PassTiming] = []

    @property
    def lane_fetches(self) -> npt.NDArray[np.int64]:
        """(groups,) lane fetches coalesced so far."""
        return self._feed.lane_fetches

    @property
    def num_lane_fetches(self) -> int:
        """Lane fetches coalesced so far."""
        return int(self._feed.lane_fetches.sum())

    @property
    def timings(self) -> dict[str, float]:
        """Host seconds per stage."""
        return dict(self._timings)

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
        start = time.thread_time()
        self.state = self._feed.add(self.state, chunk)
        self._timings["coalesce"] += time.thread_time() - start
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
        if self._timeline is not None:
            self._show_launch(launch, self._before.now, self.launches[-1])
        self._launch = -1

    def _show_launch(self, launch: Launch, start: int, done: PassTiming) -> None:
        """One launch on the timeline, and where its cycles went."""
        assert self._timeline is not None
        name = f"{launch.pass_name} (frame {launch.frame})"
        run = start + done.launch_cycles
        self._timeline.event("launch", "launch", start, done.launch_cycles, "kernels")
        self._timeline.event(
            name, launch.pass_name, run, done.cycles - done.launch_cycles, "kernels"
        )

    def _show_progress(self) -> None:
        """Issued instructions and traffic per cycle since the last sample."""
        assert self._timeline is not None
        state, now = self.state, self.cycles
        machine_now = state.pool.machine[0]
        seen = {
            "cycle": now,
            "instructions per cycle": int(state.issued.sum()),
            "L1 sectors per cycle": int(state.l1.counters[:, ACCESSES].sum()),
            "L2 sectors per cycle": int(state.l2.counters[:, ACCESSES].sum()),
            "DRAM sectors per cycle": int(machine_now["dram_reads"] + machine_now["dram_writes"]),
        }
        before, self._shown = self._shown, seen
        cycles = now - before.get("cycle", 0)
        if cycles > 0:
            for name, value in seen.items():
                if name != "cycle":
                    rate = (value - before.get(name, 0)) / cycles
                    self._timeline.counter(name, now - cycles, rate)
            resident = int(state.sms["num_resident"].sum())
            self._timeline.counter("resident warps", now, resident)

    def _close_accounts(self) -> None:
        """Book the cycles that sleeping SMs have not booked yet."""
        now = self.cycles
        state = self.state
        schedulers = int(state.pool.machine[0]["num_schedulers"])
        for sm in state.sms:
            slept = now - 1 - int(sm["last_step"])
            np.add.at(state.reasons, sm["stall"][:schedulers], slept)
            sm["last_step"] = now - 1
            sm["stall"] = records.R_IDLE

    def _run(self) -> None:
        while True:
            pause = _SAMPLE if self._timeline is not None else _PAUSE
            start = time.thread_time()
            why = engine.run(self.state, self.cycles + pause)
            self._timings["clock"] += time.thread_time() - start
            if self._timeline is not None:
                self._show_progress()
            if why in (engine.DONE, engine.NEEDS_CTAS):
                return
            if why == engine.NEEDS_ROOM:
                self.state = with_more_room(self.state)
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
            for side, ports in (
                ("in", net.inputs),
                ("out", net.outputs),
            ):
                if ports["count"].sum():
                    found.append(f"{name} {side} {int(ports['count'].sum())}")
        pipes = state.pipes
        for name, counts in (
            ("l1 banks", pipes["in_banks"]),
            ("texture fragments", pipes["fragment_count"]),
            ("texture requests", pipes["request_count"]),
            ("memory instructions", state.sms["queue_count"].sum(axis=1)),
            ("replies at SMs", state.sms["eject_count"]),
            ("load/store responses", pipes["response_count"]),
        ):
            if counts.sum():
                found.append(f"{name} {int(counts.sum())} (instance {int(counts.argmax())})")
        channels = state.memory.channels
        held = channels["pending"] + channels["num_serving"]
        for part in ("latency", "entry", "data", "return"):
            held = held + channels[f"{part}_count"]
        if held.sum():
            found.append(f"dram {int(held.sum())} (channel {int(held.argmax())})")
        blocked = sum(int(mask).bit_count() for mask in state.sms["blocked"])
        return f"cycle {self.cycles}, {blocked} warps wait; " + (
            "; ".join(found) or "all queues empty"
        )

    def drain(self) -> int:
        """Let what is on its way to memory arrive. Returns the requests left: 0 if all is well."""
        for _ in range(64):
            if self.state.pool.machine[0]["in_flight"] == 0:
                break
            self.state.pool.machine[0]["live_ctas"] = 1
            engine.run(self.state, self.cycles + 4096)
        self.state.pool.machine[0]["live_ctas"] = 0
        return int(self.state.pool.machine[0]["in_flight"])

    def counted_levels(self) -> list[CountedLevel]:
        """The levels' counters, L1 first."""
        state, gpu = self.state, self._gpu
        present = [("l1", state.l1), ("l2", state.l2)]
        if gpu.gl1 is not None:
            present.insert(1, ("gl1", state.gl1))
        if gpu.llc is not None:
            present.append(("llc", state.llc))
        return [
            CountedLevel(
                name,
                1 << int(tags.level[0]["sector_shift"]),
                tags.counters,
                dirty_sectors(tags, self.num_groups),
                None,
            )
            for name, tags in present
        ]

    def timing_result(self) -> TimingResult:
        """Cycles per pass: the launches of one pass are summed, in order of first launch."""
        passes: dict[str, PassTiming] = {}
        for one in self.launches:
            passes[one.name] = passes[one.name] + one if one.name in passes else one
        return TimingResult(self._gpu.clock_hz, tuple(passes.values()), self.raw())

    def check(self, dram: DramCounters) -> None:
        """Hold the machine to its laws once the trace is done: nothing is in flight after it was
        drained, and memory moved what the last cache passed down.

        Raises:
            ConservationError: one does not hold.
        """
        left = self.drain()
        if left:
            raise ConservationError(f"law broken: {left} requests left: {self.describe_stuck()}")
        state = self.state.pool.machine[0]
        moved = int(state["dram_reads"]), int(state["dram_writes"])
        told = dram.sectors_read, dram.sectors_written
        if moved != told:
            raise ConservationError(
                f"law broken: memory moved {moved} sectors (read, written), the last cache passed "
                f"down {told}"
            )

    def close(self) -> None:
        """Nothing to end: the clock has no threads."""

    def raw(self) -> dict[str, dict[str, int]]:
        """GPGPU-Sim's own counters."""
        return raw_counters(self.state, self.launches)
