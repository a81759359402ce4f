"""The model beside what was measured: errors per launch and level, their means, and correlation."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from experiments.silicon import ncu
from experiments.silicon.cases import Case
from experiments.silicon.rows import is_measurements, read_measurements
from experiments.tables import Column, Table
from traces.errors import InputError

if TYPE_CHECKING:
    from cachesim.report import Report


@dataclass(frozen=True)
class Quantity:
    """One thing that is compared. level: whose it is. is_rate: errors are differences in points.
    target: of the mean error's size.
    """

    name: str
    level: str
    label: str
    is_rate: bool
    target: float


QUANTITIES = (
    Quantity("l1_sectors", "L1", "sectors", False, 0.01),
    Quantity("l1_hit_rate", "L1", "hit rate", True, 0.03),
    Quantity("l2_sectors", "L2", "sectors", False, 0.05),
    Quantity("l2_hit_rate", "L2", "hit rate", True, 0.03),
    Quantity("dram_sectors", "DRAM", "sectors read", False, 0.05),
    Quantity("cycles", "SM", "cycles", False, 0.15),
)
#: Preset by what a device's name holds; the first that fits.
PRESETS = (
    (r"H100.*(HBM3|SXM)", "h100-sxm"),
    (r"H200", "h200"),
    (r"TITAN X \(Pascal\)", "titan-x-pascal"),
    (r"P4000", "quadro-p4000"),
    (r"RTX 2080 Ti", "rtx-2080-ti"),
    (r"RTX 2060", "rtx-2060"),
)
#: Said of a GPU without committed measurements.
NOT_MEASURED = "not measured"
Values = dict[str, float]


@dataclass(frozen=True)
class Measured:
    """What was measured of the workload. notes: what a reader must know."""

    device: str
    cases: Mapping[Case, Values]
    notes: tuple[str, ...]


def committed_files() -> list[Path]:
    """The measurements that are committed, by name."""
    folder = Path(str(resources.files("experiments.silicon"))) / "data"
    return sorted(folder.glob("*.csv")) if folder.is_dir() else []


def silicon_of() -> dict[str, str]:
    """Preset -> names of the committed measurements of its GPU."""
    found: dict[str, str] = {}
    for path in committed_files():
        name = preset_of(read_measured(path).device)
        found[name] = ", ".join(filter(None, (found.get(name), path.name)))
    return found


def read_measured(path: Path) -> Measured:
    """The workload's launches in a measurements' file, or in a raw page of Nsight Compute.

    Raises:
        InputError: it is neither, is damaged, or holds no launch of the workload.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    if is_measurements(text):
        return _from_measurements(path, text)
    return _from_raw_page(path, text)


def _from_measurements(path: Path, text: str) -> Measured:
    read = read_measurements(path, text)
    counters: dict[Case, Values] = {}
    timed: dict[Case, Values] = {}
    for row in read.rows:
        case = Case.of_words(row.words) if row.measurement == "workload" else None
        if case is not None:
            (counters if row.source == "ncu" else timed).setdefault(case, {})[row.quantity] = (
                row.value
            )
    cases: dict[Case, Values] = {}
    for case in sorted({*counters, *timed}):
        values = quantities_of(counters.get(case, {}))
        if "cycles" not in values and "cycles" in timed.get(case, {}):
            values["cycles"] = timed[case]["cycles"]
        if values:
            cases[case] = values
    if not cases:
        raise InputError(f"{path}: no launch of the workload was measured")
    notes = [f"Measured: {read.manifest['device']}, {read.manifest.get('date', 'no date')}."]
    if not counters:
        notes.append(f"Counters: {read.manifest.get('counters', 'none')}.")
    notes += [
        f"Wrong picture: {row.case}: {row.quantity} {row.value:g}"
        for row in read.rows
        if row.measurement == "picture" and row.quantity == "identical" and row.value != 1
    ]
    return Measured(str(read.manifest["device"]), cases, tuple(notes))


def _from_raw_page(path: Path, text: str) -> Measured:
    launches = ncu.parse_raw_page(text, str(path))
    grouped: dict[Case, list[Values]] = {}
    for launch in launches:
        case = Case.of_kernel(launch.kernel)
        values = quantities_of(launch.values)
        if case is not None and values:
            grouped.setdefault(case, []).append(values)
    if not grouped:
        names = sorted({launch.kernel for launch in launches})[:3]
        raise InputError(
            f"{path}: no kernel of the workload with its counters: need names such as "
            f"afis__close__1920x1080__fixed64__texture__sampling__0__…, found {', '.join(names)}"
        )
    cases = {
        case: {name: float(np.mean([v[name] for v in found if name in v])) for name in found[0]}
        for case, found in grouped.items()
    }
    return Measured("", cases, (f"Measured: {path.name}, by Nsight Compute.",))


def quantities_of(counters: Mapping[str, float]) -> Values:
    """What the profiler's counters say of `QUANTITIES`; what they do not say is absent."""

    def total(*names: str) -> float | None:
        known = [v for v in (ncu.pick(dict(counters), n) for n in names) if v is not None]
        return sum(known) if known else None

    found: Values = {}
    l1, l2 = total("tex_sectors", "load_sectors"), total("l2_reads")
    for name, value in (
        ("l1_sectors", l1),
        ("l2_sectors", l2),
        ("dram_sectors", total("dram_reads")),
        ("cycles", total("cycles")),
    ):
        if value is not None:
            found[name] = value
    hits, l2_hits = total("tex_hits", "load_hits"), total("l2_read_hits")
    if l1 and hits is not None:
        found["l1_hit_rate"] = hits / l1
    if l2 and l2_hits is not None:
        found["l2_hit_rate"] = l2_hits / l2
    return found


def modelled_of(report: Report) -> Values:
    """The same of the model: of loads alone, as the profiler's counters are."""
    found: Values = {"dram_sectors": float(report.dram.sectors_read)}
    for level in ("l1", "l2"):
        c = report.counters[level]
        sectors, misses = c.accesses - c.writes, c.misses - c.write_misses
        found[f"{level}_sectors"] = float(sectors)
        if sectors:
            found[f"{level}_hit_rate"] = 1 - misses / sectors
    if report.cycles is not None:
        found["cycles"] = float(report.cycles["total"] - report.cycles["launch"])
    return found


def preset_of(device: str) -> str:
    """The preset of a device's name.

    Raises:
        InputError: none fits.
    """
    for pattern, name in PRESETS:
        if re.search(pattern, device):
            return name
    raise InputError(f"device {device!r}: no preset for it: name one with --gpu")


def compare(
    measured: Mapping[Case, Values],
    modelled: Mapping[Case, Values],
    is_wanted: Callable[[Quantity], bool] = lambda quantity: True,
) -> pd.DataFrame:
    """A row per launch and quantity that both sides have.

    Columns: "workload", "pass", "mip", "fetch", "level", "quantity", "label", "measured",
    "modelled", "error": relative, or the difference of rates.
    """
    rows = []
    for case in sorted(measured):
        for q in filter(is_wanted, QUANTITIES):
            ours, theirs = modelled.get(case, {}).get(q.name), measured[case].get(q.name)
            if ours is None or theirs is None:
                continue
            rows.append(
                {
                    "workload": f"{case.scene} {case.size} {case.counts} {case.fetch}",
                    "pass": case.pass_name,
                    "mip": case.level,
                    "fetch": case.fetch,
                    "level": q.level,
                    "quantity": q.name,
                    "label": q.label,
                    "measured": theirs,
                    "modelled": ours,
                    "error": ours - theirs if q.is_rate else relative(ours, theirs),
                }
            )
    return pd.DataFrame(rows)


def relative(ours: float, theirs: float) -> float:
    """(ours - theirs) / theirs; 0 where both are 0, NaN where only the measured one is."""
    if ours == theirs:
        return 0.0
    return (ours - theirs) / theirs if theirs else math.nan


def summarise(frame: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst error's size and correlation of each quantity; "met": the mean is within its
    target.
    """
    rows = []
    for q in QUANTITIES:
        part = frame[frame["quantity"] == q.name] if len(frame) else frame
        if not len(part):
            continue
        error = part["error"].abs()
        worst = part.loc[error.idxmax()] if error.notna().any() else None
        rows.append(
            {
                "quantity": f"{q.level} {q.label}",
                "mean_error": float(error.mean()),
                "worst_error": math.nan if worst is None else float(worst["error"]),
                "worst_launch": "-" if worst is None else f"{worst['workload']} {worst['pass']}",
                "correlation": correlation(part["modelled"], part["measured"]),
                "num_launches": len(part),
                "unit": "points" if q.is_rate else "relative",
                "target": q.target,
                "met": bool(error.mean() <= q.target),
            }
        )
    return pd.DataFrame(rows)


def correlation(ours: Iterable[float], theirs: Iterable[float]) -> float:
    """Pearson's r; NaN where one of the two does not vary."""
    a, b = np.fromiter(ours, np.float64), np.fromiter(theirs, np.float64)
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(np.corrcoef(a, b)[0, 1])


def launches_table(frame: pd.DataFrame, notes: Sequence[str]) -> Table:
    """Every launch and level."""
    rates = frame["quantity"].str.endswith("rate")
    shown = frame.assign(
        measured_text=[_show(v, r) for v, r in zip(frame["measured"], rates, strict=True)],
        modelled_text=[_show(v, r) for v, r in zip(frame["modelled"], rates, strict=True)],
        error_text=[
            "-" if math.isnan(v) else f"{100 * v:+.1f} points" if r else f"{v:+.1%}"
            for v, r in zip(frame["error"], rates, strict=True)
        ],
    )
    columns = (
        Column("workload", "workload"),
        Column("pass", "pass"),
        Column("mip", "mip", numeric=False),
        Column("level", "level"),
        Column("label", "quantity"),
        Column("measured_text", "measured", numeric=True),
        Column("modelled_text", "modelled", numeric=True),
        Column("error_text", "error", numeric=True),
    )
    return Table("The model beside silicon", shown, columns, tuple(notes))


def _show(value: float, is_rate: bool) -> str:
    return f"{value:.1%}" if is_rate else f"{value:,.0f}"


def summary_table(summary: pd.DataFrame) -> Table:
    """Mean absolute error, correlation and target per quantity."""

    def text(value: float, unit: str, sign: str = "") -> str:
        if math.isnan(value):
            return "-"
        return f"{100 * value:{sign}.1f} points" if unit == "points" else f"{value:{sign}.1%}"

    def texts(name: str, sign: str = "") -> list[str]:
        pairs = zip(summary[name], summary["unit"], strict=True)
        return [text(value, unit, sign) for value, unit in pairs]

    shown = summary.assign(
        mean_text=texts("mean_error"),
        worst_text=texts("worst_error", "+"),
        target_text=texts("target"),
        verdict=summary["met"].map({True: "met", False: "not met"}),
    )
    columns = (
        Column("quantity", "quantity"),
        Column("mean_text", "mean absolute error", numeric=True),
        Column("worst_text", "worst", numeric=True),
        Column("worst_launch", "of"),
        Column("correlation", "correlation", ".4f"),
        Column("num_launches", "launches"),
        Column("target_text", "target", numeric=True),
        Column("verdict", "mean"),
    )
    note = (
        "Sectors and hit rates of loads; each launch from empty caches. The profiler's sectors, "
        "hits and cycles; the model's cycles without its launch latency. Correlation is Pearson's."
    )
    return Table("Agreement with silicon", shown, columns, (note,))
