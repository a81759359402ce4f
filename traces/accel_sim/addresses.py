"""The addresses of an instruction line: `mode` and numbers, three ways.

0   one hexadecimal address per active lane
1   base and stride: active lanes are neighbours and evenly spaced; decimal stride of 32 bits
2   base and differences: from each active lane to the next, decimal
"""

from __future__ import annotations

from functools import cache
from itertools import accumulate

import numpy as np
import numpy.typing as npt

from traces.texture import INACTIVE_ADDRESS, WARP_SIZE

ADDRESS_MASK = (1 << 64) - 1
_INACTIVE = int(INACTIVE_ADDRESS)
_MAX_STRIDE = (1 << 31) - 1


def encode(addresses: npt.NDArray[np.uint64]) -> tuple[list[str], list[str]]:
    """The masks, 8 hexadecimal digits each, and the shortest address field of each line.

    addresses: (n, 32) uint64, `INACTIVE_ADDRESS` where a lane is inactive.
    """
    active = addresses != INACTIVE_ADDRESS
    masks = np.packbits(active, axis=1, bitorder="little").view("<u4").ravel().tolist()
    counts = np.count_nonzero(active, axis=1)
    ends = counts.cumsum()
    begins = ends - counts
    flat, lane = addresses[active], np.nonzero(active)[1]
    # Differences modulo 2^64; the first of each line is not used.
    steps = np.diff(flat, prepend=np.uint64(0)).view(np.int64)
    uneven = _is_uneven(steps, lane, np.arange(len(flat)) - np.repeat(begins, counts))
    num_uneven = np.concatenate([[0], uneven.cumsum()])
    is_strided = num_uneven[ends] == num_uneven[begins]
    texts = list(map(str, steps.tolist()))
    bases = list(map(hex, flat.tolist()))
    fields = []
    for begin, end, strided in zip(
        begins.tolist(), ends.tolist(), is_strided.tolist(), strict=True
    ):
        if end - begin < 2:
            fields.append(f"0 {bases[begin]}" if end > begin else "0")
        elif strided:
            fields.append(f"1 {bases[begin]} {texts[begin + 1]}")
        else:
            fields.append(f"2 {bases[begin]} {' '.join(texts[begin + 1 : end])}")
    return [f"{mask:08x}" for mask in masks], fields


def _is_uneven(
    steps: npt.NDArray[np.int64], lane: npt.NDArray[np.int64], place: npt.NDArray[np.int64]
) -> npt.NDArray[np.bool_]:
    """Per active lane, whether mode 1 cannot give its address.

    place: which of its line's active lanes it is.
    """
    gap = np.diff(lane, prepend=-1) != 1
    wide = (steps > _MAX_STRIDE) | (steps < -_MAX_STRIDE)
    other = np.diff(steps, prepend=0) != 0
    uneven: npt.NDArray[np.bool_] = ((place > 0) & (gap | wide)) | ((place > 1) & other)
    return uneven


@cache
def lanes_of(mask: int) -> tuple[int, ...]:
    """The active lanes of a mask, ascending."""
    return tuple(lane for lane in range(WARP_SIZE) if mask >> lane & 1)


def decode(mask: int, fields: list[str]) -> tuple[list[int], int]:
    """The 32 addresses of a line, `INACTIVE_ADDRESS` where inactive, and how many fields they took.

    mask: bit l = lane l is active. fields: from the mode on; more may follow.

    Raises:
        ValueError: an unknown mode, too few fields, one that is no number, or mode 1 with gaps.
    """
    lanes = lanes_of(mask)
    made = [_INACTIVE] * WARP_SIZE
    mode = fields[0] if fields else "nothing"
    # Accel-Sim's own reader takes as many differences as there are active lanes, one too many: it
    # swallows the immediate that follows.
    used = 1 + {"0": len(lanes), "1": 2, "2": max(len(lanes), 1)}.get(mode, 0)
    if used == 1 and mode != "0":
        raise ValueError(f"address mode {mode}: allowed are 0, 1 and 2")
    if len(fields) < used:
        raise ValueError(f"{len(fields) - 1} numbers in address mode {mode}: need {used - 1}")
    if mode == "0":
        found = [int(field, 16) for field in fields[1:used]]
    elif mode == "1":
        if lanes and lanes[-1] - lanes[0] >= len(lanes):
            raise ValueError(f"address mode 1 with mask {mask:08x}: need neighbouring lanes")
        base, stride = int(fields[1], 16), int(fields[2])
        found = [base + k * stride & ADDRESS_MASK for k in range(len(lanes))]
    else:
        steps = map(int, fields[2:used])
        found = [sum_ & ADDRESS_MASK for sum_ in accumulate(steps, initial=int(fields[1], 16))]
    for lane, address in zip(lanes, found, strict=False):
        if not 0 <= address < _INACTIVE:
            raise ValueError(f"address {address:#x}: allowed are 0 to 2^64 - 2")
        made[lane] = address
    return made, used
