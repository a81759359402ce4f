"""The coding of packed texels into byte planes, and back (`traces.encoding` describes it)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from traces.texture import INACTIVE_TEXEL, WARP_SIZE

PREVIOUS_LANE, FIRST_ROW, NUM_PREDICTORS = 0, 1, 8
_LAST_BACKWARD = 5
#: Mips, low bytes, high bytes.
NUM_PLANES = 3
#: Lanes on which predictors are compared: enough to tell them apart, at a quarter of the price.
_NUM_TRIED = 8
#: After so many rows an instruction's habitual predictor is compared with the others again.
_HABIT_ROWS = 32

u32 = np.uint32


@njit(cache=True, nogil=True)
def put(offsets: Any, present: Any, row: Any, size: Any, any_bits: Any) -> None:
    """Close a row's entry of one plane: keep its bytes unless all are zero."""
    present[row] = any_bits != 0
    offsets[row + 1] = offsets[row] + (size if any_bits != 0 else 0)


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
        residual << u32(1)
        if residual < u32(0x2000)
        else ((u32(0x3FFF) - residual) << u32(1)) | u32(1)
    )


@njit(cache=True, nogil=True)
def _unfold(folded: Any) -> Any:
    half = folded >> u32(1)
    return u32(0x3FFF) - half if folded & u32(1) else half


@njit(cache=True, nogil=True, error_model="numpy")
def _guess(
    source: Any, mip: Any, from_width: Any, from_height: Any, width: Any, height: Any
) -> Any:
    """(y, x) of the texel of level `mip` at the place of the texel `source`; the sizes are those of
    mip 0.
    """
    low = u32(0x3FFF)
    y, x, from_mip = (source >> u32(14)) & low, source & low, source >> u32(28)
    if mip != from_mip or width != from_width or height != from_height:
        # Exact: the quotient of integers this small is never rounded to the next integer.
        across = np.float64((u32(2) * x + u32(1)) * max(u32(1), width >> mip))
        down = np.float64((u32(2) * y + u32(1)) * max(u32(1), height >> mip))
        x = u32(np.int64(across / np.float64(u32(2) * max(u32(1), from_width >> from_mip)))) & low
        y = u32(np.int64(down / np.float64(u32(2) * max(u32(1), from_height >> from_mip)))) & low
    return y, x


@njit(cache=True, nogil=True)
def _cost(lanes: Any, row: Any, reference: Any, size: Any, from_size: Any) -> Any:
    """How far a row's first active lanes lie from the guesses made from row `reference`; -1: from
    the lane before.
    """
    low = u32(0x3FFF)
    cost, tried = np.int64(0), 0
    before = INACTIVE_TEXEL
    for lane in range(WARP_SIZE):
        texel = lanes[row, lane]
        if texel == INACTIVE_TEXEL:
            continue
        if reference >= 0:
            source = lanes[reference, lane]
            if source == INACTIVE_TEXEL:
                y, x = u32(0), u32(0)
            else:
                y, x = _guess(
                    source, texel >> u32(28), from_size[0], from_size[1], size[0], size[1]
                )
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
def _choose(lanes: Any, begin: Any, end: Any, row: Any, instruction: Any, sizes: Any,
            predictor: Any, pinned: Any, habit: Any) -> Any:  # fmt: skip
    """The cheapest predictor that this row may use.

    habit: (3,) int64 of the row's instruction: its last choice, what that cost, and for how many
    rows it has stood. While it costs about as usual, the others are not looked at.
    """
    best: Any = PREVIOUS_LANE
    best_cost = np.int64(1) << 60
    habit[2] += 1
    for attempt in range(NUM_PREDICTORS + 1):
        code = habit[0] if attempt == 0 else attempt - 1
        if attempt and code == habit[0]:
            continue
        reference = -1
        if code != PREVIOUS_LANE:
            reference = _reference(code, row, begin)
            # The row must be of this warp, and be known before this one is: forward guesses come
            # last.
            if reference < begin or reference >= end or reference == row:
                continue
            if reference < row and predictor[reference] > _LAST_BACKWARD:
                continue
            if reference > row and pinned[row]:
                continue
        source = reference if reference >= 0 else row
        cost = _cost(lanes, row, reference, sizes[instruction[row]], sizes[instruction[source]])
        if cost < best_cost:
            best, best_cost = code, cost
        if cost == 0:
            break
        if attempt == 0 and cost <= 2 * habit[1] and habit[2] < _HABIT_ROWS:
            return code
    habit[0], habit[1], habit[2] = best, best_cost, 0
    return best


@njit(cache=True, nogil=True)
def encode_texels(lanes: Any, warp_offsets: Any, instruction: Any, sizes: Any, mask: Any,
                  predictor: Any, present: Any, offsets: Any, data: Any) -> None:  # fmt: skip
    """Fills `mask`, `predictor`, `present`, `offsets` and `data`, as in `Planes`."""
    low = u32(0x3FFF)
    pinned = np.zeros(lanes.shape[0], np.bool_)
    habits = np.full((sizes.shape[0], 3), FIRST_ROW, np.int64)
    chain = u32(0)
    xs, ys, mips = np.empty(WARP_SIZE, u32), np.empty(WARP_SIZE, u32), np.empty(WARP_SIZE + 1, u32)
    for warp in range(warp_offsets.shape[0] - 1):
        begin, end = warp_offsets[warp], warp_offsets[warp + 1]
        for row in range(begin, end):
            index = instruction[row]
            code = PREVIOUS_LANE
            if row > begin:
                code = _choose(
                    lanes, begin, end, row, instruction, sizes, predictor, pinned, habits[index]
                )
            predictor[row] = code
            reference = row
            if code != PREVIOUS_LANE:
                reference = _reference(code, row, begin)
                if reference > row:
                    pinned[reference] = True
            # Take the residuals of the active lanes.
            width, height = sizes[index, 0], sizes[index, 1]
            from_width, from_height = (
                sizes[instruction[reference], 0],
                sizes[instruction[reference], 1],
            )
            bits, num, any_mip, any_xy = u32(0), 0, u32(0), u32(0)
            source = chain
            for lane in range(WARP_SIZE):
                texel = lanes[row, lane]
                if texel == INACTIVE_TEXEL:
                    continue
                bits |= u32(1) << u32(lane)
                mip = texel >> u32(28)
                if code == PREVIOUS_LANE:
                    y, x = (source >> u32(14)) & low, source & low
                else:
                    source = lanes[reference, lane]
                    if source == INACTIVE_TEXEL:
                        source = u32(0)
                    y, x = _guess(source, mip, from_width, from_height, width, height)
                xs[num] = _fold((texel & low) - x)
                ys[num] = _fold(((texel >> u32(14)) & low) - y)
                mips[num] = (mip - (source >> u32(28))) & u32(15)
                any_mip |= mips[num]
                any_xy |= xs[num] | ys[num]
                if code == PREVIOUS_LANE:
                    source = texel
                    if num == 0:
                        chain = texel
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
            put(offsets[0], present[0], row, (num + 1) // 2, any_mip)
            put(offsets[1], present[1], row, 2 * num, any_xy & u32(0xFF))
            put(offsets[2], present[2], row, 2 * num, any_xy >> u32(8))


@njit(cache=True, nogil=True)
def decode_texels(mask: Any, predictor: Any, present: Any, offsets: Any, data: Any,
                  warp_offsets: Any, instruction: Any, sizes: Any, lanes: Any) -> Any:  # fmt: skip
    """Fills `lanes`. Returns the first row whose predictor has no row to go by, or -1."""
    low = u32(0x3FFF)
    chain = u32(0)
    xs, ys, mips = np.empty(WARP_SIZE, u32), np.empty(WARP_SIZE, u32), np.empty(WARP_SIZE + 1, u32)
    for warp in range(warp_offsets.shape[0] - 1):
        begin, end = warp_offsets[warp], warp_offsets[warp + 1]
        # Rows that look back first, then those that look forward at them.
        for forward in range(2):
            for row in range(begin, end):
                code = np.int64(predictor[row])
                if (code > _LAST_BACKWARD) != (forward == 1):
                    continue
                reference = row
                if code != PREVIOUS_LANE:
                    reference = _reference(code, row, begin)
                    if code >= NUM_PREDICTORS or reference < begin or reference >= end:
                        return row
                    if reference == row or predictor[reference] > _LAST_BACKWARD:
                        return row
                bits = mask[row]
                num_active: Any = 0
                for lane in range(WARP_SIZE):
                    num_active += np.int64((bits >> u32(lane)) & u32(1))
                # Put the planes together.
                xs[:], ys[:], mips[:] = 0, 0, 0
                if present[0, row]:
                    at = offsets[0, row]
                    for pair in range((num_active + 1) // 2):
                        byte = data[0][at + pair]
                        mips[2 * pair], mips[2 * pair + 1] = byte & u32(15), byte >> u32(4)
                if present[1, row]:
                    at = offsets[1, row]
                    for i in range(num_active):
                        xs[i], ys[i] = data[1][at + i], data[1][at + num_active + i]
                if present[2, row]:
                    at = offsets[2, row]
                    for i in range(num_active):
                        xs[i] |= u32(data[2][at + i]) << u32(8)
                        ys[i] |= u32(data[2][at + num_active + i]) << u32(8)
                # Add them to the guesses.
                index, from_index = instruction[row], instruction[reference]
                width, height = sizes[index, 0], sizes[index, 1]
                from_width, from_height = sizes[from_index, 0], sizes[from_index, 1]
                num = 0
                source = chain
                for lane in range(WARP_SIZE):
                    if not (bits >> u32(lane)) & u32(1):
                        lanes[row, lane] = INACTIVE_TEXEL
                        continue
                    if code == PREVIOUS_LANE:
                        y, x = (source >> u32(14)) & low, source & low
                        mip = (mips[num] + (source >> u32(28))) & u32(15)
                    else:
                        source = lanes[reference, lane]
                        if source == INACTIVE_TEXEL:
                            source = u32(0)
                        mip = (mips[num] + (source >> u32(28))) & u32(15)
                        y, x = _guess(source, mip, from_width, from_height, width, height)
                    x = (x + _unfold(xs[num])) & low
                    y = (y + _unfold(ys[num])) & low
                    texel = (mip << u32(28)) | (y << u32(14)) | x
                    lanes[row, lane] = texel
                    if code == PREVIOUS_LANE:
                        source = texel
                        if num == 0:
                            chain = texel
                    num += 1
    return -1
