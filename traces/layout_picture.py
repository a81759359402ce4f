"""Pictures and a table of the layouts: which texels share a sector and a line.

In goes the name of a layout and a texel format, out comes a figure of the first 2 KiB or so of a
texture; or, for all layouts and formats, a table of the texels that share 32, 64, 128 and 256 B.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from scipy.ndimage import label

from traces.errors import unknown
from traces.layout import LAYOUTS, layout_function
from traces.texture import FORMATS

SECTOR_BYTES = 32
LINE_BYTES = 128
#: NVIDIA's sector, the Infinity Cache's line, everybody's line, AMD's micro-tile.
GRANULES_BYTES = (32, 64, 128, 256)
#: Sides of a level that holds at least one 64 KiB block of every layout and format.
_LEVEL_SIDE = 256
#: Width and height in texels of the part that is drawn, by texel size in bytes: 2 KiB.
_DRAWN_TEXELS = {1: (64, 32), 2: (32, 32), 4: (32, 16), 8: (16, 16), 16: (16, 8)}


def layout_table() -> pd.DataFrame:
    """One row per layout and format: the texels, width x height, that share 32 to 256 bytes.

    "8x4": every granule is such a rectangle. "32 of 16x4": granules are not rectangles; the
    commonest holds 32 texels out of a 16x4 rectangle.
    """
    shapes = {
        (layout, texel_bytes): [granule_shape(layout, texel_bytes, size) for size in GRANULES_BYTES]
        for layout in LAYOUTS
        for texel_bytes in set(FORMATS.values())
    }
    rows = [
        (layout, name, texel_bytes, *shapes[layout, texel_bytes])
        for layout in LAYOUTS
        for name, texel_bytes in FORMATS.items()
    ]
    columns = [f"texels_per_{size}_bytes" for size in GRANULES_BYTES]
    return pd.DataFrame(rows, columns=["layout", "format", "texel_bytes", *columns])


def granule_shape(layout: str, texel_bytes: int, granule_bytes: int) -> str:
    """The texels that share one aligned granule of memory, as `layout_table` prints them."""
    granule, index, counts = np.unique(
        _offsets(layout, texel_bytes) // np.uint64(granule_bytes),
        return_inverse=True,
        return_counts=True,
    )
    extents = []
    for position in np.indices((_LEVEL_SIDE, _LEVEL_SIDE))[::-1]:
        first = np.full(len(granule), _LEVEL_SIDE)
        last = np.zeros(len(granule), np.int64)
        np.minimum.at(first, index.ravel(), position.ravel())
        np.maximum.at(last, index.ravel(), position.ravel())
        extents.append((last - first + 1).tolist())
    shapes = Counter(zip(*extents, counts.tolist(), strict=True))
    (width, height, count), _ = shapes.most_common(1)[0]
    if len(shapes) == 1 and count == width * height:
        return f"{width}x{height}"
    return f"{count} of {width}x{height}"


def draw_layout(name: str, texel_format: str) -> Figure:
    """A figure of the first texels of a texture of 256 x 256.

    Texels of one 128 B line have one colour, within a black border, and its number; both grow with
    the address among the lines drawn. White borders part the 32 B sectors, and a path goes through
    them in address order. name: a key of `LAYOUTS`. texel_format: a key of `FORMATS`.

    Raises:
        InputError: no such layout or format.
    """
    layout_function(name)
    if texel_format not in FORMATS:
        raise unknown("texel format", texel_format, FORMATS)
    texel_bytes = FORMATS[texel_format]
    width, height = _DRAWN_TEXELS[texel_bytes]
    offsets = _offsets(name, texel_bytes)[:height, :width]
    lines = _rank(offsets // np.uint64(LINE_BYTES))
    sectors = _rank(offsets // np.uint64(SECTOR_BYTES))

    figure = Figure(figsize=(9, 1.6 + 8 * height / width), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(lines, cmap="cividis", extent=(0, width, height, 0), interpolation="nearest")
    axes.add_collection(LineCollection(_borders(sectors), colors="white", linewidths=0.8))
    axes.add_collection(LineCollection(_borders(lines), colors="black", linewidths=2.2))
    _draw_path(axes, sectors)
    _draw_numbers(axes, lines)
    axes.set(
        xlabel="x (texels)",
        ylabel="y (texels)",
        xticks=range(0, width + 1, max(1, width // 16)),
        yticks=range(0, height + 1, max(1, height // 16)),
    )
    sector_shape, line_shape = (
        granule_shape(name, texel_bytes, size) for size in (SECTOR_BYTES, LINE_BYTES)
    )
    shared = "; some texels share bytes" if len(np.unique(offsets)) < offsets.size else ""
    axes.set_title(
        f"{name}, {texel_format} ({texel_bytes} B per texel)\n"
        f"{LINE_BYTES} B lines (colour, number): {line_shape} texels; "
        f"{SECTOR_BYTES} B sectors (white borders): {sector_shape} texels;\n"
        f"path: sectors by address, from the circle to the square{shared}",
        fontsize=10,
    )
    return figure


def _offsets(layout: str, texel_bytes: int) -> npt.NDArray[np.uint64]:
    """(256, 256) uint64 byte offsets of a level's texels."""
    tables = layout_function(layout)(_LEVEL_SIDE, _LEVEL_SIDE, texel_bytes)
    y, x = np.indices((_LEVEL_SIDE, _LEVEL_SIDE))
    return tables.offset(y, x)


def _rank(values: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
    """Each value's place among the distinct values."""
    ranks: npt.NDArray[np.int64] = np.unique(values, return_inverse=True)[1]
    return ranks.reshape(values.shape)


def _borders(granules: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Segments, (2, 2) arrays of x and y, between neighbouring texels of different granules."""
    rows, columns = np.nonzero(granules[:, 1:] != granules[:, :-1])
    upright = np.array([[columns + 1, rows], [columns + 1, rows + 1]])
    rows, columns = np.nonzero(granules[1:] != granules[:-1])
    level = np.array([[columns, rows + 1], [columns + 1, rows + 1]])
    return list(np.concatenate([upright, level], axis=2).transpose(2, 0, 1))


def _centres(granules: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """(number of granules, 2): mean x and y of each granule's texels."""
    counts = np.bincount(granules.ravel())
    y, x = np.indices(granules.shape) + 0.5
    sums = [np.bincount(granules.ravel(), axis.ravel()) for axis in (x, y)]
    return np.stack(sums, axis=1) / counts[:, None]


def _draw_path(axes: Axes, sectors: npt.NDArray[np.int64]) -> None:
    """A line through the sectors' middles in address order."""
    x, y = _centres(sectors).T
    outline = [withStroke(linewidth=2.6, foreground="black")]
    axes.plot(x, y, color="white", linewidth=1.2, path_effects=outline)
    for end, marker in ((0, "o"), (-1, "s")):
        axes.plot(x[end], y[end], marker, color="white", markeredgecolor="black", markersize=9)


def _draw_numbers(axes: Axes, lines: npt.NDArray[np.int64]) -> None:
    """Each line's number, in the topmost texel of each of its pieces, where few paths go."""
    outline = [withStroke(linewidth=2.5, foreground="black")]
    for number in range(int(lines.max()) + 1):
        pieces, num_pieces = label(lines == number)
        for piece in range(1, num_pieces + 1):
            rows, columns = np.nonzero(pieces == piece)
            axes.text(
                columns[0] + 0.15,
                rows[0] + 0.15,
                str(number),
                color="white",
                fontsize=10,
                fontweight="bold",
                ha="left",
                va="top",
                path_effects=outline,
            )
