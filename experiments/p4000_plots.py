"""Figures of the P4000 times: sampling time against the count, and passes beside the published."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from experiments.p4000_cases import FORCED, PLANE_SETS, PUBLISHED_MS, PUBLISHED_SIZE, SCALES, Case
from experiments.p4000_study import Cell
from experiments.p4000_tables import PASS_HEADINGS, cell_of, forced_name, pass_of, sampling_ms
from experiments.plots import FONT_SIZE, PALETTE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STYLE = {
    ("legacy", "all"): (PALETTE[0], "-", "o"),
    ("legacy", "irradiance"): (PALETTE[5], "--", "o"),
    ("physical", "all"): (PALETTE[3], "-", "s"),
    ("physical", "irradiance"): (PALETTE[1], "--", "s"),
}


def counts_figure(cells: Sequence[Cell], gpu: str) -> Figure:
    """Sampling time over the forced count, one panel per scene; adaptive as a star at its mean
    count; at their resolution the published fixed and adaptive times as grey lines.
    """
    scenes = list(dict.fromkeys(c["scene"] for c in cells))
    figure = Figure(figsize=(0.8 + 2.7 * len(scenes), 3.4), layout="constrained")
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        for scale in SCALES:
            for planes in PLANE_SETS:
                _draw_line(axes, cells, scene, scale, planes)
        for method, dash in (("fixed", "-"), ("adaptive", ":")):
            published = PUBLISHED_MS.get((scene, method), {}).get("sampling")
            if published is not None and cells[0]["size"] == PUBLISHED_SIZE:
                axes.axhline(
                    published, color="0.55", linestyle=dash, linewidth=1, label=f"paper, {method}"
                )
        axes.set_title(scene, fontsize=FONT_SIZE)
        axes.set_xticks(FORCED)
        axes.set_xlim(0, 68)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("samples per pixel", fontsize=FONT_SIZE)
        _finish(axes)
    panels[0].plot(
        [], [], color="white", marker="*", markersize=10, markeredgecolor="black",
        linestyle="none", label="adaptive, at its mean count",
    )  # fmt: skip
    panels[0].set_ylabel(f"sampling pass on {gpu} (ms)", fontsize=FONT_SIZE)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=3, fontsize=FONT_SIZE - 1, frameon=False
    )
    return figure


def _draw_line(axes: Axes, cells: Sequence[Cell], scene: str, scale: str, planes: str) -> None:
    colour, dash, marker = _STYLE[scale, planes]
    times = {
        n: sampling_ms(cell_of(cells, Case(scene, scale, planes, forced_name(n)))) for n in FORCED
    }
    known = {n: t for n, t in times.items() if not np.isnan(t)}
    if known:
        axes.plot(
            list(known), list(known.values()), color=colour, linestyle=dash, marker=marker,
            markersize=4, linewidth=1.3, label=f"forced, {scale}, {planes}",
        )  # fmt: skip
    adaptive = cell_of(cells, Case(scene, scale, planes, "adaptive"))
    if adaptive is not None:
        axes.plot(
            adaptive["mean_count"], sampling_ms(adaptive), color=colour, marker="*", markersize=10,
            markeredgecolor="black", markeredgewidth=0.5, linestyle="none",
        )  # fmt: skip


def passes_figure(cells: Sequence[Cell], scale: str, planes: str, gpu: str) -> Figure | None:
    """Time per pass beside the published, logarithmic: scenes across, fixed above adaptive; None
    where no such case was timed, or at another resolution.
    """
    methods = ("fixed", "adaptive")
    if cells[0]["size"] != PUBLISHED_SIZE:
        return None
    scenes = [
        s
        for s in dict.fromkeys(c["scene"] for c in cells)
        if any(cell_of(cells, Case(s, scale, planes, m)) for m in methods)
    ]
    if not scenes:
        return None
    figure = Figure(figsize=(0.8 + 2.7 * len(scenes), 4.6), layout="constrained")
    grid = figure.subplots(len(methods), len(scenes), squeeze=False, sharey=True)
    for row, method in zip(grid, methods, strict=True):
        for axes, scene in zip(row, scenes, strict=True):
            cell = cell_of(cells, Case(scene, scale, planes, method))
            published = PUBLISHED_MS[scene, method]
            names = [n for n in PASS_HEADINGS if n in published]
            ours = [_time(cell, n) for n in names]
            at = np.arange(len(names))
            axes.bar(at - 0.2, [published[n] for n in names], 0.4, color="0.7", label="paper")
            axes.bar(
                at + 0.2, ours, 0.4, color=PALETTE[0], hatch="///", edgecolor="white", label=gpu
            )
            axes.set_yscale("log")
            axes.set_xticks(at, [PASS_HEADINGS[n] for n in names], rotation=30)
            axes.set_title(f"{scene}, {method}", fontsize=FONT_SIZE)
            _finish(axes)
        row[0].set_ylabel("ms", fontsize=FONT_SIZE)
    handles, names = grid[0][0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=2, fontsize=FONT_SIZE, frameon=False
    )
    figure.suptitle(f"{scale} scale, planes: {planes}", fontsize=FONT_SIZE)
    return figure


def _time(cell: Cell | None, name: str) -> float:
    """Milliseconds of a pass or the total; 0 draws nothing."""
    if cell is None:
        return 0.0
    part = pass_of(cell, name)
    return float(cell["time_ms"] if name == "total" else part["time_ms"] if part else 0.0)


def _finish(axes: Axes) -> None:
    axes.tick_params(labelsize=FONT_SIZE - 1)
    axes.grid(axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
