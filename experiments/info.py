"""`cachesim info`: a trace's manifest, its size, its lane fetches per pass, texture and mip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from experiments.options import TracePath

if TYPE_CHECKING:
    from collections.abc import Iterator

    from experiments.tables import Table
    from traces.trace import Trace


def command(trace: TracePath) -> None:
    """Print a trace's manifest, its size, and its lane fetches per pass, texture and mip."""
    from experiments.console import console, progress
    from experiments.tables import print_table
    from traces.open import open_trace

    opened = open_trace(trace)
    with progress(f"reading {trace.name}"):
        table = fetch_table(opened)
    out = console()
    for line in manifest_lines(opened.manifest):
        out.print(line, markup=False)
    print_table(table)
    fetches = int(table.frame["lane_fetches"].sum())
    rows = int(table.frame["rows"].sum())
    size = trace.stat().st_size
    out.print(
        f"{rows:,} accesses of {len(opened.launches):,} launches, {fetches:,} lane fetches "
        f"({fetches / max(rows, 1):.1f} lanes active); {size:,} B on disk, "
        f"{size / max(fetches, 1):.3f} B per lane fetch",
        markup=False,
    )


def manifest_lines(manifest: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """One "name: value" line per leaf of a manifest."""
    for name, value in manifest.items():
        if isinstance(value, dict):
            yield from manifest_lines(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}: {value}"


def fetch_table(trace: Trace) -> Table:
    """Lane fetches and rows per pass, texture, mip and operation."""
    from experiments.tables import Column, Table
    from traces.analysis import lane_fetches

    columns = (
        Column("pass", "pass"),
        Column("texture", "texture"),
        Column("mip", "mip"),
        Column("operation", "operation"),
        Column("rows", "accesses"),
        Column("lane_fetches", "lane fetches"),
    )
    return Table("Lane fetches", lane_fetches(trace), columns)
