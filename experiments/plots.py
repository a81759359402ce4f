"""Figures for a paper: fixed against adaptive, per mip, sample-count maps, sweeps.

Colours are Okabe and Ito's, which people with colour-blindness tell apart; bars also differ in
hatching, lines in marker and dash. No pyplot: a figure belongs to whoever holds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from experiments.tables import three_digits

if TYPE_CHECKING:
    import pandas as pd

#: Okabe and Ito 2008, without black and yellow.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
METHOD_STYLE = {"fixed": ("#0072B2", ""), "adaptive": ("#E69F00", "///")}
FONT_SIZE = 8
#: Edges of the classes of a sample-count map.
COUNT_EDGES = (1, 9, 17, 25, 33, 41, 49, 57, 65)


def count_map(counts: npt.NDArray[np.uint16], title: str, attribution: str = "") -> Figure:
    """The samples of each pixel: grey where nothing scatters, then cividis, dark for few.

    counts: (h, w) uint16, samples of each pixel; 0 = not scattering.
    """
    height, width = counts.shape
    figure = Figure(figsize=(6.4, 6.4 * height / width * 0.86 + 0.55), layout="constrained")
    axes = figure.add_subplot()
    edges = [e for e in COUNT_EDGES if e <= max(65, int(counts.max()) + 1)]
    if counts.max() >= COUNT_EDGES[-1]:
        edges = list(np.unique(np.linspace(1, int(counts.max()) + 1, 9).astype(int)))
    from matplotlib import colormaps

    colours = colormaps["cividis"].with_extremes(bad="0.85")
    shown = axes.imshow(
        np.ma.masked_equal(counts, 0),
        cmap=colours,
        norm=BoundaryNorm(edges, colours.N),
        interpolation="nearest",
    )
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(title, fontsize=FONT_SIZE + 1)
    if attribution:
        axes.set_xlabel(attribution, fontsize=FONT_SIZE - 2)
    classes = list(pairwise(edges))
    middles = [(low + high) / 2 for low, high in classes]
    bar = figure.colorbar(shown, ax=axes, shrink=0.9, ticks=middles)
    bar.set_ticklabels([f"{low}-{high - 1}" for low, high in classes])
    bar.ax.tick_params(labelsize=FONT_SIZE - 1, length=0)
    bar.ax.minorticks_off()
    bar.set_label("samples per pixel (grey: no scattering)", fontsize=FONT_SIZE)
    return figure


def _style(axes: Axes) -> None:
    axes.tick_params(labelsize=FONT_SIZE - 1)
    axes.grid(axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def paired_bars(
    axes: Axes, labels: Sequence[str], values: Mapping[str, Sequence[float]], numbers: bool = False
) -> None:
    """One group of bars per label, one bar per method; `numbers` puts its value above each."""
    place = np.arange(len(labels))
    width = 0.8 / len(values)
    for i, (method, heights) in enumerate(values.items()):
        colour, hatch = METHOD_STYLE.get(method, (PALETTE[i % len(PALETTE)], ""))
        at = place + (i - (len(values) - 1) / 2) * width
        bars = axes.bar(
            at, heights, width, label=method, color=colour, hatch=hatch, edgecolor="white"
        )
        if numbers:
            axes.bar_label(
                bars,
                [three_digits(h) for h in heights],
                fontsize=FONT_SIZE - 3,
                padding=1,
            )
    axes.set_xticks(place, labels, fontsize=FONT_SIZE)
    _style(axes)


def comparison_figure(frame: pd.DataFrame, quantities: dict[str, str]) -> Figure:
    """Fixed beside adaptive: axes in rows of GPUs and columns of quantities, bars grouped by scene.

    frame: columns "scene", "gpu", "method" and the quantities. quantities: column to axis label
    with its unit.
    """
    gpus = list(dict.fromkeys(frame["gpu"]))
    scenes = list(dict.fromkeys(frame["scene"]))
    methods = list(dict.fromkeys(frame["method"]))
    figure = Figure(
        figsize=(1.2 + 2.1 * len(quantities), 0.5 + 1.55 * len(gpus)), layout="constrained"
    )
    grid = figure.subplots(len(gpus), len(quantities), squeeze=False, sharey="col")
    for row, gpu in zip(grid, gpus, strict=True):
        of_gpu = frame[frame["gpu"] == gpu].set_index(["scene", "method"])
        for axes, (column, label) in zip(row, quantities.items(), strict=True):
            heights = {m: [float(of_gpu.loc[(s, m), column]) for s in scenes] for m in methods}
            paired_bars(axes, scenes, heights, numbers=True)
            axes.margins(y=0.14)
            if gpu == gpus[0]:
                axes.set_title(label, fontsize=FONT_SIZE)
        row[0].set_ylabel(gpu, fontsize=FONT_SIZE)
    handles, names = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=FONT_SIZE)
    return figure


def mip_figure(frame: pd.DataFrame, label: str) -> Figure:
    """Bytes per mip level, fixed beside adaptive: one column of axes per scene.

    frame: columns "scene", "method", "mip", "megabytes". label: of the vertical axis, with unit.
    """
    scenes = list(dict.fromkeys(frame["scene"]))
    mips = sorted(set(frame["mip"]))
    figure = Figure(figsize=(1.0 + 2.4 * len(scenes), 2.6), layout="constrained")
    for axes, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
        of_scene = frame[frame["scene"] == scene].set_index(["method", "mip"])["megabytes"]
        heights = {
            m: [float(of_scene.get((m, mip), 0.0)) for mip in mips]
            for m in dict.fromkeys(frame["method"])
        }
        paired_bars(axes, [str(mip) for mip in mips], heights)
        axes.set_title(scene, fontsize=FONT_SIZE)
        # Each level holds a quarter of the one below: a linear axis would show mip 0 alone.
        axes.set_yscale("log")
        axes.set_xlabel("mip level", fontsize=FONT_SIZE)
        axes.set_ylabel(label, fontsize=FONT_SIZE)
        axes.legend(fontsize=FONT_SIZE - 1, frameon=False)
    return figure


def sweep_figure(frame: pd.DataFrame, axes_fields: Sequence[str], title: str) -> Figure:
    """Miss rate of each level, and DRAM traffic, over the first axis; a line per point of the rest.

    frame: as `cachesim.sweep` returns it. axes_fields: its axis columns.
    """
    first, others = axes_fields[0], list(axes_fields[1:])
    levels = [c.removesuffix(".miss_rate") for c in frame.columns if c.endswith(".miss_rate")]
    figure = Figure(figsize=(1.0 + 2.6 * (len(levels) + 1), 3.0), layout="constrained")
    panels = figure.subplots(1, len(levels) + 1, squeeze=False)[0]
    groups = list(frame.groupby(others, sort=False)) if others else [((), frame)]
    ticks = list(dict.fromkeys(frame[first]))
    for index, (key, part) in enumerate(groups):
        label = ", ".join(f"{o}={_axis_text(o, k)}" for o, k in zip(others, key, strict=True))
        at = [ticks.index(v) for v in part[first]]
        style = {
            "color": PALETTE[index % len(PALETTE)],
            "marker": "osD^vP"[index % 6],
            "markersize": 4,
            "linewidth": 1.2,
            "linestyle": ("-", "--", "-.", ":")[index % 4],
            "label": label or None,
        }
        for axes, level in zip(panels, levels, strict=False):
            axes.plot(at, part[f"{level}.miss_rate"].astype(float), **style)
            axes.set_title(f"{level.upper()} miss rate", fontsize=FONT_SIZE)
        panels[-1].plot(at, part["dram.bytes"] / 1e6, **style)
        panels[-1].set_title("DRAM traffic (MB)", fontsize=FONT_SIZE)
    for axes in panels:
        axes.set_xticks(range(len(ticks)), [_axis_text(first, t) for t in ticks])
        axes.tick_params(axis="x", rotation=30)
        axes.set_xlabel(first, fontsize=FONT_SIZE)
        axes.set_ylim(0, 1.08 * axes.get_ylim()[1])
        _style(axes)
    if others:
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=FONT_SIZE - 1)
    figure.suptitle(title, fontsize=FONT_SIZE + 1)
    return figure


def _axis_text(field: str, value: object) -> str:
    """A value of an axis for a tick: sizes with their unit."""
    from cachesim.units import format_size

    is_size = field.rpartition(".")[2] in ("capacity", "line_bytes", "sector_bytes", "shared")
    if is_size and isinstance(value, int | np.integer):
        return format_size(int(value))
    return str(value)
