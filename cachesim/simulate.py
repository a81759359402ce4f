"""Simulate: a trace and a GPU in, a `Report` out.

trace ──► place texels ──► dispatch ──► coalesce ──► L1 ──► L2 ──► DRAM ──► report
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cachesim import cache, presets
from cachesim.coalesce import groups_of, placement_of, program_of
from cachesim.config import L1, FetchPath, Gpu
from cachesim.dispatch import Dispatcher
from cachesim.hierarchy import BATCH_ROWS, Hierarchy
from cachesim.level import Level
from cachesim.report import DramCounters, LevelCounters, Part, Report
from traces.errors import unknown
from traces.placement import place
from traces.texture import MAX_MIPS
from traces.trace import Chunk, Trace

FETCH_PATHS: tuple[FetchPath, ...] = ("texture", "readonly", "global")
Progress = Callable[[int], None]

#: What of a trace's manifest a report repeats.
_IDENTIFYING = (
    "name", "scene", "attribution", "width", "height", "method", "num_frames", "traced_frames",
    "seed", "device", "differing_fetches",
)  # fmt: skip


def simulate(
    trace: Trace,
    gpu: Gpu | str,
    *,
    fetch_path: str | None = None,
    layout: str | None = None,
    layouts: Mapping[str, str] | None = None,
    threaded: bool = True,
    progress: Progress | None = None,
) -> Report:
    """Count what a trace asks of a GPU's caches and memory.

    Args: trace: recorded, read from a file, imported or synthetic. gpu: a configuration or the name
        of a preset. fetch_path: "texture", "readonly" or "global"; None takes "texture", or for a
        lane-address trace the GPU's own default. layout: texel layout; None takes the GPU's.
        layouts: other layouts for single textures, by name. threaded: run the stages side by side;
        the result is the same. progress: called with the number of lane fetches counted so far.

    Raises:
        InputError: unknown GPU, fetch path or layout, or a trace that does not fit.
        ConservationError: a law of the report is broken.
    """
    return simulate_all(
        trace,
        [gpu],
        fetch_path=fetch_path,
        layout=layout,
        layouts=layouts,
        threaded=threaded,
        progress=progress,
    )[0]


def simulate_all(
    trace: Trace,
    gpus: Sequence[Gpu | str],
    *,
    fetch_path: str | None = None,
    layout: str | None = None,
    layouts: Mapping[str, str] | None = None,
    threaded: bool = True,
    progress: Progress | None = None,
) -> list[Report]:
    """`simulate` for several GPUs in one pass over the trace's chunks, so that a live recording
    renders once.
    """
    chosen = [presets.load(g) if isinstance(g, str) else g for g in gpus]
    alone = len(chosen) == 1
    models = [
        _Model(trace, gpu, fetch_path, layout, layouts or {}, threaded=threaded and alone)
        for gpu in chosen
    ]
    try:
        with ThreadPoolExecutor(len(models) if threaded and not alone else 1) as pool:
            for chunk in trace.chunks():
                list(pool.map(lambda m, c=chunk: m.add(c), models))
                if progress is not None:
                    progress(models[0].num_lane_fetches)
            reports = list(pool.map(_Model.finish, models))
            if progress is not None:
                progress(reports[0].lane_fetches)
            return reports
    finally:
        for model in models:
            model.close()


class _Model:
    """One GPU's way through the stages."""

    def __init__(
        self,
        trace: Trace,
        gpu: Gpu,
        fetch_path: str | None,
        layout: str | None,
        layouts: Mapping[str, str],
        *,
        threaded: bool,
    ) -> None:
        self._trace, self._gpu = trace, gpu
        default = gpu.lane_address_path if trace.is_lane_address else "texture"
        self._fetch_path = fetch_path or default
        if self._fetch_path not in FETCH_PATHS:
            raise unknown("fetch path", self._fetch_path, FETCH_PATHS)
        self._layout = None if trace.is_lane_address else layout or gpu.texture_layout
        address_map = (
            place(trace.textures, self._layout, overrides=layouts) if self._layout else None
        )
        self._pairs = groups_of(trace)
        num_groups = max(1, len(self._pairs)) * MAX_MIPS
        byte_range = (
            (address_map.base_address, address_map.footprint_bytes) if address_map else None
        )
        levels, units = hierarchy_levels(gpu, self._fetch_path, num_groups, byte_range)
        lanes_dtype = np.uint64 if trace.is_lane_address else np.uint32
        self._dispatcher = Dispatcher(gpu.sm, units[0], lanes_dtype, BATCH_ROWS)
        self._hierarchy = Hierarchy(
            levels,
            [1, *(u for u in units[1:])],
            program_of(trace),
            placement_of(address_map),
            warp_size=gpu.sm.warp_size,
            texel_range=(address_map.base_address, address_map.footprint_bytes)
            if address_map
            else None,
            num_groups=num_groups,
            threaded=threaded,
        )
        self._launch = -1

    @property
    def num_lane_fetches(self) -> int:
        return int(self._hierarchy.lane_fetches.sum())

    def add(self, chunk: Chunk) -> None:
        """Queue a chunk's CTAs, and count what can issue."""
        if chunk.launch != self._launch:
            self._end_launch()
            self._launch = chunk.launch
            self._dispatcher.begin(self._trace.launches[chunk.launch])
        self._dispatcher.add(chunk)
        self._issue()

    def finish(self) -> Report:
        """Count what is left; the checked report."""
        self._end_launch()
        report = self._report()
        report.check()
        return report

    def close(self) -> None:
        self._hierarchy.close()

    def _issue(self) -> None:
        while (rows := self._dispatcher.issue()) is not None:
            self._hierarchy.process(rows)

    def _end_launch(self) -> None:
        if self._launch >= 0:
            self._dispatcher.finish()
            self._issue()
            self._hierarchy.end_launch()

    def _report(self) -> Report:
        hierarchy, gpu = self._hierarchy, self._gpu
        levels = hierarchy.levels
        dirty = [level.dirty_by_group(len(hierarchy.lane_fetches)) for level in levels]
        parts = []
        for pair, (pass_name, texture) in enumerate(self._pairs):
            if texture < 0:
                continue
            for mip in range(self._trace.textures[texture].num_mips):
                group = pair * MAX_MIPS + mip
                counters = {
                    level.name: _counters(level, slice(group, group + 1), int(dirty[k][group]))
                    for k, level in enumerate(levels)
                }
                fetches = int(hierarchy.lane_fetches[group])
                name = self._trace.textures[texture].name
                part = Part(pass_name, name, mip, fetches, counters, _dram(gpu, counters))
                if fetches or any(c.presented or c.writebacks for c in counters.values()):
                    parts.append(part)
        counters = {
            level.name: _counters(level, slice(None), int(dirty[k].sum()))
            for k, level in enumerate(levels)
        }
        manifest = self._trace.manifest
        return Report(
            gpu=gpu.name,
            trace={k: manifest[k] for k in _IDENTIFYING if k in manifest},
            fetch_path=self._fetch_path,
            layout=self._layout,
            num_rows=hierarchy.num_rows,
            lane_fetches=int(hierarchy.lane_fetches.sum()),
            counters=counters,
            dram=_dram(gpu, counters),
            parts=None if self._trace.is_lane_address else tuple(parts),
            distinct_sectors={
                level.name: level.num_distinct
                for level in levels
                if level.num_distinct is not None and not level.counters[:, cache.BYPASSES].any()
            },
            timings=dict(hierarchy.timings),
        )


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


def _counters(level: Level, groups: slice, dirty_at_end: int) -> LevelCounters:
    row = level.counters[groups].sum(axis=0)
    return LevelCounters(
        sector_bytes=level.config.sector_bytes,
        requests=int(row[cache.REQUESTS]),
        accesses=int(row[cache.ACCESSES]),
        hits=int(row[cache.HITS]),
        line_misses=int(row[cache.LINE_MISSES]),
        sector_misses=int(row[cache.SECTOR_MISSES]),
        writes=int(row[cache.WRITES]),
        write_misses=int(row[cache.WRITE_MISSES]),
        stores_down=int(row[cache.STORES_DOWN]),
        write_fills=int(row[cache.WRITE_FILLS]),
        bypasses=int(row[cache.BYPASSES]),
        bypassed_writes=int(row[cache.BYPASSED_WRITES]),
        writebacks=int(row[cache.WRITEBACKS]),
        dirty_at_end=dirty_at_end,
    )


def _dram(gpu: Gpu, counters: dict[str, LevelCounters]) -> DramCounters:
    """What the last level passes down, in DRAM's sectors."""
    last = list(counters.values())[-1]
    atoms = last.sector_bytes // gpu.dram.sector_bytes
    return DramCounters(gpu.dram.sector_bytes, last.reads_down * atoms, last.writes_down * atoms)
