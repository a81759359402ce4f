"""The lossless coding of a chunk's lanes for the Parquet file: predict, keep the residuals, cut them into byte planes.

Each row names a predictor: where the guess of its lanes comes from.

    0        the lane before (lane 0: the first lane of the last row that was coded so)
    1        the same lane of the warp's first row
    2 to 5   the same lane of the row 1 to 4 before
    6, 7     the same lane of the row 1 or 2 after, which must itself not use 6 or 7

A guess from a row of another size of level is scaled: x' = floor((x + 1/2) w' / w). The three fetches of one sampling step thus cost
about as much as one: the profile id lies at the normal's texel, and the filtered colour at the same place of a smaller level.
Residuals of x and y are taken modulo 2^14, those of a mip modulo 16, those of an address modulo 2^64, so that any input comes back
exactly; signed ones are folded to 0, -1, 1, -2, ... = 0, 1, 2, 3, ... before they are cut into bytes. A plane holds the active lanes
only, and a row whose plane is all zero has no entry in it (null).

    texels      plane 0: mips, two to a byte; 1: low bytes of x, then of y; 2: high bytes of x, then of y
    addresses   plane p: byte p, least significant first
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, WARP_SIZE

PREVIOUS_LANE, FIRST_ROW, NUM_PREDICTORS = 0, 1, 8
_LAST_BACKWARD = 5
NUM_TEXEL_PLANES, NUM_ADDRESS_PLANES = 3, 8
#: Lanes on which predictors are compared: enough to tell them apart, at a quarter of the price.
_NUM_TRIED = 8

u32, u64 = np.uint32, np.uint64


@dataclass(frozen=True, eq=False)
class Planes:
    """The coded lanes of n rows in P byte planes.

    mask: (n,) uint32, bit l = lane l is active. predictor: (n,) uint8. present: (P, n) bool, false where a row's plane is all zero.
    offsets: (P, n + 1) int32; the bytes of row r in plane p are data[p][offsets[p, r] : offsets[p, r + 1]]. data: P arrays of uint8.
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
    level_sizes: tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32]],
) -> Planes:
    """Code the rows of whole warps.

    lanes: (n, 32) uint32 packed texels or uint64 addresses. warp_offsets, instruction: as in `Chunk`.
    level_sizes: two (num_instructions, 16) arrays, as `traces.check.level_sizes` makes them; not used for addresses.
    """
    num_rows = len(lanes)
    texels = lanes.dtype == np.uint32
    num_planes = NUM_TEXEL_PLANES if texels else NUM_ADDRESS_PLANES
    mask, predictor = np.empty(num_rows, np.uint32), np.empty(num_rows, np.uint8)
    present = np.zeros((num_planes, num_rows), np.bool_)
    offsets = np.zeros((num_planes, num_rows + 1), np.int32)
    # Two bytes a lane are the widest texel plane; untouched memory of the others costs nothing.
    data = np.empty((num_planes, num_rows * WARP_SIZE * (2 if texels else 1)), np.uint8)
    if texels:
        _encode_texels(
            lanes, warp_offsets, instruction, *level_sizes, mask, predictor, present, offsets, data
        )
    else:
        _encode_addresses(lanes, warp_offsets, mask, predictor, present, offsets, data)
    held = tuple(data[plane, : offsets[plane, -1]] for plane in range(num_planes))
    return Planes(mask, predictor, present, offsets, held)


def decode(
    planes: Planes,
    warp_offsets: npt.NDArray[np.int64],
    instruction: npt.NDArray[np.uint16],
    level_sizes: tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32]],
) -> npt.NDArray[Any]:
    """The lanes that `encode` was given.

    Raises:
        ValueError: planes that no `encode` makes, with the first such row.
    """
    num_rows = len(planes.mask)
    num_active = np.bitwise_count(planes.mask).astype(np.int32)
    texels = len(planes.data) == NUM_TEXEL_PLANES
    for plane, present in enumerate(planes.present):
        size = num_active
        if texels:
            size = (num_active + 1) // 2 if plane == 0 else 2 * num_active
        wrong = np.diff(planes.offsets[plane]) != np.where(present, size, 0)
        if wrong.any():
            raise ValueError(f"row {int(wrong.argmax())}: plane {plane} has a wrong length")
    lanes: npt.NDArray[Any]
    if texels:
        lanes = np.empty((num_rows, WARP_SIZE), np.uint32)
        bad = _decode_texels(
            planes.mask, planes.predictor, planes.present, planes.offsets, planes.data,
            warp_offsets, instruction, *level_sizes, lanes,
        )  # fmt: skip
    else:
        lanes = np.empty((num_rows, WARP_SIZE), np.uint64)
        bad = _decode_addresses(
            planes.mask, planes.predictor, planes.present, planes.offsets, planes.data,
            warp_offsets, lanes,
        )  # fmt: skip
    if bad >= 0:
        raise ValueError(f"row {bad}: predictor {planes.predictor[bad]} has no row to go by")
    return lanes


@njit(cache=True, nogil=True)
def _reference(code: Any, row: Any, begin: Any) -> Any:
    """The row that predictor `code` of `row` looks at."""
    if code == FIRST_ROW:
        return begin
    return row - (code - 1) if code <= _LAST_BACKWARD else row + (code - _LAST_BACKWARD)


@njit(cache=True, nogil=True)
def _fold(residual: Any) -> Any:
    """A residual modulo 2^14 as 0, -1, 1, -2, ... -> 0, 1, 2, 3, ..."""
    residual &= u32(0x3FFF)
    return (
        residual << u32(1) if residual < u32(0x2000) else ((u32(0x3FFF) - residual) << u32(1)) | u32(1)
    )


@njit(cache=True, nogil=True)
def _unfold(folded: Any) -> Any:
    half = folded >> u32(1)
    return u32(0x3FFF) - half if folded & u32(1) else half


@njit(cache=True, nogil=True, error_model="numpy")
def _guess(reference: Any, mip: Any, from_widths: Any, from_heights: Any, widths: Any, heights: Any) -> Any:
    """(y, x) of the texel of level `mip` at the place of the texel `reference`; (0, 0) if that lane is inactive there."""
    if reference == INACTIVE_TEXEL:
        return u32(0), u32(0)
    low = u32(0x3FFF)
    y, x = (reference >> u32(14)) & low, reference & low
    from_mip = reference >> u32(28)
    width, from_width = widths[mip], from_widths[from_mip]
    if width != from_width:
        x = ((u32(2) * x + u32(1)) * width // (u32(2) * max(from_width, u32(1)))) & low
    height, from_height = heights[mip], from_heights[from_mip]
    if height != from_height:
        y = ((u32(2) * y + u32(1)) * height // (u32(2) * max(from_height, u32(1)))) & low
    return y, x


@njit(cache=True, nogil=True)
def _cost(lanes: Any, row: Any, reference: Any, index: Any, from_index: Any, widths: Any, heights: Any) -> Any:
    """How far a row's first active lanes lie from the guesses made from row `reference`; -1: from the lane before."""
    low = u32(0x3FFF)
    cost, tried = 0, 0
    before = INACTIVE_TEXEL
    for lane in range(WARP_SIZE):
        texel = lanes[row, lane]
        if texel == INACTIVE_TEXEL:
            continue
        mip = texel >> u32(28)
        if reference >= 0:
            y, x = _guess(
                lanes[reference, lane], mip, widths[from_index], heights[from_index], widths[index], heights[index]
            )  # fmt: skip
        else:
            start = texel if before == INACTIVE_TEXEL else before
            y, x = (start >> u32(14)) & low, start & low
            before = texel
        cost += np.int64(_fold((texel & low) - x)) + np.int64(_fold(((texel >> u32(14)) & low) - y))
        tried += 1
        if tried == _NUM_TRIED:
            break
    return cost


@njit(cache=True, nogil=True)
def _choose(lanes: Any, begin: Any, end: Any, row: Any, instruction: Any, widths: Any, heights: Any,
            predictor: Any, pinned: Any, last: Any) -> Any:  # fmt: skip
    """The cheapest predictor that this row may use. `last`: the instruction's last choice, tried first."""
    best, best_cost = PREVIOUS_LANE, np.int64(1) << 60
    for attempt in range(NUM_PREDICTORS + 1):
        code = last if attempt == 0 else attempt - 1
        if attempt and code == last:
            continue
        reference = -1
        if code != PREVIOUS_LANE:
            reference = _reference(code, row, begin)
            # The row must be of this warp, and be known before this one is: forward guesses come last.
            if reference < begin or reference >= end or reference == row:
                continue
            if reference < row and predictor[reference] > _LAST_BACKWARD:
                continue
            if reference > row and pinned[row]:
                continue
        source = reference if reference >= 0 else row
        cost = _cost(lanes, row, reference, instruction[row], instruction[source], widths, heights)
        if cost < best_cost:
            best, best_cost = code, cost
            if cost == 0:
                break
    return best


@njit(cache=True, nogil=True)
def _put(offsets: Any, present: Any, row: Any, size: Any, any_bits: Any) -> None:
    """Close a row's entry of one plane: keep its bytes unless all are zero."""
    present[row] = any_bits != 0
    offsets[row + 1] = offsets[row] + (size if any_bits != 0 else 0)


@njit(cache=True, nogil=True)
def _encode_texels(lanes: Any, warp_offsets: Any, instruction: Any, widths: Any, heights: Any,
                   mask: Any, predictor: Any, present: Any, offsets: Any, data: Any) -> None:  # fmt: skip
    low = u32(0x3FFF)
    pinned = np.zeros(lanes.shape[0], np.bool_)
    last_choice = np.full(widths.shape[0], FIRST_ROW, np.int64)
    chain = u32(0)
    xs, ys, mips = np.empty(WARP_SIZE, u32), np.empty(WARP_SIZE, u32), np.empty(WARP_SIZE + 1, u32)
    for warp in range(warp_offsets.shape[0] - 1):
        begin, end = warp_offsets[warp], warp_offsets[warp + 1]
        for row in range(begin, end):
            index = instruction[row]
            code = PREVIOUS_LANE
            if row > begin:
                code = _choose(
                    lanes, begin, end, row, instruction, widths, heights, predictor, pinned, last_choice[index]
                )  # fmt: skip
                last_choice[index] = code
            predictor[row] = code
            reference = row
            if code != PREVIOUS_LANE:
                reference = _reference(code, row, begin)
                if reference > row:
                    pinned[reference] = True
            # Take the residuals of the active lanes.
            from_index = instruction[reference]
            bits, num, any_mip, any_xy = u32(0), 0, u32(0), u32(0)
            before = chain
            for lane in range(WARP_SIZE):
                texel = lanes[row, lane]
                if texel == INACTIVE_TEXEL:
                    continue
                bits |= u32(1) << u32(lane)
                mip = texel >> u32(28)
                if code == PREVIOUS_LANE:
                    y, x, from_mip = (before >> u32(14)) & low, before & low, before >> u32(28)
                    if num == 0:
                        chain = texel
                    before = texel
                else:
                    source = lanes[reference, lane]
                    y, x = _guess(
                        source, mip, widths[from_index], heights[from_index], widths[index], heights[index]
                    )  # fmt: skip
                    from_mip = u32(0) if source == INACTIVE_TEXEL else source >> u32(28)
                xs[num] = _fold((texel & low) - x)
                ys[num] = _fold(((texel >> u32(14)) & low) - y)
                mips[num] = (mip - from_mip) & u32(15)
                any_mip |= mips[num]
                any_xy |= xs[num] | ys[num]
                num += 1
            mask[row] = bits
            # Cut them into planes.
            mips[num] = 0
            if any_mip:
                at = offsets[0, row]
                for pair in range((num + 1) // 2):
                    data[0, at + pair] = mips[2 * pair] | mips[2 * pair + 1] << u32(4)
            if any_xy & u32(0xFF):
                at = offsets[1, row]
                for i in range(num):
                    data[1, at + i], data[1, at + num + i] = xs[i] & u32(0xFF), ys[i] & u32(0xFF)
            if any_xy >> u32(8):
                at = offsets[2, row]
                for i in range(num):
                    data[2, at + i], data[2, at + num + i] = xs[i] >> u32(8), ys[i] >> u32(8)
            _put(offsets[0], present[0], row, (num + 1) // 2, any_mip)
            _put(offsets[1], present[1], row, 2 * num, any_xy & u32(0xFF))
            _put(offsets[2], present[2], row, 2 * num, any_xy >> u32(8))


@njit(cache=True, nogil=True)
def _decode_texels(mask: Any, predictor: Any, present: Any, offsets: Any, data: Any, warp_offsets: Any,
                   instruction: Any, widths: Any, heights: Any, lanes: Any) -> Any:  # fmt: skip
    """Fills `lanes`. Returns the first row whose predictor has no row to go by, or -1."""
    low = u32(0x3FFF)
    chain = u32(0)
    for warp in range(warp_offsets.shape[0] - 1):
        begin, end = warp_offsets[warp], warp_offsets[warp + 1]
        # Rows that look back first, then those that look forward at them.
        for forward in range(2):
            for row in range(begin, end):
                code = predictor[row]
                if (code > _LAST_BACKWARD) != (forward == 1):
                    continue
                reference = row
                if code != PREVIOUS_LANE:
                    reference = _reference(np.int64(code), row, begin)
                    if code >= NUM_PREDICTORS or reference < begin or reference >= end:
                        return row
                    if reference == row or predictor[reference] > _LAST_BACKWARD:
                        return row
                index, from_index = instruction[row], instruction[reference]
                bits = mask[row]
                num_active = 0
                for lane in range(WARP_SIZE):
                    num_active += np.int64((bits >> u32(lane)) & u32(1))
                at_mip, at_low, at_high = offsets[0, row], offsets[1, row], offsets[2, row]
                has_mip, has_low, has_high = present[0, row], present[1, row], present[2, row]
                num = 0
                before = chain
                for lane in range(WARP_SIZE):
                    if not (bits >> u32(lane)) & u32(1):
                        lanes[row, lane] = INACTIVE_TEXEL
                        continue
                    mip, x_residual, y_residual = u32(0), u32(0), u32(0)
                    if has_mip:
                        mip = (u32(data[0][at_mip + (num >> 1)]) >> u32(4 * (num & 1))) & u32(15)
                    if has_low:
                        x_residual = u32(data[1][at_low + num])
                        y_residual = u32(data[1][at_low + num_active + num])
                    if has_high:
                        x_residual |= u32(data[2][at_high + num]) << u32(8)
                        y_residual |= u32(data[2][at_high + num_active + num]) << u32(8)
                    if code == PREVIOUS_LANE:
                        y, x, from_mip = (before >> u32(14)) & low, before & low, before >> u32(28)
                        mip = (mip + from_mip) & u32(15)
                    else:
                        source = lanes[reference, lane]
                        from_mip = u32(0) if source == INACTIVE_TEXEL else source >> u32(28)
                        mip = (mip + from_mip) & u32(15)
                        y, x = _guess(
                            source, mip, widths[from_index], heights[from_index], widths[index], heights[index]
                        )  # fmt: skip
                    x = (x + _unfold(x_residual)) & low
                    y = (y + _unfold(y_residual)) & low
                    texel = (mip << u32(28)) | (y << u32(14)) | x
                    if code == PREVIOUS_LANE:
                        if num == 0:
                            chain = texel
                        before = texel
                    lanes[row, lane] = texel
                    num += 1
    return -1


@njit(cache=True, nogil=True)
def _encode_addresses(lanes: Any, warp_offsets: Any, mask: Any, predictor: Any, present: Any,
                      offsets: Any, data: Any) -> None:  # fmt: skip
    chain = u64(0)
    for warp in range(warp_offsets.shape[0] - 1):
        begin = warp_offsets[warp]
        for row in range(begin, warp_offsets[warp + 1]):
            # Addresses take the lane before, or the row before where its distances are smaller.
            code = PREVIOUS_LANE
            if row > begin:
                by_lane, by_row = 0.0, 0.0
                for lane in range(1, WARP_SIZE):
                    address = lanes[row, lane]
                    if address != INACTIVE_ADDRESS:
                        by_lane += abs(np.float64(np.int64(address - lanes[row, lane - 1])))
                        by_row += abs(np.float64(np.int64(address - lanes[row - 1, lane])))
                code = FIRST_ROW + 1 if by_row < by_lane else PREVIOUS_LANE
            predictor[row] = code
            bits, num, union = u32(0), 0, u64(0)
            before = chain
            for lane in range(WARP_SIZE):
                address = lanes[row, lane]
                if address == INACTIVE_ADDRESS:
                    continue
                bits |= u32(1) << u32(lane)
                if code != PREVIOUS_LANE:
                    before = lanes[row - 1, lane]
                residual = address - before
                folded = (residual << u64(1)) ^ (u64(0) - (residual >> u64(63)))
                if code == PREVIOUS_LANE:
                    if num == 0:
                        chain = address
                    before = address
                union |= folded
                for plane in range(NUM_ADDRESS_PLANES):
                    data[plane, offsets[plane, row] + num] = (folded >> u64(8 * plane)) & u64(0xFF)
                num += 1
            mask[row] = bits
            for plane in range(NUM_ADDRESS_PLANES):
                used = (union >> u64(8 * plane)) & u64(0xFF)
                _put(offsets[plane], present[plane], row, num, used)


@njit(cache=True, nogil=True)
def _decode_addresses(mask: Any, predictor: Any, present: Any, offsets: Any, data: Any, warp_offsets: Any,
                      lanes: Any) -> Any:  # fmt: skip
    """Fills `lanes`. Returns the first row whose predictor has no row to go by, or -1."""
    chain = u64(0)
    for warp in range(warp_offsets.shape[0] - 1):
        begin = warp_offsets[warp]
        for row in range(begin, warp_offsets[warp + 1]):
            code = predictor[row]
            if code != PREVIOUS_LANE and (code != FIRST_ROW + 1 or row == begin):
                return row
            num = 0
            before = chain
            for lane in range(WARP_SIZE):
                if not (mask[row] >> u32(lane)) & u32(1):
                    lanes[row, lane] = INACTIVE_ADDRESS
                    continue
                folded = u64(0)
                for plane in range(NUM_ADDRESS_PLANES):
                    if present[plane, row]:
                        byte = u64(data[plane][offsets[plane, row] + num])
                        folded |= byte << u64(8 * plane)
                if code != PREVIOUS_LANE:
                    before = lanes[row - 1, lane]
                address = before + ((folded >> u64(1)) ^ (u64(0) - (folded & u64(1))))
                if code == PREVIOUS_LANE:
                    if num == 0:
                        chain = address
                    before = address
                lanes[row, lane] = address
                num += 1
    return -1
