"""`cachesim bound`: Belady's optimal replacement as a bound beside the GPU's own policy."""

from __future__ import annotations

from typing import Annotated

import typer

from experiments.options import FetchPathName, GpuName, LayoutName, Overrides, TracePath


def command(
    trace: TracePath,
    gpu: GpuName,
    level: Annotated[
        str, typer.Option("--level", metavar="l1|l2", help="Which level to bound.")
    ] = "l1",
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    fetch_path: FetchPathName = None,
    layout: LayoutName = None,
) -> None:
    """Line misses of a level under its own policy, and under Belady's OPT, which none can beat."""
    import pandas as pd

    from experiments.console import progress
    from experiments.options import check_fetch_path
    from experiments.tables import Column, Table, print_table
    from traces.errors import unknown

    check_fetch_path(fetch_path)
    if level not in ("l1", "l2"):
        raise unknown("level", level, ("l1", "l2"), "--level")
    from cachesim import belady, presets
    from traces.open import open_trace

    machine = presets.load(gpu, overrides)
    with progress(f"Belady's OPT on {level} of {machine.name}") as bar:
        found = belady(
            open_trace(trace),
            machine,
            level=level,
            fetch_path=fetch_path,
            layout=layout,
            progress=bar.update,
        )
    frame = pd.DataFrame(found["policies"])
    print(frame, Column, Table, print_table)
