"""The cost function's errors: their mean per GPU and level, the verdicts, the table, the plot."""

from __future__ import annotations

from typing import Any

import pandas as pd

from experiments.reproduce.experiment import Comparison

#: Targets of the mean held-out error.
DEMAND_TARGET, CYCLES_TARGET = 0.10, 0.20
LEVELS = ("l1", "l2", "dram")


def summarise(errors: pd.DataFrame) -> pd.DataFrame:
    """Mean relative error per GPU, level and kind of frame, of the model and the baselines.

    errors: rows of frames as `run` makes them. Columns: gpu, level, frames (how many), held_out,
    model, worst, per_n, bytes_32.
    """
    rows = []
    for (gpu, held_out), group in errors.groupby(["gpu", "held_out"], sort=False):
        for level in (*LEVELS, "cycles"):
            known = group[group[f"{level}_simulated"].notna() & group[f"{level}_predicted"].notna()]
            if known.empty:
                continue

            def off(kind: str, known: pd.DataFrame = known, level: str = level) -> pd.Series:
                found = known[f"{level}_{kind}"].astype(float)
                return (found / known[f"{level}_simulated"].astype(float) - 1.0).abs()

            rows.append(
                {
                    "gpu": gpu,
                    "level": level,
                    "frames": len(known),
                    "held_out": bool(held_out),
                    "model": float(off("predicted").mean()),
                    "worst": float(off("predicted").max()),
                    "per_n": float(off("per_n").mean()),
                    "bytes_32": float(off("32_bytes").mean()) if level != "cycles" else None,
                }
            )
    return pd.DataFrame(rows).astype({"bytes_32": "float64"})


def judge(summary: pd.DataFrame) -> tuple[Comparison, ...]:
    """The targets, and the baselines that must be beaten."""
    held = summary[summary["held_out"]]
    found = []
    for level in (*LEVELS, "cycles"):
        rows = held[held["level"] == level]
        if rows.empty:
            continue
        target = CYCLES_TARGET if level == "cycles" else DEMAND_TARGET
        mean, worst = float(rows["model"].mean()), rows.loc[rows["model"].idxmax()]
        name = level if level == "cycles" else f"{level.upper()} demand"
        good = bool((rows["model"] <= target).all())
        within = f"within {100 * target:.0f} % on {int((rows['model'] <= target).sum())} of "
        found.append(
            Comparison(
                f"{name}: mean held-out error, {len(rows)} GPU{'s' if len(rows) > 1 else ''}",
                None,
                f"{100 * mean:.1f}",
                "%",
                f"{within}{len(rows)}; most {100 * worst['model']:.1f} % ({worst['gpu']})",
                good,
            )
        )
        if level in ("l2", "dram"):
            for column, words in (("per_n", "proportional to n"), ("bytes_32", "32 B a fetch")):
                beaten = bool((rows["model"] < rows[column]).all())
                found.append(
                    Comparison(
                        f"{name}: error of the baseline, {words}",
                        None,
                        f"{100 * float(rows[column].mean()):.0f}",
                        "%",
                        "the model is better on every GPU" if beaten else "not beaten on every GPU",
                        beaten,
                    )
                )
    return tuple(found)


def error_summary(summary: pd.DataFrame) -> Any:
    from experiments.tables import Column, Table

    shown = summary.assign(
        kind=summary["held_out"].map({True: "held out", False: "fitted"}),
        **{c: 100.0 * summary[c] for c in ("model", "worst", "per_n", "bytes_32")},
    )
    columns = (
        Column("gpu", "GPU"),
        Column("kind", "frames are"),
        Column("level", "level"),
        Column("frames", "frames"),
        Column("model", "model", ".1f"),
        Column("worst", "worst frame", ".1f"),
        Column("per_n", "proportional to n", ".0f"),
        Column("bytes_32", "32 B a fetch", ".0f"),
    )
    return Table("Mean size of predicted / simulated - 1, in per cent", shown, columns)


def scatter_figure(errors: pd.DataFrame) -> Any:
    import numpy as np
    from matplotlib.figure import Figure

    from experiments.plots import FONT_SIZE, PALETTE

    figure = Figure(figsize=(9.4, 3.0), layout="constrained")
    panels = figure.subplots(1, 4)
    markers = ("o", "s", "^", "v", "D", "P", "X", "<", ">")
    for axes, level in zip(panels, (*LEVELS, "cycles"), strict=True):
        known = errors[errors[f"{level}_simulated"].notna() & errors[f"{level}_predicted"].notna()]
        axes.set_title(
            level if level == "cycles" else f"{level.upper()} demand", fontsize=FONT_SIZE
        )
        if known.empty:
            continue
        scale = 1e-6
        for k, (gpu, group) in enumerate(known.groupby("gpu", sort=False)):
            colour, marker = PALETTE[k % len(PALETTE)], markers[k % len(markers)]
            for held_out, part in group.groupby("held_out"):
                axes.plot(
                    part[f"{level}_simulated"].astype(float) * scale,
                    part[f"{level}_predicted"].astype(float) * scale,
                    marker, markersize=3.5, color=colour,
                    markerfacecolor="none" if held_out else colour,
                    label=str(gpu) if not held_out and level == "l1" else None,
                )  # fmt: skip
        ends = known[f"{level}_simulated"].astype(float) * scale
        line = np.array([ends.min() / 1.5, ends.max() * 1.5])
        band = CYCLES_TARGET if level == "cycles" else DEMAND_TARGET
        axes.plot(line, line, color="0.4", linewidth=0.8)
        axes.fill_between(line, line * (1 - band), line * (1 + band), color="0.88", zorder=0)
        axes.set_xscale("log")
        axes.set_yscale("log")
        unit = "millions" if level == "cycles" else "MB"
        axes.set_xlabel(f"simulated ({unit})", fontsize=FONT_SIZE)
        axes.tick_params(labelsize=FONT_SIZE - 1)
    panels[0].set_ylabel("predicted", fontsize=FONT_SIZE)
    figure.legend(loc="outside lower center", ncols=5, fontsize=FONT_SIZE - 1)
    return figure
