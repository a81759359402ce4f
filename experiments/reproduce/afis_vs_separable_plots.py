"""The figure of `afis-vs-separable`: quality over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.plots import FONT_SIZE, PALETTE

if TYPE_CHECKING:
    import pandas as pd


def times_figure(frame: pd.DataFrame, gpu: str) -> Figure:
    """A panel per scene: PSNR against time, ours filled and the paper's open."""
    markers = ("o", "s", "^", "D")
    scenes = list(dict.fromkeys(frame["scene"]))
    figure = Figure(figsize=(9.0, 3.1), layout="constrained")
    grid = figure.subplots(1, len(scenes), squeeze=False, sharey=True)[0]
    methods = list(dict.fromkeys(frame["method"]))
    for axes, scene in zip(grid, scenes, strict=True):
        for i, method in enumerate(methods):
            row = frame[(frame["scene"] == scene) & (frame["method"] == method)].iloc[0]
            axes.plot(row["time_ms"], row["psnr_db"], markers[i], color=PALETTE[i], markersize=7)
            if row["paper_psnr_db"] == row["paper_psnr_db"]:
                axes.plot(
                    row["paper_ms"], row["paper_psnr_db"], markers[i], color=PALETTE[i],
                    markersize=7, fillstyle="none",
                )  # fmt: skip
        axes.set_title(scene, fontsize=FONT_SIZE + 1)
        axes.set_xscale("log")
        axes.set_xlabel("time of the frame (ms)", fontsize=FONT_SIZE)
        axes.tick_params(which="both", labelsize=FONT_SIZE - 1)
        axes.grid(color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.margins(0.12)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("PSNR (dB)", fontsize=FONT_SIZE)
    shown = [
        Line2D([], [], color=PALETTE[i], marker=markers[i], linestyle="", label=method)
        for i, method in enumerate(methods)
    ]
    shown.append(
        Line2D(
            [],
            [],
            color="0.3",
            marker="o",
            fillstyle="none",
            linestyle="",
            label="open: the paper's",
        )
    )
    figure.legend(handles=shown, loc="outside lower center", ncols=5, fontsize=FONT_SIZE)
    figure.suptitle(gpu, fontsize=FONT_SIZE + 1)
    return figure
