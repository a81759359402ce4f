"""T(n) = k T'_k(n/k) + O(n), its groups: which tiles an SM holds together, and when.

A launch's k CTAs are handed out in order, at first one per SM in turn; a CTA that is done makes
room for the next. In each turn every SM issues one access of its next warp. This is the counting
model's order, of which only the numbers of accesses are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from cachesim.cost.workload import Floats, Ints


@dataclass(frozen=True, eq=False)
class Schedule:
    """When and where each CTA ran. start, end: (n,) turns. unit: (n,) its L1."""

    start: Floats
    end: Floats
    unit: Ints


def dispatch(accesses: Ints, num_sms: int, places: int, units: int) -> Schedule:
    """Hand out CTAs.

    accesses: (n, warps) of each warp; a CTA has one or more. num_sms: at least 1. places: CTAs that
    an SM holds. units: L1 units of an SM, which a CTA's place chooses.
    """
    n = len(accesses)
    start, end, unit = np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    _dispatch(np.asarray(accesses, np.int64), num_sms, places, units, start, end, unit)
    return Schedule(start, end, unit)


@njit(cache=True, nogil=True)
def _dispatch(
    accesses: Any, num_sms: int, places: int, units: int, start: Any, end: Any, unit_of: Any
) -> None:
    n, warps = accesses.shape
    slots = places * warps
    cta_at = np.full((num_sms, places), -1, np.int64)
    left = np.zeros((num_sms, slots), np.int64)
    live = np.zeros(num_sms, np.int64)
    pointer = np.zeros(num_sms, np.int64)
    following, turn, running = 0, 0, 0
    for first in range(num_sms * places):
        if first < n:
            sm, place = first % num_sms, first // num_sms
            cta_at[sm, place] = first
            unit_of[first] = sm * units + place % units
            for w in range(warps):
                left[sm, place * warps + w] = accesses[first, w]
                live[sm] += accesses[first, w]
            following = first + 1
    running = following
    while running:
        turn += 1
        for sm in range(num_sms):
            if live[sm] == 0:
                continue
            slot = pointer[sm]
            while left[sm, slot] == 0:
                slot = slot + 1 if slot + 1 < slots else 0
            pointer[sm] = slot + 1 if slot + 1 < slots else 0
            left[sm, slot] -= 1
            live[sm] -= 1
            if left[sm, slot]:
                continue
            place = slot // warps
            if left[sm, place * warps : (place + 1) * warps].any():
                continue
            end[cta_at[sm, place]] = turn
            running -= 1
            if following < n:
                # The next CTA takes the place at once.
                cta_at[sm, place] = following
                start[following] = turn
                unit_of[following] = sm * units + place % units
                for w in range(warps):
                    left[sm, place * warps + w] = accesses[following, w]
                    live[sm] += accesses[following, w]
                following += 1
                running += 1
