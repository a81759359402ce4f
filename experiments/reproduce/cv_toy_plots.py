"""Figures of `cv-toy`."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from experiments.plots import FONT_SIZE, PALETTE
from experiments.reproduce import cv_toy_model as toy


def error_figure(errors: dict[str, dict[str, toy.Values]]) -> Figure:
    """The errors over the frames, a panel per light, a line per residual."""
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    frames = np.arange(1, toy.NUM_FRAMES + 1)
    for axes, (light, by_name) in zip(figure.subplots(1, 2), errors.items(), strict=True):
        for i, (name, values) in enumerate(by_name.items()):
            style = (PALETTE[i], ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))[i])
            axes.plot(
                frames[2:],
                np.median(values, axis=0)[2:],
                color=style[0],
                linestyle=style[1],
                linewidth=1.3,
                label=name,
            )
        axes.set_yscale("log")
        axes.set_title(f"{light} light", fontsize=FONT_SIZE)
        axes.set_xlabel("frame", fontsize=FONT_SIZE)
        axes.set_ylabel("error, median of the seeds", fontsize=FONT_SIZE)
        axes.tick_params(which="both", labelsize=FONT_SIZE - 1)
        axes.grid(color="0.9", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=FONT_SIZE - 1)
    return figure


def coefficient_figure(drawn: toy.Draws) -> Figure:
    """The coefficient over the frames of the dynamic light: in each frame, and online."""
    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    axes = figure.subplots()
    frames = np.arange(1, toy.NUM_FRAMES + 1)
    shown = {
        "a of each frame's samples": drawn.a_frame,
        "online a (EMCM)": toy.emcm_coefficient(drawn.f_bar, drawn.g_bar),
    }
    for (name, values), colour, dash in zip(
        shown.items(), (PALETTE[1], PALETTE[0]), ("--", "-"), strict=True
    ):
        low, middle, high = np.percentile(values, (5, 50, 95), axis=0)
        axes.fill_between(frames, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(frames, middle, color=colour, linestyle=dash, linewidth=1.3, label=name)
    for value, text in ((toy.A_STATIC, "18 ln 2 - 12"), (toy.A_CONSTANT_G, "ln 4")):
        axes.axhline(value, color="0.4", linestyle=":", linewidth=1)
        axes.annotate(text, (100, value), ha="right", va="bottom", fontsize=FONT_SIZE - 1)
    axes.set_ylim(-0.2, 2.4)
    axes.set_xlabel("frame", fontsize=FONT_SIZE)
    axes.set_ylabel("coefficient: median and 5 to 95 %", fontsize=FONT_SIZE)
    axes.tick_params(labelsize=FONT_SIZE - 1)
    axes.legend(fontsize=FONT_SIZE - 1, frameon=False, loc="upper right")
    axes.spines[["top", "right"]].set_visible(False)
    return figure
