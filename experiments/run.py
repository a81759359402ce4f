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
    from traces.open import open_trace

    machine = presets.load(gpu, overrides)
    opened = open_trace(trace)
    with progress(f"counting on {machine.name}") as bar:
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
    if report.by is not None:
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
    notes = (
        f"Lane fetches {demand.lane_fetches:,}. Demand: L1 {demand.l1_bytes / 1e6:,.1f} MB, "
        f"L2 {demand.l2_bytes / 1e6:,.1f} MB, DRAM {demand.dram_bytes / 1e6:,.1f} MB "
        f"({dram.sectors_read:,} sectors read, {dram.sectors_written:,} written).",
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
        Column("lane_fetches", "lane fetches"),
    ]
    for level in report.levels:
        columns += [
            Column(f"{level}_mb", f"{level.upper()} MB", ",.2f"),
            Column(f"{level}_miss_rate", f"{level.upper()} miss", ".3f"),
        ]
    columns.append(Column("dram_mb", "DRAM MB", ",.2f"))
    return Table("By pass, texture and mip", wide, tuple(columns))


def by_wide(report: Report) -> pd.DataFrame:
    """The report's `by` with one row per pass, texture and mip: lane fetches, MB and miss rate of each level, DRAM MB."""
    import pandas as pd

    rows = []
    for part in report.by or ():
        row = {name: part[name] for name in ("pass", "texture", "mip", "lane_fetches")}
        for level in report.levels:
            counts = part[level]
            row[f"{level}_accesses"] = counts["accesses"]
            row[f"{level}_misses"] = counts["misses"]
            row[f"{level}_mb"] = counts["accesses"] * report.counters[level].sector_bytes / 1e6
            row[f"{level}_miss_rate"] = miss_rate(counts["misses"], counts["accesses"])
        row["dram_mb"] = part["dram"]["bytes"] / 1e6
        rows.append(row)
    return pd.DataFrame(rows)


def miss_rate(misses: int, accesses: int) -> float | None:
    """Misses / accesses; None where there were none."""
    return misses / accesses if accesses else None


def _by_frame(report: Report) -> pd.DataFrame:
    return report.frame() if report.by is None else report.by_frame()
