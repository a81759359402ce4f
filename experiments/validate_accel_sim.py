"""Our timing model beside Accel-Sim on the oracle traces: errors, bounds, tables, and in words what
misses the bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from cachesim import simulate
from experiments.accel_sim_oracle import (
    CONFIGS,
    FETCH_PATH,
    QUANTITIES,
    VERSION,
    ours,
    theirs,
)
from experiments.tables import Column, Table
from traces.oracle_traces import oracle_trace

if TYPE_CHECKING:
    from cachesim.config import Gpu

#: Bounds on counters that depend on timing: of their number, or of the level's accesses.
COUNTER_BOUND, OF_ACCESSES_BOUND = 0.03, 0.005
#: Bounds on cycles: of the mean and of the worst error.
MEAN_BOUND, WORST_BOUND = 0.10, 0.20
CYCLES = ("cycles", "run_cycles")
COUNTERS = tuple(name for name in QUANTITIES if name not in CYCLES)
ALL = "all"
_WORDS = {
    "cycles": "Cycles, launch included",
    "run_cycles": "Cycles, launch excluded",
    "l1_accesses": "L1 accesses",
    "l1_misses": "L1 misses",
    "l2_accesses": "L2 accesses",
    "l2_misses": "L2 misses",
}


def relative_error(found: int, expected: int) -> float:
    """(found - expected) / expected; 0 where both are 0, infinite where only `expected` is."""
    if found == expected:
        return 0.0
    return (found - expected) / expected if expected else math.inf


def compare(
    results: pd.DataFrame,
    configs: Sequence[str],
    traces: Sequence[str],
    step: Callable[[str], None] = lambda text: None,
) -> pd.DataFrame:
    """Run every trace on every machine: a row each.

    results: as `accel_sim_oracle.read_results` returns it. step: told what is run next.

    Returns "config", "trace", and for each of `QUANTITIES` q: "q_ours", "q_theirs", "q_error"
    (relative), "q_of_accesses" (the difference / the level's accesses; counters only) and
    "q_within" (its bound; for cycles, that on the worst error).
    """
    gpus: dict[str, Gpu] = {config: CONFIGS[config].gpu() for config in configs}
    rows = []
    for name in traces:
        trace = oracle_trace(name)
        for config in configs:
            step(f"{config} {name}")
            timing = simulate(
                trace, gpus[config], fetch_path=FETCH_PATH, threaded=False, timing=True
            ).timing
            assert timing is not None
            expected = theirs(results.loc[(config, name)])
            rows.append(compare_run(config, name, ours(timing), expected))
    frame = pd.DataFrame(rows)
    order = {config: index for index, config in enumerate(configs)}
    return frame.sort_values("config", key=lambda c: c.map(order), kind="stable", ignore_index=True)


def compare_run(
    config: str, trace: str, found: dict[str, int], expected: dict[str, int]
) -> dict[str, object]:
    """One row of `compare`."""
    row: dict[str, object] = {"config": config, "trace": trace}
    for name in QUANTITIES:
        error = relative_error(found[name], expected[name])
        row[f"{name}_ours"], row[f"{name}_theirs"] = found[name], expected[name]
        row[f"{name}_error"] = error
        if name in CYCLES:
            row[f"{name}_within"] = abs(error) <= WORST_BOUND
            continue
        accesses = expected[f"{name.partition('_')[0]}_accesses"]
        difference = found[name] - expected[name]
        share = difference / accesses if accesses else relative_error(found[name], expected[name])
        row[f"{name}_of_accesses"] = share
        if must_be_equal(config, name):
            row[f"{name}_within"] = difference == 0
        else:
            row[f"{name}_within"] = abs(error) <= COUNTER_BOUND or abs(share) <= OF_ACCESSES_BOUND
    return row


def must_be_equal(config: str, quantity: str) -> bool:
    """Whether a quantity depends on the trace alone, and not on timing."""
    skips = CONFIGS[config].skips_l1
    return quantity == "l1_accesses" or (quantity == "l2_accesses" and skips)


def summarise(frame: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst error and correlation of each quantity, per machine and over all.

    Over the runs in which the quantity occurs: zeros that must be zeros would flatter the mean.
    "correlation" is Pearson's, of our values with theirs; NaN where either does not vary.
    "num_within": runs within their bound; "met": whether the quantity's bounds hold.
    """
    configs = list(dict.fromkeys(frame["config"]))
    parts = {config: frame[frame["config"] == config] for config in configs}
    if len(configs) > 1:
        parts[ALL] = frame
    rows = []
    for config, part in parts.items():
        for name, label in QUANTITIES.items():
            found = _summary_of(occurring(part, name), name)
            rows.append({"config": config, "quantity": label, **found})
    return pd.DataFrame(rows)


def occurring(frame: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """The runs in which a quantity is not 0 on both sides."""
    return frame[(frame[f"{quantity}_ours"] > 0) | (frame[f"{quantity}_theirs"] > 0)]


def _summary_of(part: pd.DataFrame, name: str) -> dict[str, object]:
    """One quantity's columns of `summarise`."""
    error = part[f"{name}_error"].abs()
    num_within = int(part[f"{name}_within"].sum())
    met = num_within == len(part)
    if name in CYCLES and len(part):
        met = met and float(error.mean()) <= MEAN_BOUND
    has_worst = len(part) > 0 and error.max() > 0
    worst = int(error.to_numpy().argmax()) if has_worst else 0
    return {
        "mean_error": float(error.mean()) if len(part) else math.nan,
        "worst_error": float(part[f"{name}_error"].iloc[worst]) if len(part) else math.nan,
        "worst_trace": part["trace"].iloc[worst] if has_worst else None,
        "correlation": correlation(part[f"{name}_ours"], part[f"{name}_theirs"]),
        "num_runs": len(part),
        "num_within": num_within,
        "met": met,
    }


def correlation(found: pd.Series, expected: pd.Series) -> float:
    """Pearson's r, NaN where one of the two does not vary."""
    a, b = found.to_numpy(np.float64), expected.to_numpy(np.float64)
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(np.corrcoef(a, b)[0, 1])


def cycles_table(frame: pd.DataFrame) -> Table:
    """Cycles and L1 accesses of every run."""
    columns = (
        Column("config", "config"),
        Column("trace", "trace"),
        Column("cycles_ours", "cycles, ours"),
        Column("cycles_theirs", "Accel-Sim"),
        Column("cycles_error", "error", "+.1%"),
        Column("run_cycles_error", "error without launch", "+.1%"),
        Column("l1_accesses_ours", "L1 accesses, ours"),
        Column("l1_accesses_theirs", "Accel-Sim"),
    )
    return Table("Cycles beside Accel-Sim", frame, columns, (VERSION,))


def counters_table(frame: pd.DataFrame) -> Table:
    """Misses and L2 accesses of every run."""
    columns = [Column("config", "config"), Column("trace", "trace")]
    for name in COUNTERS[1:]:
        columns += [
            Column(f"{name}_ours", f"{QUANTITIES[name]}, ours"),
            Column(f"{name}_theirs", "Accel-Sim"),
            Column(f"{name}_error", "error", "+.1%"),
        ]
        if name.endswith("misses"):
            columns.append(Column(f"{name}_of_accesses", "of accesses", "+.2%"))
    note = (
        "Sector requests of loads; misses are GPGPU-Sim's MISS and SECTOR_MISS. Of accesses: the "
        "difference / the level's accesses."
    )
    return Table("Misses and L2 accesses beside Accel-Sim", frame, tuple(columns), (note,))


def summary_table(summary: pd.DataFrame) -> Table:
    """Errors, correlation and bounds per machine and quantity."""
    shown = summary.assign(bounds=summary["met"].map({True: "met", False: "not met"}))
    columns = (
        Column("config", "config"),
        Column("quantity", "quantity"),
        Column("mean_error", "mean error", ".2%"),
        Column("worst_error", "worst error", "+.1%"),
        Column("worst_trace", "of"),
        Column("correlation", "correlation", ".5f"),
        Column("num_within", "runs within"),
        Column("num_runs", "of"),
        Column("bounds", "bounds"),
    )
    note = (
        "Runs: those in which the quantity is not 0. Mean of the errors' sizes; correlation is "
        "Pearson's, - where a quantity does not vary."
    )
    return Table("Agreement with Accel-Sim", shown, columns, (note, VERSION))


def verdicts(frame: pd.DataFrame) -> list[str]:
    """A sentence per bound, which runs miss it, and last whether all are met."""
    lines, missed = [], []
    for name in QUANTITIES:
        met, line = _cycles_verdict(frame, name) if name in CYCLES else _counter(frame, name)
        lines.append(f"{_WORDS[name]}: {line}")
        if not met:
            missed.append(_WORDS[name])
    if missed:
        lines.append(f"Bounds not met: {'; '.join(missed)}.")
    else:
        lines.append("All bounds are met.")
    return lines


def _cycles_verdict(frame: pd.DataFrame, name: str) -> tuple[bool, str]:
    """The bounds hold on each machine by itself."""
    error = frame.assign(size=frame[f"{name}_error"].abs())
    means = error.groupby("config", sort=False)["size"].mean()
    over = [config for config, mean in means.items() if mean > MEAN_BOUND]
    outside = error[~frame[f"{name}_within"]]
    worst = error.loc[error["size"].idxmax()]
    line = (
        f"mean error {', '.join(f'{c} {m:.1%}' for c, m in means.items())} "
        f"(bound {MEAN_BOUND:.0%}), worst {worst[f'{name}_error']:+.1%} in {worst['config']} "
        f"{worst['trace']} (bound {WORST_BOUND:.0%}): "
    )
    if not over and outside.empty:
        return True, line + "met."
    reasons = [f"the mean of {config}" for config in over]
    reasons += _runs(outside, name)
    return False, line + f"outside: {', '.join(reasons)}."


def _counter(frame: pd.DataFrame, name: str) -> tuple[bool, str]:
    """The bounds hold in each run."""
    met = bool(frame[f"{name}_within"].all())
    frame = occurring(frame, name)
    equal = frame["config"].map(lambda config: must_be_equal(config, name))
    parts = []
    for part, bound in (
        (frame[equal], "equal"),
        (frame[~equal], f"within {COUNTER_BOUND:.0%} or {OF_ACCESSES_BOUND:.1%} of the accesses"),
    ):
        if part.empty:
            continue
        outside = part[~part[f"{name}_within"]]
        where = " where loads skip the L1" if bound == "equal" and not equal.all() else ""
        line = f"{len(part) - len(outside)} of {len(part)} runs {bound}{where}"
        parts.append(line + (f" (not: {', '.join(_runs(outside, name))})" if len(outside) else ""))
    return met, ("; ".join(parts) or "none on either side") + "."


def _runs(frame: pd.DataFrame, name: str) -> list[str]:
    """Each run with its error, worst first."""
    worst_first = frame.sort_values(f"{name}_error", key=lambda e: -e.abs(), kind="stable")
    return [
        f"{row['config']} {row['trace']} {row[f'{name}_error']:+.1%}"
        for _, row in worst_first.iterrows()
    ]
