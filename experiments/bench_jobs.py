"""One measurement of `cachesim bench`, run as a process of its own: a JSON line on stdout.

Run: python -m experiments.bench_jobs stream|pipeline|file SCENE METHOD WxH GPU [DEVICE]
"""

from __future__ import annotations

import dataclasses
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cachesim import Report, presets, simulate
from cachesim.first_use import compile_loops
from experiments.bench import row_name
from experiments.options import parse_image_size
from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.opencl.device import open_device
from kernels.record import record
from kernels.scene import load_scene
from traces.parquet import write_parquet
from traces.synthetic import scatter
from traces.trace import Chunk, Trace, from_chunks

NUM_FRAMES = 8
#: Runs of the counted stream; the median counts.
NUM_RUNS = 3


def timed(trace: Trace) -> tuple[Trace, dict[str, float]]:
    """The trace, and a dictionary that gathers the seconds spent waiting for its chunks."""
    seconds = {"waiting for chunks": 0.0}

    def chunks() -> Iterator[Chunk]:
        source = trace.chunks()
        while True:
            start = time.perf_counter()
            chunk = next(source, None)
            seconds["waiting for chunks"] += time.perf_counter() - start
            if chunk is None:
                return
            yield chunk

    return dataclasses.replace(trace, source=chunks), seconds


def measure_stream(gbuffer: GBuffer, method: Method, gpu: str) -> dict[str, Any]:
    """Counting alone: the chunks are held in memory and the stages run one after the other."""
    live = record(gbuffer, method)
    held = from_chunks(
        [dataclasses.replace(c, lanes=c.lanes.copy()) for c in live.chunks()],
        live.textures,
        live.instructions,
        live.launches,
    )
    compile_loops()
    reports = [simulate(held, gpu, threaded=False) for _ in range(NUM_RUNS)]
    report = sorted(reports, key=_counting_s)[NUM_RUNS // 2]
    counting = _counting_s(report)
    return _row(report, counting, counting) | {"stages": dict(report.timings)}


def _counting_s(report: Report) -> float:
    """Host seconds of counting: L1, L2 and the way between them."""
    return sum(s for name, s in report.timings.items() if name in ("l1", "route", "l2"))


def measure_pipeline(gbuffer: GBuffer, method: Method, gpu: str) -> dict[str, Any]:
    """Recording and counting in one go."""
    compile_loops()
    start = time.perf_counter()
    trace, waiting = timed(record(gbuffer, method, num_frames=NUM_FRAMES if method.adaptive else 1))
    report = simulate(trace, gpu)
    seconds = time.perf_counter() - start
    return _row(report, seconds) | {"stages": waiting | dict(report.timings)}


def measure_file(gbuffer: GBuffer, method: Method, gpu: str) -> dict[str, Any]:
    """Recording to a file, in the system's folder for temporary files."""
    del gpu
    num_fetches = 0

    def count(done: int) -> None:
        nonlocal num_fetches
        num_fetches = done

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.parquet"
        start = time.perf_counter()
        trace, waiting = timed(record(gbuffer, method))
        write_parquet(trace, path, progress=count)
        seconds = time.perf_counter() - start
        size_bytes = path.stat().st_size
    rest = seconds - sum(waiting.values())
    return {
        "lane_fetches_m": num_fetches / 1e6,
        "seconds": seconds,
        "bytes_per_fetch": size_bytes / num_fetches,
        "stages": waiting | {"encoding and writing": rest},
    }


def _row(report: Report, seconds: float, counting: float | None = None) -> dict[str, Any]:
    requests = report.counters["l1"].requests
    return {
        "lane_fetches_m": report.lane_fetches / 1e6,
        "seconds": seconds,
        "requests_m_per_s": requests / counting / 1e6 if counting else None,
    }


JOBS: dict[str, Callable[[GBuffer, Method, str], dict[str, Any]]] = {
    "stream": measure_stream,
    "pipeline": measure_pipeline,
    "file": measure_file,
}


def main(job: str, scene: str, method: str, size: str, gpu: str, device: str = "") -> None:
    """Run one job and print its row and stages."""
    width, height = parse_image_size(size)
    # Compile before the clock starts: a first run would measure numba.
    simulate(scatter(64, 64, 4.0, 2), presets.load(gpu))
    gbuffer = load_scene(scene, width, height, device=open_device(device or None))
    found = JOBS[job](gbuffer, Method(kind=method), gpu)
    stages = [{"stage": name, "seconds": s} for name, s in found.pop("stages").items()]
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    row = {"measured": row_name(job, scene, method, size), **found, "peak_gib": peak_kib / 2**20}
    print(json.dumps({"row": row, "stages": stages}))


if __name__ == "__main__":
    main(*sys.argv[1:])
