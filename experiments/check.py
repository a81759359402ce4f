"""`cachesim check`: hold a trace file to every invariant of its format."""

from __future__ import annotations

import typer  # noqa: F401 -- Typer resolves the annotations below

from experiments.options import TracePath


def command(trace: TracePath) -> None:
    """Check a trace: launches and CTAs complete and in order, texels inside their levels, sizes."""
    from experiments.console import progress
    from traces.check import check
    from traces.open import open_trace

    with progress(f"checking {trace.name}") as bar:
        found = check(open_trace(trace), str(trace), progress=bar.update)
    print(
        f"{trace}: sound: {found.num_launches:,} launches, {found.num_ctas:,} CTAs, "
        f"{found.num_rows:,} accesses, {found.num_lane_fetches:,} lane fetches"
    )
