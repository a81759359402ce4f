"""`cachesim bench`: speed, memory and file size, with the machine they were taken on."""

from __future__ import annotations

import json
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from experiments.options import DeviceName

if TYPE_CHECKING:
    import pandas as pd

    from experiments.tables import Table

GPU = "titan-x-pascal"
SCENES = ("close", "front")
#: Million requests a second per core that the project asks for, fixed 64 with all planes.
ASKED_MREQUESTS = {"close": 40, "front": 60}
#: Frame sizes: of the counted stream, and of the pipeline and the file.
SIZES = {"full": ("960x540", "1920x1080"), "quick": ("320x180", "480x270")}


def command(
    quick: Annotated[bool, typer.Option("--quick", help="Small frames: a smoke test.")] = False,
    device: DeviceName = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="STEM", help="Also STEM.csv, .md, .tex."),
    ] = None,
) -> None:
    """Measure counting speed, the pipeline's time and peak memory, and the file's bytes."""
    import pandas as pd

    from experiments.console import progress, remark
    from experiments.output import output_file
    from experiments.tables import print_table, write_table

    if output is not None:
        output_file(output.with_name(output.name + ".csv"))
    stream_size, pipeline_size = SIZES["quick" if quick else "full"]
    remark(machine_line() + ("; quick: small frames, not the figures to quote" if quick else ""))
    jobs = [("stream", scene, "fixed", stream_size) for scene in SCENES]
    jobs += [("pipeline", "close", method, pipeline_size) for method in ("fixed", "adaptive")]
    jobs += [("file", scene, "fixed", pipeline_size) for scene in SCENES]
    rows, stages = [], []
    with progress("starting", len(jobs)) as bar:
        for job in jobs:
            bar.describe(" ".join(job))
            found = run_job(*job, device)
            rows.append(found["row"])
            stages += [{"measured": row_name(*job), **s} for s in found["stages"]]
            bar.advance()
    table = figures_table(pd.DataFrame(rows))
    print_table(table)
    print_table(stages_table(pd.DataFrame(stages)))
    if output is not None:
        write_table(table, output)


def row_name(job: str, scene: str, method: str, size: str) -> str:
    """A measurement's name in the tables."""
    return f"{job} {scene} {method} {size}"


def machine_line() -> str:
    """The CPU's model, its cores, and the date."""
    import os
    import platform

    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            model = next(s.partition(":")[2].strip() for s in lines if s.startswith("model name"))
    except (OSError, StopIteration):
        pass
    cores = len(os.sched_getaffinity(0))
    return f"{model}, {cores} cores, {datetime.now(UTC):%Y-%m-%d}"


def run_job(
    job: str, scene: str, method: str, size: str, device: str | None = None
) -> dict[str, Any]:
    """Run one measurement in a process of its own, whose peak memory is then its own.

    Raises:
        WorkError: it failed; says the last line of what it wrote.
    """
    from traces.errors import WorkError

    arguments = [job, scene, method, size, GPU, device or ""]
    done = subprocess.run(
        [sys.executable, "-m", "experiments.bench_jobs", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise WorkError(f"bench {' '.join(arguments[:4])}: {last}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def figures_table(frame: pd.DataFrame) -> Table:
    """One row per measurement."""
    from experiments.tables import Column, Table

    columns = (
        Column("measured", "measured"),
        Column("lane_fetches_m", "fetches M", ",.1f"),
        Column("seconds", "s", ".2f"),
        Column("requests_m_per_s", "M requests/s, one core", ".1f"),
        Column("peak_gib", "peak GiB", ".2f"),
        Column("bytes_per_fetch", "B per fetch", ".3f"),
    )
    notes = (
        machine_line(),
        f"stream: L1 and L2 counting on {GPU} of a coalesced stream in memory, one thread, "
        "median of 3 runs, set-up and "
        "coalescing excluded, all planes. pipeline: rendered, recorded and counted with no file "
        "between; "
        "peak of the whole process. file: Parquet with full provenance.",
        "Asked: stream close 40, front 60; pipeline close fixed 1920x1080 30 s and 2 GiB; file "
        "1.8 B "
        "in the worst scene, 1.0 where a mm is under 10 pixels.",
    )
    return Table("Speed and memory", frame, columns, notes)


def stages_table(frame: pd.DataFrame) -> Table:
    """Where the time of each measurement goes."""
    from experiments.tables import Column, Table

    columns = (
        Column("measured", "measured"),
        Column("stage", "stage"),
        Column("seconds", "s", ".2f"),
    )
    note = "Stages of a pipeline run side by side: their seconds overlap."
    return Table("Time per stage", frame, columns, (note,))
