"""The coding of byte addresses into byte planes, and back (`traces.encoding` describes it)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from traces.texel_coding import put
from traces.texture import INACTIVE_ADDRESS, WARP_SIZE

#: The two predictors in use.
PREVIOUS_LANE, ROW_BEFORE = 0, 2
NUM_PLANES = 8

u32, u64 = np.uint32, np.uint64


@njit(cache=True, nogil=True)
def encode_addresses(lanes: Any, warp_offsets: Any, mask: Any, predictor: Any, present: Any,
                     offsets: Any, data: Any) -> None:  # fmt: skip
    """Fills `mask`, `predictor`, `present`, `offsets` and `data`, as in `Planes`."""
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
                code = ROW_BEFORE if by_row < by_lane else PREVIOUS_LANE
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
                for plane in range(NUM_PLANES):
                    data[plane, offsets[plane, row] + num] = (folded >> u64(8 * plane)) & u64(0xFF)
                num += 1
            mask[row] = bits
            for plane in range(NUM_PLANES):
                used = (union >> u64(8 * plane)) & u64(0xFF)
                put(offsets[plane], present[plane], row, num, used)


@njit(cache=True, nogil=True)
def decode_addresses(mask: Any, predictor: Any, present: Any, offsets: Any, data: Any,
                     warp_offsets: Any, lanes: Any) -> Any:  # fmt: skip
    """Fills `lanes`. Returns the first row whose predictor has no row to go by, or -1."""
    chain = u64(0)
    for warp in range(warp_offsets.shape[0] - 1):
        begin = warp_offsets[warp]
        for row in range(begin, warp_offsets[warp + 1]):
            code = predictor[row]
            if code != PREVIOUS_LANE and (code != ROW_BEFORE or row == begin):
                return row
            num = 0
            before = chain
            for lane in range(WARP_SIZE):
                if not (mask[row] >> u32(lane)) & u32(1):
                    lanes[row, lane] = INACTIVE_ADDRESS
                    continue
                folded = u64(0)
                for plane in range(NUM_PLANES):
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
