"""The experiment of the dissertation's chapter 4: one view, fixed against adaptive sampling, under
GPGPU-Sim's TITAN X Pascal.

The slides show three plots in turn (simulation cycles; L1 and L2 demand; L1 and L2 miss rate) for a
side view, without axes, and print one pair of numbers. They do not say the resolution, the samples,
the fetch path or what a demand is; so we show each fetch path, say which L1 columns mean anything,
and compare directions alone. A demand here is the sectors that a level was asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cachesim import simulate
from cachesim.report import sum_parts
from experiments.adaptive_tables import FIRST_TOUCH
from experiments.tables import Column, Table, show_value
from kernels.method import Method
from kernels.record import record

if TYPE_CHECKING:
    from cachesim import Report
    from cachesim.config import Gpu
    from cachesim.report import LevelCounters
    from kernels.gbuffer import GBuffer
    from kernels.opencl.device import Device

FETCH_PATHS = ("texture", "readonly", "global")
METHODS = ("fixed", "adaptive")
#: With the mip chain, and with every sample at mip 0 and no pre-filter.
MIPS: dict[str, dict[str, Any]] = {
    "Eq 5.12": {},
    "mip 0 only": {"mip_rule": "mip0", "prefilter": False},
}
NUM_RUNS = len(FETCH_PATHS) * len(METHODS) * len(MIPS)
#: A number is of the whole frame, or of its sampling pass alone.
PASSES = ("frame", "sampling")
MIPPED_TEXTURE = "setup"
PRINTED = (
    "The slides print one pair, Mip0: 91,541 vs 151,356 (0.605). They do not say of what: accesses "
    "or misses of mip 0, or cycles with mips off; of which level; of which crop of the view, whose "
    "size such small numbers suggest; which of the two is adaptive. We claim no reproduction; the "
    "mip 0 rows and the runs with mip 0 only stand here for the direction."
)


@dataclass(frozen=True, eq=False)
class Run:
    """One timed frame. mips: a name in MIPS. num_samples: of all pixels together."""

    fetch_path: str
    mips: str
    method: str
    report: Report


def measure(
    gbuffer: GBuffer,
    gpu: Gpu,
    shared: Method,
    *,
    num_frames: int,
    device: Device | None = None,
    step: Callable[[str], None] = lambda _: None,
) -> list[Run]:
    """Record and time every combination of fetch path, mips and method.

    Args:
        gbuffer: the view.
        gpu: with timing.
        shared: settings that all runs have in common.
        num_frames: frames of an adaptive run; the last one is timed.
        device: where to render.
        step: is told each run's name before it starts.
    """
    runs = []
    for path in FETCH_PATHS:
        for mips in MIPS:
            for kind in METHODS:
                step(f"{path}, {mips}, {kind}")
                runs.append(
                    measure_run(
                        gbuffer, gpu, shared, path, mips, kind, num_frames=num_frames, device=device
                    )
                )
    return runs


def measure_run(
    gbuffer: GBuffer,
    gpu: Gpu,
    shared: Method,
    fetch_path: str,
    mips: str,
    kind: str,
    *,
    num_frames: int,
    device: Device | None = None,
) -> Run:
    """Record and time one of the combinations of `measure`."""
    method = replace(shared, kind=kind, **MIPS[mips])
    count = num_frames if method.adaptive else 1
    trace = record(gbuffer, method, num_frames=count, device=device, self_check=False)
    return Run(fetch_path, mips, kind, simulate(trace, gpu, fetch_path=fetch_path, timing=True))


def totals_frame(runs: Sequence[Run]) -> pd.DataFrame:
    """One row per run and population ("frame" or "sampling"): cycles, sectors asked, miss rates."""
    rows = []
    for run in runs:
        for passes in PASSES:
            key = {"fetch_path": run.fetch_path, "mips": run.mips, "passes": passes}
            rows.append(key | {"method": run.method} | _totals(run.report, passes))
    return pd.DataFrame(rows)


def _totals(report: Report, passes: str) -> dict[str, Any]:
    timing = report.timing
    assert timing is not None
    if passes == "frame":
        cycles, counters = timing.total.cycles, report.counters
        dram = report.dram.bytes
    else:
        cycles = sum(p.cycles for p in timing.passes if p.name == passes)
        parts = [p for p in report.parts or () if p.pass_name == passes]
        counters = {level: sum_parts(parts, level) for level in report.levels}
        dram = sum(p.dram.bytes for p in parts)
    row: dict[str, Any] = {"cycles": cycles}
    for level in ("l1", "l2"):
        row |= _level_row(level, counters[level])
    return row | {"dram_bytes": dram}


def _level_row(level: str, counts: LevelCounters) -> dict[str, Any]:
    return {
        f"{level}_accesses": counts.accesses,
        f"{level}_misses": counts.misses,
        f"{level}_miss_rate": counts.miss_rate,
    }


def ratio_rows(totals: pd.DataFrame) -> pd.DataFrame:
    """Adaptive / fixed of every number: one row per fetch path, mips and passes; NaN for 0 / 0."""
    keys = ["fetch_path", "mips", "passes"]
    fixed, adaptive = (
        totals[totals["method"] == m].drop(columns="method").set_index(keys).astype(float)
        for m in METHODS
    )
    ratios: pd.DataFrame = (adaptive / fixed).reset_index()
    return ratios


def totals_table(totals: pd.DataFrame, gpu: Gpu, title: str) -> Table:
    """Fixed, adaptive and their ratio, with a word on each fetch path's L1."""
    ratios = ratio_rows(totals).set_index(["fetch_path", "mips", "passes"])
    numbers = {"cycles": ",.0f", "l1_accesses": ",.0f", "l2_accesses": ",.0f"}
    numbers |= {"l1_miss_rate": ".3f", "l2_miss_rate": ".3f"}
    rows = []
    for key, group in totals.groupby(["fetch_path", "mips", "passes"], sort=False):
        shared = dict(zip(("fetch_path", "mips", "passes"), key, strict=True))
        for _, row in group.iterrows():
            cells = {n: show_value(_number(row[n]), f) for n, f in numbers.items()}
            rows.append(shared | {"method": row["method"]} | cells)
        ratio = ratios.loc[key]
        rows.append(
            shared
            | {"method": "ratio"}
            | {n: show_value(_number(ratio[n]), ".3f") for n in numbers}
        )
    columns = (
        Column("fetch_path", "fetch path"),
        Column("mips", "mips"),
        Column("passes", "of"),
        Column("method", "method"),
        Column("cycles", "cycles", numeric=True),
        Column("l1_accesses", "L1 demand", numeric=True),
        Column("l2_accesses", "L2 demand", numeric=True),
        Column("l1_miss_rate", "L1 miss rate", numeric=True),
        Column("l2_miss_rate", "L2 miss rate", numeric=True),
    )
    notes = [
        "Demand: sectors asked of the level (32 B here as in GPGPU-Sim). ratio: adaptive / fixed. "
        "frame: all passes, of which only adaptive has an update.",
        *(l1_verdict(gpu, path, _l1_accesses(totals, path)) for path in FETCH_PATHS),
        *findings(ratio_rows(totals)),
        PRINTED,
    ]
    return Table(f"Fixed 64 against adaptive: {title}", pd.DataFrame(rows), columns, tuple(notes))


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _l1_accesses(totals: pd.DataFrame, path: str) -> int:
    of_frames = totals[(totals["fetch_path"] == path) & (totals["passes"] == "frame")]
    return int(of_frames["l1_accesses"].sum())


def l1_verdict(gpu: Gpu, path: str, l1_accesses: int) -> str:
    """Whether the L1 columns of a fetch path mean anything on this machine."""
    if not l1_accesses:
        return (
            f"{path}: the L1 columns mean nothing. Plain loads skip the L1 on {gpu.name} "
            "(l1.bypass_loads), so its demand is 0 and it has no miss rate; a plot that shows both "
            "was made with another path or another setting."
        )
    if path == "texture" and gpu.l1_texture is not None:
        return (
            f"{path}: the L1 columns are those of the separate texture L1 of {gpu.name}, which the "
            "card does not have (its texture unit shares the L1). They mean what a CUDA port sees "
            "that reads through texture objects."
        )
    if path == "readonly":
        return (
            f"{path}: the L1 columns mean the L1 data cache of {gpu.name}, as a CUDA port sees it "
            "whose loads the compiler marks read-only (const __restrict__, __ldg); its stores "
            "pass by."
        )
    return f"{path}: the L1 columns mean the L1 of {gpu.name}, through which these loads go."


def findings(ratios: pd.DataFrame) -> list[str]:
    """Directions, over all fetch paths and both mip rules: lower for adaptive or not."""
    names = {
        "cycles": "Cycles", "l1_accesses": "L1 demand", "l2_accesses": "L2 demand",
        "l1_miss_rate": "L1 miss rate", "l2_miss_rate": "L2 miss rate",
    }  # fmt: skip
    lines = []
    for passes in PASSES:
        of = ratios[ratios["passes"] == passes]
        told = []
        for name, text in names.items():
            known = of[name].replace([np.inf, -np.inf], np.nan).dropna()
            if known.empty:
                continue
            below = int((known < 1).sum())
            span = f"{known.min():.2f} to {known.max():.2f}"
            where = "lower in all" if below == len(known) else f"lower in {below} of {len(known)}"
            told.append(f"{text} {span} ({where})")
        of_what = "the frame" if passes == "frame" else "the sampling pass"
        lines.append(f"Adaptive / fixed of {of_what}: {'; '.join(told)}.")
    if (ratios[["l1_miss_rate", "l2_miss_rate"]] > 1).any(axis=None):
        lines.append(FIRST_TOUCH)
    return lines


def mips_frame(runs: Sequence[Run]) -> pd.DataFrame:
    """One row per run with mips and part: a mip of the irradiance texture, or all other textures;
    the parts of a run sum to its frame.
    """
    rows = []
    for run in runs:
        if run.mips != "Eq 5.12":
            continue
        groups: dict[str, list[Any]] = {}
        for part in run.report.parts or ():
            name = f"mip {part.mip}" if part.texture == MIPPED_TEXTURE else "other"
            groups.setdefault(name, []).append(part)
        for name in sorted(groups):
            row = {"fetch_path": run.fetch_path, "part": name, "method": run.method}
            for level in ("l1", "l2"):
                row |= _level_row(level, sum_parts(groups[name], level))
            rows.append(row)
    return pd.DataFrame(rows)


def mips_table(mips: pd.DataFrame, title: str) -> Table:
    """Fixed beside adaptive per part, with the ratio of the demands."""
    names = ("l1_accesses", "l1_miss_rate", "l2_accesses", "l2_miss_rate")
    by_key = {(r["fetch_path"], r["part"], r["method"]): r for _, r in mips.iterrows()}
    rows = []
    for path, part in dict.fromkeys((k[0], k[1]) for k in by_key):
        row = {"fetch_path": path, "part": part}
        pair = [by_key.get((path, part, m)) for m in METHODS]
        for name in names:
            for method, found in zip(METHODS, pair, strict=True):
                value = None if found is None else _number(found[name])
                row[f"{name}_{method}"] = show_value(value, ".3f" if "rate" in name else ",.0f")
        for level in ("l1", "l2"):
            asked = [0.0 if p is None else float(p[f"{level}_accesses"]) for p in pair]
            row[f"{level}_ratio"] = show_value(asked[1] / asked[0] if asked[0] else None, ".3f")
        rows.append(row)
    columns = [Column("fetch_path", "fetch path"), Column("part", "part")]
    for level in ("l1", "l2"):
        head = level.upper()
        columns += [
            Column(f"{level}_accesses_fixed", f"{head} fix", numeric=True),
            Column(f"{level}_accesses_adaptive", f"{head} ada", numeric=True),
            Column(f"{level}_ratio", "ratio", numeric=True),
            Column(f"{level}_miss_rate_fixed", f"{head} miss fix", numeric=True),
            Column(f"{level}_miss_rate_adaptive", f"{head} miss ada", numeric=True),
        ]
    notes = (
        "Sectors asked per mip of the irradiance texture, its writes by set-up and pre-filter "
        "included; other: all other textures. Eq 5.12 takes coarser mips for fewer samples.",
        PRINTED,
    )
    return Table(f"By mip: {title}", pd.DataFrame(rows), tuple(columns), notes)
