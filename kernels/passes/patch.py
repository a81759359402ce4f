"""The patch of a tile in local memory: which reads fill it, and which texels it holds.

A tile of 8x8 pixels and a border of one texel, of colour, normal and profile id: a sample at level
0 that lands there is read from local memory and fetches nothing. Facts sheet 1.5. The kernel's part
is patch.cl.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.access import Access
from kernels.grid import TILE_SIDE, WARPS_PER_CTA, Grid
from kernels.method import Method
from traces.texture import INACTIVE_TEXEL, WARP_SIZE, pack_texel

Texels = npt.NDArray[np.uint32]
#: Texels along a side of the patch: a tile and a border of one.
PATCH_SIDE = 10
#: The two loads of each thread, as the kernel's arguments are named.
PATCH_PARTS = ("patch", "rest")


def patch_accesses(method: Method) -> list[Access]:
    """The traced reads that fill the patch in local memory, in the order of the kernel."""
    if not method.lds:
        return []
    planes = [("setup", "setup")] * ("colour" in method.planes)
    planes += [("normal", "normal")] * ("normal" in method.planes and method.normal_weights)
    planes += [("profile_id", "id")] * ("profile_id" in method.planes)
    return [
        Access(texture, subsurface_only=True, of_tile=True, argument=f"{part}_{short}")
        for part in PATCH_PARTS
        for texture, short in planes
    ]


def patch_texels(grid: Grid) -> list[Texels]:
    """(num_warps, 32) packed texels of each part of the patch of each warp's tile: 10x10 of them,
    numbered row by row, of which a thread loads its own number and the one 64 on.
    """
    tile_x, tile_y = (
        np.repeat(t.astype(np.int32), 2) for t in (grid.tiles & 0xFFFF, grid.tiles >> 16)
    )
    threads = WARPS_PER_CTA * WARP_SIZE
    thread = np.tile(np.arange(threads).reshape(-1, WARP_SIZE), (grid.num_ctas, 1))
    found = []
    for first in range(0, len(PATCH_PARTS) * threads, threads):
        row, column = np.divmod(thread + first, PATCH_SIDE)
        y, x = tile_y[:, None] * TILE_SIDE - 1 + row, tile_x[:, None] * TILE_SIDE - 1 + column
        exists = (row < PATCH_SIDE) & (y >= 0) & (y < grid.height) & (x >= 0) & (x < grid.width)
        found.append(np.where(exists, pack_texel(0, y, x), INACTIVE_TEXEL))
    return found


def is_held(x: Any, y: Any, texel_x: Any, texel_y: Any) -> npt.NDArray[np.bool_]:
    """Whether texels of level 0 lie in the patch of the tiles of pixels (x, y)."""
    found: Any = True
    for pixel, texel in ((x, texel_x), (y, texel_y)):
        place = texel - (pixel // TILE_SIDE * TILE_SIDE - 1)
        found = found & (place >= 0) & (place < PATCH_SIDE)
    held: npt.NDArray[np.bool_] = found
    return held
