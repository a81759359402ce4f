"""What each pixel asks of the memory, taken from a trace: in go the fetches of the passes that
scatter, out come pictures of technique, fetches and mean mip level per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from traces.texture import unpack_texel
from traces.trace import Chunk, Trace, warp_of_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Techniques of a pixel, as numbers in `DemandMaps.technique`.
NONE, AFIS, SEPARABLE = range(3)
TECHNIQUES = ("no scattering pass", "AFIS", "Separable")
_OF_PASS = {"sampling": AFIS, "separable_h": SEPARABLE, "separable_v": SEPARABLE}
#: What the scattering passes read as light.
_LIGHT = ("setup", "tex")


@dataclass(frozen=True, eq=False)
class DemandMaps:
    """One frame's demand per pixel; h, w: its height and width.

    technique: (h, w) uint8, NONE, AFIS or SEPARABLE. light_fetches: (h, w) int64 lane fetches of
    irradiance by the passes that scatter. mean_level: (h, w) float64 mean mip level of those, NaN
    where there are none.
    """

    technique: npt.NDArray[np.uint8]
    light_fetches: npt.NDArray[np.int64]
    mean_level: npt.NDArray[np.float64]


def map_demand(trace: Trace) -> DemandMaps:
    """The maps of a recorded frame. A warp's lanes are known by the texels that they write."""
    height, width = int(trace.manifest["height"]), int(trace.manifest["width"])
    technique = np.zeros((height, width), np.uint8)
    fetches = np.zeros((height, width), np.int64)
    levels, visits = np.zeros_like(fetches), np.zeros_like(fetches)
    names = [trace.textures[i.texture].name for i in trace.instructions]
    is_store = np.array([i.operation == "store" for i in trace.instructions])
    is_light = np.array([name in _LIGHT for name in names]) & ~is_store
    for chunk in trace.chunks():
        scatters = _OF_PASS.get(trace.launches[chunk.launch].pass_name)
        if scatters is None:
            continue
        pixels = _pixels_of_warps(chunk, is_store, width)
        rows = np.flatnonzero(is_light[chunk.instruction])
        texels = chunk.lanes[rows]
        of_pixel = pixels[warp_of_rows(chunk)[rows]]
        asked = chunk.active[rows] & (of_pixel >= 0)
        at = of_pixel[asked]
        np.add.at(fetches.reshape(-1), at, 1)
        np.add.at(levels.reshape(-1), at, unpack_texel(texels[asked])[0].astype(np.int64))
        visited = pixels[pixels >= 0]
        technique.reshape(-1)[visited] = scatters
        visits.reshape(-1)[visited] += 1
    mean = np.divide(levels, fetches, out=np.full(fetches.shape, np.nan), where=fetches > 0)
    # A lane that only looks whether its pixel scatters asks for one texel in each pass.
    idle = fetches <= visits
    technique[idle] = NONE
    mean[idle] = np.nan
    return DemandMaps(technique, np.where(idle, 0, fetches), mean)


def _pixels_of_warps(
    chunk: Chunk, is_store: npt.NDArray[np.bool_], width: int
) -> npt.NDArray[np.int64]:
    """(num_warps, 32) the pixel that each lane writes, y x width + x; -1 where it writes none."""
    pixels = np.full((chunk.num_warps, 32), -1, np.int64)
    rows = np.flatnonzero(is_store[chunk.instruction])
    _, y, x = unpack_texel(chunk.lanes[rows])
    written = np.where(chunk.active[rows], y.astype(np.int64) * width + x, -1)
    pixels[warp_of_rows(chunk)[rows]] = written
    return pixels


def demand_figure(maps: dict[str, DemandMaps], title: str, attribution: str = "") -> Figure:
    """A row per method: technique, fetches of irradiance and mean mip level of each pixel."""
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm
    from matplotlib.figure import Figure

    from experiments.plots import FONT_SIZE, PALETTE

    first = next(iter(maps.values()))
    height, width = first.technique.shape
    wide = 3.0
    figure = Figure(
        figsize=(3 * wide, len(maps) * (wide * height / width + 0.2) + 0.9), layout="constrained"
    )
    grid = figure.subplots(len(maps), 3, squeeze=False)
    most = max(int(m.light_fetches.max()) for m in maps.values())
    shades = colormaps["cividis"].with_extremes(bad="0.85")
    kinds = ListedColormap(["0.85", PALETTE[0], PALETTE[1]])
    for row, (name, found) in zip(grid, maps.items(), strict=True):
        shown = [
            row[0].imshow(found.technique, cmap=kinds, norm=BoundaryNorm(np.arange(4) - 0.5, 3)),
            row[1].imshow(
                np.ma.masked_equal(found.light_fetches, 0), cmap=shades, norm=LogNorm(4, most)
            ),
            row[2].imshow(np.ma.masked_invalid(found.mean_level), cmap=shades, vmin=0, vmax=5),
        ]
        row[0].set_ylabel(name, fontsize=FONT_SIZE)
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
    headings = ("technique", "fetches of irradiance per pixel", "their mean mip level")
    for column, (heading, image) in enumerate(zip(headings, shown, strict=True)):
        grid[0, column].set_title(heading, fontsize=FONT_SIZE)
        bar = figure.colorbar(image, ax=grid[:, column], location="bottom", shrink=0.9)
        bar.ax.tick_params(labelsize=FONT_SIZE - 2)
        if column == 0:
            bar.set_ticks([0, 1, 2], labels=list(TECHNIQUES))
        elif column == 1:
            ticks = [4 << i for i in range(8) if 4 << i <= most]
            bar.set_ticks(ticks, labels=[str(t) for t in ticks])
            bar.minorticks_off()
    figure.suptitle(title, fontsize=FONT_SIZE + 1)
    if attribution:
        figure.supxlabel(attribution, fontsize=FONT_SIZE - 2)
    return figure
