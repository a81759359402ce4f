"""The correlation plot: our counts over Accel-Sim's, a panel per quantity and a point per run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from experiments.accel_sim_oracle import QUANTITIES, VERSION
from experiments.plots import FONT_SIZE, PALETTE
from experiments.validate_accel_sim import CYCLES, WORST_BOUND, correlation, occurring

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_MARKERS = "osD^vP"
#: How far an axis goes beyond its points.
_MARGIN = 1.6


def correlation_figure(frame: pd.DataFrame) -> Figure:
    """Both axes logarithmic, the diagonal where both agree; colour and marker tell machines apart.

    frame: as `validate_accel_sim.compare` returns it. Runs in which both counts are 0 have no
    place on these axes.
    """
    figure = Figure(figsize=(8.4, 6.1))
    figure.set_layout_engine("constrained", hspace=0.06)
    configs = list(dict.fromkeys(frame["config"]))
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, QUANTITIES.items(), strict=True):
        _panel(axes, frame, configs, name)
        axes.set_title(label, fontsize=FONT_SIZE + 1)
        axes.set_xlabel("Accel-Sim", fontsize=FONT_SIZE)
        axes.set_ylabel("sss-cachesim", fontsize=FONT_SIZE)
    # A panel may lack a machine: the legend is made of marks of its own.
    handles = [
        axes.plot(
            [], [], marker=_MARKERS[i], linestyle="none", markersize=5, markerfacecolor="none",
            color=PALETTE[i],
        )[0]
        for i in range(len(configs))
    ]  # fmt: skip
    figure.legend(
        handles, configs, loc="outside lower center", ncols=3, fontsize=FONT_SIZE, frameon=False
    )
    figure.suptitle(f"Every oracle trace beside {VERSION}", fontsize=FONT_SIZE + 1)
    return figure


def _panel(axes: Axes, frame: pd.DataFrame, configs: list[str], name: str) -> None:
    found, expected = f"{name}_ours", f"{name}_theirs"
    shown = frame[(frame[found] > 0) & (frame[expected] > 0)]
    axes.set_xscale("log")
    axes.set_yscale("log")
    values = shown[[found, expected]].to_numpy(np.float64)
    low, high = (values.min(), values.max()) if values.size else (1.0, 10.0)
    ends = np.array([low / _MARGIN, high * _MARGIN])
    axes.plot(ends, ends, color="0.4", linewidth=0.8, zorder=1)
    if name in CYCLES:
        axes.fill_between(
            ends, ends * (1 - WORST_BOUND), ends * (1 + WORST_BOUND), color="0.92", zorder=0
        )
    for index, config in enumerate(configs):
        part = shown[shown["config"] == config]
        axes.plot(
            part[expected],
            part[found],
            marker=_MARKERS[index],
            linestyle="none",
            markersize=5,
            markerfacecolor="none",
            color=PALETTE[index],
        )
    axes.set_xlim(*ends)
    axes.set_ylim(*ends)
    axes.set_aspect("equal")
    for axis in (axes.xaxis, axes.yaxis):
        # Powers of ten alone would leave a short axis with one number.
        axis.set_major_locator(LogLocator(subs=(1,) if ends[1] > 300 * ends[0] else (1, 2, 5)))
        axis.set_major_formatter(EngFormatter(sep=""))
        axis.set_minor_formatter(NullFormatter())
    part = occurring(frame, name)
    r = correlation(part[found], part[expected])
    told = f"{len(part)} runs" + ("" if np.isnan(r) else f"\nr = {r:.5f}")
    axes.text(0.04, 0.96, told, transform=axes.transAxes, va="top", fontsize=FONT_SIZE - 1)
    axes.tick_params(labelsize=FONT_SIZE - 1)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
