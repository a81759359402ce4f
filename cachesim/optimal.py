"""Belady's OPT over a line stream: set by set, when each line is used next, then which to evict.

A miss evicts the resident whose next use is farthest away [Belady 1966]. Every missed line is
inserted; bypassing the cache is not considered.
"""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

_NEVER = np.int64(1) << np.int64(62)
_U64 = np.uint64


class LineStream:
    """A sequence of (line, set) pairs in two temporary files, 12 bytes a pair; OPT takes 8 more."""

    def __init__(self) -> None:
        self._lines = tempfile.TemporaryFile()
        self._sets = tempfile.TemporaryFile()
        self.num_requests = 0

    def __enter__(self) -> LineStream:
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.close()
        self._sets.close()

    def append(self, line: npt.NDArray[np.uint64], cache_set: npt.NDArray[np.uint32]) -> None:
        """Write more pairs.

        line: (n,) uint64 line numbers. cache_set: (n,) uint32, the set among those of all
            instances.
        """
        self._lines.write(line.tobytes())
        self._sets.write(cache_set.astype(np.uint32, copy=False).tobytes())
        self.num_requests += len(line)

    def optimal_misses(self, num_sets: int, ways: int) -> int:
        """OPT's misses over the sequence, from empty sets; forgets the sequence."""
        if self.num_requests == 0:
            return 0
        self._lines.flush()
        self._sets.flush()
        line, cache_set = self._map(self._lines, np.uint64), self._map(self._sets, np.uint32)
        starts = np.zeros(num_sets + 1, np.int64)
        with tempfile.TemporaryFile() as file:
            file.truncate(8 * self.num_requests)
            by_set = self._map(file, np.uint64)
            _group_by_set(line, cache_set, starts, by_set)
            misses = int(_optimal_misses(by_set, starts, ways))
        for written in (self._lines, self._sets):
            written.seek(0)
            written.truncate()
        self.num_requests = 0
        return misses

    def _map(self, file: Any, dtype: type) -> npt.NDArray[Any]:
        return np.asarray(np.memmap(file, dtype, "r+", shape=(self.num_requests,)))


@njit(cache=True, nogil=True)
def _group_by_set(line, cache_set, starts, out):  # type: ignore[no-untyped-def]
    """Write the lines of each set to out, in order, set after set.

    starts: (num_sets + 1,) int64 zeros, becomes where each set begins.
    """
    for i in range(len(line)):
        starts[cache_set[i] + 1] += 1
    for s in range(1, len(starts)):
        starts[s] += starts[s - 1]
    at = starts[:-1].copy()
    for i in range(len(line)):
        out[at[cache_set[i]]] = line[i]
        at[cache_set[i]] += 1


@njit(cache=True, nogil=True)
def _next_uses(line, begin, end, stamp, key, position, owner, next_use):  # type: ignore[no-untyped-def]
    """Where each line of one set's stream is used next, counted from begin, or `_NEVER`.

    key, position, owner: a hash table of a power of two of entries; an entry is of this set where
        owner is `stamp`.
    """
    last = _U64(len(key) - 1)
    for t in range(end - begin - 1, -1, -1):
        number = line[begin + t]
        bucket = ((number * _U64(0x9E3779B97F4A7C15)) >> _U64(20)) & last
        while owner[bucket] == stamp and key[bucket] != number:
            bucket = (bucket + _U64(1)) & last
        next_use[t] = position[bucket] if owner[bucket] == stamp else _NEVER
        owner[bucket], key[bucket], position[bucket] = stamp, number, t


@njit(cache=True, nogil=True)
def _sift_down(heap, size, at):  # type: ignore[no-untyped-def]
    """Move an entry of a max-heap down to its place."""
    value = heap[at]
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size and heap[child + 1] > heap[child]:
            child += 1
        if heap[child] <= value:
            break
        heap[at] = heap[child]
        at = child
    heap[at] = value


@njit(cache=True, nogil=True)
def _push(heap, size, value):  # type: ignore[no-untyped-def]
    """Add an entry to a max-heap of `size` entries."""
    at = size
    while at > 0 and heap[(at - 1) // 2] < value:
        heap[at] = heap[(at - 1) // 2]
        at = (at - 1) // 2
    heap[at] = value


@njit(cache=True, nogil=True)
def _misses_of_set(next_use, num, ways, expected, heap):  # type: ignore[no-untyped-def]
    """OPT's misses of one set.

    expected: (num,) uint8, 1 where the line used then is resident and waits for that use.
    heap: (2 ways + 2,) int64, the uses that residents wait for, farthest first. Entries in the past
        are left behind by hits; they never reach the top, as any resident with a use ahead stands
        above them.
    """
    expected[:num] = 0
    misses, resident, dead, size = 0, 0, 0, 0
    for t in range(num):
        if not expected[t]:
            misses += 1
            if resident < ways:
                resident += 1
            elif dead:
                # A resident that is never used again is farther than any other.
                dead -= 1
            else:
                expected[heap[0]] = 0
                size -= 1
                heap[0] = heap[size]
                _sift_down(heap, size, 0)
        if next_use[t] == _NEVER:
            dead += 1
            continue
        expected[next_use[t]] = 1
        if size == len(heap):
            kept = 0
            for k in range(size):
                if heap[k] > t:
                    heap[kept] = heap[k]
                    kept += 1
            size = kept
            for at in range(size // 2 - 1, -1, -1):
                _sift_down(heap, size, at)
        _push(heap, size, next_use[t])
        size += 1
    return misses


@njit(cache=True, nogil=True)
def _optimal_misses(line, starts, ways):  # type: ignore[no-untyped-def]
    """OPT's misses of all sets. line: their streams, set after set; starts: (num_sets + 1,)."""
    longest = 0
    for s in range(len(starts) - 1):
        longest = max(longest, starts[s + 1] - starts[s])
    entries = 16
    while entries < 2 * longest:
        entries *= 2
    key, position = np.zeros(entries, np.uint64), np.zeros(entries, np.int64)
    owner = np.full(entries, -1, np.int64)
    next_use, expected = np.empty(longest, np.int64), np.empty(longest, np.uint8)
    heap = np.empty(2 * ways + 2, np.int64)
    misses = 0
    for s in range(len(starts) - 1):
        begin, end = starts[s], starts[s + 1]
        if end > begin:
            _next_uses(line, begin, end, s, key, position, owner, next_use)
            misses += _misses_of_set(next_use, end - begin, ways, expected, heap)
    return misses
