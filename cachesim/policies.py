"""Replacement policies: for each, what an access to a present line does (`touch`) and which line of
a full set goes (`victim`).

Lines of a set form a ring in recency order (`newer`, `older`; `newest` names the set's most recent
line), so that LRU and FIFO
cost the same at 16 or 96 ways: the victim is the line next to the newest in ring order. Lines never
used come first.

    policy     | an access does            | the victim is
    LRU        | moves the line to front   | the back of the ring
    FIFO       | nothing                   | the back of the ring
    TREE_PLRU  | points the tree away      | where the tree points
    RANDOM     | nothing                   | a hash of the set's fill count
    SRRIP      | re-reference value := 0   | the first line at 3, after ageing all
               |                           | until there is one

SRRIP is SRRIP-HP of [Jaleel et al. 2010].
"""

from __future__ import annotations

import numpy as np

from cachesim.address import mix64
from cachesim.compiled import inlined

LRU, FIFO, TREE_PLRU, RANDOM, SRRIP = range(5)
CODES = {"lru": LRU, "fifo": FIFO, "tree-plru": TREE_PLRU, "random": RANDOM, "srrip": SRRIP}

#: SRRIP with 2-bit values: a new line is predicted to come back after a long time, a line at 3 in
#: the distant future.
SRRIP_NEW, SRRIP_MAX = 2, 3

U64 = np.uint64
U32 = np.uint32

# Places in a line's views, as `cachesim.cache.CacheState` describes them.
NEWER, OLDER = U64(3), U64(4)


@inlined
def to_front(line, cache_set, links, newest):  # type: ignore[no-untyped-def]
    """Make `line` the newest of its set's ring. OLDER walks back in time; what is newer than the
    newest is the oldest.
    """
    front = newest[cache_set]
    if line != front:
        before, after = links[line * U64(6) + NEWER], links[line * U64(6) + OLDER]
        links[before * U64(6) + OLDER] = after
        links[after * U64(6) + NEWER] = before
        oldest = links[front * U64(6) + NEWER]
        links[front * U64(6) + NEWER] = line
        links[line * U64(6) + OLDER] = front
        links[line * U64(6) + NEWER] = oldest
        links[oldest * U64(6) + OLDER] = line
        newest[cache_set] = line


@inlined
def oldest_to_front(cache_set, links, newest):  # type: ignore[no-untyped-def]
    """The oldest line of the set's ring, made its newest: the ring turns by one."""
    line = links[newest[cache_set] * U64(6) + NEWER]
    newest[cache_set] = line
    return line


@inlined
def _point_away(way, ways, cache_set, tree):  # type: ignore[no-untyped-def]
    """Set the tree bits on the path to `way` so that they point to the other side."""
    bits = tree[cache_set]
    node, low, high = U64(1), U64(0), U64(1)
    while high < ways:
        high <<= U64(1)
    while high - low > U64(1):
        middle = (low + high) >> U64(1)
        if way < middle:
            bits |= U64(1) << (node - U64(1))
            node, high = node << U64(1), middle
        else:
            bits &= ~(U64(1) << (node - U64(1)))
            node, low = (node << U64(1)) | U64(1), middle
    tree[cache_set] = bits


@inlined
def _pointed_way(ways, cache_set, tree):  # type: ignore[no-untyped-def]
    """The way the tree points to; a side without ways (ways not a power of two) is never taken."""
    bits = tree[cache_set]
    node, low, high = U64(1), U64(0), U64(1)
    while high < ways:
        high <<= U64(1)
    while high - low > U64(1):
        middle = (low + high) >> U64(1)
        if (bits >> (node - U64(1))) & U64(1) and middle < ways:
            node, low = (node << U64(1)) | U64(1), middle
        else:
            node, high = node << U64(1), middle
    return low


@inlined
def touch(policy, line, cache_set, ways, links, rrpv, newest, tree):  # type: ignore[no-untyped-def]
    """A present line was accessed."""
    if policy == LRU:
        to_front(line, cache_set, links, newest)
    elif policy == TREE_PLRU:
        _point_away(U64(line) - U64(cache_set) * ways, ways, cache_set, tree)
    elif policy == SRRIP:
        rrpv[line] = 0


@inlined
def victim(policy, cache_set, ways, links, rrpv, newest, fills, tree):  # type: ignore[no-untyped-def]
    """The line of the set that a new tag replaces, marked as just inserted. Unused lines go first,
    in way order.
    """
    first = U64(cache_set) * ways
    if policy == LRU or policy == FIFO:
        return oldest_to_front(cache_set, links, newest)
    count = fills[cache_set]
    fills[cache_set] = count + U64(1)
    if count < ways:
        way = count
    elif policy == RANDOM:
        way = ((mix64((U64(cache_set) << U64(32)) ^ count) >> U64(32)) * ways) >> U64(32)
    elif policy == TREE_PLRU:
        way = _pointed_way(ways, cache_set, tree)
    else:
        way = ways
        while way == ways:
            for w in range(ways):
                if rrpv[first + U64(w)] == SRRIP_MAX:
                    way = U64(w)
                    break
            if way == ways:
                for w in range(ways):
                    rrpv[first + U64(w)] += np.uint8(1)
    if policy == TREE_PLRU:
        _point_away(way, ways, cache_set, tree)
    elif policy == SRRIP:
        rrpv[first + way] = SRRIP_NEW
    return U32(first + way)
