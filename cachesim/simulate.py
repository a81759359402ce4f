"""Simulate: a trace and a GPU in, a `Report` out.

trace ──► place texels ──► dispatch ──► coalesce ──► L1 ──► L2 ──► DRAM ──► report
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from cachesim import cache, presets
from cachesim.config import Gpu
from cachesim.level import Level
from cachesim.report import DramCounters, LevelCounters, Part, Report
from cachesim.stages import Stages
from traces.texture import MAX_MIPS
from traces.trace import Trace

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
        Stages(trace, gpu, fetch_path, layout, layouts, threaded=threaded and alone)
        for gpu in chosen
    ]
    try:
        with ThreadPoolExecutor(len(models) if threaded and not alone else 1) as pool:
            for chunk in trace.chunks():
                list(pool.map(lambda m, c=chunk: m.add(c), models))
                if progress is not None:
                    progress(models[0].num_lane_fetches)
            list(pool.map(Stages.finish, models))
            reports = [_report(trace, g, m) for g, m in zip(chosen, models, strict=True)]
            if progress is not None:
                progress(reports[0].lane_fetches)
            return reports
    finally:
        for model in models:
            model.close()


def _report(trace: Trace, gpu: Gpu, stages: Stages) -> Report:
    """The checked report of finished stages."""
    hierarchy = stages.hierarchy
    levels = hierarchy.levels
    dirty = [level.dirty_by_group(len(hierarchy.lane_fetches)) for level in levels]
    parts = []
    for pair, (pass_name, texture) in enumerate(stages.pairs):
        if texture < 0:
            continue
        for mip in range(trace.textures[texture].num_mips):
            group = pair * MAX_MIPS + mip
            counters = {
                level.name: _counters(level, slice(group, group + 1), int(dirty[k][group]))
                for k, level in enumerate(levels)
            }
            fetches = int(hierarchy.lane_fetches[group])
            name = trace.textures[texture].name
            part = Part(pass_name, name, mip, fetches, counters, _dram(gpu, counters))
            if fetches or any(c.presented or c.writebacks for c in counters.values()):
                parts.append(part)
    counters = {
        level.name: _counters(level, slice(None), int(dirty[k].sum()))
        for k, level in enumerate(levels)
    }
    manifest = trace.manifest
    report = Report(
        gpu=gpu.name,
        trace={k: manifest[k] for k in _IDENTIFYING if k in manifest},
        fetch_path=stages.fetch_path,
        layout=stages.layout,
        num_rows=hierarchy.num_rows,
        lane_fetches=int(hierarchy.lane_fetches.sum()),
        counters=counters,
        dram=_dram(gpu, counters),
        parts=None if trace.is_lane_address else tuple(parts),
        distinct_sectors={
            level.name: level.num_distinct
            for level in levels
            if level.num_distinct is not None and not level.counters[:, cache.BYPASSES].any()
        },
        timings=dict(hierarchy.timings),
    )
    report.check()
    return report


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
