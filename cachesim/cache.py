"""The cache: a batch of requests in, hits and misses counted, what goes to the next level out.

All instances of a level (units, arrays or slices) live in one set of flat arrays. `cachesim.lookup`
finds lines in them, `cachesim.policies` chooses victims, `cachesim.access` holds the loops.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim import policies
from cachesim.access import access_hashed, access_small
from cachesim.config import CacheLevel
from cachesim.counts import (
    ACCESSES,
    BYPASSED_WRITES,
    BYPASSES,
    DIRTY,
    HIT_BACK,
    HITS,
    LINE_MISSES,
    NUM_COUNTERS,
    ON_HIT,
    ON_MISS,
    PARTIAL,
    REQUESTS,
    SECTOR_MISSES,
    STORES_DOWN,
    USED,
    VALID,
    WRITE_FILLS,
    WRITE_MISSES,
    WRITEBACKS,
    WRITES,
)
from cachesim.lookup import FIRST_RECENCY, NO_LINE, NO_TAG, SMALL_WAYS
from cachesim.stream import Outcome, Requests


class CacheState(NamedTuple):
    """The arrays of all instances of a level. L = lines in all, S = sets in all, B = hash buckets
    in all.

    flags: (4 L,) uint8, 4 l + `USED`, `VALID`, `PARTIAL`, `DIRTY`; flag_words: (L,) uint32, the
        same. bytes_held: (L, 8) uint32 bytes of each partial sector; owner: (L, 8) int32 group that
        dirtied a sector.
    Hashed: 24 bytes per line, in two views, so that what a miss needs of its victim comes with one
        fetch. tags: (3 L,) uint64, 3 l is the line number that line l holds. links: (6 L,) uint32,
        6 l + `lookup.CHAIN` is the next line of its hash chain, 6 l + `policies.NEWER` and `OLDER`
        its set's ring. bucket: (B,) uint32 first line of a chain, `NO_LINE` = empty. newest: (S,)
        uint32 a set's most recent line. fills: (S,) uint64 tags it was given. tree: (S,) uint64
        tree-PLRU's bits. rrpv: (L,) uint8 SRRIP's values. Empty where sets are small.
    Small sets: every set has room for 16 lines. small_tags: (16 S,) uint32 line number less the
        first. recency: (S,) uint64, its ways from the newest, lowest 4 bits, up. Empty where
        hashed.
    """

    flags: npt.NDArray[np.uint8]
    flag_words: npt.NDArray[np.uint32]
    bytes_held: npt.NDArray[np.uint32]
    owner: npt.NDArray[np.int32]
    tags: npt.NDArray[np.uint64]
    links: npt.NDArray[np.uint32]
    bucket: npt.NDArray[np.uint32]
    newest: npt.NDArray[np.uint32]
    fills: npt.NDArray[np.uint64]
    tree: npt.NDArray[np.uint64]
    rrpv: npt.NDArray[np.uint8]
    small_tags: npt.NDArray[np.uint32]
    recency: npt.NDArray[np.uint64]


class CacheRules(NamedTuple):
    """The scalars of a level that its loops need. small: whether it uses small sets, with line
    numbers from `first_line` up.
    """

    num_instances: int
    num_sets: int
    ways: int
    policy: int
    sectors_per_line: int
    all_bytes: int
    on_hit: int
    on_miss: int
    can_be_dirty: int
    bypass_loads: int
    bypass_stores: int
    small: int
    first_line: np.uint64


def cache_rules(
    level: CacheLevel,
    num_instances: int,
    *,
    bypass_loads: bool,
    bypass_stores: bool,
    first_line: int | None = None,
) -> CacheRules:
    """The rules of `num_instances` caches like `level`.

    first_line: given where all line numbers are known to lie in [first_line, first_line + 2^32 -
        2]; lets sets be small.
    """
    on_hit = ON_HIT[level.write_policy]
    small = (
        first_line is not None and level.ways <= SMALL_WAYS and level.replacement in ("lru", "fifo")
    )
    return CacheRules(
        num_instances=num_instances,
        num_sets=level.num_sets,
        ways=level.ways,
        policy=policies.CODES[level.replacement],
        sectors_per_line=level.sectors_per_line,
        all_bytes=(1 << min(32, level.sector_bytes)) - 1,
        on_hit=on_hit,
        on_miss=ON_MISS[level.write_allocate],
        can_be_dirty=int(on_hit == HIT_BACK and not bypass_stores),
        bypass_loads=int(bypass_loads),
        bypass_stores=int(bypass_stores),
        small=int(small),
        first_line=np.uint64(first_line or 0),
    )


def empty_state(rules: CacheRules) -> CacheState:
    """Caches with nothing in them."""
    sets = rules.num_instances * rules.num_sets
    lines = sets * (SMALL_WAYS if rules.small else rules.ways)
    hashed_lines, hashed_sets = (0, 0) if rules.small else (lines, sets)
    # Eight buckets per line: a chain that is nearly always empty or of one line is a branch that
    # the host predicts.
    per_instance = rules.num_sets * rules.ways
    buckets = 1 << max(4, (8 * per_instance - 1).bit_length())
    stores = 0 if rules.bypass_stores else lines
    memory, flag_words = np.zeros(3 * hashed_lines, np.uint64), np.zeros(lines, np.uint32)
    state = CacheState(
        flags=flag_words.view(np.uint8),
        flag_words=flag_words,
        bytes_held=np.zeros((stores, 8), np.uint32),
        owner=np.zeros((stores, 8), np.int32),
        tags=memory,
        links=memory.view(np.uint32),
        bucket=np.empty(0 if rules.small else rules.num_instances * buckets, np.uint32),
        newest=np.zeros(hashed_sets, np.uint32),
        fills=np.zeros(hashed_sets, np.uint64),
        tree=np.zeros(hashed_sets, np.uint64),
        rrpv=np.zeros(hashed_lines, np.uint8),
        small_tags=np.empty(lines - hashed_lines, np.uint32),
        recency=np.empty(sets - hashed_sets, np.uint64),
    )
    reset(state, rules)
    return state


def reset(state: CacheState, rules: CacheRules) -> None:
    """Forget every line; nothing is written back."""
    state.flags[:] = 0
    state.small_tags[:] = NO_TAG
    state.recency[:] = FIRST_RECENCY
    state.bucket[:] = NO_LINE
    state.tags[:] = 0
    state.fills[:] = 0
    state.tree[:] = 0
    state.rrpv[:] = 0
    lines = np.arange(len(state.tags) // 3, dtype=np.uint32).reshape(-1, rules.ways)
    state.newest[:] = lines[:, 0]
    state.links[policies.NEWER :: 6] = np.roll(lines, 1, axis=1).ravel()
    state.links[policies.OLDER :: 6] = np.roll(lines, -1, axis=1).ravel()


def line_numbers(state: CacheState, rules: CacheRules) -> npt.NDArray[np.uint64]:
    """(L,) uint64: the line number that each line holds; undefined where it holds none."""
    if rules.small:
        return state.small_tags.astype(np.uint64) + rules.first_line
    return state.tags[::3]


def empty_outcome(rules: CacheRules, num_requests: int) -> Outcome:
    """Arrays for the outcome of up to `num_requests` requests."""
    evictions = num_requests if rules.can_be_dirty else 0
    return Outcome(
        down=np.zeros(num_requests, np.uint8),
        fill=np.zeros(0 if rules.bypass_stores else num_requests, np.uint8),
        evicted_line=np.zeros(evictions, np.uint64),
        evicted_owner=np.zeros((evictions, 8), np.int32),
        evicted_bytes=np.zeros((evictions, 8), np.uint32),
    )


def access(
    state: CacheState,
    rules: CacheRules,
    requests: Requests,
    sets: npt.NDArray[np.uint32],
    counters: npt.NDArray[np.int64],
    outcome: Outcome,
) -> None:
    """Send requests to their cache instances, segment by segment.

    requests: segments of one instance in issue order. sets: (n,) uint32, set of each request in its
        instance.
    counters: (num_groups, NUM_COUNTERS) int64, added to. outcome: room for every request, filled
        in.
    """
    if rules.small:
        access_small(state, rules, requests, sets, counters, outcome, np.uint64(SMALL_WAYS))
    else:
        others = None if rules.policy in (policies.LRU, policies.FIFO) else 1
        access_hashed(state, rules, requests, sets, counters, outcome, others)


__all__ = [
    "ACCESSES",
    "BYPASSED_WRITES",
    "BYPASSES",
    "DIRTY",
    "HITS",
    "LINE_MISSES",
    "NUM_COUNTERS",
    "PARTIAL",
    "REQUESTS",
    "SECTOR_MISSES",
    "STORES_DOWN",
    "USED",
    "VALID",
    "WRITEBACKS",
    "WRITES",
    "WRITE_FILLS",
    "WRITE_MISSES",
    "CacheRules",
    "CacheState",
    "access",
    "cache_rules",
    "empty_outcome",
    "empty_state",
    "line_numbers",
    "reset",
]
