"""The columns of a level's counters, and the codes of its rules."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

# Columns of the counters: all in the level's sectors, except REQUESTS.
(
    REQUESTS,
    ACCESSES,
    HITS,
    LINE_MISSES,
    SECTOR_MISSES,
    WRITES,
    WRITE_MISSES,
    STORES_DOWN,
    WRITE_FILLS,
    BYPASSES,
    BYPASSED_WRITES,
    WRITEBACKS,
    MERGED,
) = range(13)
NUM_COUNTERS = 13

# What a store does on a present sector, and on an absent one (facts sheet 3.2, `wr` and `wralloc`).
HIT_THROUGH, HIT_BACK, HIT_EVICT = range(3)
MISS_NONE, MISS_ALLOCATE, MISS_FETCH, MISS_LAZY = range(4)
#: By the names in `cachesim.config`.
ON_HIT = {
    "read-only": HIT_THROUGH,
    "write-through": HIT_THROUGH,
    "write-back": HIT_BACK,
    "write-evict": HIT_EVICT,
    # Local write-back, global write-evict: a texel store is global.
    "local-write-back": HIT_EVICT,
}
ON_MISS = {
    "none": MISS_NONE,
    "write-allocate": MISS_ALLOCATE,
    "fetch-on-write": MISS_FETCH,
    "lazy-fetch-on-read": MISS_LAZY,
}

# Places in a line's four flag bytes: whether it holds a tag, its readable sectors, those written in
# part and not readable, those to write back.
USED, VALID, PARTIAL, DIRTY = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
#: The same in the word that the four bytes are to the hot loops (little-endian hosts).
VALID_SHIFT, PARTIAL_SHIFT, DIRTY_SHIFT = np.uint64(8), np.uint64(16), np.uint64(24)

POPCOUNT = np.array([bin(m).count("1") for m in range(256)], np.int64)


class CountedLevel(NamedTuple):
    """A level's counters at the end of a run. counters: (groups, NUM_COUNTERS) int64; dirty:
    (groups,) int64 dirty sectors still held, by the group that dirtied them. num_distinct: sectors
    asked for at least once, None where not counted.
    """

    name: str
    sector_bytes: int
    counters: npt.NDArray[np.int64]
    dirty: npt.NDArray[np.int64]
    num_distinct: int | None
