"""Traces of microbenchmarks: a pointer chase and a stream over a footprint, as they are run on
silicon to measure the latency and the bandwidth of one level of caches.

Both are lane-address traces whose first launch, pass "warm", brings the footprint into the caches
(it has no rows where nothing is to be warm).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
import numpy.typing as npt

from traces.texture import INACTIVE_ADDRESS, WARP_SIZE
from traces.trace import Chunk, Instruction, Launch, Trace

#: Bytes between two loads of a chase, and that a warp of a stream loads at once.
STEP_BYTES = 128
_BASE_ADDRESS = 0x7F40_0000_0000
_WARPS_PER_CTA = 8
_LANE_BYTES = STEP_BYTES // WARP_SIZE

Warm = Literal["self", "whole", "rest"]
Lines = npt.NDArray[np.int64]


def chase(footprint_bytes: int, num_loads: int, warm: Warm = "whole", seed: int = 0) -> Trace:
    """One lane that loads again and again, each load after the last one's data, in a random cyclic
    order of addresses 128 B apart: `num_loads` of them in pass "once", twice as many in pass
    "twice". The passes' difference is free of what starts and ends a kernel.

    num_loads: at most a sixth of the footprint's lines unless warm is "self".
    warm: "self": the lane goes once round the footprint first, as all warps have done before, and
        then `num_loads` (twice as many) loads further. "whole", "rest": the loads are of the
        footprint's first half, none twice, after all warps have touched all of it, or only its
        last eighth (which opens rows in the memory). So the whole is found in the last cache that
        holds it and, L1s being emptied between launches, not in one that holds half of it.
    """
    num_lines = footprint_bytes // STEP_BYTES
    middle = 0 if warm == "self" else num_lines // 2
    order = np.random.default_rng(seed).permutation(middle or num_lines)
    touched = np.arange(num_lines - num_lines // 8 if warm == "rest" else 0, num_lines)
    if warm == "self":
        walks = [np.resize(order, num_lines + k * num_loads) for k in (1, 2)]
    else:
        walks = [order[:num_loads], order[num_loads : 3 * num_loads]]
    launches = [_warming(touched)]
    for lines in walks:
        lanes = np.full((1, len(lines), WARP_SIZE), INACTIVE_ADDRESS, np.uint64)
        lanes[0, :, 0] = _BASE_ADDRESS + lines * STEP_BYTES
        launches.append((1, lanes))
    return _trace(("warm", "once", "twice"), launches, dependent=True)


def stream(
    footprint_bytes: int,
    num_warps: int,
    loads_per_warp: int,
    num_waves: int,
    *,
    is_warm: bool = True,
    shift: int | None = None,
) -> Trace:
    """Waves of warps that load 128 B each, side by side, in pass "stream".

    num_warps: those of a wave, a multiple of 8; as many as the machine holds. is_warm: all of the
    footprint is touched before. shift: lines between two loads of a warp; a wave's width unless
    given, so that each wave goes on where the last one ended.
    """
    num_lines = footprint_bytes // STEP_BYTES
    step = num_warps if shift is None else shift
    warp = np.arange(num_waves * num_warps)[:, None]
    load = warp // num_warps * loads_per_warp + np.arange(loads_per_warp)
    launches = [
        _warming(np.arange(num_lines if is_warm else 0)),
        (num_waves * num_warps, _lanes((load * step + warp % num_warps) % num_lines)),
    ]
    return _trace(("warm", "stream"), launches, dependent=False)


def _lanes(lines: Lines) -> npt.NDArray[np.uint64]:
    """(..., 32) addresses of warps that load whole lines."""
    address = _BASE_ADDRESS + lines[..., None] * STEP_BYTES + np.arange(WARP_SIZE) * _LANE_BYTES
    return address.astype(np.uint64)


def _warming(lines: Lines) -> tuple[int, npt.NDArray[np.uint64]]:
    """A launch whose warps load one of the lines each."""
    warps = -(-max(1, len(lines)) // _WARPS_PER_CTA) * _WARPS_PER_CTA
    loads = 1 if len(lines) else 0
    return warps, _lanes(np.resize(lines, (warps, loads)))


def _trace(
    names: tuple[str, ...], launches: list[tuple[int, npt.NDArray[np.uint64]]], dependent: bool
) -> Trace:
    """A trace of launches: the passes' names; warps, and their lanes (warps, loads, 32)."""
    described = []
    for name, (warps, _) in zip(names, launches, strict=True):
        per_cta = min(warps, _WARPS_PER_CTA)
        described.append(Launch(0, name, warps // per_cta, per_cta))

    def chunks() -> Iterator[Chunk]:
        for k, (warps, lanes) in enumerate(launches):
            loads = lanes.shape[1]
            offsets = np.arange(warps + 1, dtype=np.int64) * loads
            code = np.full(warps * loads, k, np.uint16)
            yield Chunk(k, 0, offsets, code, lanes.reshape(-1, WARP_SIZE))

    # A dependent load waits for all before it; nothing waits while the caches are warmed.
    instructions = [
        Instruction(
            name, -1, access_bytes=_LANE_BYTES, num_outstanding=0 if dependent and k else -1
        )
        for k, name in enumerate(names)
    ]
    return Trace({"scene": "microbench"}, (), instructions, described, chunks)
