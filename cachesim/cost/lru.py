"""A cache that replaces the least recently used line, for reads that are drawn."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit


class Cache(NamedTuple):
    """The units of a level.

    set_of: (lines,), empty where there is no such level. valid: (units, lines) bits of sectors, 0
    where absent. newer, older: (units, lines + sets) doubly linked lists, a set's own entry behind
    the lines. held: (units, sets). asked_at: (sectors,) the access that asked last.
    """

    set_of: npt.NDArray[np.uint32]
    ways: int
    sectors_per_line: int
    sector_bytes: int
    valid: npt.NDArray[np.uint8]
    newer: npt.NDArray[np.int32]
    older: npt.NDArray[np.int32]
    held: npt.NDArray[np.int32]
    asked_at: npt.NDArray[np.int64]


@njit(cache=True, nogil=True)
def look_up(cache: Any, unit: Any, number: Any) -> bool:
    """Look up a sector, and fetch it where it is missing; whether it was there."""
    line = number // cache.sectors_per_line
    bit = np.uint8(1 << number % cache.sectors_per_line)
    num_lines = cache.valid.shape[1]
    newer, older, own = cache.newer[unit], cache.older[unit], num_lines + cache.set_of[line]
    was = cache.valid[unit, line]
    if was:
        newer[older[line]], older[newer[line]] = newer[line], older[line]
    elif cache.held[unit, cache.set_of[line]] == cache.ways:
        victim = newer[own]
        newer[own], older[newer[victim]] = newer[victim], own
        cache.valid[unit, victim] = 0
    else:
        cache.held[unit, cache.set_of[line]] += 1
    # The set's entry stands between its newest line and its oldest.
    newest = older[own]
    newer[newest], older[line], newer[line], older[own] = line, newest, own, line
    cache.valid[unit, line] = was | bit
    return bool(was & bit)
