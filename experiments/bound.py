"""`cachesim bound`: Belady's optimal replacement beside LRU and the GPU's own policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import FetchPathName, GpuName, LayoutName, Overrides, TracePath

if TYPE_CHECKING:
    from cachesim.bound import Bound
    from experiments.tables import Table


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
    from cachesim import belady, presets
    from cachesim.first_use import compile_loops
    from experiments.console import progress
    from experiments.options import check_fetch_path
    from experiments.tables import print_table
    from traces.errors import unknown
    from traces.open import open_trace

    check_fetch_path(fetch_path)
    if level not in ("l1", "l2"):
        raise unknown("level", level, ("l1", "l2"), "--level")
    machine = presets.load(gpu, overrides)
    opened = open_trace(trace)
    with progress("compiling the simulator") as bar:
        compile_loops(lane_address=opened.is_lane_address)
        bar.describe(f"bounding {level} of {machine.name}")
        found = belady(
            opened, machine, level, fetch_path=fetch_path, layout=layout, progress=bar.update
        )
    print_table(bound_table(found, machine.name))


def bound_table(found: Bound, gpu: str) -> Table:
    """One row per policy: line misses, their share of the loads, and how many times OPT's."""
    import pandas as pd

    from experiments.tables import Column, Table

    misses = {found.policy: found.policy_misses, "lru": found.lru_misses, "OPT": found.misses}
    rows = [
        {
            "policy": policy,
            "misses": count,
            "miss_rate": count / found.accesses if found.accesses else None,
            "times_opt": count / found.misses if found.misses else None,
        }
        for policy, count in misses.items()
    ]
    columns = (
        Column("policy", "policy"),
        Column("misses", "line misses"),
        Column("miss_rate", "miss rate", ".4f", numeric=True),
        Column("times_opt", "times OPT", ".3f", numeric=True),
    )
    notes = (
        f"{found.accesses:,} loads, counted in whole lines and not in sectors as reports are. "
        "OPT evicts the line whose next use is farthest away.",
    )
    return Table(f"{found.level} of {gpu}", pd.DataFrame(rows), columns, notes)
