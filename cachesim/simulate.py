"""Simulate: a trace and a GPU in, a `Report` out.

trace ──► place texels ──► dispatch ──► coalesce ──► L1 ──► L2 ──► DRAM ──► report
                └──► with timing: the same machine with a clock (`cachesim.timing`) ──►┘
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from cachesim import counts, presets
from cachesim.config import Gpu
from cachesim.counts import CountedLevel
from cachesim.report import DramCounters, LevelCounters, Part, Report
from cachesim.stages import Stages
from cachesim.timing.clock import Clock, Timeline
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
    timing: bool = False,
    timeline: Timeline | None = None,
) -> Report:
    """Count what a trace asks of a GPU's caches and memory, and with `timing` how long it takes.

    Args: trace: recorded, read from a file, imported or synthetic. gpu: a configuration or the name
        of a preset. fetch_path: "texture", "readonly" or "global"; None takes "texture", or for a
        lane-address trace the GPU's own default. layout: texel layout; None takes the GPU's.
        layouts: other layouts for single textures, by name. threaded: run the stages side by side;
        the result is the same. progress: called with the number of lane fetches counted so far.
        timing: run the machine cycle by cycle; the accesses are the same, what hits is not.
        timeline: told each launch and what went on in it (with `timing`).

    Raises:
        InputError: unknown GPU, fetch path or layout, a trace that does not fit, or a GPU without
            the timing tables.
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
        timing=timing,
        timeline=timeline,
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
    timing: bool | Sequence[bool] = False,
    timeline: Timeline | None = None,
) -> list[Report]:
    """`simulate` for several GPUs in one pass over the trace's chunks, so that a live recording
    renders once. timing: for all, or one value per GPU. timeline: of the first timed GPU.
    """
    chosen = [presets.load(g) if isinstance(g, str) else g for g in gpus]
    timed = [timing] * len(chosen) if isinstance(timing, bool) else list(timing)
    alone = len(chosen) == 1
    models: list[Stages | Clock] = []
    for gpu, with_clock in zip(chosen, timed, strict=True):
        if with_clock:
            shown, timeline = timeline, None
            models.append(Clock(trace, gpu, fetch_path, layout, layouts, timeline=shown))
        else:
            models.append(
                Stages(trace, gpu, fetch_path, layout, layouts, threaded=threaded and alone)
            )
    try:
        with ThreadPoolExecutor(len(models) if threaded and not alone else 1) as pool:
            for chunk in trace.chunks():
                list(pool.map(lambda m, c=chunk: m.add(c), models))
                if progress is not None:
                    progress(models[0].num_lane_fetches)
            list(pool.map(lambda m: m.finish(), models))
            reports = [_report(trace, g, m) for g, m in zip(chosen, models, strict=True)]
            if progress is not None:
                progress(reports[0].lane_fetches)
            return reports
    finally:
        for model in models:
            model.close()


def _report(trace: Trace, gpu: Gpu, model: Stages | Clock) -> Report:
    """The checked report of a finished model."""
    if isinstance(model, Clock):
        model.drain()
    levels = model.counted_levels()
    parts = []
    for pair, (pass_name, texture) in enumerate(model.pairs):
        if texture < 0:
            continue
        for mip in range(trace.textures[texture].num_mips):
            group = pair * MAX_MIPS + mip
            counters = {level.name: _counters(level, slice(group, group + 1)) for level in levels}
            fetches = int(model.lane_fetches[group])
            name = trace.textures[texture].name
            part = Part(pass_name, name, mip, fetches, counters, _dram(gpu, counters))
            if fetches or any(c.presented or c.writebacks for c in counters.values()):
                parts.append(part)
    counters = {level.name: _counters(level, slice(None)) for level in levels}
    manifest = trace.manifest
    report = Report(
        gpu=gpu.name,
        trace={k: manifest[k] for k in _IDENTIFYING if k in manifest},
        fetch_path=model.fetch_path,
        layout=model.layout,
        num_rows=model.num_rows,
        lane_fetches=model.num_lane_fetches,
        counters=counters,
        dram=_dram(gpu, counters),
        parts=None if trace.is_lane_address else tuple(parts),
        distinct_sectors={
            level.name: level.num_distinct
            for level in levels
            if level.num_distinct is not None and not level.counters[:, counts.BYPASSES].any()
        },
        timing=model.timing_result() if isinstance(model, Clock) else None,
        timings=model.timings,
    )
    report.check()
    if isinstance(model, Clock):
        model.check(report.dram)
    return report


def _counters(level: CountedLevel, groups: slice) -> LevelCounters:
    row = level.counters[groups].sum(axis=0)
    return LevelCounters(
        sector_bytes=level.sector_bytes,
        requests=int(row[counts.REQUESTS]),
        accesses=int(row[counts.ACCESSES]),
        hits=int(row[counts.HITS]),
        line_misses=int(row[counts.LINE_MISSES]),
        sector_misses=int(row[counts.SECTOR_MISSES]),
        merged=int(row[counts.MERGED]),
        writes=int(row[counts.WRITES]),
        write_misses=int(row[counts.WRITE_MISSES]),
        stores_down=int(row[counts.STORES_DOWN]),
        write_fills=int(row[counts.WRITE_FILLS]),
        bypasses=int(row[counts.BYPASSES]),
        bypassed_writes=int(row[counts.BYPASSED_WRITES]),
        writebacks=int(row[counts.WRITEBACKS]),
        dirty_at_end=int(level.dirty[groups].sum()),
    )


def _dram(gpu: Gpu, counters: dict[str, LevelCounters]) -> DramCounters:
    """What the last level passes down, in DRAM's sectors."""
    last = list(counters.values())[-1]
    atoms = last.sector_bytes // gpu.dram.sector_bytes
    return DramCounters(gpu.dram.sector_bytes, last.reads_down * atoms, last.writes_down * atoms)
