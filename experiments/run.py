"""`cachesim run`: count one trace on one GPU, or time it, and print the report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import FetchPathName, GpuName, LayoutName, Overrides, TracePath
from traces.errors import InputError, unknown

if TYPE_CHECKING:
    import pandas as pd

    from cachesim import Report
    from cachesim.config import Gpu
    from experiments.tables import Table

FORMATS = ("table", "gpgpusim")
ROOFLINE_SUFFIXES = (".png", ".pdf", ".svg")

JSON_HELP = "Write the report as JSON; - writes only that to stdout."
CSV_HELP = "Write the counters per pass, texture, mip and level as CSV."
TIMING_HELP = "Time the run as well: cycles, and where they went."
TIMELINE_HELP = "Write a timeline for Perfetto and chrome://tracing."
ROOFLINE_HELP = "Draw the passes under the machine's bandwidth roofs: .png, .pdf or .svg."
FORMAT_HELP = "gpgpusim prints the counters in GPGPU-Sim's own stat lines."


def command(
    trace: TracePath,
    gpu: GpuName,
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    fetch_path: FetchPathName = None,
    layout: LayoutName = None,
    json: Annotated[str | None, typer.Option("--json", metavar="FILE|-", help=JSON_HELP)] = None,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help=CSV_HELP)] = None,
    timing: Annotated[bool, typer.Option("--timing", help=TIMING_HELP)] = False,
    timeline: Annotated[
        Path | None, typer.Option("--timeline", metavar="FILE.json", help=TIMELINE_HELP)
    ] = None,
    roofline: Annotated[
        Path | None, typer.Option("--roofline", metavar="FILE", help=ROOFLINE_HELP)
    ] = None,
    shown_as: Annotated[
        str, typer.Option("--format", metavar="table|gpgpusim", help=FORMAT_HELP)
    ] = "table",
) -> None:
    """Count a trace on a GPU: demand and miss rates per level, by pass, texture and mip; --timing
    adds cycles.
    """
    from contextlib import nullcontext
    from json import dumps
    from time import monotonic

    from experiments.console import progress
    from experiments.options import check_fetch_path
    from experiments.output import output_file, write_figure, write_text
    from experiments.timeline import timeline_file

    check_fetch_path(fetch_path)
    check_timing_options(timing, timeline, roofline, shown_as, json)
    for path in (csv, Path(json) if json and json != "-" else None):
        if path is not None:
            output_file(path)
    from cachesim import presets, simulate
    from cachesim.first_use import compile_loops
    from traces.open import open_trace

    machine = presets.load(gpu, overrides)
    opened = open_trace(trace)
    title = f"{trace.name} on {machine.name}"
    writer = timeline_file(timeline, machine.clock_hz, title) if timeline else nullcontext()
    with progress("compiling the simulator") as bar, writer as events:
        compile_loops(lane_address=opened.is_lane_address, timing=timing)
        bar.describe(f"{'timing' if timing else 'counting'} on {machine.name}")
        start = monotonic()
        report = simulate(
            opened,
            machine,
            fetch_path=fetch_path,
            layout=layout,
            progress=bar.update,
            timing=timing,
            timeline=events,
        )
        host_s = monotonic() - start
    text = dumps(report.to_json(), indent=2)
    if csv is not None:
        write_text(csv, _by_frame(report).to_csv(index=False))
    if roofline is not None and report.timing is not None:
        from experiments.roofline import roofline_figure

        write_figure(roofline, roofline_figure(report.timing, machine, title))
    if json == "-":
        print(text)
        return
    if json is not None:
        write_text(Path(json), text + "\n")
    if shown_as == "gpgpusim":
        print_stat_lines(report, machine, trace.stem, host_s)
    else:
        print_report(report, machine)


def check_timing_options(
    timing: bool, timeline: Path | None, roofline: Path | None, shown_as: str, json: str | None
) -> None:
    """Refuse options that do not go together, and outputs that cannot be written.

    Raises:
        InputError: an option that only a timed run has, without --timing; an unknown format; two
            formats on stdout; a file that cannot be written, or of another kind.
    """
    from experiments.output import output_file

    if shown_as not in FORMATS:
        raise unknown("format", shown_as, FORMATS, "--format")
    for option, value in (
        ("--timeline", timeline),
        ("--roofline", roofline),
        ("--format", shown_as if shown_as == "gpgpusim" else None),
    ):
        if value is not None and not timing:
            raise InputError(f"{option} {value}: a run without --timing has none; add --timing")
    if shown_as == "gpgpusim" and json == "-":
        raise InputError("--format gpgpusim: --json - writes to stdout too; name a file for one")
    if timeline is not None:
        output_file(timeline, ".json")
    if roofline is not None:
        output_file(roofline, *ROOFLINE_SUFFIXES)


def print_stat_lines(report: Report, gpu: Gpu, name: str, host_s: float) -> None:
    """The counters in GPGPU-Sim's stat lines on stdout; what to know of them on stderr."""
    from experiments.console import remark
    from experiments.gpgpusim_format import stat_lines
    from experiments.timing_tables import comparison_notes, is_gpgpusim

    if report.timing is None:
        raise ValueError("a report without timing has no stat lines")
    print(
        stat_lines(report.timing, gpu, fetch_path=report.fetch_path, name=name, host_s=host_s),
        end="",
    )
    if not is_gpgpusim(gpu):
        remark(
            f"{gpu.name} describes the card, not a config of GPGPU-Sim's: these are its names, for "
            "another machine than the one it would simulate."
        )
    for line in comparison_notes(gpu, report.fetch_path, report.counters["l1"].accesses):
        remark(line)


def print_report(report: Report, gpu: Gpu) -> None:
    """The report's tables on stdout, and the host time of each stage on stderr."""
    from experiments.console import remark
    from experiments.tables import print_table

    print_table(level_table(report))
    if report.parts is not None:
        print_table(by_table(report))
    if report.timing is not None:
        print_timing(report, gpu)
    stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in report.timings.items())
    remark(f"time per stage: {stages}")


def print_timing(report: Report, gpu: Gpu) -> None:
    """Cycles, traffic and the bottleneck of a timed report."""
    from dataclasses import replace

    from experiments import timing_tables as tables
    from experiments.tables import print_table

    if report.timing is None:
        return
    print_table(tables.bandwidth_table(report.timing, gpu))
    print_table(tables.cycles_table(report.timing, gpu))
    where = tables.where_table(report.timing, gpu)
    told = tables.comparison_notes(gpu, report.fetch_path, report.counters["l1"].accesses)
    print_table(replace(where, notes=(*where.notes, *told)))


def level_table(report: Report) -> Table:
    """One row per cache level, and the totals as notes."""
    from experiments.tables import Column, Table

    columns = (
        Column("level", "level"),
        Column("requests", "requests"),
        Column("accesses", "accesses"),
        Column("hits", "hits"),
        Column("misses", "misses"),
        Column("miss_rate", "miss rate", ".4f"),
        Column("writes", "writes"),
        Column("bypasses", "bypasses"),
        Column("writebacks", "write-backs"),
    )
    demand, dram = report.demand, report.dram
    levels = ", ".join(
        f"{name.upper()} {demand[f'{name}_bytes'] / 1e6:,.1f} MB"
        for name in (*report.levels, "dram")
    )
    notes = (
        f"{report.lane_fetches:,} lane fetches of {report.num_rows:,} warp instructions; fetch "
        "path "
        f"{report.fetch_path}, layout {report.layout or 'none (byte addresses)'}.",
        f"Demand: {levels} ({dram.sectors_read:,} sectors of {dram.sector_bytes} B read, "
        f"{dram.sectors_written:,} written).",
        "Counts are in sectors of each level: "
        + ", ".join(f"{n} {report.counters[n].sector_bytes} B" for n in report.levels)
        + ".",
    )
    return Table(f"Cache levels of {report.gpu}", report.frame(), columns, notes)


def by_table(report: Report) -> Table:
    """One row per pass, texture and mip, with each level's demand and miss rate."""
    from experiments.tables import Column, Table

    wide = by_wide(report)
    columns = [
        Column("pass", "pass"),
        Column("texture", "texture"),
        Column("mip", "mip"),
        Column("lane_fetches_m", "fetches M", ",.2f"),
    ]
    for level in report.levels:
        if level in ("l1", "l2"):
            columns.append(Column(f"{level}_mb", f"{level.upper()} MB", ",.2f"))
        columns.append(Column(f"{level}_miss_rate", f"{level.upper()} miss", ".3f"))
    columns.append(Column("dram_mb", "DRAM MB", ",.2f"))
    return Table("By pass, texture and mip", wide, tuple(columns))


def by_wide(report: Report) -> pd.DataFrame:
    """One row per pass, texture and mip: lane fetches (M), demand (MB), miss rates."""
    import pandas as pd

    rows = []
    for part in report.parts or ():
        row: dict[str, object] = {
            "pass": part.pass_name,
            "texture": part.texture,
            "mip": part.mip,
            "lane_fetches_m": part.lane_fetches / 1e6,
        }
        for level, counts in part.counters.items():
            row[f"{level}_mb"] = counts.demand_bytes / 1e6
            row[f"{level}_miss_rate"] = counts.miss_rate
        row["dram_mb"] = part.dram.bytes / 1e6
        rows.append(row)
    frame = pd.DataFrame(rows)
    rates = {f"{level}_miss_rate": float for level in report.levels}
    return frame.astype(rates) if rows else frame


def _by_frame(report: Report) -> pd.DataFrame:
    return report.frame() if report.parts is None else report.by_frame()
