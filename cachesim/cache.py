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

# Places in the views of a line, beside those of `policies` (`CacheState`).
CHAIN = U64(2)
USED, VALID, PARTIAL, DIRTY = U64(20), U64(21), U64(22), U64(23)

NO_LINE = np.uint32(0xFFFFFFFF)
#: Of the hash of a line number to its bucket (Fibonacci hashing).
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)

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

    A line is 32 bytes, half a host cache line, so that what a miss needs of its victim comes with one fetch. Three views of it:
    tags: (4 L,) uint64, 4 l is the line number that line l holds. links: (8 L,) uint32, 8 l + `CHAIN` is the next line of its hash
        chain, 8 l + `NEWER` and `OLDER` its set's ring (`policies`). flags: (32 L,) uint8, 32 l + `USED` holds a tag, `VALID`
        readable sectors, `PARTIAL` sectors written in part and not readable, `DIRTY` sectors to write back, `RRPV` as SRRIP has it.
    (Not records: numba counts references to an array for every record it takes from it, which costs twice the cache.)
    newest: (S,) uint32 a set's most recent line. fills: (S,) uint64 tags it was given. tree: (S,) uint64 tree-PLRU's bits.
    bucket: (B,) uint32 first line of a chain, `NO_LINE` = empty.
    bytes_held: (L, 8) uint32 bytes of each partial sector; owner: (L, 8) int32 group that dirtied a sector.
    """

    tags: npt.NDArray[np.uint64]
    links: npt.NDArray[np.uint32]
    flags: npt.NDArray[np.uint8]
    newest: npt.NDArray[np.uint32]
    fills: npt.NDArray[np.uint64]
    tree: npt.NDArray[np.uint64]
    bucket: npt.NDArray[np.uint32]
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


def cache_rules(
    level: CacheLevel, num_instances: int, *, bypass_loads: bool, bypass_stores: bool
) -> CacheRules:
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
    buckets = 1 << max(4, (8 * per_instance - 1).bit_length())
    stores = 0 if rules.bypass_stores else lines
    memory = np.zeros(4 * lines, np.uint64)
    state = CacheState(
        tags=memory,
        links=memory.view(np.uint32),
        flags=memory.view(np.uint8),
        newest=np.zeros(sets, np.uint32),
        fills=np.zeros(sets, np.uint64),
        tree=np.zeros(sets, np.uint64),
        bucket=np.empty(rules.num_instances * buckets, np.uint32),
        bytes_held=np.zeros((stores, 8), np.uint32),
        owner=np.zeros((stores, 8), np.int32),
    )
    reset(state, rules)
    return state


def reset(state: CacheState, rules: CacheRules) -> None:
    """Forget every line; nothing is written back."""
    state.bucket[:] = NO_LINE
    state.tags[:] = 0
    state.fills[:] = 0
    state.tree[:] = 0
    lines = np.arange(len(state.tags) // 4, dtype=np.uint32).reshape(-1, rules.ways)
    state.newest[:] = lines[:, 0]
    state.links[policies.NEWER :: 8] = np.roll(lines, 1, axis=1).ravel()
    state.links[policies.OLDER :: 8] = np.roll(lines, -1, axis=1).ravel()


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


@njit(cache=True, nogil=True, _nrt=False)
def _evict(  # type: ignore[no-untyped-def]
    tags,
    flags,
    bytes_held,
    owner,
    line,
    sectors_per_line,
    all_bytes,
    i,
    counters,
    evicted_line,
    evicted_owner,
    evicted_bytes,
):
    """Count and report the write-back of a dirty line; a write-back belongs to the group that dirtied the sector."""
    evicted_line[i] = tags[line * U64(4)]
    dirty = flags[line * U64(32) + DIRTY]
    for s in range(sectors_per_line):
        if (dirty >> U8(s)) & U8(1):
            counters[owner[line, s], WRITEBACKS] += 1
            evicted_owner[i, s] = owner[line, s] + 1
            full = (flags[line * U64(32) + VALID] >> U8(s)) & U8(1)
            evicted_bytes[i, s] = all_bytes if full else bytes_held[line, s]
    flags[line * U64(32) + DIRTY] = 0


@njit(cache=True, nogil=True, _nrt=False)
def _store(state, rules, line, mask, group, operation, written, bytes_written):  # type: ignore[no-untyped-def]
    """Put a store's or atomic's sectors into a present line. Returns (sectors passed down, sectors to fetch)."""
    flags = state.flags
    down, fill = U8(0), U8(0)
    for s in range(rules.sectors_per_line):
        bit = U8(1) << U8(s)
        if not mask & bit:
            continue
        if rules.on_hit == HIT_EVICT and operation == STORE:
            flags[line * U64(32) + VALID] &= ~bit
            flags[line * U64(32) + PARTIAL] &= ~bit
            down |= bit
            continue
        readable = flags[line * U64(32) + VALID] & bit
        held = state.bytes_held[line, s] if flags[line * U64(32) + PARTIAL] & bit else U32(0)
        present = readable or held
        if not present and rules.on_miss == MISS_NONE:
            down |= bit
            continue
        covered = held | (
            U32(rules.all_bytes) if operation == ATOMIC else bytes_written[written, s]
        )
        complete = covered == U32(rules.all_bytes)
        if not readable and (
            operation == ATOMIC
            or (rules.on_miss == MISS_ALLOCATE and not present)
            or (rules.on_miss != MISS_LAZY and not complete)
        ):
            fill |= bit
            readable = bit
        if readable or complete:
            flags[line * U64(32) + VALID] |= bit
            flags[line * U64(32) + PARTIAL] &= ~bit
        else:
            flags[line * U64(32) + PARTIAL] |= bit
            state.bytes_held[line, s] = covered
        if rules.on_hit == HIT_BACK and (present or rules.on_miss != MISS_ALLOCATE):
            flags[line * U64(32) + DIRTY] |= bit
            state.owner[line, s] = group
        else:
            down |= bit
    return down, fill


@njit(cache=True, nogil=True, _nrt=False, inline="always")
def _find(tags, links, buckets, bucket, number):  # type: ignore[no-untyped-def]
    """The line that holds a tag, or `NO_LINE`."""
    line = buckets[bucket]
    while line != NO_LINE and tags[line * U64(4)] != number:
        line = links[line * U64(8) + CHAIN]
    return line


@njit(cache=True, nogil=True, _nrt=False, inline="always")
def _take(  # type: ignore[no-untyped-def]
    tags,
    links,
    flags,
    newest,
    fills,
    tree,
    buckets,
    policy,
    ways,
    bucket,
    first_bucket,
    bucket_shift,
    cache_set,
):
    """Give a line of the set to a new tag. What its last tag left in it is still there but for the tag: see `_clear`."""
    line = policies.victim(policy, cache_set, ways, links, flags, newest, fills, tree)
    if flags[line * U64(32) + USED]:
        old = first_bucket + ((tags[line * U64(4)] * _MULTIPLIER) >> bucket_shift)
        other = buckets[old]
        if other == line:
            buckets[old] = links[line * U64(8) + CHAIN]
        else:
            while links[other * U64(8) + CHAIN] != line:
                other = links[other * U64(8) + CHAIN]
            links[other * U64(8) + CHAIN] = links[line * U64(8) + CHAIN]
    flags[line * U64(32) + USED] = 1
    links[line * U64(8) + CHAIN] = buckets[bucket]
    buckets[bucket] = line
    return line


@njit(cache=True, nogil=True, _nrt=False)
def _other_request(  # type: ignore[no-untyped-def]
    state, rules, requests, i, bucket, first_bucket, bucket_shift, cache_set, counters, outcome
):
    """A store, an atomic, or a load that bypasses."""
    tags, links, flags = state.tags, state.links, state.flags
    number, mask = requests.line[i], requests.mask[i]
    operation = requests.meta[i] >> U32(GROUP_BITS)
    group = U64(requests.meta[i] & U32(GROUP_MASK))
    count = POPCOUNT[mask]
    outcome.down[i] = mask
    if len(outcome.fill):
        outcome.fill[i] = 0
    bypasses = rules.bypass_loads if operation == LOAD else rules.bypass_stores
    if bypasses or (operation == ATOMIC and rules.on_hit != HIT_BACK):
        counters[group, BYPASSES] += count
        if operation != LOAD:
            counters[group, BYPASSED_WRITES] += count
        return
    counters[group, REQUESTS] += 1
    counters[group, ACCESSES] += count
    counters[group, WRITES] += count
    line = _find(tags, links, state.bucket, bucket, number)
    if line != NO_LINE:
        # A write hits a sector that was written in part; an atomic reads it first.
        present = flags[line * U64(32) + VALID]
        if operation == STORE:
            present |= flags[line * U64(32) + PARTIAL]
        hits = POPCOUNT[present & mask]
        counters[group, HITS] += hits
        counters[group, SECTOR_MISSES] += count - hits
        counters[group, WRITE_MISSES] += count - hits
        policies.touch(
            rules.policy, line, cache_set, U64(rules.ways), links, flags, state.newest, state.tree
        )
    else:
        counters[group, LINE_MISSES] += count
        counters[group, WRITE_MISSES] += count
        if rules.on_miss == MISS_NONE:
            counters[group, STORES_DOWN] += count
            return
        line = _take(
            tags,
            links,
            flags,
            state.newest,
            state.fills,
            state.tree,
            state.bucket,
            rules.policy,
            U64(rules.ways),
            bucket,
            first_bucket,
            bucket_shift,
            cache_set,
        )
        if rules.can_be_dirty and flags[line * U64(32) + DIRTY]:
            _evict(
                tags,
                flags,
                state.bytes_held,
                state.owner,
                line,
                rules.sectors_per_line,
                rules.all_bytes,
                i,
                counters,
                outcome.evicted_line,
                outcome.evicted_owner,
                outcome.evicted_bytes,
            )
        tags[line * U64(4)] = number
        flags[line * U64(32) + VALID] = 0
        flags[line * U64(32) + PARTIAL] = 0
    down, fill = _store(
        state, rules, line, mask, group, operation, requests.written[i], requests.bytes_written
    )
    counters[group, STORES_DOWN] += POPCOUNT[down]
    counters[group, WRITE_FILLS] += POPCOUNT[fill]
    outcome.down[i] = down
    outcome.fill[i] = fill


@njit(cache=True, nogil=True, _nrt=False)
def access(state, rules, requests, sets, counters, outcome):  # type: ignore[no-untyped-def]
    """Send requests to their cache instances, segment by segment.

    requests: `Requests`, segments of one instance in issue order. sets: (n,) uint32, set of each request in its instance.
    counters: (num_groups, NUM_COUNTERS) int64, added to. outcome: `Outcome`, zeroed by the caller where it can be dirty.
    """
    # Arrays of a tuple are counted references; in local names the loop takes none.
    tags, links, flags, newest, fills, tree, buckets, bytes_held, owner = state
    down, _, evicted_line, evicted_owner, evicted_bytes = outcome
    all_lines, all_masks, all_meta = requests.line, requests.mask, requests.meta
    sectors_per_line, all_bytes = rules.sectors_per_line, rules.all_bytes
    policy, can_be_dirty, bypass_loads = rules.policy, rules.can_be_dirty, rules.bypass_loads
    ways = U64(rules.ways)
    num_buckets = U64(len(buckets) // rules.num_instances)
    bucket_shift = U64(64)
    size = num_buckets
    while size > U64(1):
        size >>= U64(1)
        bucket_shift -= U64(1)
    for segment in range(len(requests.instance)):
        instance = U64(requests.instance[segment])
        first_bucket = instance * num_buckets
        first_set = instance * U64(rules.num_sets)
        begin, end = U64(requests.segments[segment]), U64(requests.segments[segment + 1])
        # Counts of a run of loads of one group stay in registers.
        run = U32(0)
        looked_up, asked, hits, line_misses = 0, 0, 0, 0
        for i in range(begin, end):
            number, mask, meta = all_lines[i], all_masks[i], all_meta[i]
            if meta != run:
                _add_loads(counters, run, looked_up, asked, hits, line_misses)
                run = meta
                looked_up, asked, hits, line_misses = 0, 0, 0, 0
            bucket = first_bucket + ((number * _MULTIPLIER) >> bucket_shift)
            cache_set = first_set + U64(sets[i])
            if bypass_loads or meta >> U32(GROUP_BITS) != U32(LOAD):
                _other_request(
                    state,
                    rules,
                    requests,
                    i,
                    bucket,
                    first_bucket,
                    bucket_shift,
                    cache_set,
                    counters,
                    outcome,
                )
                continue
            count = POPCOUNT[mask]
            looked_up += 1
            asked += count
            line = _find(tags, links, buckets, bucket, number)
            if line != NO_LINE:
                policies.touch(policy, line, cache_set, ways, links, flags, newest, tree)
                valid = flags[line * U64(32) + VALID]
                hits += POPCOUNT[valid & mask]
                down[i] = mask & ~valid
                flags[line * U64(32) + VALID] = valid | mask
                flags[line * U64(32) + PARTIAL] &= ~mask
            else:
                line = _take(
                    tags,
                    links,
                    flags,
                    newest,
                    fills,
                    tree,
                    buckets,
                    policy,
                    ways,
                    bucket,
                    first_bucket,
                    bucket_shift,
                    cache_set,
                )
                if can_be_dirty and flags[line * U64(32) + DIRTY]:
                    _evict(
                        tags,
                        flags,
                        bytes_held,
                        owner,
                        line,
                        sectors_per_line,
                        all_bytes,
                        i,
                        counters,
                        evicted_line,
                        evicted_owner,
                        evicted_bytes,
                    )
                tags[line * U64(4)] = number
                flags[line * U64(32) + VALID] = mask
                flags[line * U64(32) + PARTIAL] = 0
                line_misses += count
                down[i] = mask
        _add_loads(counters, run, looked_up, asked, hits, line_misses)


@njit(cache=True, nogil=True, _nrt=False, inline="always")
def _add_loads(counters, meta, looked_up, asked, hits, line_misses):  # type: ignore[no-untyped-def]
    group = U64(meta & U32(GROUP_MASK))
    counters[group, REQUESTS] += looked_up
    counters[group, ACCESSES] += asked
    counters[group, HITS] += hits
    counters[group, LINE_MISSES] += line_misses
    counters[group, SECTOR_MISSES] += asked - hits - line_misses


__all__ = [
    "CacheRules",
    "CacheState",
    "access",
    "cache_rules",
    "empty_outcome",
    "empty_state",
    "reset",
]
