"""Figures of the experiments over time: lines over the frames, and rows of maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.plots import FONT_SIZE, PALETTE

if TYPE_CHECKING:
    import numpy.typing as npt
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))


@dataclass(frozen=True, eq=False)
class Panel:
    """One diagram. lines: name to y values. x: of all lines; None = 0, 1, 2 ... marks: x value to
    the text of a vertical line there. limits: of y.
    """

    title: str
    y_label: str
    lines: Mapping[str, Sequence[float] | npt.NDArray[Any]]
    x: Sequence[float] | npt.NDArray[Any] | None = None
    x_label: str = "frame"
    is_log: bool = False
    marker: str = ""
    marks: Mapping[float, str] = field(default_factory=dict)
    limits: tuple[float, float] | None = None


def line_figure(panels: Sequence[Panel], num_columns: int = 2, title: str = "") -> Figure:
    """Panels in rows; a line of one name has the same colour and dash in all of them."""
    from matplotlib.figure import Figure

    num_columns = min(num_columns, len(panels))
    num_rows = -(-len(panels) // num_columns)
    figure = Figure(figsize=(1.0 + 3.7 * num_columns, 0.7 + 2.35 * num_rows), layout="constrained")
    grid = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
    names = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    for axes, panel in zip(grid, panels, strict=False):
        _draw(axes, panel, names)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    handles = {
        label: handle
        for axes in grid[: len(panels)]
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if len(names) > 1:
        figure.legend(
            [handles[n] for n in names],
            names,
            loc="outside lower center",
            ncols=min(4, len(names)),
            fontsize=FONT_SIZE - 1,
        )
    if title:
        figure.suptitle(title, fontsize=FONT_SIZE + 1)
    return figure


def _draw(axes: Axes, panel: Panel, names: Sequence[str]) -> None:
    for name, values in panel.lines.items():
        i = names.index(name)
        axes.plot(
            np.arange(len(values)) if panel.x is None else panel.x,
            values,
            color=PALETTE[i % len(PALETTE)],
            linestyle=_DASHES[i % len(_DASHES)],
            marker=panel.marker,
            markersize=3.5,
            linewidth=1.2,
            label=name,
        )
    for at, text in panel.marks.items():
        axes.axvline(at, color="0.5", linewidth=0.8, linestyle=":")
        axes.annotate(
            text,
            (at, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(2, -2),
            textcoords="offset points",
            ha="left",
            va="top",
            fontsize=FONT_SIZE - 2,
        )
    if panel.is_log:
        axes.set_yscale("log")
    if panel.limits:
        axes.set_ylim(*panel.limits)
    axes.set_title(panel.title, fontsize=FONT_SIZE)
    axes.set_xlabel(panel.x_label, fontsize=FONT_SIZE)
    axes.set_ylabel(panel.y_label, fontsize=FONT_SIZE)
    axes.tick_params(which="both", labelsize=FONT_SIZE - 1)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def map_figure(
    maps: Mapping[str, npt.NDArray[Any]],
    label: str,
    *,
    num_columns: int = 3,
    limits: tuple[float, float] | None = None,
    colours: str = "cividis",
    title: str = "",
    outlines: Mapping[str, npt.NDArray[np.bool_]] | None = None,
    attribution: str = "",
) -> Figure:
    """Maps in rows with one colour bar; NaN is grey. outlines: name to a mask whose border is drawn
    over every map.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    first = next(iter(maps.values()))
    num_columns = min(num_columns, len(maps))
    num_rows = -(-len(maps) // num_columns)
    wide = 5.0 if num_columns == 1 else 3.0
    high = wide * first.shape[0] / first.shape[1]
    figure = Figure(
        figsize=(wide * num_columns, 0.9 + num_rows * (high + 0.25)), layout="constrained"
    )
    grid = figure.subplots(num_rows, num_columns, squeeze=False)
    low, most = limits or (
        min(float(np.nanmin(m)) for m in maps.values()),
        max(float(np.nanmax(m)) for m in maps.values()),
    )
    shades = colormaps[colours].with_extremes(bad="0.85")
    for axes, (name, values) in zip(grid.ravel(), maps.items(), strict=False):
        shown = axes.imshow(
            np.ma.masked_invalid(values), cmap=shades, vmin=low, vmax=most, interpolation="nearest"
        )
        for i, mask in enumerate((outlines or {}).values()):
            if mask.any() and not mask.all():
                axes.contour(mask, [0.5], colors=[PALETTE[(i + 3) % len(PALETTE)]], linewidths=0.6)
        axes.set_title(name, fontsize=FONT_SIZE)
    for axes in grid.ravel():
        axes.set_xticks([])
        axes.set_yticks([])
    for axes in grid.ravel()[len(maps) :]:
        axes.set_axis_off()
    bar = figure.colorbar(shown, ax=grid, location="bottom", shrink=0.5, aspect=40)
    bar.set_label(label, fontsize=FONT_SIZE)
    bar.ax.tick_params(labelsize=FONT_SIZE - 1)
    if title:
        figure.suptitle(title, fontsize=FONT_SIZE + 1)
    if attribution:
        figure.supxlabel(attribution, fontsize=FONT_SIZE - 2)
    return figure
