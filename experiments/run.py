"""`cachesim run`: count one trace on one GPU and print the report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import FetchPathName, GpuName, LayoutName, Overrides, TracePath

if TYPE_CHECKING:
    import pandas as pd

    from cachesim import Report
    from experiments.tables import Table

JSON_HELP = "Write the report as JSON; - writes only that to stdout."
CSV_HELP = "Write the counters per pass, texture, mip and level as CSV."


def command(
    trace: TracePath,
    gpu: GpuName,
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    fetch_path: FetchPathName = None,
    layout: LayoutName = None,
    json: Annotated[str | None, typer.Option("--json", metavar="FILE|-", help=JSON_HELP)] = None,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help=CSV_HELP)] = None,
) -> None:
    """Count a trace on a GPU: demand and miss rates per level, and by pass, texture and mip."""
    from json import dumps

    from experiments.console import progress
    from experiments.options import check_fetch_path
    from experiments.output import output_file, write_text

    check_fetch_path(fetch_path)
    for path in (csv, Path(json) if json and json != "-" else None):
        if path is not None:
            output_file(path)
    from cachesim import presets, simulate
    from cachesim.first_use import compile_loops
    from traces.open import open_trace

    machine = presets.load(gpu, overrides)
    opened = open_trace(trace)
    with progress("compiling the simulator") as bar:
        compile_loops(lane_address=opened.is_lane_address)
        bar.describe(f"counting on {machine.name}")
        report = simulate(
            opened, machine, fetch_path=fetch_path, layout=layout, progress=bar.update
        )
    text = dumps(report.to_json(), indent=2)
    if csv is not None:
        write_text(csv, _by_frame(report).to_csv(index=False))
    if json == "-":
        print(text)
        return
    if json is not None:
        write_text(Path(json), text + "\n")
    print_report(report)


def print_report(report: Report) -> None:
    """The report's tables on stdout, and the host time of each stage on stderr."""
    from experiments.console import remark
    from experiments.tables import print_table

    print_table(level_table(report))
    if report.parts is not None:
        print_table(by_table(report))
    stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in report.timings.items())
    remark(f"time per stage: {stages}")


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
