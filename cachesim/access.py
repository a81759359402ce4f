"""The loops of the cache: requests to hits, misses and what goes to the next level.

Arrays of a tuple are counted references to numba, and every counted reference taken in a loop costs
as much as a look-up: the hot loops take the arrays out first, and nothing here is compiled with
counting.
"""

from __future__ import annotations

import numpy as np

from cachesim import policies
from cachesim.compiled import compiled, inlined
from cachesim.counts import (
    ACCESSES,
    BYPASSED_WRITES,
    BYPASSES,
    DIRTY,
    DIRTY_SHIFT,
    HIT_BACK,
    HIT_EVICT,
    HITS,
    LINE_MISSES,
    MISS_ALLOCATE,
    MISS_LAZY,
    MISS_NONE,
    PARTIAL,
    PARTIAL_SHIFT,
    POPCOUNT,
    REQUESTS,
    SECTOR_MISSES,
    STORES_DOWN,
    USED,
    VALID,
    VALID_SHIFT,
    WRITE_FILLS,
    WRITE_MISSES,
    WRITEBACKS,
    WRITES,
)
from cachesim.lookup import (
    NO_LINE,
    SMALL_WAYS,
    bucket_of,
    find_hashed,
    find_small,
    move_line,
    take_small,
    touch_small,
)
from cachesim.stream import ATOMIC, GROUP_BITS, GROUP_MASK, LOAD, NO_OPERATION, STORE

U64, U32, U8 = np.uint64, np.uint32, np.uint8


@compiled
def _evict(state, rules, line, number, i, counters, outcome):  # type: ignore[no-untyped-def]
    """Count and report the write-back of dirty line `number`; it belongs to the groups that dirtied
    its sectors.
    """
    at = U64(line) * U64(4)
    outcome.evicted_line[i] = number
    for s in range(rules.sectors_per_line):
        if (state.flags[at + DIRTY] >> U8(s)) & U8(1):
            owner = state.owner[line, s]
            counters[owner, WRITEBACKS] += 1
            outcome.evicted_owner[i, s] = owner + 1
            full = (state.flags[at + VALID] >> U8(s)) & U8(1)
            outcome.evicted_bytes[i, s] = rules.all_bytes if full else state.bytes_held[line, s]
    state.flags[at + DIRTY] = 0


@compiled
def _store(state, rules, line, mask, group, operation, written, bytes_written):  # type: ignore[no-untyped-def]
    """Put a store's or atomic's sectors into a present line. Returns (sectors passed down, sectors
    to fetch).
    """
    flags, at = state.flags, U64(line) * U64(4)
    down, fill = U8(0), U8(0)
    for s in range(rules.sectors_per_line):
        bit = U8(1) << U8(s)
        if not mask & bit:
            continue
        if rules.on_hit == HIT_EVICT and operation == STORE:
            flags[at + VALID] &= ~bit
            flags[at + PARTIAL] &= ~bit
            down |= bit
            continue
        readable = flags[at + VALID] & bit
        held = state.bytes_held[line, s] if flags[at + PARTIAL] & bit else U32(0)
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
            flags[at + VALID] |= bit
            flags[at + PARTIAL] &= ~bit
        else:
            flags[at + PARTIAL] |= bit
            state.bytes_held[line, s] = covered
        if rules.on_hit == HIT_BACK and (present or rules.on_miss != MISS_ALLOCATE):
            flags[at + DIRTY] |= bit
            state.owner[line, s] = group
        else:
            down |= bit
    return down, fill


@compiled
def _other_request(  # type: ignore[no-untyped-def]
    state, rules, requests, i, first_bucket, shift, cache_set, counters, outcome, others
):
    """A store, an atomic, or a load that bypasses."""
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
    flags = state.flags
    tag = U32(number - U64(rules.first_line))
    bucket = bucket_of(number, first_bucket, shift)
    if rules.small:
        line = find_small(state.small_tags, tag, cache_set, U64(SMALL_WAYS))
    else:
        line = find_hashed(state.tags, state.links, state.bucket, bucket, number)
    if line != NO_LINE:
        # A write hits a sector that was written in part; an atomic reads it first.
        present = flags[line * U64(4) + VALID]
        if operation == STORE:
            present |= flags[line * U64(4) + PARTIAL]
        hits = POPCOUNT[present & mask]
        counters[group, HITS] += hits
        counters[group, SECTOR_MISSES] += count - hits
        counters[group, WRITE_MISSES] += count - hits
        if rules.small:
            if rules.policy == policies.LRU:
                touch_small(state.recency, line, cache_set)
        elif others is not None:
            policies.touch(
                rules.policy, line, cache_set, U64(rules.ways), state.links, state.rrpv,
                state.newest, state.tree,
            )  # fmt: skip
        elif rules.policy == policies.LRU:
            policies.to_front(line, cache_set, state.links, state.newest)
    else:
        counters[group, LINE_MISSES] += count
        counters[group, WRITE_MISSES] += count
        if rules.on_miss == MISS_NONE:
            counters[group, STORES_DOWN] += count
            return
        if rules.small:
            line = take_small(state.recency, U64(rules.ways), cache_set)
            old = U64(state.small_tags[line]) + U64(rules.first_line)
            state.small_tags[line] = tag
        else:
            if others is None:
                line = policies.oldest_to_front(cache_set, state.links, state.newest)
            else:
                line = policies.victim(
                    rules.policy, cache_set, U64(rules.ways), state.links, state.rrpv, state.newest,
                    state.fills, state.tree,
                )  # fmt: skip
            move_line(
                state.tags, state.links, flags, state.bucket, line, bucket, first_bucket, shift
            )
            old = state.tags[line * U64(3)]
            state.tags[line * U64(3)] = number
        at = line * U64(4)
        if rules.can_be_dirty and flags[at + DIRTY]:
            _evict(state, rules, line, old, i, counters, outcome)
        flags[at + USED], flags[at + VALID], flags[at + PARTIAL] = 1, 0, 0
    down, fill = _store(
        state, rules, line, mask, group, operation, requests.written[i], requests.bytes_written
    )
    counters[group, STORES_DOWN] += POPCOUNT[down]
    counters[group, WRITE_FILLS] += POPCOUNT[fill]
    outcome.down[i] = down
    outcome.fill[i] = fill


@inlined
def _add_loads(counters, meta, looked_up, asked, hits, line_misses):  # type: ignore[no-untyped-def]
    group = U64(meta & U32(GROUP_MASK))
    counters[group, REQUESTS] += looked_up
    counters[group, ACCESSES] += asked
    counters[group, HITS] += hits
    counters[group, LINE_MISSES] += line_misses
    counters[group, SECTOR_MISSES] += asked - hits - line_misses


@compiled
def access_hashed(state, rules, requests, sets, counters, outcome, others):  # type: ignore[no-untyped-def]
    """`cache.access` with hashed look-up.

    others: None for LRU and FIFO, which numba then compiles without the other policies; else 1.
    """
    tags, links, rrpv = state.tags, state.links, state.rrpv
    flags, words = state.flags, state.flag_words
    newest, fills, tree, buckets = state.newest, state.fills, state.tree, state.bucket
    lines, masks, metas, all_down = requests.line, requests.mask, requests.meta, outcome.down
    policy, touches = rules.policy, rules.policy == policies.LRU
    load_code = U32(NO_OPERATION if rules.bypass_loads else LOAD)
    ways = U64(rules.ways)
    num_buckets = U64(len(buckets) // rules.num_instances)
    shift = U64(64)
    while (U64(1) << (U64(64) - shift)) < num_buckets:
        shift -= U64(1)
    for segment in range(len(requests.instance)):
        instance = U64(requests.instance[segment])
        first_bucket, first_set = instance * num_buckets, instance * U64(rules.num_sets)
        # Counts of a run of loads of one group stay in registers.
        run = U32(0)
        looked_up, asked, hits, line_misses = 0, 0, 0, 0
        for i in range(U64(requests.segments[segment]), U64(requests.segments[segment + 1])):
            number, mask, meta = lines[i], masks[i], metas[i]
            if meta != run:
                _add_loads(counters, run, looked_up, asked, hits, line_misses)
                run = meta
                looked_up, asked, hits, line_misses = 0, 0, 0, 0
            cache_set = first_set + U64(sets[i])
            if meta >> U32(GROUP_BITS) != load_code:
                _other_request(
                    state, rules, requests, i, first_bucket, shift, cache_set, counters, outcome,
                    others,
                )  # fmt: skip
                continue
            count = POPCOUNT[mask]
            looked_up += 1
            asked += count
            bucket = bucket_of(number, first_bucket, shift)
            line = find_hashed(tags, links, buckets, bucket, number)
            if line != NO_LINE:
                if others is not None:
                    policies.touch(policy, line, cache_set, ways, links, rrpv, newest, tree)
                elif touches:
                    policies.to_front(line, cache_set, links, newest)
                word = U64(words[line])
                valid = (word >> VALID_SHIFT) & U64(255)
                hits += POPCOUNT[valid & mask]
                all_down[i] = U64(mask) & ~valid
                words[line] = (word | (U64(mask) << VALID_SHIFT)) & ~(U64(mask) << PARTIAL_SHIFT)
            else:
                if others is None:
                    line = policies.oldest_to_front(cache_set, links, newest)
                else:
                    line = policies.victim(
                        policy, cache_set, ways, links, rrpv, newest, fills, tree
                    )
                move_line(tags, links, flags, buckets, line, bucket, first_bucket, shift)
                if words[line] >> DIRTY_SHIFT:
                    _evict(state, rules, line, tags[line * U64(3)], i, counters, outcome)
                tags[line * U64(3)] = number
                words[line] = U64(1) | (U64(mask) << VALID_SHIFT)
                line_misses += count
                all_down[i] = mask
        _add_loads(counters, run, looked_up, asked, hits, line_misses)


@compiled
def access_small(state, rules, requests, sets, counters, outcome, num_tags):  # type: ignore[no-untyped-def]
    """`cache.access` with small sets."""
    small_tags, recency, words = state.small_tags, state.recency, state.flag_words
    lines, masks, metas, all_down = requests.line, requests.mask, requests.meta, outcome.down
    load_code = U32(NO_OPERATION if rules.bypass_loads else LOAD)
    touches = rules.policy == policies.LRU
    ways, first_line = U64(rules.ways), U64(rules.first_line)
    for segment in range(len(requests.instance)):
        first_set = U64(requests.instance[segment]) * U64(rules.num_sets)
        run = U32(0)
        looked_up, asked, hits, line_misses = 0, 0, 0, 0
        for i in range(U64(requests.segments[segment]), U64(requests.segments[segment + 1])):
            mask, meta = masks[i], metas[i]
            if meta != run:
                _add_loads(counters, run, looked_up, asked, hits, line_misses)
                run = meta
                looked_up, asked, hits, line_misses = 0, 0, 0, 0
            cache_set = first_set + U64(sets[i])
            if meta >> U32(GROUP_BITS) != load_code:
                _other_request(
                    state, rules, requests, i, U64(0), U64(63), cache_set, counters, outcome, None
                )
                continue
            count = POPCOUNT[mask]
            looked_up += 1
            asked += count
            tag = U32(lines[i] - first_line)
            line = find_small(small_tags, tag, cache_set, num_tags)
            if line != NO_LINE:
                if touches:
                    touch_small(recency, line, cache_set)
                word = U64(words[line])
                valid = (word >> VALID_SHIFT) & U64(255)
                hits += POPCOUNT[valid & mask]
                all_down[i] = U64(mask) & ~valid
                words[line] = (word | (U64(mask) << VALID_SHIFT)) & ~(U64(mask) << PARTIAL_SHIFT)
            else:
                line = take_small(recency, ways, cache_set)
                if words[line] >> DIRTY_SHIFT:
                    _evict(
                        state, rules, line, U64(small_tags[line]) + first_line, i, counters, outcome
                    )
                small_tags[line] = tag
                words[line] = U64(1) | (U64(mask) << VALID_SHIFT)
                line_misses += count
                all_down[i] = mask
        _add_loads(counters, run, looked_up, asked, hits, line_misses)
