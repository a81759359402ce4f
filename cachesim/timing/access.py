"""One access of one level with a clock: hit, miss, merged, or refused this cycle; and fills.

The rules are those of facts sheet sections 3.2, 3.5 and 4: a refused access (a reservation fail)
changes nothing and is tried again; a miss takes an MSHR and a place in the miss queue; lines are
taken at the miss (on-miss) or when the data arrives (on-fill, streaming).
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.counts import (
    ACCESSES,
    BYPASSED_WRITES,
    BYPASSES,
    HIT_BACK,
    HIT_EVICT,
    HIT_THROUGH,
    HITS,
    LINE_MISSES,
    MERGED,
    MISS_ALLOCATE,
    MISS_LAZY,
    MISS_NONE,
    REQUESTS,
    SECTOR_MISSES,
    STORES_DOWN,
    WRITE_FILLS,
    WRITE_MISSES,
    WRITEBACKS,
    WRITES,
)
from cachesim.stream import ATOMIC, LOAD, STORE
from cachesim.timing.records import (
    FAIL,
    HIT,
    HIT_RESERVED,
    MISS,
    MSHR_HIT,
    NO_MSHR,
    NO_OTHER,
    NO_QUEUE,
    SECTOR_MISS,
    WRITE_FILL,
    WRITEBACK,
)
from cachesim.timing.tags import (
    find_line,
    find_mshr,
    install,
    mark_ready,
    merge,
    reserve,
    set_of,
    take_mshr,
    touch,
    victim_of,
)

#: Rings of a node's `Tags.queues`.
IN, MISSES, DOWN, FILLS, OUT = range(5)


@small
def take_request(pool):  # type: ignore[no-untyped-def]
    """A free request of the pool, its links and parts empty."""
    machine = pool.machine[0]
    machine.free_top -= 1
    machine.in_flight += 1
    at = pool.free[machine.free_top]
    one = pool.requests[at]
    one.is_part = 0
    one.source = 0
    return at


@small
def drop_request(pool, request):  # type: ignore[no-untyped-def]
    """Give a request back to the pool."""
    machine = pool.machine[0]
    pool.free[machine.free_top] = request
    machine.free_top += 1
    machine.in_flight -= 1


@small
def since(then, now):  # type: ignore[no-untyped-def]
    """Cycles from `then`, kept modulo 2^32, to `now`."""
    return (now - np.int64(then)) & 0xFFFFFFFF


@small
def book(pool, stage, entered, now):  # type: ignore[no-untyped-def]
    """Book the time from `entered`, modulo 2^32, to `now` for a stage."""
    took = since(entered, now)
    waits = pool.waits
    waits[stage, 0] += took
    waits[stage, 1] += 1
    waits[stage, 2] = min(waits[stage, 2], took)


@small
def note(pool, stage, request, now):  # type: ignore[no-untyped-def]
    """Book the time a request spent in a stage, and start the next."""
    book(pool, stage, pool.requests[request].mark, now)
    pool.requests[request].mark = now


@small
def push_miss(tags, node, request):  # type: ignore[no-untyped-def]
    """Append to the miss queue of an instance."""
    home = tags.nodes[node]
    room = tags.queues.shape[2] - 1
    tags.queues[node, MISSES, (home.miss_head + home.miss_count) & room] = request
    home.miss_count += 1


@compiled
def _write_back(tags, pool, node, line, now):  # type: ignore[no-untyped-def]
    """Send the modified sectors of a line that is given up towards memory."""
    level = tags.level[0]
    one = tags.lines[line]
    for s in range(level.sectors_per_line):
        if (one.modified >> s) & 1:
            at = take_request(pool)
            request = pool.requests[at]
            request.address = (one.key << level.line_shift) + (s << level.sector_shift)
            request.warp = -1
            request.load = 0
            request.operation = STORE
            request.write = 1
            request.kind = WRITEBACK
            request.path = 0
            request.unit = 0
            request.slice = node
            request.born = now
            request.mark = now
            owner = tags.owner[line * level.sectors_per_line + s]
            request.group = owner
            full = (one.valid >> s) & 1
            request.bytes = (
                level.all_bytes if full else tags.held[line * level.sectors_per_line + s]
            )
            tags.counters[owner, WRITEBACKS] += 1
            push_miss(tags, node, at)


@compiled
def _take_line(tags, pool, node, request, now):  # type: ignore[no-untyped-def]
    """Install the request's line in its set, writing back what it displaces; -1 if no line can be
    given up.
    """
    level = tags.level[0]
    key = pool.requests[request].address >> level.line_shift
    number = pool.requests[request].number if level.index >= 2 else key
    home = set_of(tags, node, number)
    line = victim_of(tags, node, home)
    if line < 0:
        return line
    if tags.lines[line].modified != 0 and level.on_hit == HIT_BACK:
        _write_back(tags, pool, node, line, now)
    install(tags, node, line, key)
    return line


@compiled
def _read(tags, pool, node, request, now):  # type: ignore[no-untyped-def]
    """Outcome of a read; on a miss the request waits in its MSHR, and one that is first goes to the
    miss queue.
    """
    level = tags.level[0]
    requests = pool.requests
    address = requests[request].address
    bit = 1 << ((address >> level.sector_shift) & level.sector_mask)
    line = find_line(tags, node, address >> level.line_shift)
    outcome = MISS
    if line >= 0:
        one = tags.lines[line]
        if one.valid & bit:
            if level.touch_on_hit:
                touch(tags, line)
            return HIT
        outcome = HIT_RESERVED if one.reserved & bit else SECTOR_MISS
    home = tags.nodes[node]
    if home.miss_count + 1 >= level.miss_queue:
        home.fail_reason = NO_QUEUE
        return FAIL
    home.fail_reason = NO_OTHER
    sector = address >> level.sector_shift
    entry = find_mshr(tags, node, sector)
    if entry >= 0:
        if tags.mshrs[entry].count >= level.merge:
            return FAIL
    elif home.mshr_used >= level.num_mshrs:
        home.fail_reason = NO_MSHR
        return FAIL
    if level.on_miss_allocation:
        if outcome == MISS:
            line = _take_line(tags, pool, node, request, now)
            if line < 0:
                return FAIL
        else:
            touch(tags, line)
        if entry < 0:
            reserve(tags, line, bit)
    if entry >= 0:
        merge(tags, requests, entry, request)
        tags.outcomes[0, MSHR_HIT] += 1
        if outcome != HIT_RESERVED:
            tags.counters[requests[request].group, MERGED] += 1
    else:
        take_mshr(tags, requests, node, sector, request)
        push_miss(tags, node, request)
    return outcome


@compiled
def _write_sector(tags, line, sector, request, requests):  # type: ignore[no-untyped-def]
    """Put a store's bytes into a present or new sector."""
    level = tags.level[0]
    one = tags.lines[line]
    bit = 1 << sector
    at = line * level.sectors_per_line + sector
    covered = requests[request].bytes
    if one.partial & bit:
        covered |= tags.held[at]
    if (one.valid & bit) == 0:
        if covered == level.all_bytes:
            one.valid |= bit
            one.partial &= ~bit
        else:
            one.partial |= bit
            tags.held[at] = covered
    one.modified |= bit
    tags.owner[at] = requests[request].group


@compiled
def _fetch_for_store(tags, pool, node, request, line, bit, now):  # type: ignore[no-untyped-def]
    """Ask for the rest of a sector that a store covers in part; the store does not wait for it."""
    level = tags.level[0]
    at = take_request(pool)
    source, fetch = pool.requests[request], pool.requests[at]
    fetch.address = source.address
    fetch.number = source.number
    fetch.slice = source.slice
    fetch.lower = source.lower
    fetch.unit = source.unit
    fetch.group = source.group
    fetch.warp = -1
    # Whose fetch it is: the levels below answer it like any other.
    fetch.load = level.index
    fetch.operation = LOAD
    fetch.write = 0
    fetch.kind = WRITE_FILL
    fetch.path = source.path
    fetch.born = now
    fetch.mark = now
    reserve(tags, line, bit)
    tags.counters[source.group, WRITE_FILLS] += 1
    take_mshr(tags, pool.requests, node, source.address >> level.sector_shift, at)
    push_miss(tags, node, at)


@compiled
def _write(tags, pool, node, request, now):  # type: ignore[no-untyped-def]
    """Outcome of a store. A store that goes down is in the miss queue afterwards (`sent` in the
    second value); otherwise this level answers it.
    """
    level = tags.level[0]
    requests = pool.requests
    home = tags.nodes[node]
    address = requests[request].address
    group = requests[request].group
    sector = (address >> level.sector_shift) & level.sector_mask
    bit = 1 << sector
    line = find_line(tags, node, address >> level.line_shift)
    outcome = MISS
    if line >= 0:
        one = tags.lines[line]
        if (one.valid | one.partial) & bit:
            outcome = HIT
        elif one.reserved & bit:
            outcome = HIT_RESERVED
        else:
            outcome = SECTOR_MISS
    if home.miss_count >= level.miss_queue:
        return FAIL, 0
    if outcome == HIT and level.on_hit == HIT_EVICT:
        one = tags.lines[line]
        one.valid &= ~bit
        one.partial &= ~bit
        tags.counters[group, STORES_DOWN] += 1
        push_miss(tags, node, request)
        return HIT, 1
    if outcome != HIT and level.on_store_miss == MISS_NONE:
        tags.counters[group, STORES_DOWN] += 1
        push_miss(tags, node, request)
        return outcome, 1
    if line < 0:
        needs_fetch = level.on_store_miss == MISS_ALLOCATE or (
            level.on_store_miss != MISS_LAZY and requests[request].bytes != level.all_bytes
        )
    else:
        present = (tags.lines[line].valid | tags.lines[line].reserved) & bit
        needs_fetch = present == 0 and (
            (level.on_store_miss == MISS_ALLOCATE and outcome != HIT)
            or (level.on_store_miss != MISS_LAZY and requests[request].bytes != level.all_bytes)
        )
    if needs_fetch and (
        home.mshr_used >= level.num_mshrs
        or home.miss_count + 1 >= level.miss_queue
        or find_mshr(tags, node, address >> level.sector_shift) >= 0
    ):
        return FAIL, 0
    if line < 0:
        line = _take_line(tags, pool, node, request, now)
        if line < 0:
            return FAIL, 0
    else:
        touch(tags, line)
    if tags.lines[line].modified == 0:
        home.dirty_lines += 1
    _write_sector(tags, line, sector, request, requests)
    if needs_fetch:
        _fetch_for_store(tags, pool, node, request, line, bit, now)
    if level.on_hit == HIT_THROUGH:
        tags.counters[group, STORES_DOWN] += 1
        push_miss(tags, node, request)
        return outcome, 1
    return outcome, 0


@compiled
def access(tags, pool, node, request, now):  # type: ignore[no-untyped-def]
    """Look a request up in one instance. Returns (outcome, whether the request was sent down as a
    store).

    An outcome other than FAIL is counted; after FAIL nothing has changed but the count of fails.
    """
    operation = pool.requests[request].operation
    group = pool.requests[request].group
    is_write = operation != LOAD
    sent = 0
    if operation == STORE:
        tags.nodes[node].fail_reason = NO_OTHER
        outcome, sent = _write(tags, pool, node, request, now)
    else:
        outcome = _read(tags, pool, node, request, now)
        if operation == ATOMIC and outcome != FAIL:
            # It is resolved here: below, its sector is only read.
            pool.requests[request].operation = LOAD
            level = tags.level[0]
            address = pool.requests[request].address
            line = find_line(tags, node, address >> level.line_shift)
            if tags.lines[line].modified == 0:
                tags.nodes[node].dirty_lines += 1
            sector = (address >> level.sector_shift) & level.sector_mask
            tags.lines[line].modified |= 1 << sector
            tags.owner[line * level.sectors_per_line + sector] = group
    tags.outcomes[1 if is_write else 0, outcome] += 1
    if outcome == FAIL:
        return outcome, sent
    counters = tags.counters
    if tags.level[0].index > 0:
        counters[group, REQUESTS] += 1
    counters[group, ACCESSES] += 1
    if is_write:
        counters[group, WRITES] += 1
    if outcome == HIT or outcome == HIT_RESERVED:
        counters[group, HITS] += 1
    else:
        counters[group, LINE_MISSES if outcome == MISS else SECTOR_MISSES] += 1
        if operation == STORE:
            counters[group, WRITE_MISSES] += 1
    return outcome, sent


@small
def count_bypass(tags, group, is_write):  # type: ignore[no-untyped-def]
    """A sector that goes around this level."""
    tags.counters[group, BYPASSES] += 1
    if is_write:
        tags.counters[group, BYPASSED_WRITES] += 1


@small
def note_filled(tags, node, sector):  # type: ignore[no-untyped-def]
    """A sector can be read, or be written, that could not before."""
    home = tags.nodes[node]
    home.version += 1
    home.num_filled += 1
    home.filled_sector = sector


@compiled
def fill(tags, pool, node, request, now):  # type: ignore[no-untyped-def]
    """The data of a read that this instance sent down has come back."""
    level = tags.level[0]
    one_request = pool.requests[request]
    address = one_request.address
    number = address >> level.sector_shift
    bit = 1 << (number & level.sector_mask)
    line = find_line(tags, node, address >> level.line_shift)
    if line >= 0 and tags.lines[line].reserved & bit:
        one = tags.lines[line]
        one.reserved &= ~bit
        if one.reserved == 0:
            tags.sets[one.set].reserved_lines -= 1
    elif line < 0:
        line = _take_line(tags, pool, node, request, now)
    elif (tags.lines[line].valid & bit) == 0:
        touch(tags, line)
    if line >= 0:
        one = tags.lines[line]
        one.valid |= bit
        one.partial &= ~bit
    mark_ready(tags, node, number)
    note_filled(tags, node, number)
