"""Tags and MSHRs of one level: find a line, take one, remember who waits for a sector.

A level's instances share flat arrays. Lines are found by a hash chain and ordered by use in a list
per set, so that neither a look-up nor a victim costs a scan of the ways.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.address import index_of
from cachesim.compiled import compiled, small
from cachesim.timing.records import NEVER


class Tags(NamedTuple):
    """The arrays of one level. L = lines, S = sets, M = MSHRs, each of all instances.

    level: (1,) `records.LEVEL`. nodes: `records.NODE` per instance. lines: (L,) `records.LINE`,
    held: (L * sectors,) uint32 written granules; owner: the same, int32 group that dirtied it.
    sets: (S,); buckets, mshr_buckets: int32 heads of hash chains, -1 = empty; mshrs: (M,).
    set_table: the tables of the set hash. counters: (groups, counters) int64 as in
    `cachesim.counts`. outcomes: (2, 6) int64, reads and writes by `records.OUTCOMES`.
    queues: (instances, 5, room) int32, rings of requests by `IN` to `OUT`. delay: (instances, room)
    `records.WAITING`, ring of requests on their way to the look-up.
    """

    level: npt.NDArray[np.void]
    nodes: npt.NDArray[np.void]
    lines: npt.NDArray[np.void]
    held: npt.NDArray[np.uint32]
    owner: npt.NDArray[np.int32]
    sets: npt.NDArray[np.void]
    buckets: npt.NDArray[np.int32]
    mshrs: npt.NDArray[np.void]
    mshr_buckets: npt.NDArray[np.int32]
    set_table: npt.NDArray[np.uint32]
    counters: npt.NDArray[np.int64]
    outcomes: npt.NDArray[np.int64]
    queues: npt.NDArray[np.int32]
    delay: npt.NDArray[np.void]


@small
def spread(key):  # type: ignore[no-untyped-def]
    """A hash of a line or sector number for the chains; eight neighbours share a host line, each
    eight in an order of their own, for what is far apart is often a multiple of eight apart.
    """
    run = key >> 3
    mixed = run * 0x1E3779B97F4A7C15
    return (((mixed >> 29) ^ (run >> 7)) << 3) | ((key ^ (mixed >> 40)) & 7)


@small
def bucket_of(tags, node, key):  # type: ignore[no-untyped-def]
    """Where the chain begins that may hold `key`."""
    mask = tags.level[0].bucket_mask
    return node * (mask + 1) + (spread(key) & mask)


@small
def find_line(tags, node, key):  # type: ignore[no-untyped-def]
    """The line of an instance that holds `key`, or -1."""
    at = tags.buckets[bucket_of(tags, node, key)]
    lines = tags.lines
    while at >= 0 and lines[at].key != key:
        at = lines[at].chain
    return at


@compiled
def set_of(tags, node, number):  # type: ignore[no-untyped-def]
    """The set of a line number inside an instance, among the sets of all."""
    level = tags.level[0]
    index = index_of(np.uint64(number), level.set_kind, level.num_sets, tags.set_table)
    return node * level.num_sets + np.int64(index)


@small
def touch(tags, line):  # type: ignore[no-untyped-def]
    """Make a line its set's newest."""
    lines = tags.lines
    one = lines[line]
    home = tags.sets[one.set]
    if home.newest == line:
        return
    base = one.set * tags.level[0].ways
    newer, older = one.newer, one.older
    lines[base + newer].older = older
    if older >= 0:
        lines[base + older].newer = newer
    else:
        home.oldest = base + newer
    one.older = home.newest - base
    one.newer = -1
    lines[home.newest].newer = line - base
    home.newest = line


@compiled
def victim_of(tags, node, home):  # type: ignore[no-untyped-def]
    """The line of a set to give up: the least recently used that awaits nothing, dirty ones only
    above the dirty limit; -1 where there is none.
    """
    level = tags.level[0]
    lines = tags.lines
    if tags.sets[home].reserved_lines >= level.ways:
        return -1
    dirty = tags.nodes[node].dirty_lines
    spare_dirty = dirty * 100 < level.dirty_limit * level.num_sets * level.ways
    at = tags.sets[home].oldest
    while True:
        one = lines[at]
        if one.reserved == 0 and not (spare_dirty and one.modified != 0):
            return at
        if one.newer < 0:
            return -1
        at = home * level.ways + one.newer


@compiled
def install(tags, node, line, key):  # type: ignore[no-untyped-def]
    """Give a line another tag, its sectors empty, and make it the newest."""
    lines, buckets = tags.lines, tags.buckets
    one = lines[line]
    if one.key != -NEVER:
        bucket = bucket_of(tags, node, one.key)
        if buckets[bucket] == line:
            buckets[bucket] = one.chain
        else:
            before = buckets[bucket]
            while lines[before].chain != line:
                before = lines[before].chain
            lines[before].chain = one.chain
    if one.modified != 0:
        tags.nodes[node].dirty_lines -= 1
    bucket = bucket_of(tags, node, key)
    one.key = key
    one.chain = buckets[bucket]
    buckets[bucket] = line
    one.valid = 0
    one.partial = 0
    one.modified = 0
    one.reserved = 0
    touch(tags, line)


@small
def reserve(tags, line, bit):  # type: ignore[no-untyped-def]
    """Note that a sector of a line is on its way."""
    one = tags.lines[line]
    if one.reserved == 0:
        tags.sets[one.set].reserved_lines += 1
    one.reserved |= bit


@small
def find_mshr(tags, node, key):  # type: ignore[no-untyped-def]
    """The MSHR of an instance for sector `key`, or -1."""
    mask = tags.level[0].mshr_mask
    at = tags.mshr_buckets[node * (mask + 1) + (spread(key) & mask)]
    mshrs = tags.mshrs
    while at >= 0 and mshrs[at].key != key:
        at = mshrs[at].chain
    return at


@compiled
def take_mshr(tags, requests, node, key, request):  # type: ignore[no-untyped-def]
    """Take a free MSHR for sector `key` and its first request."""
    level = tags.level[0]
    mask = level.mshr_mask
    home = tags.nodes[node]
    at = home.mshr_free
    entry = tags.mshrs[at]
    home.mshr_free = entry.ready_next
    home.mshr_used += 1
    home.num_taken += 1
    home.taken_sector = key
    bucket = node * (mask + 1) + (spread(key) & mask)
    entry.key = key
    entry.chain = tags.mshr_buckets[bucket]
    tags.mshr_buckets[bucket] = at
    entry.first = request
    entry.last = request
    entry.count = 1
    entry.ready_next = -1
    requests[request].next[level.index] = -1


@small
def merge(tags, requests, entry, request):  # type: ignore[no-untyped-def]
    """Append a request to those that wait for a sector."""
    index = tags.level[0].index
    one = tags.mshrs[entry]
    requests[one.last].next[index] = request
    requests[request].next[index] = -1
    one.last = request
    one.count += 1


@compiled
def mark_ready(tags, node, key):  # type: ignore[no-untyped-def]
    """The data of sector `key` is there: its requests may be answered, one per cycle."""
    entry = find_mshr(tags, node, key)
    home = tags.nodes[node]
    tags.mshrs[entry].ready_next = -1
    if home.ready_first < 0:
        home.ready_first = entry
    else:
        tags.mshrs[home.ready_last].ready_next = entry
    home.ready_last = entry


@compiled
def next_ready(tags, requests, node):  # type: ignore[no-untyped-def]
    """Take the next request whose data is there; frees the MSHR after its last one."""
    level = tags.level[0]
    home = tags.nodes[node]
    at = home.ready_first
    entry = tags.mshrs[at]
    request = entry.first
    entry.first = requests[request].next[level.index]
    entry.count -= 1
    if entry.first < 0:
        home.ready_first = entry.ready_next
        mask = level.mshr_mask
        bucket = node * (mask + 1) + (spread(entry.key) & mask)
        if tags.mshr_buckets[bucket] == at:
            tags.mshr_buckets[bucket] = entry.chain
        else:
            before = tags.mshr_buckets[bucket]
            while tags.mshrs[before].chain != at:
                before = tags.mshrs[before].chain
            tags.mshrs[before].chain = entry.chain
        entry.ready_next = home.mshr_free
        home.mshr_free = at
        home.mshr_used -= 1
        home.version += 1
    return request
