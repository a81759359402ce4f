"""Which pixel each lane of each warp works on: 8x8 tiles in CTA order, two warps of 32 lanes a
tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

TILE_SIDE = 8
WARPS_PER_CTA = 2
#: Warp states below 1: no lane inside the frame, and no lane that scatters.
OUTSIDE, PLAIN = -1, 0


def _deinterleave(code: npt.NDArray[np.int64], num_bits: int) -> npt.NDArray[np.int64]:
    """Every second bit of `code`, from bit 0: the x of a Morton code."""
    return sum(((code >> (2 * b)) & 1) << b for b in range(num_bits))  # type: ignore[return-value]


def _interleave(x: npt.NDArray[np.int64], y: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The Morton code of coordinates below 2048."""
    return sum(  # type: ignore[return-value]
        (((x >> b) & 1) << (2 * b)) | (((y >> b) & 1) << (2 * b + 1)) for b in range(11)
    )


def lane_table(lane_map: str) -> npt.NDArray[np.uint8]:
    """(64,) uint8: x | y << 3 inside the tile of each thread of a CTA, for a `Method.lane_map`."""
    thread = np.arange(TILE_SIDE * TILE_SIDE, dtype=np.int64)
    if lane_map == "linear":
        x, y = thread % 8, thread // 8
    elif lane_map == "quad2x2":
        # Four neighbouring lanes shade a quad; quads stand row by row.
        quad = thread // 4
        x, y = quad % 4 * 2 + thread % 2, quad // 4 * 2 + thread // 2 % 2
    else:
        x, y = _deinterleave(thread, 3), _deinterleave(thread >> 1, 3)
    return (x | y << 3).astype(np.uint8)


@dataclass(frozen=True)
class Grid:
    """The CTAs of one full-screen launch. width, height: pixels (of the destination level, for the
    pre-filter).
    """

    width: int
    height: int
    tile_order: str
    lane_map: str

    @property
    def num_ctas(self) -> int:
        return -(-self.width // TILE_SIDE) * -(-self.height // TILE_SIDE)

    @property
    def num_warps(self) -> int:
        return self.num_ctas * WARPS_PER_CTA

    @cached_property
    def tiles(self) -> npt.NDArray[np.uint32]:
        """(num_ctas,) uint32: tile x | tile y << 16 of each CTA."""
        across = -(-self.width // TILE_SIDE)
        cta = np.arange(self.num_ctas, dtype=np.int64)
        x, y = cta % across, cta // across
        if self.tile_order == "morton":
            order = np.argsort(_interleave(x, y), kind="stable")
            x, y = x[order], y[order]
        return (x | y << 16).astype(np.uint32)

    @cached_property
    def lanes(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """(x, y) of each lane, (num_warps, 32) int32; outside the frame where the tile overhangs
        it.
        """
        table = lane_table(self.lane_map).astype(np.int32)
        tiles = self.tiles.astype(np.int32)[:, None]
        x = (tiles & 0xFFFF) * TILE_SIDE + (table & 7)
        y = (tiles >> 16) * TILE_SIDE + (table >> 3)
        return x.reshape(-1, 32), y.reshape(-1, 32)

    @cached_property
    def inside(self) -> npt.NDArray[np.bool_]:
        """(num_warps, 32) bool: the lanes whose pixel lies in the frame."""
        x, y = self.lanes
        return (x < self.width) & (y < self.height)

    def gather(self, image: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """(num_warps, 32): an image's values in lane order; those of the nearest pixel for lanes
        outside.
        """
        x, y = self.lanes
        return image[np.minimum(y, self.height - 1), np.minimum(x, self.width - 1)]

    def scatter(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(height, width, ...): the image of values in lane order, (num_warps, 32, ...)."""
        empty = np.zeros((self.height, self.width, *values.shape[2:]), values.dtype)
        return self.scatter_into(empty, values)

    def scatter_into(self, image: npt.NDArray[Any], values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The image with the grid's pixels replaced by values in lane order."""
        x, y = self.lanes
        image = image.copy()
        image[y[self.inside], x[self.inside]] = values[self.inside]
        return image

    def warp_states(self, mask: npt.NDArray[np.bool_] | None = None) -> npt.NDArray[np.int32]:
        """(num_warps,) int32: `OUTSIDE`, `PLAIN`, or 1 where a lane's pixel is in `mask`, (height,
        width) bool.
        """
        states = np.where(self.inside.any(axis=1), PLAIN, OUTSIDE).astype(np.int32)
        if mask is not None:
            states[(self.gather(mask).astype(np.bool_) & self.inside).any(axis=1)] = 1
        return states
