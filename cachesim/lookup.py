"""Finding a line and choosing its victim: two structures with the same behaviour.

Hashed: any geometry and policy. A tag is found through a chained hash table, so that a set of 96
    ways costs what one of 4 does; replacement is `cachesim.policies`.

Small sets: up to 16 ways under LRU or FIFO, line numbers within 32 bits. The tags of a set are one
    host cache line, compared at once; their order of recency is sixteen 4-bit ways in one word, the
    newest lowest. Less memory, so that a whole L2's state stays in the host's own L2.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import inlined

U64, U32 = np.uint64, np.uint32

NO_LINE = np.uint32(0xFFFFFFFF)
SMALL_WAYS = 16
#: A small set's tag for "none"; line numbers less the first stay below it.
NO_TAG = np.uint32(0xFFFFFFFF)
#: Ways 15 to 0 from the highest 4 bits down: way 0 is the newest, so that way ways - 1 is the first
#: victim.
FIRST_RECENCY = np.uint64(0xFEDCBA9876543210)

# Of the hash of a line number to its bucket (Fibonacci hashing).
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
# Place of a 64-bit number's single set bit: a de Bruijn sequence times the number, top 6 bits.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_BIT_PLACE = np.zeros(64, np.uint64)
for _bit in range(64):
    _BIT_PLACE[((int(_DE_BRUIJN) << _bit) & (2**64 - 1)) >> 58] = _bit
_EACH = np.uint64(0x1111111111111111)
_HIGH = np.uint64(0x8888888888888888)

#: Place in a line's 24 bytes, beside those of `policies`.
CHAIN = U64(2)


@inlined
def bucket_of(number, first_bucket, shift):  # type: ignore[no-untyped-def]
    """The hash bucket of a line number in an instance whose buckets start at `first_bucket`."""
    return first_bucket + ((number * _MULTIPLIER) >> shift)


@inlined
def find_hashed(tags, links, buckets, bucket, number):  # type: ignore[no-untyped-def]
    """The line that holds a tag, or `NO_LINE`."""
    line = buckets[bucket]
    while line != NO_LINE and tags[line * U64(3)] != number:
        line = links[line * U64(6) + CHAIN]
    return line


@inlined
def move_line(tags, links, used, buckets, line, bucket, first_bucket, shift):  # type: ignore[no-untyped-def]
    """Take a line out of the chain of its old tag, still there, and put it into `bucket`'s;
    the caller sets the new tag.
    """
    if used[line * U64(4)]:
        old = bucket_of(tags[line * U64(3)], first_bucket, shift)
        other = buckets[old]
        if other == line:
            buckets[old] = links[line * U64(6) + CHAIN]
        else:
            while links[other * U64(6) + CHAIN] != line:
                other = links[other * U64(6) + CHAIN]
            links[other * U64(6) + CHAIN] = links[line * U64(6) + CHAIN]
    links[line * U64(6) + CHAIN] = buckets[bucket]
    buckets[bucket] = line


@inlined
def find_small(small_tags, tag, cache_set, num_tags):  # type: ignore[no-untyped-def]
    """The line that holds a tag, or `NO_LINE`. num_tags: 16, which the compiler must not know or it
    does not vectorise.
    """
    first = cache_set * U64(SMALL_WAYS)
    found = U32(0)
    for way in range(num_tags):
        found |= U32(small_tags[first + way] == tag) << U32(way)
    if not found:
        return NO_LINE
    return U32(first + _BIT_PLACE[(U64(found) * _DE_BRUIJN) >> U64(58)])


@inlined
def touch_small(recency, line, cache_set):  # type: ignore[no-untyped-def]
    """Move a line's way to the newest place."""
    order = recency[cache_set]
    way = U64(line) & U64(SMALL_WAYS - 1)
    # The lowest 4 bits equal to the way: subtracting borrows out of zero digits first.
    other = order ^ (way * _EACH)
    zero = (other - _EACH) & ~other & _HIGH
    newer = ((zero & (~zero + U64(1))) >> U64(3)) - U64(1)
    recency[cache_set] = (
        (order & ~((newer << U64(4)) | U64(15))) | ((order & newer) << U64(4)) | way
    )


@inlined
def take_small(recency, ways, cache_set):  # type: ignore[no-untyped-def]
    """The oldest line of the set, made the newest; the caller sets its tag."""
    order = recency[cache_set]
    way = (order >> ((ways - U64(1)) * U64(4))) & U64(SMALL_WAYS - 1)
    keep = ~U64(0) if ways == U64(SMALL_WAYS) else (U64(1) << (ways * U64(4))) - U64(1)
    # Digits above the last way stay as they are; they are never read.
    recency[cache_set] = (order & ~keep) | (((order << U64(4)) | way) & keep)
    return U32(cache_set * U64(SMALL_WAYS) + way)
