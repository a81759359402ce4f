"""The cache: a batch of requests in, hits and misses counted, what goes to the next level out.

All instances of a level (units, arrays or slices) live in one set of flat arrays. A tag is found through a chained hash table, so
that a set of 96 ways costs what one of 4 does; replacement is `cachesim.policies`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from cachesim import policies
from cachesim.config import CacheLevel
from cachesim.stream import ATOMIC, GROUP_BITS, GROUP_MASK, LOAD, STORE, Outcome, Requests

U64, U32, U8 = np.uint64, np.uint32, np.uint8
NO_LINE = np.uint32(0xFFFFFFFF)
ALL_BYTES = np.uint32(0xFFFFFFFF)

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
) = range(12)
NUM_COUNTERS = 12

# What a store does on a present sector, and on an absent one (facts sheet 3.2, `wr` and `wralloc`).
HIT_THROUGH, HIT_BACK, HIT_EVICT = range(3)
MISS_NONE, MISS_ALLOCATE, MISS_FETCH, MISS_LAZY = range(4)
_ON_HIT = {
    "read-only": HIT_THROUGH,
    "write-through": HIT_THROUGH,
    "write-back": HIT_BACK,
    "write-evict": HIT_EVICT,
    # Local write-back, global write-evict: a texel store is global.
    "local-write-back": HIT_EVICT,
}
_ON_MISS = {
    "none": MISS_NONE,
    "write-allocate": MISS_ALLOCATE,
    "fetch-on-write": MISS_FETCH,
    "lazy-fetch-on-read": MISS_LAZY,
}

POPCOUNT = np.array([bin(m).count("1") for m in range(256)], np.int64)


class CacheState(NamedTuple):
    """The arrays of all instances of a level. L = lines in all, S = sets in all, B = hash buckets in all.

    tag: (L,) uint64 line number; bucket: (B,) uint32 first line of a chain, `NO_LINE` = empty; chain: (L,) uint32 next in chain.
    used: (L,) uint8 holds a tag; valid: (L,) uint8 readable sectors; partial: (L,) uint8 sectors written in part and not readable;
    dirty: (L,) uint8 sectors to write back.
    newest: (S,) uint32; newer, older: (L,) uint32, `policies`' rings; tree: (S,) uint64; rrpv: (L,) uint8; fills: (S,) uint64.
    bytes_held: (L, 8) uint32 bytes of each partial sector; owner: (L, 8) int32 group that dirtied a sector.
    """

    tag: npt.NDArray[np.uint64]
    bucket: npt.NDArray[np.uint32]
    chain: npt.NDArray[np.uint32]
    used: npt.NDArray[np.uint8]
    valid: npt.NDArray[np.uint8]
    partial: npt.NDArray[np.uint8]
    dirty: npt.NDArray[np.uint8]
    newest: npt.NDArray[np.uint32]
    newer: npt.NDArray[np.uint32]
    older: npt.NDArray[np.uint32]
    tree: npt.NDArray[np.uint64]
    rrpv: npt.NDArray[np.uint8]
    fills: npt.NDArray[np.uint64]
    bytes_held: npt.NDArray[np.uint32]
    owner: npt.NDArray[np.int32]


class CacheRules(NamedTuple):
    """The scalars of a level that its loop needs."""

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


def cache_rules(level: CacheLevel, num_instances: int, *, bypass_loads: bool, bypass_stores: bool) -> CacheRules:
    """The rules of `num_instances` caches like `level`."""
    on_hit = _ON_HIT[level.write_policy]
    return CacheRules(
        num_instances=num_instances,
        num_sets=level.num_sets,
        ways=level.ways,
        policy=policies.CODES[level.replacement],
        sectors_per_line=level.sectors_per_line,
        all_bytes=(1 << min(32, level.sector_bytes)) - 1,
        on_hit=on_hit,
        on_miss=_ON_MISS[level.write_allocate],
        can_be_dirty=int(on_hit == HIT_BACK),
        bypass_loads=int(bypass_loads),
        bypass_stores=int(bypass_stores),
    )


def empty_state(rules: CacheRules) -> CacheState:
    """Caches with nothing in them."""
    sets = rules.num_instances * rules.num_sets
    lines = sets * rules.ways
    per_instance = rules.num_sets * rules.ways
    buckets = 1 << max(4, (2 * per_instance - 1).bit_length())
    stores = 0 if rules.bypass_stores else lines
    state = CacheState(
        tag=np.zeros(lines, np.uint64),
        bucket=np.empty(rules.num_instances * buckets, np.uint32),
        chain=np.zeros(lines, np.uint32),
        used=np.zeros(lines, np.uint8),
        valid=np.zeros(lines, np.uint8),
        partial=np.zeros(lines, np.uint8),
        dirty=np.zeros(lines, np.uint8),
        newest=np.zeros(sets, np.uint32),
        newer=np.zeros(lines, np.uint32),
        older=np.zeros(lines, np.uint32),
        tree=np.zeros(sets, np.uint64),
        rrpv=np.zeros(lines, np.uint8),
        fills=np.zeros(sets, np.uint64),
        bytes_held=np.zeros((stores, 8), np.uint32),
        owner=np.zeros((stores, 8), np.int32),
    )
    reset(state, rules)
    return state


def reset(state: CacheState, rules: CacheRules) -> None:
    """Forget every line; nothing is written back."""
    state.bucket[:] = NO_LINE
    for array in (state.used, state.valid, state.partial, state.dirty, state.tree, state.rrpv, state.fills):
        array[...] = 0
    lines = np.arange(len(state.tag), dtype=np.int64).reshape(-1, rules.ways)
    state.newest[:] = lines[:, 0]
    state.newer.reshape(lines.shape)[:] = np.roll(lines, 1, axis=1)
    state.older.reshape(lines.shape)[:] = np.roll(lines, -1, axis=1)


def empty_outcome(rules: CacheRules, num_requests: int) -> Outcome:
    """Arrays for the outcome of up to `num_requests` requests."""
    evictions = num_requests if rules.can_be_dirty else 0
    return Outcome(
        down=np.zeros(num_requests, np.uint8),
        fill=np.zeros(0 if rules.bypass_stores else num_requests, np.uint8),
        evicted_line=np.zeros(evictions, np.uint64),
        evicted_owner=np.full((evictions, 8), -1, np.int32),
        evicted_bytes=np.zeros((evictions, 8), np.uint32),
    )


@njit(cache=True, nogil=True, inline="always")
def _evict(state, rules, line, i, counters, outcome):  # type: ignore[no-untyped-def]
    """Count and report the write-back of a dirty line; a write-back belongs to the group that dirtied the sector."""
    outcome.evicted_line[i] = state.tag[line]
    dirty = state.dirty[line]
    for s in range(rules.sectors_per_line):
        if (dirty >> U8(s)) & U8(1):
            counters[state.owner[line, s], WRITEBACKS] += 1
            outcome.evicted_owner[i, s] = state.owner[line, s]
            full = (state.valid[line] >> U8(s)) & U8(1)
            outcome.evicted_bytes[i, s] = rules.all_bytes if full else state.bytes_held[line, s]
    state.dirty[line] = 0


@njit(cache=True, nogil=True, inline="always")
def _store(state, rules, line, mask, group, operation, written, bytes_written):  # type: ignore[no-untyped-def]
    """Put a store's or atomic's sectors into a present line. Returns (sectors passed down, sectors to fetch)."""
    down, fill = U8(0), U8(0)
    for s in range(rules.sectors_per_line):
        bit = U8(1) << U8(s)
        if not mask & bit:
            continue
        if rules.on_hit == HIT_EVICT and operation == STORE:
            state.valid[line] &= ~bit
            state.partial[line] &= ~bit
            down |= bit
            continue
        readable = state.valid[line] & bit
        held = state.bytes_held[line, s] if state.partial[line] & bit else U32(0)
        present = readable or held
        if not present and rules.on_miss == MISS_NONE:
            down |= bit
            continue
        covered = held | (U32(rules.all_bytes) if operation == ATOMIC else bytes_written[written, s])
        complete = covered == U32(rules.all_bytes)
        if not readable and (
            operation == ATOMIC
            or (rules.on_miss == MISS_ALLOCATE and not present)
            or (rules.on_miss != MISS_LAZY and not complete)
        ):
            fill |= bit
            readable = bit
        if readable or complete:
            state.valid[line] |= bit
            state.partial[line] &= ~bit
        else:
            state.partial[line] |= bit
            state.bytes_held[line, s] = covered
        if rules.on_hit == HIT_BACK and (present or rules.on_miss != MISS_ALLOCATE):
            state.dirty[line] |= bit
            state.owner[line, s] = group
        else:
            down |= bit
    return down, fill


@njit(cache=True, nogil=True)
def access(state, rules, requests, sets, counters, outcome):  # type: ignore[no-untyped-def]
    """Send requests to their cache instances, segment by segment.

    requests: `Requests`, segments of one instance in issue order. sets: (n,) uint32, set of each request in its instance.
    counters: (num_groups, NUM_COUNTERS) int64, added to. outcome: `Outcome`, zeroed by the caller where it can be dirty.
    """
    ways = U64(rules.ways)
    buckets = U64(len(state.bucket) // rules.num_instances)
    bucket_shift = U64(64)
    size = buckets
    while size > U64(1):
        size >>= U64(1)
        bucket_shift -= U64(1)
    multiplier = U64(0x9E3779B97F4A7C15)
    for segment in range(len(requests.instance)):
        instance = U64(requests.instance[segment])
        first_bucket = instance * buckets
        first_set = instance * U64(rules.num_sets)
        begin, end = U64(requests.segments[segment]), U64(requests.segments[segment + 1])
        for i in range(begin, end):
            number = requests.line[i]
            mask = requests.mask[i]
            meta = requests.meta[i]
            operation = meta >> U32(GROUP_BITS)
            group = U64(meta & U32(GROUP_MASK))
            count = POPCOUNT[mask]
            if (
                rules.bypass_loads
                if operation == LOAD
                else (rules.bypass_stores or operation == ATOMIC and rules.on_hit != HIT_BACK)
            ):
                counters[group, BYPASSES] += count
                if operation != LOAD:
                    counters[group, BYPASSED_WRITES] += count
                outcome.down[i] = mask
                if len(outcome.fill):
                    outcome.fill[i] = 0
                continue
            counters[group, REQUESTS] += 1
            counters[group, ACCESSES] += count
            bucket = first_bucket + ((number * multiplier) >> bucket_shift)
            cache_set = first_set + U64(sets[i])

            # Find the tag.
            line = state.bucket[bucket]
            while line != NO_LINE and state.tag[line] != number:
                line = state.chain[line]

            if line != NO_LINE:
                present = state.valid[line]
                if operation == STORE:
                    present |= state.partial[line]
                hits = POPCOUNT[present & mask]
                counters[group, HITS] += hits
                counters[group, SECTOR_MISSES] += count - hits
                if operation != LOAD:
                    counters[group, WRITE_MISSES] += count - hits
                policies.touch(
                    rules.policy, line, cache_set, ways, state.newest, state.newer, state.older, state.tree, state.rrpv
                )
            else:
                counters[group, LINE_MISSES] += count
                if operation != LOAD:
                    counters[group, WRITE_MISSES] += count
                    if rules.on_miss == MISS_NONE:
                        counters[group, WRITES] += count
                        counters[group, STORES_DOWN] += count
                        outcome.down[i] = mask
                        outcome.fill[i] = 0
                        continue
                # Replace a line.
                line = policies.victim(
                    rules.policy, cache_set, ways, state.newest, state.newer, state.tree, state.rrpv, state.fills
                )
                if state.used[line]:
                    old = first_bucket + ((state.tag[line] * multiplier) >> bucket_shift)
                    other = state.bucket[old]
                    if other == line:
                        state.bucket[old] = state.chain[line]
                    else:
                        while state.chain[other] != line:
                            other = state.chain[other]
                        state.chain[other] = state.chain[line]
                    if rules.can_be_dirty and state.dirty[line]:
                        _evict(state, rules, line, i, counters, outcome)
                state.used[line] = 1
                state.tag[line] = number
                state.chain[line] = state.bucket[bucket]
                state.bucket[bucket] = line
                state.valid[line] = 0
                state.partial[line] = 0

            # Fetch what a load misses, or merge a store.
            if operation == LOAD:
                outcome.down[i] = mask & ~state.valid[line]
                state.valid[line] |= mask
                state.partial[line] &= ~mask
            else:
                counters[group, WRITES] += count
                down, fill = _store(
                    state, rules, line, mask, group, operation, requests.written[i], requests.bytes_written
                )
                counters[group, STORES_DOWN] += POPCOUNT[down]
                counters[group, WRITE_FILLS] += POPCOUNT[fill]
                outcome.down[i] = down
                outcome.fill[i] = fill


__all__ = ["CacheRules", "CacheState", "access", "cache_rules", "empty_outcome", "empty_state", "reset"]
