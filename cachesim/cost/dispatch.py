"""T(n) = k T'_k(n/k) + O(n), its groups: which tiles an SM holds together, and when.

A launch's k CTAs are handed out in order, at first one per SM in turn; a CTA that is done makes
room for the next. An SM shares its turns equally among the CTAs that it holds, so that a CTA's time
is its accesses times those it shares with. This is the counting model's order without its accesses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from cachesim.cost.workload import Floats, Ints

#: Turns between the ends of CTAs of equal work: their last accesses.
_BETWEEN_ENDS = 2.0


@dataclass(frozen=True, eq=False)
class Schedule:
    """When and where each CTA ran. start, end: (n,) turns. unit: (n,) its L1. sharing: (n,) working
    CTAs on that L1, itself included, on average over its time.
    """

    start: Floats
    end: Floats
    unit: Ints
    sharing: Floats


def dispatch(
    accesses: npt.NDArray[Any], works: npt.NDArray[np.bool_], num_sms: int, places: int, units: int
) -> Schedule:
    """Hand out CTAs of so many accesses each.

    accesses: (n,) of all warps of a CTA, above 0. works: (n,) bool, whether it takes samples.
    num_sms: at least 1. places: CTAs that an SM holds. units: L1 units of an SM, which a CTA's
    place chooses.
    """
    n = len(accesses)
    start, end, sharing, unit = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    asked = np.asarray(accesses, np.float64)
    _dispatch(asked, works, num_sms, places, units, start, end, unit, sharing)
    return Schedule(start, end, unit, sharing)


@njit(cache=True, nogil=True)
def _dispatch(
    accesses: Any,
    works: Any,
    num_sms: int,
    places: int,
    units: int,
    start: Any,
    end: Any,
    unit_of: Any,
    sharing: Any,
) -> None:
    n = len(accesses)
    cta_at = np.full((num_sms, places), -1, np.int64)
    left = np.zeros((num_sms, places))
    held = np.zeros(num_sms, np.int64)
    # When each SM was last brought up to date, and when its next CTA ends.
    now_of = np.zeros(num_sms)
    next_end = np.full(num_sms, np.inf)
    working = np.zeros((num_sms, units), np.int64)
    shared = np.zeros((num_sms, units))
    following = 0
    for place in range(places):
        for each_sm in range(num_sms):
            if following < n:
                cta_at[each_sm, place] = following
                left[each_sm, place] = accesses[following]
                held[each_sm] += 1
                working[each_sm, place % units] += works[following]
                unit_of[following] = each_sm * units + place % units
                following += 1
    for each_sm in range(num_sms):
        least = np.inf
        for place in range(places):
            if cta_at[each_sm, place] >= 0:
                least = min(least, left[each_sm, place])
        if held[each_sm]:
            next_end[each_sm] = least * held[each_sm]
    while True:
        sm: Any = np.argmin(next_end)
        now = next_end[sm]
        if now == np.inf:
            return
        passed = now - now_of[sm]
        each = passed / held[sm]
        for unit in range(units):
            shared[sm, unit] += passed * working[sm, unit]
        now_of[sm] = now
        least = np.inf
        waiting = False
        for place in range(places):
            cta = cta_at[sm, place]
            if cta < 0:
                continue
            left[sm, place] -= each
            if left[sm, place] <= 1e-9 * accesses[cta]:
                if waiting:
                    # CTAs that are done in one round end one after the other, so that those of
                    # other SMs come between.
                    least = 0.0
                    continue
                waiting = True
                unit = place % units
                end[cta] = now
                length = now - start[cta]
                if length > 0:
                    sharing[cta] = (shared[sm, unit] - sharing[cta]) / length
                working[sm, unit] -= works[cta]
                cta_at[sm, place] = -1
                held[sm] -= 1
                if following < n:
                    cta_at[sm, place] = following
                    left[sm, place] = accesses[following]
                    start[following] = now
                    unit_of[following] = sm * units + unit
                    # Until its end, this holds the integral at its start.
                    sharing[following] = shared[sm, unit]
                    working[sm, unit] += works[following]
                    held[sm] += 1
                    following += 1
            if cta_at[sm, place] >= 0:
                least = min(least, left[sm, place])
        next_end[sm] = now + max(least * held[sm], _BETWEEN_ENDS) if held[sm] else np.inf
