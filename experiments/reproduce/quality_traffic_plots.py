"""The figure of `quality-traffic`: quality over bytes, a column per GPU, rows L2 and DRAM."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from experiments.plots import FONT_SIZE, PALETTE
from experiments.reproduce.gpu_generations import GPUS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_MARKERS = ("v", "o", "s", "^", "D")
_DASHES = (":", "-", "-", "--", "-.")
#: An axis is logarithmic where the largest value is this many times the smallest.
LOG_FROM = 4.0
_METRICS = {"psnr": ("psnr_db", "PSNR (dB)"), "flip": ("flip", "FLIP")}


def traffic_figure(
    frame: pd.DataFrame, metric: str, title: str, traffic: Mapping[str, str]
) -> Figure:
    """One scene. metric: "psnr" or "flip". traffic: column of bytes -> what it is called."""
    column, label = _METRICS[metric]
    gpus = [name for name in GPUS if name in set(frame["gpu"])]
    methods = list(dict.fromkeys(frame["method"]))
    figure = Figure(figsize=(2.35 * len(gpus) + 0.4, 5.0), layout="constrained")
    grid = figure.subplots(len(traffic), len(gpus), squeeze=False, sharey=True, sharex="row")
    for number, (quantity, words) in enumerate(traffic.items()):
        for axes, gpu in zip(grid[number], gpus, strict=True):
            for i, method in enumerate(methods):
                own = frame[(frame["gpu"] == gpu) & (frame["method"] == method)]
                axes.plot(
                    own[quantity] / 1e6, own[column], _DASHES[i], marker=_MARKERS[i],
                    markersize=3.5, linewidth=1.1, color=PALETTE[i], label=method,
                )  # fmt: skip
            axes.set_xlabel(f"{words} (MB)", fontsize=FONT_SIZE)
            axes.tick_params(which="both", labelsize=FONT_SIZE - 2)
            axes.grid(color="0.92", linewidth=0.6)
            axes.set_axisbelow(True)
            axes.spines[["top", "right"]].set_visible(False)
            if number == 0:
                axes.set_title(f"{GPUS[gpu]}\n{gpu}", fontsize=FONT_SIZE)
        _scale(grid[number][0], "x", frame[quantity] / 1e6)
        if metric == "flip":
            _scale(grid[number][0], "y", frame[column])
        grid[number][0].set_ylabel(label, fontsize=FONT_SIZE)
    handles, names = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=5, fontsize=FONT_SIZE)
    figure.suptitle(title, fontsize=FONT_SIZE + 1)
    return figure


def _scale(axes: Axes, which: str, values: pd.Series) -> None:
    """A logarithmic axis with plain numbers, where the values spread enough to need one.

    which: "x" or "y"; the other axes of its row share it.
    """
    if values.max() < LOG_FROM * values.min():
        return
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(_short))
    axis.set_minor_formatter(NullFormatter())


def _short(value: float, _: int) -> str:
    """A tick's number; thousands as "5k", so that neighbours do not touch."""
    return f"{value / 1000:g}k" if value >= 1000 else f"{value:g}"
