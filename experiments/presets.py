"""`cachesim presets`: the shipped GPUs, one with the source of every field, or how two differ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import Overrides
from traces.errors import InputError, unknown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from experiments.tables import Table

ACTIONS = {"list": 0, "show": 1, "diff": 2}
VALUE_WIDTH = 24
CONFIDENCES = (
    "S read in source code or a config, M measured on silicon, P published, R recalled from a "
    "vendor's specification, D derived, ? assumed"
)


def command(
    action: Annotated[str, typer.Argument(metavar="[list|show|diff]")] = "list",
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME|FILE.toml]…")] = None,
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
) -> None:
    """List the GPUs, show one with the source and confidence of every field, or compare two."""
    from experiments.tables import print_table

    given = names or []
    if action not in ACTIONS:
        raise unknown("action", action, ACTIONS, "presets")
    if len(given) != ACTIONS[action]:
        raise InputError(
            f"presets {action}: {len(given)} names given: {action} takes {ACTIONS[action]}"
        )
    if overrides and action != "show":
        raise InputError(f"--set {overrides[0]}: only `presets show` takes it, not {action}")
    if action == "show":
        print_table(show_table(given[0], overrides))
    elif action == "diff":
        print_table(diff_table(*given))
    else:
        print_table(list_table())


def list_table() -> Table:
    """One row per shipped preset: what decides its counts."""
    import pandas as pd

    from cachesim import presets
    from cachesim.units import format_size
    from experiments.tables import Column, Table

    rows = []
    for name in presets.names():
        gpu = presets.load(name)
        rows.append(
            {
                "name": name,
                "sms": gpu.sm.count,
                "l1": f"{gpu.l1.units_per_sm} x {format_size(gpu.l1.capacity)}"
                if gpu.l1.units_per_sm > 1
                else format_size(gpu.l1.capacity),
                "gl1": format_size(gpu.gl1.capacity) if gpu.gl1 else None,
                "l2": f"{format_size(gpu.l2.capacity)} / {gpu.l2.num_slices}",
                "llc": format_size(gpu.llc.capacity) if gpu.llc else None,
                "layout": gpu.texture_layout,
            }
        )
    columns = (
        Column("name", "GPU"),
        Column("sms", "SMs"),
        Column("l1", "L1 of an SM"),
        Column("gl1", "GL1"),
        Column("l2", "L2 / slices"),
        Column("llc", "LLC"),
        Column("layout", "texture layout"),
    )
    return Table("Presets", pd.DataFrame(rows), columns, (_against_silicon(presets.names()),))


def show_table(name: str, overrides: list[str]) -> Table:
    """One row per field of a GPU: value, source, confidence."""
    from textwrap import wrap

    from cachesim import presets
    from experiments.tables import Column, Table

    fields = presets.describe(name, overrides)
    # A map of 64 address bits would leave no room for the sources.
    fields["value"] = ["\n".join(wrap(value, VALUE_WIDTH)) for value in fields["value"]]
    columns = (
        Column("field", "field"),
        Column("value", "value", wraps=True),
        Column("confidence", "grade"),
        Column("source", "source", wraps=True),
    )
    return Table(name, fields, columns, (CONFIDENCES, _against_silicon([name])))


def _against_silicon(names: Sequence[str]) -> str:
    """Which of these GPUs were measured with `cachesim silicon`."""
    from experiments.silicon.compare import NOT_MEASURED, silicon_of

    found = silicon_of()
    told = [f"{name} {found[name]}" for name in names if name in found]
    rest = [name for name in names if name not in found]
    if rest:
        told.append(NOT_MEASURED if rest == list(names) else f"the others {NOT_MEASURED}")
    return f"Against silicon (`cachesim validate silicon`): {', '.join(told)}"


def diff_table(first: str, second: str) -> Table:
    """The fields in which two GPUs differ."""
    from cachesim import presets
    from experiments.tables import plain_table

    return plain_table(f"{first} against {second}", presets.diff(first, second))
