"""The classes of 8x8 tiles, and the grids that only the tiles of one class are launched on.

The hybrid method's `classify` pass gives each tile a class; the tiles of a class, in the order of
the method's tiles (rows, or the Z-order curve), make a list, and a launch over a list has a CTA per
entry. A CTA reads its entry from the texture `tile_list`. How classes become lists, a scan over a
byte per tile, is not traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from kernels.grid import TILE_SIDE, WARPS_PER_CTA, Grid
from traces.texture import WARP_SIZE, pack_texel

#: Nothing scatters; less than a pixel far; filtered; sampled.
EMPTY, PASSTHROUGH, SEPARABLE, SAMPLED = range(4)
#: The class whose tiles each pass of the hybrid method is launched on; other passes take all.
CLASS_OF_PASS = {"sampling": SAMPLED, "separable_h": SEPARABLE, "separable_v": SEPARABLE}


def count_tiles(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down a frame."""
    return -(-width // TILE_SIDE), -(-height // TILE_SIDE)


@dataclass(frozen=True, eq=False)
class ListedGrid(Grid):
    """The CTAs of a launch over a list; equal to itself alone. listed: (num_ctas,) uint32, tile x |
    tile y << 16.
    """

    listed: npt.NDArray[np.uint32]

    __eq__ = object.__eq__
    __hash__ = object.__hash__

    @staticmethod
    def of(grid: Grid, classes: npt.NDArray[np.uint8], tile_class: int) -> ListedGrid:
        """The tiles of one class. grid: the full screen's. classes: (tiles down, tiles across)."""
        tiles = grid.tiles
        listed = tiles[classes[tiles >> 16, tiles & np.uint32(0xFFFF)] == tile_class]
        return ListedGrid(grid.width, grid.height, grid.tile_order, grid.lane_map, listed)

    @property
    def num_ctas(self) -> int:
        return len(self.listed)

    @cached_property
    def tiles(self) -> npt.NDArray[np.uint32]:
        """As `Grid.tiles`."""
        return self.listed

    def entry_texels(self) -> npt.NDArray[np.uint32]:
        """(num_warps, 32) packed texels: where each CTA's entry stands in `tile_list`."""
        across, _ = count_tiles(self.width, self.height)
        cta = np.arange(self.num_warps) // WARPS_PER_CTA
        entry = pack_texel(0, cta // across, cta % across)
        return np.repeat(entry[:, None], WARP_SIZE, axis=1)
