"""The correlation plot: modelled over measured, a panel per quantity and a point per launch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, PercentFormatter

from experiments.plots import FONT_SIZE, PALETTE
from experiments.silicon.compare import QUANTITIES, Quantity, correlation

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

_MARKERS = {"texture": "o", "load": "s"}
_PASSES = ("setup", "prefilter", "sampling", "update", "combine")
#: How far an axis goes beyond its points.
_MARGIN = 1.6


def correlation_figure(frame: pd.DataFrame, device: str) -> Figure:
    """Both axes logarithmic, the diagonal where both agree; colour tells passes apart, marker the
    way to fetch.

    frame: as `compare.compare` returns it. Zeros have no place on these axes.
    """
    figure = Figure(figsize=(8.4, 6.1))
    figure.set_layout_engine("constrained", hspace=0.06)
    for axes, quantity in zip(figure.subplots(2, 3).flat, QUANTITIES, strict=True):
        _panel(axes, frame[frame["quantity"] == quantity.name], quantity)
    handles, names = [], []
    for index, name in enumerate(_PASSES):
        handles.append(_mark(axes, PALETTE[index], "o"))
        names.append(name)
    for fetch, marker in _MARKERS.items():
        handles.append(_mark(axes, "0.3", marker))
        names.append(fetch)
    figure.legend(
        handles, names, loc="outside lower center", ncols=7, fontsize=FONT_SIZE, frameon=False
    )
    figure.suptitle(f"Every launch beside {device or 'silicon'}", fontsize=FONT_SIZE + 1)
    return figure


def _mark(axes: Axes, colour: str, marker: str) -> Line2D:
    return axes.plot(
        [], [], marker=marker, linestyle="none", markersize=5, markerfacecolor="none", color=colour
    )[0]


def _panel(axes: Axes, part: pd.DataFrame, quantity: Quantity) -> None:
    shown = part[(part["measured"] > 0) & (part["modelled"] > 0)]
    axes.set_xscale("log")
    axes.set_yscale("log")
    values = shown[["measured", "modelled"]].to_numpy(np.float64)
    low, high = (values.min(), values.max()) if values.size else (1.0, 10.0)
    ends = np.array([low / _MARGIN, high * _MARGIN])
    axes.plot(ends, ends, color="0.4", linewidth=0.8, zorder=1)
    if not quantity.is_rate:
        near = ends * (1 - quantity.target), ends * (1 + quantity.target)
        axes.fill_between(ends, *near, color="0.92", zorder=0)
    for index, name in enumerate(_PASSES):
        for fetch, marker in _MARKERS.items():
            points = shown[(shown["pass"] == name) & (shown["fetch"] == fetch)]
            axes.plot(
                points["measured"],
                points["modelled"],
                marker=marker,
                linestyle="none",
                markersize=5,
                markerfacecolor="none",
                color=PALETTE[index],
            )
    axes.set_xlim(*ends)
    axes.set_ylim(*ends)
    axes.set_aspect("equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1,) if ends[1] > 300 * ends[0] else (1, 2, 5)))
        axis.set_major_formatter(
            PercentFormatter(1, 0) if quantity.is_rate else EngFormatter(sep="")
        )
        axis.set_minor_formatter(NullFormatter())
    r = correlation(part["modelled"], part["measured"])
    told = f"{len(part)} launches" + ("" if np.isnan(r) else f"\nr = {r:.4f}")
    axes.text(0.04, 0.96, told, transform=axes.transAxes, va="top", fontsize=FONT_SIZE - 1)
    axes.set_title(f"{quantity.level} {quantity.label}", fontsize=FONT_SIZE + 1)
    axes.set_xlabel("measured", fontsize=FONT_SIZE)
    axes.set_ylabel("modelled", fontsize=FONT_SIZE)
    axes.tick_params(labelsize=FONT_SIZE - 1)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
