"""Figures of `ground-truth`: convergence, pictures with their errors, and path tracing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from experiments.plots import FONT_SIZE, PALETTE
from kernels.picture import tone_map

if TYPE_CHECKING:
    import pandas as pd

    from experiments.reproduce.ground_truth_study import Study
    from experiments.reproduce.ground_truth_volume import Compared

_MARKERS = ("o", "s", "^")
_DASHES = ("-", "--", ":")
#: Errors are shown this many times larger.
GAIN = 10.0


def convergence_figure(errors: pd.DataFrame, slopes: pd.DataFrame) -> Figure:
    """Error against budget, an axes per scene; slopes in the legends."""
    scenes = list(dict.fromkeys(errors["scene"]))
    figure = Figure(figsize=(3.0 * len(scenes), 3.2), layout="constrained")
    grid = figure.subplots(1, len(scenes), squeeze=False, sharey=True)[0]
    slope_of = slopes.set_index(["scene", "method"])["slope"]
    for axes, scene in zip(grid, scenes, strict=True):
        part = errors[errors["scene"] == scene]
        for i, method in enumerate(dict.fromkeys(part["method"])):
            own = part[part["method"] == method]
            axes.loglog(
                own["budget"], own["rms_error"], _DASHES[i], marker=_MARKERS[i], markersize=4,
                color=PALETTE[i], label=f"{method}: slope {slope_of[(scene, method)]:.2f}",
            )  # fmt: skip
        budgets = np.array([part["budget"].min(), part["budget"].max()], float)
        start = float(part["rms_error"].max())
        axes.loglog(budgets, start * (budgets / budgets[0]) ** -0.5, color="0.6", linewidth=0.8)
        axes.set_title(scene, fontsize=FONT_SIZE + 1)
        axes.set_xlabel("samples or taps", fontsize=FONT_SIZE)
        axes.tick_params(labelsize=FONT_SIZE - 1)
        axes.grid(color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=FONT_SIZE - 2, frameon=False, loc="lower left")
    # Room for the legends.
    grid[0].set_ylim(bottom=0.1 * float(errors["rms_error"].min()))
    grid[0].set_ylabel("RMS error against every texel", fontsize=FONT_SIZE)
    grid[-1].annotate(
        "grey line: slope -1/2", (0.98, 0.97), xycoords="axes fraction", ha="right", va="top",
        fontsize=FONT_SIZE - 2, color="0.4",
    )  # fmt: skip
    return figure


def picture_figure(studies: Sequence[Study]) -> Figure:
    """Two rows per scene: light as it arrives, dense, and the methods; under these, errors."""
    names = list(studies[0].shown)
    columns = 2 + len(names)
    rows = 2 * len(studies)
    height, width = studies[0].dense.shape[:2]
    figure = Figure(
        figsize=(2.1 * columns, 2.1 * height / width * rows + 0.55), layout="constrained"
    )
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    for number, study in enumerate(studies):
        above, below = grid[2 * number], grid[2 * number + 1]
        above[0].set_ylabel(study.name, fontsize=FONT_SIZE)
        received = np.where(study.gbuffer.subsurface[..., None], study.gbuffer.irradiance, 0)
        above[0].imshow(tone_map(received.astype(np.float32)))
        above[1].imshow(tone_map(study.dense))
        for axes, under, name in zip(above[2:], below[2:], names, strict=True):
            axes.imshow(tone_map(study.shown[name]))
            shown = under.imshow(
                np.abs(study.shown[name] - study.dense).mean(axis=2) * GAIN,
                cmap="inferno", vmin=0, vmax=1,
            )  # fmt: skip
        below[2].set_ylabel(f"error x {GAIN:.0f}", fontsize=FONT_SIZE - 1)
    for axes, name in zip(grid[0], ("light as it arrives", "every texel", *names), strict=True):
        axes.set_title(name, fontsize=FONT_SIZE - 1)
    bar = figure.colorbar(shown, ax=grid[:, -1], shrink=0.6)
    bar.ax.tick_params(labelsize=FONT_SIZE - 2)
    owed = "; ".join(sorted({s.gbuffer.attribution for s in studies} - {""}))
    if owed:
        figure.supxlabel(owed, fontsize=FONT_SIZE - 2)
    return figure


def volume_figure(compared: Sequence[Compared]) -> Figure:
    """The slab's line; for each shape: no scattering, path tracing, profile, difference."""
    line, *pictures = compared
    figure = Figure(figsize=(9.2, 2.4 + 1.45 * len(pictures)), layout="constrained")
    ratios = [1.6, *[1.0] * len(pictures)]
    grid: Any = figure.add_gridspec(1 + len(pictures), 4, height_ratios=ratios)
    axes = figure.add_subplot(grid[0, :])
    at = np.arange(len(line.traced)) - (len(line.traced) - 1) / 2
    axes.plot(at, line.unscattered, color="0.6", linewidth=0.9, label="without scattering")
    axes.plot(at, line.traced, color=PALETTE[0], marker="o", markersize=2.5, linestyle="",
              label="path tracing")  # fmt: skip
    axes.plot(at, line.predicted, color=PALETTE[3], label="profile")
    axes.set_title(f"{line.name}: RMS difference {line.error():.3f}", fontsize=FONT_SIZE)
    axes.set_xlabel("pixels from the edge of the light", fontsize=FONT_SIZE - 1)
    axes.set_ylabel("brightness", fontsize=FONT_SIZE - 1)
    axes.tick_params(labelsize=FONT_SIZE - 1)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=FONT_SIZE - 1, frameon=False)
    for row, shape in enumerate(pictures, start=1):
        shades = {
            f"{shape.name}: without scattering": shape.unscattered,
            "path tracing": shape.traced,
            "profile": shape.predicted,
        }
        for column, (title, picture) in enumerate(shades.items()):
            shown = figure.add_subplot(grid[row, column])
            shown.imshow(np.clip(picture, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            shown.set_title(title, fontsize=FONT_SIZE - 1)
            shown.set_xticks([])
            shown.set_yticks([])
        last = figure.add_subplot(grid[row, 3])
        difference = np.where(shape.mask, shape.predicted - shape.traced, np.nan)
        drawn = last.imshow(difference, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
        last.set_title(f"profile - path tracing, RMS {shape.error():.3f}", fontsize=FONT_SIZE - 1)
        last.set_xticks([])
        last.set_yticks([])
        figure.colorbar(drawn, ax=last, shrink=0.8).ax.tick_params(labelsize=FONT_SIZE - 2)
    return figure
