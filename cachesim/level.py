"""One level of the hierarchy: its caches, and how a request finds the instance and the set that it
belongs to.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cachesim import cache
from cachesim.address import index_of, partition_of, set_hash, set_indices, slice_and_line
from cachesim.compiled import compiled
from cachesim.config import L2, MAX_LINE_BYTES, CacheLevel
from cachesim.counts import POPCOUNT
from cachesim.stream import GROUP_BITS, STORE, Outcome, Requests

_U64, _U32 = np.uint64, np.uint32

#: Up to this many lines, a table holds the set of each, which is cheaper than to hash its address
#: again and again.
_MAX_TABLE_LINES = 1 << 23


@compiled
def _locate_in_slices(line, count, line_bytes, partition, set_hash, sets):  # type: ignore[no-untyped-def]
    """Set of each line among the sets of all slices, slice by slice."""
    line_shift = _U64(0)
    while (_U64(1) << line_shift) < _U64(line_bytes):
        line_shift += _U64(1)
    channels, per_channel = _U64(partition.num_channels), _U64(partition.slices_per_channel)
    run_shift, xor = _U64(partition.run_shift), partition.xor
    kind, slices, table = partition.hash.kind, partition.hash.size, partition.hash.table
    set_kind, num_sets, set_table = set_hash.kind, set_hash.size, set_hash.table
    for i in range(_U64(count)):
        where, number = slice_and_line(
            line[i] << line_shift,
            channels,
            per_channel,
            run_shift,
            kind,
            slices,
            table,
            xor,
            line_shift,
        )
        sets[i] = where * _U64(num_sets) + index_of(number, set_kind, num_sets, set_table)


@compiled
def _split_by_slice(sets, count, num_sets, where, per_slice):  # type: ignore[no-untyped-def]
    """Slice and set in the slice of each set among all; per_slice: (num_slices,) int64, how many
    lines each slice got.
    """
    for i in range(_U64(count)):
        where[i] = sets[i] // _U32(num_sets)
        sets[i] -= where[i] * _U32(num_sets)
        per_slice[where[i]] += 1


@compiled
def _look_up_sets(line, mask, count, first_line, table, seen, sets):  # type: ignore[no-untyped-def]
    """Set of each line from the table of `Level`; returns how many sectors were asked for the first
    time.
    """
    first, new = _U64(first_line), 0
    for i in range(_U64(count)):
        at = line[i] - first
        sets[i] = table[at]
        new += POPCOUNT[mask[i] & ~seen[at]]
        seen[at] |= mask[i]
    return new


@compiled
def _sort_by_slice(  # type: ignore[no-untyped-def]
    line,
    mask,
    meta,
    written,
    sets,
    where,
    count,
    next_of_slice,
    out_line,
    out_mask,
    out_meta,
    out_written,
    out_sets,
):
    """Requests slice by slice, each slice's in their order. next_of_slice: (num_slices,) int64
    first place of each, advanced.
    """
    for i in range(_U64(count)):
        at = _U64(next_of_slice[where[i]])
        next_of_slice[where[i]] += 1
        out_line[at], out_mask[at], out_meta[at], out_sets[at] = line[i], mask[i], meta[i], sets[i]
        if meta[i] >> _U32(GROUP_BITS) == _U32(STORE):
            out_written[at] = written[i]


class Level:
    """The caches of one level.

    by_slice: whether a batch is worked off slice by slice, so that a slice's state stays in the
        host's own cache. The order between slices is lost then, which only a level with nothing but
        DRAM below it may do; small sets do not need it.
    """

    def __init__(
        self,
        name: str,
        config: CacheLevel,
        num_instances: int,
        num_groups: int,
        *,
        is_last: bool = False,
        bypass_loads: bool = False,
        bypass_stores: bool = False,
        byte_range: tuple[int, int] | None = None,
    ) -> None:
        """num_instances: caches that a request's SM chooses among; of a sliced level 1, whatever
        its number of slices.

        is_last: nothing but DRAM is below. byte_range: first address and bytes that all requests
            lie in, where known.
        """
        self.name = name
        self.config = config
        lines = _lines_of(byte_range, config.line_bytes)
        self.partition = partition_of(config) if isinstance(config, L2) else None
        self.hash = set_hash(config)
        self.num_slices = config.num_slices if isinstance(config, L2) else 1
        self.rules = cache.cache_rules(
            config,
            num_instances,
            bypass_loads=bypass_loads,
            bypass_stores=bypass_stores or config.write_policy == "read-only",
            first_line=None if lines is None else lines[0],
        )
        self.by_slice = is_last and self.num_slices > 1 and not self.rules.small
        if self.by_slice:
            self.rules = self.rules._replace(num_instances=self.num_slices)
        else:
            self.rules = self.rules._replace(num_sets=self.rules.num_sets * self.num_slices)
        self._first_line, self._set_of_line = 0, np.zeros(0, np.uint32)
        self._seen = np.zeros(0, np.uint8)
        # Distinct sectors asked of all instances together, which a level that is never emptied
        # misses at least; None: not counted.
        self.num_distinct: int | None = None
        if lines is not None and lines[1] <= _MAX_TABLE_LINES and self.num_slices > 1:
            self._tabulate(*lines)
        self.state = cache.empty_state(self.rules)
        self.counters = np.zeros((num_groups, cache.NUM_COUNTERS), np.int64)

    def arrange(
        self, requests: Requests, buffer: Buffer
    ) -> tuple[Requests, npt.NDArray[np.uint32]]:
        """The requests in the order in which they are worked off, and the set of each in its
        instance.
        """
        count = requests.num_requests
        if self.num_distinct is not None:
            self.num_distinct += _look_up_sets(
                requests.line, requests.mask, count, self._first_line, self._set_of_line,
                self._seen, buffer.sets,
            )  # fmt: skip
        else:
            self._locate(requests.line, count, buffer.sets)
        if not self.by_slice:
            return requests, buffer.sets
        per_slice = np.zeros(self.num_slices, np.int64)
        _split_by_slice(buffer.sets, count, self.hash.size, buffer.where, per_slice)
        segments = np.concatenate([[0], np.cumsum(per_slice)])
        out = buffer.by_slice
        assert out is not None
        _sort_by_slice(
            requests.line, requests.mask, requests.meta, requests.written, buffer.sets,
            buffer.where, count, segments[:-1].copy(),
            out.line, out.mask, out.meta, out.written, buffer.sets_by_slice,
        )  # fmt: skip
        slices = np.arange(self.num_slices)
        arranged = out._replace(
            bytes_written=requests.bytes_written,
            segments=segments,
            instance=slices.astype(np.uint32),
            order=slices,
        )
        return arranged, buffer.sets_by_slice

    def _locate(
        self, line: npt.NDArray[np.uint64], count: int, sets: npt.NDArray[np.uint32]
    ) -> None:
        """Set of each line, among the sets of all slices where the level is sliced."""
        h = self.hash
        if self.partition is None:
            set_indices(line, count, h.kind, h.size, h.table, sets)
        else:
            _locate_in_slices(line, count, self.config.line_bytes, self.partition, h, sets)

    def _tabulate(self, first_line: int, count: int) -> None:
        line = np.arange(count, dtype=np.uint64) + _U64(first_line)
        self._first_line, self._set_of_line = first_line, np.empty(count, np.uint32)
        self._seen, self.num_distinct = np.zeros(count, np.uint8), 0
        self._locate(line, count, self._set_of_line)

    def access(self, requests: Requests, sets: npt.NDArray[np.uint32], outcome: Outcome) -> None:
        """Count a batch; fills `outcome`, request by request in the order given."""
        cache.access(self.state, self.rules, requests, sets, self.counters, outcome)

    def bound_passed_down(self, num_requests: int, lower: CacheLevel) -> int:
        """How many requests to the next level a batch can become."""
        lines = max(1, self.config.line_bytes // lower.line_bytes)
        kinds = (
            1
            + (not self.rules.bypass_stores)
            + self.rules.can_be_dirty * self.rules.sectors_per_line
        )
        return num_requests * lines * kinds

    def dirty_by_group(self, num_groups: int) -> npt.NDArray[np.int64]:
        """(num_groups,) int64: dirty sectors held, by the group that dirtied them."""
        count = np.zeros(num_groups, np.int64)
        if self.rules.can_be_dirty:
            for s in range(self.rules.sectors_per_line):
                dirty = (self.state.flags[cache.DIRTY :: 4] >> s) & 1 == 1
                count += np.bincount(self.state.owner[dirty, s], minlength=num_groups)
        return count


class Buffer:
    """Room for one batch at one level; pages that are not written cost nothing."""

    def __init__(self, level: Level, num_requests: int, num_segments: int) -> None:
        self.requests = _room(num_requests, num_requests, num_segments)
        self.sets = np.empty(num_requests, np.uint32)
        self.position = np.empty(num_requests, np.uint32)
        self.outcome = cache.empty_outcome(level.rules, num_requests)
        self.where = np.empty(num_requests if level.by_slice else 0, np.uint32)
        self.by_slice = _room(num_requests, 0, 0) if level.by_slice else None
        self.sets_by_slice = np.empty(num_requests if level.by_slice else 0, np.uint32)


def _lines_of(byte_range: tuple[int, int] | None, line_bytes: int) -> tuple[int, int] | None:
    """First line number and number of lines of a byte range, if 32 bits can tell them apart."""
    if byte_range is None:
        return None
    # A level above with larger sectors asks for whole ones, beyond the range's ends.
    start = byte_range[0] // MAX_LINE_BYTES * MAX_LINE_BYTES
    end = -(-(byte_range[0] + byte_range[1]) // MAX_LINE_BYTES) * MAX_LINE_BYTES
    first, last = start // line_bytes, end // line_bytes
    return (first, last - first + 1) if last - first < (1 << 32) - 2 else None


def _room(num_requests: int, num_stores: int, num_segments: int) -> Requests:
    return Requests(
        line=np.empty(num_requests, np.uint64),
        mask=np.empty(num_requests, np.uint8),
        meta=np.empty(num_requests, np.uint32),
        written=np.empty(num_requests, np.int32),
        bytes_written=np.empty((num_stores, 8), np.uint32),
        segments=np.zeros(num_segments + 1, np.int64),
        instance=np.zeros(num_segments, np.uint32),
        order=np.zeros(num_segments, np.int64),
    )


__all__ = ["Buffer", "Level"]
