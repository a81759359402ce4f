"""The bar charts of the chapter 4 experiment, one figure per fetch path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.cache_table_study import METHODS, PASSES
from experiments.plots import FONT_SIZE, paired_bars


def path_figure(totals: pd.DataFrame, path: str, title: str) -> Figure:
    """The three bar charts of one fetch path, with mips: cycles, demands, miss rates."""
    chosen = totals[(totals["fetch_path"] == path) & (totals["mips"] == "Eq 5.12")]
    by_key = chosen.set_index(["passes", "method"])
    figure = Figure(figsize=(7.6, 2.9), layout="constrained")
    cycles, demand, rates = figure.subplots(1, 3, squeeze=False)[0]
    paired_bars(
        cycles,
        PASSES,
        {m: [float(by_key.loc[(p, m), "cycles"]) for p in PASSES] for m in METHODS},
        numbers=True,
    )
    cycles.set_title("simulation cycles", fontsize=FONT_SIZE)
    for axes, quantity, text in (
        (demand, "accesses", "demand (sectors)"),
        (rates, "miss_rate", "miss rate"),
    ):
        heights = {
            m: [_height(by_key.loc[("frame", m), f"{level}_{quantity}"]) for level in ("l1", "l2")]
            for m in METHODS
        }
        paired_bars(axes, ("L1", "L2"), heights, numbers=True)
        axes.set_title(f"{text}, frame", fontsize=FONT_SIZE)
        if not by_key["l1_accesses"].any():
            axes.text(0, 0, "L1 not asked", ha="center", va="bottom", fontsize=FONT_SIZE - 1)
    handles, names = cycles.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=FONT_SIZE)
    figure.suptitle(title, fontsize=FONT_SIZE + 1)
    return figure


def _height(value: Any) -> float:
    """A bar's height; none where the value is missing."""
    return 0.0 if value is None or np.isnan(float(value)) else float(value)
