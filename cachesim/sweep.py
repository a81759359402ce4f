"""Sweep: one trace counted over a grid of configurations, a few at a time, on all cores.

    axes ──► grid of checked GPUs ──► batches ──► a pass over the trace each ──► rows in grid order

A trace in a file is opened by every worker process anew. A trace in memory, or a live recording, is
read by this process, once per batch, with the batch's GPUs side by side in threads.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import pandas as pd

from cachesim import presets
from cachesim.addressing import FETCH_PATHS
from cachesim.config import Gpu
from cachesim.dispatch import resident_ctas
from cachesim.report import Report
from cachesim.simulate import simulate_all
from traces.errors import InputError, WorkError, unknown
from traces.layout import layout_function
from traces.open import open_trace
from traces.trace import Trace

#: GPUs per pass: the trace is decoded once for all of them.
POINTS_PER_PASS = 4

Row = dict[str, Any]
Batch = list[tuple[int, Gpu]]


def sweep(
    trace: str | Path | Trace,
    gpu: Gpu | str,
    axes: Mapping[str, Sequence[Any]],
    *,
    fetch_path: str | None = None,
    layout: str | None = None,
    num_workers: int | None = None,
    progress: Callable[[int], None] | None = None,
    on_row: Callable[[Row], None] | None = None,
) -> pd.DataFrame:
    """Count a trace on every point of a grid of configurations.

    Args:
        trace: a file (what many cores are best used with), or a Trace.
        gpu: the machine that the axes vary, or the name of a preset.
        axes: field path -> values, as `presets.with_fields` takes them:
            {"l1.capacity": [16384, 32768], "l1.ways": [4, 8]}.
        fetch_path, layout: as in `simulate`.
        num_workers: processes (threads for a Trace); None takes all cores. With 1 everything runs
            in this process. A script that uses more needs the usual `if __name__ == "__main__":`,
            as worker processes import the main module.
        progress: called with the number of points done.
        on_row: called with each row when it is done, in any order; what it kept is what an
            interrupted sweep leaves.

    Returns:
        One row per point, in grid order, the last axis fastest: the axes' columns, then the
        counters of each level ("l1.accesses", "l1.miss_rate", ...), "dram.*" and "demand.*". A
        level that a point lacks is NaN there.

    Raises:
        InputError: before any work starts, for an axis without values, an unknown field, or a
            point whose values do not fit together or cannot hold the trace's CTAs, which it names;
            and what reading the trace raises.
        WorkError: a worker process died.
        KeyboardInterrupt: after the workers have stopped.
    """
    if fetch_path is not None and fetch_path not in FETCH_PATHS:
        raise unknown("fetch path", fetch_path, FETCH_PATHS)
    if layout is not None:
        layout_function(layout)
    if num_workers is not None and num_workers < 1:
        raise InputError(f"num_workers = {num_workers}: allowed are 1 and up")
    workers = num_workers or os.cpu_count() or 1
    points = grid(gpu, axes)
    opened = trace if isinstance(trace, Trace) else open_trace(trace)
    _check_occupancy(points, opened)
    rows: dict[int, Row] = {}

    def done(results: list[tuple[int, Report]]) -> None:
        for index, report in results:
            rows[index] = points[index][0] | flat_counters(report)
            if on_row is not None:
                on_row(rows[index])
        if progress is not None:
            progress(len(rows))

    for results in _counted(trace, opened, points, workers, fetch_path, layout):
        done(results)
    return pd.DataFrame([rows[index] for index in range(len(points))])


def grid(gpu: Gpu | str, axes: Mapping[str, Sequence[Any]]) -> list[tuple[Row, Gpu]]:
    """The points of a sweep, in grid order: values by axis, and the checked GPU.

    Raises:
        InputError: as `sweep`.
    """
    base = presets.load(gpu) if isinstance(gpu, str) else gpu
    for field, values in axes.items():
        if not len(values):
            raise InputError(f"axis {field!r}: no values; allowed are one and more")
    points = (dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values()))
    return [(point, presets.with_fields(base, point)) for point in points]


def flat_counters(report: Report) -> Row:
    """A report as one row: "l1.accesses" and so on for all levels, then "dram.*" and "demand.*"."""
    sections: dict[str, Mapping[str, Any]] = {
        **{name: report.level_json(name) for name in report.levels},
        "dram": report.dram.to_json(),
        "demand": report.demand,
    }
    return {f"{name}.{key}": v for name, section in sections.items() for key, v in section.items()}


def _check_occupancy(points: list[tuple[Row, Gpu]], trace: Trace) -> None:
    """Every launch known so far must fit every point's SMs."""
    for point, gpu in points:
        for launch in trace.launches:
            try:
                resident_ctas(gpu.sm, launch)
            except InputError as error:
                told = ", ".join(f"{field}={value}" for field, value in point.items())
                raise InputError(f"{gpu.name} with {told}: {error}") from None


def _counted(
    trace: str | Path | Trace,
    opened: Trace,
    points: list[tuple[Row, Gpu]],
    workers: int,
    fetch_path: str | None,
    layout: str | None,
) -> Iterator[list[tuple[int, Report]]]:
    """The reports of the points, batch by batch as they are done."""
    numbered = list(enumerate(gpu for _, gpu in points))
    in_process = isinstance(trace, Trace) or workers == 1
    share = workers if in_process else -(-len(numbered) // workers)
    size = max(POINTS_PER_PASS, share) if in_process else min(POINTS_PER_PASS, share)
    batches = [numbered[k : k + size] for k in range(0, len(numbered), size)]
    if in_process or len(batches) == 1:
        for batch in batches:
            yield _count(batch, opened, fetch_path, layout, threaded=workers > 1)
    else:
        assert not isinstance(trace, Trace)
        yield from _count_in_processes(
            batches, trace, min(workers, len(batches)), fetch_path, layout
        )


def _count(
    batch: Batch,
    trace: Trace,
    fetch_path: str | None,
    layout: str | None,
    *,
    threaded: bool,
    progress: Callable[[int], None] | None = None,
) -> list[tuple[int, Report]]:
    """Count one batch in one pass over the trace."""
    gpus = [gpu for _, gpu in batch]
    reports = simulate_all(
        trace, gpus, fetch_path=fetch_path, layout=layout, threaded=threaded, progress=progress
    )
    return [(index, report) for (index, _), report in zip(batch, reports, strict=True)]


def _count_in_processes(
    batches: list[Batch],
    path: str | Path,
    workers: int,
    fetch_path: str | None,
    layout: str | None,
) -> Iterator[list[tuple[int, Report]]]:
    """Count batches in worker processes; an interrupt, or an error of one, stops them all first."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with ProcessPoolExecutor(
        workers, context, _start_worker, (str(path), fetch_path, layout, stop)
    ) as pool:
        try:
            with _interrupts_held():
                futures: list[Future[list[tuple[int, Report]]]] = [
                    pool.submit(_count_in_worker, batch) for batch in batches
                ]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool as error:
            raise WorkError("sweep: a worker process died, for want of memory perhaps") from error
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back for a moment.

    Processes started meanwhile inherit that and never see it; this process does after.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Stopped(Exception):
    """The sweep was interrupted."""


# What `_start_worker` leaves to the tasks of its process: trace, fetch path, layout, stop event.
_worker: tuple[Trace, str | None, str | None, Event] | None = None


def _start_worker(path: str, fetch_path: str | None, layout: str | None, stop: Event) -> None:
    global _worker
    _worker = open_trace(path), fetch_path, layout, stop


def _count_in_worker(batch: Batch) -> list[tuple[int, Report]]:
    assert _worker is not None
    trace, fetch_path, layout, stop = _worker

    def check(_: int) -> None:
        if stop.is_set():
            raise _Stopped

    return _count(batch, trace, fetch_path, layout, threaded=False, progress=check)
