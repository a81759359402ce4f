"""Footprints: the byte addresses of the texels that a fetch reads.

In go packed texel coordinates and an `AddressMap`, out come byte addresses. A point fetch reads one
texel. A bilinear fetch reads the 2x2 texels from its coordinate towards larger x and y, those
beyond the level's edge clamped to it, so that near an edge the same texel may be read twice.
`texel_address` is the scalar core; hot loops call it too, so that the rule stands in one place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from traces.errors import InputError
from traces.placement import AddressMap
from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, MAX_SIDE_TEXELS

#: Texels of a bilinear footprint, in the order (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1).
NUM_CORNERS = 4
_SIDE_MASK = np.uint64(MAX_SIDE_TEXELS - 1)
_Y_SHIFT = np.uint64(14)
_MIP_SHIFT = np.uint64(28)


@njit(cache=True, nogil=True)
def texel_offset(x_entry: int, y_entry: int, low_mask: int) -> Any:
    """uint64 byte offset of a texel in its level from its two table entries (`traces.layout`)."""
    x = np.uint64(x_entry)
    y = np.uint64(y_entry)
    low = np.uint64(low_mask)
    return (x & ~low) + (y & ~low) + ((x ^ y) & low)


@njit(cache=True, nogil=True)
def texel_address(
    texture: int,
    packed: int,
    x_start: npt.NDArray[np.int64],
    y_start: npt.NDArray[np.int64],
    x_tables: npt.NDArray[np.uint32],
    y_tables: npt.NDArray[np.uint32],
    base: npt.NDArray[np.uint64],
    low_mask: npt.NDArray[np.uint32],
) -> Any:
    """uint64 byte address of one packed texel, which must exist; nothing is checked."""
    level = np.uint64(texture), np.uint64(packed) >> _MIP_SHIFT
    x = np.uint64(packed) & _SIDE_MASK
    y = (np.uint64(packed) >> _Y_SHIFT) & _SIDE_MASK
    x_entry = x_tables[np.uint64(x_start[level]) + x]
    y_entry = y_tables[np.uint64(y_start[level]) + y]
    return base[level] + texel_offset(x_entry, y_entry, low_mask[level[0]])


def texel_addresses(
    lanes: npt.NDArray[np.uint32], texture: int, bilinear: bool, address_map: AddressMap
) -> npt.NDArray[np.uint64]:
    """Byte addresses of the texels that rows of one texture read.

    lanes: (n, 32) uint32, packed texels, `INACTIVE_TEXEL` where inactive. texture: index into
        `address_map.textures`.

    Returns:
        (n, 32) uint64 for point fetches, (n, 128) for bilinear ones, whose lane l owns columns 4 l
        to 4 l + 3 in the order of `NUM_CORNERS`; `INACTIVE_ADDRESS` where inactive.

    Raises:
        InputError: no such texture, or a lane whose mip or texel the texture does not have.
    """
    if not 0 <= texture < len(address_map.textures):
        raise InputError(f"texture {texture}: allowed are 0 to {len(address_map.textures) - 1}")
    num_corners = NUM_CORNERS if bilinear else 1
    addresses = np.full((len(lanes), lanes.shape[1] * num_corners), INACTIVE_ADDRESS, np.uint64)
    m = address_map
    bad = _fill_addresses(
        lanes,
        texture,
        num_corners,
        (m.x_start, m.y_start, m.x_tables, m.y_tables, m.base, m.low_mask),
        m.width,
        m.height,
        addresses,
    )
    if bad >= 0:
        row, lane = divmod(bad, lanes.shape[1])
        packed = int(lanes[row, lane])
        mip, y, x = packed >> 28, packed >> 14 & 0x3FFF, packed & 0x3FFF
        name = m.textures[texture].name
        raise InputError(
            f"row {row}, lane {lane}: texture {name!r} has no texel (mip {mip}, y {y}, x {x})"
        )
    return addresses


@njit(cache=True, nogil=True)
def _fill_addresses(
    lanes: npt.NDArray[np.uint32],
    texture: int,
    num_corners: int,
    tables: Any,
    width: npt.NDArray[np.int32],
    height: npt.NDArray[np.int32],
    addresses: npt.NDArray[np.uint64],
) -> Any:
    """Fill `addresses` in place; the flat index of the first lane outside the texture, or -1."""
    num_rows, num_lanes = lanes.shape
    for row in range(num_rows):
        for lane in range(num_lanes):
            packed = lanes[row, lane]
            if packed == INACTIVE_TEXEL:
                continue
            mip = np.int64(packed) >> 28
            y = (np.int64(packed) >> 14) & (MAX_SIDE_TEXELS - 1)
            x = np.int64(packed) & (MAX_SIDE_TEXELS - 1)
            if mip >= width.shape[1] or x >= width[texture, mip] or y >= height[texture, mip]:
                return row * num_lanes + lane
            for corner in range(num_corners):
                corner_x = min(x + (corner & 1), width[texture, mip] - 1)
                corner_y = min(y + (corner >> 1), height[texture, mip] - 1)
                corner_packed = (mip << 28) | (corner_y << 14) | corner_x
                addresses[row, lane * num_corners + corner] = texel_address(
                    texture, corner_packed, *tables
                )
    return -1
