"""The lossless coding of a chunk's lanes for the Parquet file: predict, keep the residuals, cut
them into byte planes.

Each row names a predictor: where the guess of its lanes comes from.

    0        the lane before; for the first, the first lane of the last row that was coded so
    1        the same lane of the warp's first row
    2 to 5   the same lane of the row 1 to 4 before
    6, 7     the same lane of the row 1 or 2 after, which must itself not use 6 or 7

Addresses use 0 and 2 only. A guess from a level of another size is scaled:
x' = floor((x + 1/2) w' / w). The three fetches of one sampling step thus cost about as much as one:
the profile id lies at the normal's texel, and the filtered colour at the same place of a smaller
level. A lane that is inactive in the row that is looked at counts as 0.

Residuals of x and y are taken modulo 2^14, those of a mip modulo 16, those of an address modulo
2^64, so that any input comes back exactly; signed ones are folded, 0, -1, 1, -2, ... to
0, 1, 2, 3, ..., before they are cut into bytes. A plane holds the active lanes only, and a row
whose plane is all zero has no entry in it (null).

    texels      plane 0: mips, two to a byte, the first in the low half
                plane 1: low bytes of x, then of y; plane 2: high bytes of x, then of y
    addresses   plane p: byte p, least significant first
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from traces import address_coding, texel_coding
from traces.texture import WARP_SIZE


@dataclass(frozen=True, eq=False)
class Planes:
    """The coded lanes of n rows in P byte planes.

    mask: (n,) uint32, bit l = lane l is active. predictor: (n,) uint8. present: (P, n) bool, false
        where a row's plane is all zero.
    offsets: (P, n + 1) int32; the bytes of row r in plane p start at data[p][offsets[p, r]] and end
        where those of row r + 1 start. data: P arrays of uint8.
    """

    mask: npt.NDArray[np.uint32]
    predictor: npt.NDArray[np.uint8]
    present: npt.NDArray[np.bool_]
    offsets: npt.NDArray[np.int32]
    data: tuple[npt.NDArray[np.uint8], ...]


def encode(
    lanes: npt.NDArray[Any],
    warp_offsets: npt.NDArray[np.int64],
    instruction: npt.NDArray[np.uint16],
    sizes: npt.NDArray[np.uint32],
) -> Planes:
    """Code the rows of whole warps.

    lanes: (n, 32) uint32 packed texels or uint64 addresses. warp_offsets, instruction: as in
        `Chunk`.
    sizes: (num_instructions, 2) uint32, width and height of mip 0 of each instruction's texture;
        not used for addresses.
    """
    num_rows = len(lanes)
    lanes = np.ascontiguousarray(lanes)
    texels = lanes.dtype == np.uint32
    num_planes = texel_coding.NUM_PLANES if texels else address_coding.NUM_PLANES
    mask, predictor = np.empty(num_rows, np.uint32), np.empty(num_rows, np.uint8)
    present = np.zeros((num_planes, num_rows), np.bool_)
    offsets = np.zeros((num_planes, num_rows + 1), np.int32)
    # Two bytes a lane are the widest texel plane; untouched memory of the others costs nothing.
    data = np.empty((num_planes, num_rows * WARP_SIZE * (2 if texels else 1)), np.uint8)
    if texels:
        texel_coding.encode_texels(
            lanes, warp_offsets, instruction, sizes, mask, predictor, present, offsets, data
        )
    else:
        address_coding.encode_addresses(
            lanes, warp_offsets, mask, predictor, present, offsets, data
        )
    held = tuple(data[plane, : offsets[plane, -1]] for plane in range(num_planes))
    return Planes(mask, predictor, present, offsets, held)


def decode(
    planes: Planes,
    warp_offsets: npt.NDArray[np.int64],
    instruction: npt.NDArray[np.uint16],
    sizes: npt.NDArray[np.uint32],
) -> npt.NDArray[Any]:
    """The lanes that `encode` was given.

    Raises:
        ValueError: planes that no `encode` makes, with the first such row.
    """
    num_rows = len(planes.mask)
    num_active = np.bitwise_count(planes.mask).astype(np.int32)
    texels = len(planes.data) == texel_coding.NUM_PLANES
    for plane, present in enumerate(planes.present):
        size = num_active
        if texels:
            size = (num_active + 1) // 2 if plane == 0 else 2 * num_active
        offsets = planes.offsets[plane]
        wrong = np.diff(offsets) != np.where(present, size, 0)
        if wrong.any() or offsets[0] < 0 or offsets[-1] > len(planes.data[plane]):
            raise ValueError(f"row {int(wrong.argmax())}: plane {plane} has a wrong length")
    # What comes from a file is read-only; one kind of array spares a second compilation.
    data = tuple(plane.view() for plane in planes.data)
    for plane_data in data:
        plane_data.flags.writeable = False
    lanes: npt.NDArray[Any]
    if texels:
        lanes = np.empty((num_rows, WARP_SIZE), np.uint32)
        bad = texel_coding.decode_texels(
            planes.mask, planes.predictor, planes.present, planes.offsets, data,
            warp_offsets, instruction, sizes, lanes,
        )  # fmt: skip
    else:
        lanes = np.empty((num_rows, WARP_SIZE), np.uint64)
        bad = address_coding.decode_addresses(
            planes.mask, planes.predictor, planes.present, planes.offsets, data,
            warp_offsets, lanes,
        )  # fmt: skip
    if bad >= 0:
        raise ValueError(f"row {bad}: predictor {planes.predictor[bad]} has no row to go by")
    return lanes
