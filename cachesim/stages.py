"""The stages between a trace and the counters of one GPU, for whoever drives them.

trace ──► place texels ──► dispatch ──► coalesce ──► L1 ──► L2 ──► DRAM
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from cachesim.addressing import addressing
from cachesim.coalesce import groups_of, placement_of, program_of
from cachesim.config import L1, Gpu
from cachesim.counts import CountedLevel
from cachesim.dispatch import Dispatcher
from cachesim.hierarchy import BATCH_ROWS, Hierarchy
from cachesim.level import Level
from traces.texture import MAX_MIPS
from traces.trace import Chunk, Trace


class Stages:
    """One trace's way through one GPU: chunks are added in order, then it is finished.

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
        threaded: bool = True,
        levels_of: Callable[[list[Level]], list[Level]] = lambda levels: levels,
        at_launch_end: Callable[[], None] = lambda: None,
    ) -> None:
        """levels_of: the levels to use instead of the GPU's, L1 first. at_launch_end: called
        when a launch has passed every level.

        Raises:
            InputError: unknown fetch path or layout, or a trace that does not fit.
        """
        self._trace = trace
        self.fetch_path, self.layout, address_map = addressing(
            trace, gpu, fetch_path, layout, layouts
        )
        byte_range = (
            (address_map.base_address, address_map.footprint_bytes) if address_map else None
        )
        self.pairs = groups_of(trace)
        num_groups = max(1, len(self.pairs)) * MAX_MIPS
        levels, units = hierarchy_levels(gpu, self.fetch_path, num_groups, byte_range)
        levels = levels_of(levels)
        lanes_dtype = np.uint64 if trace.is_lane_address else np.uint32
        self._dispatcher = Dispatcher(gpu.sm, units[0], lanes_dtype, BATCH_ROWS)
        self.hierarchy = Hierarchy(
            levels,
            [1, *units[1 : len(levels)]],
            program_of(trace),
            placement_of(address_map),
            warp_size=gpu.sm.warp_size,
            texel_range=byte_range,
            num_groups=num_groups,
            threaded=threaded,
        )
        self._at_launch_end = at_launch_end
        self._launch = -1

    @property
    def num_lane_fetches(self) -> int:
        """Lane fetches that have been coalesced so far."""
        return int(self.hierarchy.lane_fetches.sum())

    def add(self, chunk: Chunk) -> None:
        """Queue a chunk's CTAs, and count what can issue."""
        if chunk.launch != self._launch:
            self.finish()
            self._launch = chunk.launch
            self._dispatcher.begin(self._trace.launches[chunk.launch])
        self._dispatcher.add(chunk)
        self._issue()

    def finish(self) -> None:
        """Count what is left of the last launch."""
        if self._launch >= 0:
            self._dispatcher.finish()
            self._issue()
            self.hierarchy.end_launch()
            self._at_launch_end()
            self._launch = -1

    @property
    def lane_fetches(self) -> npt.NDArray[np.int64]:
        """(groups,) lane fetches."""
        return self.hierarchy.lane_fetches

    @property
    def num_rows(self) -> int:
        """Access instructions issued so far."""
        return self.hierarchy.num_rows

    @property
    def timings(self) -> dict[str, float]:
        """Host seconds per stage."""
        return dict(self.hierarchy.timings)

    def counted_levels(self) -> list[CountedLevel]:
        """The levels' counters, L1 first."""
        groups = len(self.lane_fetches)
        return [
            CountedLevel(
                level.name,
                level.config.sector_bytes,
                level.counters,
                level.dirty_by_group(groups),
                level.num_distinct,
            )
            for level in self.hierarchy.levels
        ]

    def close(self) -> None:
        """End the stages' threads."""
        self.hierarchy.close()

    def _issue(self) -> None:
        while (rows := self._dispatcher.issue()) is not None:
            self.hierarchy.process(rows)


def hierarchy_levels(
    gpu: Gpu, fetch_path: str, num_groups: int, byte_range: tuple[int, int] | None = None
) -> tuple[list[Level], list[int]]:
    """The levels of a GPU under a fetch path, and per level how many L1 units share one instance
    (all, where sliced).

    The first entry of the second list is the number of L1 units per SM.
    """
    l1: L1 = gpu.l1_texture if fetch_path == "texture" and gpu.l1_texture is not None else gpu.l1
    skips = fetch_path == "global" and gpu.l1.bypass_loads
    units = gpu.sm.count * l1.units_per_sm
    levels = [
        Level(
            "l1",
            l1,
            units,
            num_groups,
            bypass_loads=skips,
            bypass_stores=skips,
            byte_range=byte_range,
        )
    ]
    sharing = [l1.units_per_sm]
    if gpu.gl1 is not None:
        per_array = gpu.gl1.sms_per_instance
        arrays = -(-gpu.sm.count // per_array)
        levels.append(Level("gl1", gpu.gl1, arrays, num_groups, byte_range=byte_range))
        sharing.append(per_array * l1.units_per_sm)
    for name, config in (("l2", gpu.l2), ("llc", gpu.llc)):
        if config is not None:
            is_last = name == "llc" or gpu.llc is None
            levels.append(
                Level(name, config, 1, num_groups, is_last=is_last, byte_range=byte_range)
            )
            sharing.append(units)
    return levels, sharing
