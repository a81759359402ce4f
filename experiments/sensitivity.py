"""`cachesim sensitivity`: what halving and doubling each assumed field does to the cycles."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from experiments.options import (
    FetchPathName,
    GpuName,
    LayoutName,
    Overrides,
    TracePath,
    parse_names,
)

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from experiments.tables import Table
    from traces.trace import Trace

FIELDS_HELP = (
    "Fields to vary, with commas between; all timing fields that are assumed unless given."
)
OUTPUT_HELP = "Write the table as CSV, with the cycles of every run."
TIMING_SECTIONS = (
    "sm_timing",
    "l1_timing",
    "l1_texture_timing",
    "gl1_timing",
    "icnt",
    "l2_timing",
    "llc_timing",
    "dram_timing",
)
#: A change of the cycles below this is shown, but not counted as one.
NOTICEABLE = 0.01


@dataclass(frozen=True)
class Variant:
    """A machine with one field changed.

    factor: "half" or "double". gpu: None where the changed value does not fit with the others.
    """

    field: str
    factor: str
    value: int
    gpu: Gpu | None


def command(
    trace: TracePath,
    gpu: GpuName,
    fields: Annotated[
        str | None, typer.Option("--fields", metavar="A,B,…", help=FIELDS_HELP)
    ] = None,
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    fetch_path: FetchPathName = None,
    layout: LayoutName = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE.csv", help=OUTPUT_HELP)
    ] = None,
) -> None:
    """Halve and double each assumed timing field of a GPU and show how the cycles change."""
    from experiments.console import progress
    from experiments.options import check_fetch_path
    from experiments.output import output_file, write_text
    from experiments.tables import print_table

    check_fetch_path(fetch_path)
    if output is not None:
        output_file(output, ".csv")
    from cachesim import presets
    from cachesim.first_use import compile_loops
    from traces.open import open_trace

    machine = presets.load(gpu, overrides)
    wanted = parse_names(fields, "--fields") if fields is not None else None
    chosen = fields_to_vary(gpu, overrides, wanted)
    opened = open_trace(trace)
    default = machine.lane_address_path if opened.is_lane_address else "texture"
    variants = make_variants(machine, chosen, fetch_path or default)
    num_runs = 1 + sum(v.gpu is not None for v in variants)
    with progress("compiling the simulator", num_runs) as bar:
        compile_loops(lane_address=opened.is_lane_address, timing=True)
        bar.describe(f"timing {num_runs} machines")
        frame = sensitivity_frame(
            opened,
            machine,
            variants,
            {field: presets.sources(gpu, overrides)[field].source for field in chosen},
            fetch_path=fetch_path,
            layout=layout,
            step=bar.advance,
        )
    if output is not None:
        write_text(output, frame.to_csv(index=False))
    left_out = [] if wanted else unvaried(gpu, overrides)
    print_table(sensitivity_table(frame, f"{trace.name} on {machine.name}", left_out))


def fields_to_vary(gpu: str, overrides: Sequence[str], wanted: Sequence[str] | None) -> list[str]:
    """The timing fields to vary: those asked for, or every assumed number that is not 0.

    Raises:
        InputError: a field that is unknown, no number of the timing model, not in this GPU, or 0.
    """
    from cachesim import presets
    from traces.errors import InputError

    given = presets.sources(gpu, overrides)
    if wanted is None:
        return [
            field
            for field, entry in given.items()
            if is_timing_number(field) and entry.confidence == "?" and entry.value
        ]
    from cachesim.presets.fields import check_path

    for field in wanted:
        check_path(field, "--fields")
        if not is_timing_number(field):
            allowed = f"allowed are the numbers of {', '.join(TIMING_SECTIONS)}"
            raise InputError(f"--fields {field}: is no number of the timing model; {allowed}")
        if field not in given:
            raise InputError(f"--fields {field}: {gpu} has no [{field.partition('.')[0]}]")
        if not given[field].value:
            raise InputError(f"--fields {field}: is 0, which halved and doubled is 0")
    return list(wanted)


def unvaried(gpu: str, overrides: Sequence[str]) -> list[str]:
    """The assumed timing fields that `fields_to_vary` leaves out: choices, and zeros."""
    from cachesim import presets

    varied = set(fields_to_vary(gpu, overrides, None))
    return [
        field
        for field, entry in presets.sources(gpu, overrides).items()
        if field.partition(".")[0] in TIMING_SECTIONS
        and entry.confidence == "?"
        and field not in varied
    ]


def is_timing_number(field: str) -> bool:
    """Whether a field path is a whole number of the timing model."""
    from cachesim.presets.fields import FIELDS

    hint = FIELDS[field]
    return field.partition(".")[0] in TIMING_SECTIONS and (get_args(hint) or (hint,))[0] is int


def halved_and_doubled(field: str, value: int) -> dict[str, int]:
    """Half and double of a value, rounded down, within the field's bounds.

    Never 0, which would lift a limit instead of halving it. A factor whose value would be the same
    is left out.
    """
    from cachesim.presets.fields import FIELDS

    given = [b for info in get_args(FIELDS[field]) for b in getattr(info, "metadata", ())]
    bounds = {
        name: getattr(b, name) for b in given for name in ("gt", "ge", "le") if hasattr(b, name)
    }
    least = max(1, bounds.get("ge", 0), bounds.get("gt", 0) + 1)
    tried = {"half": max(least, value // 2), "double": min(bounds.get("le", 2 * value), 2 * value)}
    return {factor: new for factor, new in tried.items() if new != value}


def make_variants(gpu: Gpu, fields: Iterable[str], fetch_path: str = "texture") -> list[Variant]:
    """The machines of the study: each field halved and doubled, where that is allowed."""
    from cachesim import presets
    from cachesim.presets.fields import flatten_gpu
    from experiments.timing_tables import timing_refusal
    from traces.errors import InputError

    values = flatten_gpu(gpu)
    variants = []
    for field in fields:
        for factor, value in halved_and_doubled(field, values[field]).items():
            try:
                changed = presets.with_fields(gpu, {field: value})
            except InputError:
                changed = None
            if changed is not None and timing_refusal(changed, fetch_path) is not None:
                changed = None
            variants.append(Variant(field, factor, value, changed))
    return variants


def sensitivity_frame(
    trace: Trace,
    gpu: Gpu,
    variants: Sequence[Variant],
    sources: dict[str, str],
    *,
    fetch_path: str | None = None,
    layout: str | None = None,
    step: Callable[[], None] = lambda: None,
) -> pd.DataFrame:
    """Time a trace on a GPU and on its variants, as many side by side as there are cores.

    Args:
        trace: read once per batch of machines.
        gpu: the machine that the variants vary.
        variants: the changed machines; one without a GPU becomes a row without cycles.
        sources: field -> where its value comes from.
        fetch_path, layout: as in `simulate`.
        step: called after each run.

    Returns:
        One row per field, largest change first: `field`, `value`, `cycles` of the machine as it
        is, and per factor the `value_*`, the `cycles_*` and `change_*`, the cycles' relative
        change; `largest`, the larger of both changes' sizes; `source`.
    """
    import pandas as pd

    from cachesim.presets.fields import flatten_gpu

    runs = [gpu, *(v.gpu for v in variants if v.gpu is not None)]
    cycles = _timed(trace, runs, fetch_path, layout, step)
    base = cycles.pop(0)
    values = flatten_gpu(gpu)
    rows: dict[str, dict[str, Any]] = {}
    for variant in variants:
        field, factor = variant.field, variant.factor
        row = rows.setdefault(field, {"field": field, "value": values[field], "cycles": base})
        row[f"value_{factor}"] = variant.value
        if variant.gpu is not None:
            row[f"cycles_{factor}"] = cycles.pop(0)
            row[f"change_{factor}"] = row[f"cycles_{factor}"] / base - 1
    names = ["field", "value", "cycles"]
    names += [f"{kind}_{f}" for f in ("half", "double") for kind in ("value", "cycles", "change")]
    frame = pd.DataFrame(list(rows.values()), columns=names)
    whole = {f"{kind}_{f}": "Int64" for f in ("half", "double") for kind in ("value", "cycles")}
    frame = frame.astype(whole | {f"change_{f}": float for f in ("half", "double")})
    frame["largest"] = frame[["change_half", "change_double"]].abs().max(axis=1)
    frame["source"] = [sources.get(field, "") for field in frame["field"]]
    order = frame.sort_values("largest", ascending=False, kind="stable", na_position="last")
    return order.reset_index(drop=True)


def _timed(
    trace: Trace,
    gpus: Sequence[Gpu],
    fetch_path: str | None,
    layout: str | None,
    step: Callable[[], None],
) -> list[int]:
    """Total cycles on each machine; a batch shares one pass over the trace."""
    from cachesim import simulate_all

    cycles: list[int] = []
    at_once = os.cpu_count() or 1
    for first in range(0, len(gpus), at_once):
        batch = gpus[first : first + at_once]
        reports = simulate_all(trace, batch, fetch_path=fetch_path, layout=layout, timing=True)
        for report in reports:
            if report.timing is None:
                raise ValueError(f"{report.gpu}: the run has no timing")
            cycles.append(report.timing.total.cycles)
            step()
    return cycles


def sensitivity_table(frame: pd.DataFrame, title: str, left_out: Sequence[str] = ()) -> Table:
    """The change of the cycles in % per field, the largest first, and what was not varied."""
    from experiments.tables import Column, Table

    columns = (
        Column("field", "field"),
        Column("value", "value"),
        Column("value_half", "halved"),
        Column("change_half", "cycles", "+.2%"),
        Column("value_double", "doubled"),
        Column("change_double", "cycles", "+.2%"),
    )
    notes = []
    if len(frame):
        num_felt = int((frame["largest"] >= NOTICEABLE).sum())
        notes.append(
            f"Change of {int(frame['cycles'].iloc[0]):,} cycles, launches included. {num_felt} of "
            f"{len(frame)} fields change them by {NOTICEABLE:.0%} or more; '-' where the halved or "
            "doubled value is out of bounds or does not fit the other fields."
        )
    else:
        notes.append("No assumed number to vary.")
    if left_out:
        notes.append(f"Assumed, but choices or 0, so not varied: {', '.join(left_out)}.")
    return Table(f"Sensitivity of {title}", frame, columns, tuple(notes))
