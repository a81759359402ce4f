"""`cachesim bench`: speed, memory and file size, with the machine they were taken on."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
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

FIGURES, TIMING = ("stream", "pipeline", "file"), "timing"
JOBS = (*FIGURES, TIMING)
ACCEL_SIM_HELP = "Run this Accel-Sim (accel-sim.out or its tree) beside ours, and nothing else."
CONFIGS_HELP = "Accel-Sim's configurations, a folder each, where they are not in its tree."
KEEP_HELP = "Keep the exported traces, command lines and Accel-Sim's output here."


def command(
    quick: Annotated[bool, typer.Option("--quick", help="Small frames: a smoke test.")] = False,
    only: Annotated[
        str, typer.Option("--only", metavar="LIST", help=f"Of {', '.join(JOBS)}.")
    ] = ",".join(JOBS),
    accel_sim: Annotated[
        Path | None, typer.Option("--accel-sim", metavar="PATH", help=ACCEL_SIM_HELP)
    ] = None,
    accel_sim_configs: Annotated[
        Path | None, typer.Option("--accel-sim-configs", metavar="DIR", help=CONFIGS_HELP)
    ] = None,
    accel_sim_keep: Annotated[
        Path | None, typer.Option("--accel-sim-keep", metavar="DIR", help=KEEP_HELP)
    ] = None,
    device: DeviceName = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="STEM", help="Also STEM.csv, .md, .tex."),
    ] = None,
) -> None:
    """Measure counting and timing speed, the pipeline's time and peak memory, the file's bytes."""
    from experiments.console import remark
    from experiments.options import parse_names
    from experiments.output import output_file
    from traces.errors import InputError, unknown

    jobs = parse_names(only, "--only")
    for job in jobs:
        if job not in JOBS:
            raise unknown("measurement", job, JOBS, "--only")
    if output is not None:
        output_file(output.with_name(output.name + ".csv"))
    if accel_sim is None:
        for option, path in (("configs", accel_sim_configs), ("keep", accel_sim_keep)):
            if path is not None:
                raise InputError(f"--accel-sim-{option} {path}: needs --accel-sim")
    remark(machine_line() + ("; quick: small frames, not the figures to quote" if quick else ""))
    if accel_sim is not None:
        bench_accel_sim(accel_sim, accel_sim_configs, accel_sim_keep, quick, output)
        return
    if set(jobs) & set(FIGURES):
        bench_figures([job for job in FIGURES if job in jobs], quick, device, output)
    if TIMING in jobs:
        stem = output.with_name(f"{output.name}-timing") if output is not None else None
        bench_timing(quick, stem)


def bench_figures(
    chosen: Sequence[str], quick: bool, device: str | None, output: Path | None
) -> None:
    """Counting, the pipeline and the file."""
    import pandas as pd

    from experiments.console import progress
    from experiments.tables import print_table, write_table

    stream_size, pipeline_size = SIZES["quick" if quick else "full"]
    jobs = [("stream", scene, "fixed", stream_size) for scene in SCENES]
    jobs += [("pipeline", "close", method, pipeline_size) for method in ("fixed", "adaptive")]
    jobs += [("file", scene, "fixed", pipeline_size) for scene in SCENES]
    jobs = [job for job in jobs if job[0] in chosen]
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


def bench_timing(quick: bool, output: Path | None) -> None:
    """The timing model on the oracle traces, and its compilation."""
    import os
    from tempfile import TemporaryDirectory

    from experiments import bench_timing as timing
    from experiments.accel_sim_oracle import CONFIGS, read_results
    from experiments.console import progress
    from experiments.tables import print_table, write_table

    results = read_results()
    num_runs, names = (1, ",".join(timing.QUICK)) if quick else (timing.NUM_RUNS, "")
    module = "experiments.bench_timing"
    with progress("compiling the timing model", len(CONFIGS) + 1) as bar:
        with TemporaryDirectory(prefix="cachesim-bench-") as empty:
            environment = {**os.environ, "NUMBA_CACHE_DIR": empty}
            first_s = run_process(module, [timing.COMPILE], environment)["seconds"]
            loading_s = run_process(module, [timing.COMPILE], environment)["seconds"]
        found = {}
        for config in CONFIGS:
            bar.advance()
            bar.describe(f"timing the oracle traces on {config}")
            found[config] = run_process(module, [config, str(num_runs), names])
    frame = timing.speed_frame(found, results)
    table = timing.speed_table(frame, num_runs, first_s, loading_s, machine_line())
    print_table(table)
    if output is not None:
        write_table(table, output)


def bench_accel_sim(
    path: Path, configs: Path | None, kept: Path | None, quick: bool, output: Path | None
) -> None:
    """A user's own Accel-Sim beside ours."""
    from experiments import bench_accel_sim as beside
    from experiments import bench_timing as timing
    from experiments.accel_sim_oracle import CONFIGS
    from experiments.console import progress
    from experiments.output import output_folder
    from experiments.tables import print_table, write_table
    from traces.oracle_traces import ORACLE_TRACES

    found = beside.find_accel_sim(path, configs, list(CONFIGS))
    if kept is not None:
        output_folder(kept)
    names = list(timing.QUICK if quick else ORACLE_TRACES)
    with progress("starting") as bar:
        frame = beside.run_beside(found, list(CONFIGS), names, kept, step=bar.describe)
    table = beside.beside_table(frame, found.binary, machine_line())
    print_table(table)
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
    return run_process("experiments.bench_jobs", [job, scene, method, size, GPU, device or ""])


def run_process(
    module: str, arguments: Sequence[str], environment: dict[str, str] | None = None
) -> dict[str, Any]:
    """Run a module as a process and return the JSON of its last line.

    Raises:
        WorkError: it failed; says the last line of what it wrote.
    """
    from traces.errors import WorkError

    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
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
