"""What a trace asks for before any cache is chosen: lane fetches, footprints, and exact reuse
distances.

The reuse distance of a request is the number of distinct other lines since the last request to its
line; a fully associative LRU cache of C lines hits exactly those of distance below C [Mattson,
Gecsei, Slutz, Traiger 1970]. The count of distinct lines is a prefix sum over the last times of all
lines, kept in a binary indexed tree [Bennett, Kruskal 1975; Fenwick 1994].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from numba import njit

from traces.errors import InputError
from traces.footprint import NUM_CORNERS, texel_addresses
from traces.placement import AddressMap
from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, WARP_SIZE
from traces.trace import Chunk, Trace

_ROWS_PER_BLOCK = 4096
_NUM_MIP_CODES = 16
#: 2^64 / golden ratio, odd: Knuth's multiplicative hashing.
_HASH_FACTOR = np.uint64(0x9E3779B97F4A7C15)


def lane_fetches(trace: Trace) -> pd.DataFrame:
    """Fetches per pass, texture, mip and operation.

    Columns: pass, texture, mip, operation; rows, the access instructions of warps with a lane on
    that mip; lane_fetches, the active lanes. A lane-address trace has texture "" and mip -1.
    """
    counts = np.zeros((2, len(trace.instructions), _NUM_MIP_CODES), np.int64)
    for chunk in trace.chunks():
        if trace.is_lane_address:
            per_row = chunk.active.sum(axis=1)
            np.add.at(counts[0, :, 0], chunk.instruction, per_row > 0)
            np.add.at(counts[1, :, 0], chunk.instruction, per_row)
        else:
            _count_mips(chunk.lanes, chunk.instruction, counts)
    records = [
        {
            "pass": instruction.pass_name,
            "texture": "" if trace.is_lane_address else trace.textures[instruction.texture].name,
            "mip": -1 if trace.is_lane_address else mip,
            "operation": instruction.operation,
            "rows": int(counts[0, index, mip]),
            "lane_fetches": int(counts[1, index, mip]),
        }
        for index, instruction in enumerate(trace.instructions)
        for mip in range(_NUM_MIP_CODES)
        if counts[0, index, mip]
    ]
    keys = ["pass", "texture", "mip", "operation"]
    frame = pd.DataFrame(records, columns=[*keys, "rows", "lane_fetches"])
    return frame.groupby(keys, as_index=False, sort=False).sum()


def footprint(
    trace: Trace, address_map: AddressMap | None, line_bytes: int, sector_bytes: int = 32
) -> pd.DataFrame:
    """Distinct lines and sectors that a trace touches, per texture and mip.

    Columns: texture, mip, lines, sectors. A line that two levels share counts in both. A
    lane-address trace has one row, with texture "" and mip -1.

    address_map: where the texels lie; None for a lane-address trace. line_bytes, sector_bytes:
        powers of two from 16; sectors divide lines.

    Raises:
        InputError: other sizes, or an address map that is missing or of other textures.
    """
    _check_arguments(trace, address_map, line_bytes, sector_bytes)
    per_line = line_bytes // sector_bytes
    if address_map is None:
        sectors = np.zeros(0, np.uint64)
        for _, addresses in _blocks(trace, None):
            held = np.unique(addresses[addresses != INACTIVE_ADDRESS] // np.uint64(sector_bytes))
            sectors = np.union1d(sectors, held)
        lines = np.unique(sectors // np.uint64(per_line))
        return pd.DataFrame([["", -1, len(lines), len(sectors)]], columns=_FOOTPRINT_COLUMNS)
    # One flag per sector of each level, from the start of the level's first line.
    first = address_map.base // np.uint64(line_bytes) * np.uint64(per_line)
    ends = address_map.base + address_map.size_bytes + np.uint64(line_bytes - 1)
    sizes = (ends // np.uint64(line_bytes) * np.uint64(per_line) - first).astype(np.int64)
    sizes[address_map.size_bytes == 0] = 0
    starts = np.concatenate([[0], np.cumsum(sizes.ravel())])
    touched = np.zeros(starts[-1], np.bool_)
    texture_of = np.array([i.texture for i in trace.instructions], np.int64)
    start_of = starts[:-1].reshape(sizes.shape)
    for chunk, addresses in _blocks(trace, address_map):
        textures = texture_of[chunk.instruction]
        sector = np.uint64(sector_bytes)
        _mark(addresses, chunk.lanes, textures, sector, first, start_of, touched)
    records = []
    for index, texture in enumerate(trace.textures):
        for mip in range(texture.num_mips):
            begin = start_of[index, mip]
            level = touched[begin : begin + sizes[index, mip]].reshape(-1, per_line)
            records.append([texture.name, mip, int(level.any(axis=1).sum()), int(level.sum())])
    frame = pd.DataFrame(records, columns=_FOOTPRINT_COLUMNS)
    return frame[frame["sectors"] > 0].reset_index(drop=True)


_FOOTPRINT_COLUMNS = ["texture", "mip", "lines", "sectors"]


@dataclass(frozen=True, eq=False)
class ReuseDistances:
    """The reuse distances of a trace's line requests.

    histogram: (num_lines,) int64, requests at distance 0, 1, ... num_cold: first requests of a
    line, which have none: as many as there are distinct lines.
    """

    histogram: npt.NDArray[np.int64]
    num_cold: int

    @property
    def num_requests(self) -> int:
        return int(self.histogram.sum()) + self.num_cold

    def misses(self, capacity_lines: int) -> int:
        """Misses of a fully associative LRU cache of so many lines: compulsory misses, and requests
        at that distance or beyond.
        """
        return self.num_cold + int(self.histogram[capacity_lines:].sum())


def reuse_distance(trace: Trace, address_map: AddressMap | None, line_bytes: int) -> ReuseDistances:
    """The exact reuse distances of a trace's requests, in the order of the trace: one warp after
    the other.

    A request is one line of one access of one warp, in the order of the lanes that first ask for
    it; loads and stores count alike.

    address_map, line_bytes: as for `footprint`.

    Raises:
        InputError: as `footprint`.
    """
    _check_arguments(trace, address_map, line_bytes, line_bytes)
    stack = _Stack()
    for _, addresses in _blocks(trace, address_map):
        stack.touch(addresses, np.uint64(line_bytes))
    return ReuseDistances(stack.histogram[: stack.num_lines].copy(), stack.num_lines)


class _Stack:
    """The LRU stack: a hash table from line to its last time, and a tree that counts last times.

    keys, last, row: (2^k,) the hash table, linear probing; last = 0 marks a free slot. row: serial
        number of the last row that asked.
    tree: (n + 1,) int64, binary indexed, 1 at the last time of each line. time: of the last
        request. num_rows: seen so far.
    """

    def __init__(self) -> None:
        self._resize_table(1 << 10)
        self.tree = np.zeros(1, np.int64)
        self.histogram = np.zeros(0, np.int64)
        self.time = self.num_lines = self.num_rows = 0

    def touch(self, addresses: npt.NDArray[np.uint64], line_bytes: np.uint64) -> None:
        """Take the requests of (n, k) byte addresses, row by row."""
        most = addresses.size
        self._make_room(most)
        self.time, self.num_lines = _touch(
            addresses, line_bytes, self.keys, self.last, self.row, self.tree, self.histogram,
            self.time, self.num_lines, self.num_rows,
        )  # fmt: skip
        self.num_rows += len(addresses)

    def _make_room(self, num_requests: int) -> None:
        lines = self.num_lines + num_requests
        if 2 * lines > len(self.keys):
            keys, last, row = self.keys, self.last, self.row
            self._resize_table(1 << (2 * lines - 1).bit_length())
            held = last > 0
            _insert(keys[held], last[held], row[held], self.keys, self.last, self.row)
        if lines > len(self.histogram):
            self.histogram = np.concatenate([self.histogram, np.zeros(lines, np.int64)])
        if self.time + num_requests >= len(self.tree):
            # Number the last times anew without gaps; order is all that counts.
            used = np.flatnonzero(self.last)
            self.last[used[np.argsort(self.last[used])]] = np.arange(1, len(used) + 1)
            self.time = len(used)
            index = np.arange(2 * lines + num_requests + 1)
            low_bit = index & -index
            self.tree = np.minimum(index, self.time) - np.minimum(index - low_bit, self.time)

    def _resize_table(self, size: int) -> None:
        self.keys = np.zeros(size, np.uint64)
        self.last, self.row = np.zeros((2, size), np.int64)


def _check_arguments(
    trace: Trace, address_map: AddressMap | None, line_bytes: int, sector_bytes: int
) -> None:
    for field, value in (("line_bytes", line_bytes), ("sector_bytes", sector_bytes)):
        if value < 16 or value & (value - 1):
            raise InputError(f"{field} {value}: allowed are powers of two from 16")
    if line_bytes % sector_bytes:
        raise InputError(f"sector_bytes {sector_bytes} does not divide line_bytes {line_bytes}")
    expected = None if trace.is_lane_address else tuple(trace.textures)
    if (None if address_map is None else address_map.textures) != expected:
        raise InputError(
            "address map: needs the trace's own textures, and none for a lane-address trace"
        )


def _blocks(
    trace: Trace, address_map: AddressMap | None
) -> Iterator[tuple[Chunk, npt.NDArray[np.uint64]]]:
    """The trace a few rows at a time, with (n, 32) byte addresses, or (n, 128) where there are
    bilinear rows: 4 per lane.
    """
    bilinear = any(i.footprint == "bilinear" for i in trace.instructions)
    for chunk in trace.chunks():
        for begin in range(0, chunk.num_rows, _ROWS_PER_BLOCK):
            rows = slice(begin, begin + _ROWS_PER_BLOCK)
            lanes, instruction = chunk.lanes[rows], chunk.instruction[rows]
            block = Chunk(chunk.launch, chunk.first_cta, chunk.warp_offsets, instruction, lanes)
            if address_map is None:
                yield block, lanes
                continue
            width = WARP_SIZE * (NUM_CORNERS if bilinear else 1)
            addresses = np.full((len(lanes), width), INACTIVE_ADDRESS)
            for index in np.unique(instruction):
                described = trace.instructions[index]
                chosen = np.flatnonzero(instruction == index)
                made = texel_addresses(
                    lanes[chosen], described.texture, described.footprint == "bilinear", address_map
                )
                # Lane l's addresses stand from column l * (width / 32) on, whatever their number.
                step = width // made.shape[1]
                addresses[chosen, ::step] = made
            yield block, addresses


@njit(cache=True, nogil=True)
def _count_mips(lanes: Any, instruction: Any, counts: Any) -> None:
    """Add the rows (counts[0]) and active lanes (counts[1]) per instruction and mip."""
    for row in range(lanes.shape[0]):
        index = instruction[row]
        seen = np.uint32(0)
        for lane in range(WARP_SIZE):
            texel = lanes[row, lane]
            if texel != INACTIVE_TEXEL:
                mip = texel >> np.uint32(28)
                counts[1, index, mip] += 1
                if not (seen >> mip) & np.uint32(1):
                    seen |= np.uint32(1) << mip
                    counts[0, index, mip] += 1


@njit(cache=True, nogil=True)
def _mark(
    addresses: Any,
    lanes: Any,
    texture: Any,
    sector_bytes: Any,
    first: Any,
    start: Any,
    touched: Any,
) -> None:
    """Flag the sectors of all addresses: sector s of (texture, mip) is flag start[texture, mip] + s
    - first[texture, mip].
    """
    per_lane = addresses.shape[1] // WARP_SIZE
    for row in range(addresses.shape[0]):
        for column in range(addresses.shape[1]):
            address = addresses[row, column]
            if address != INACTIVE_ADDRESS:
                mip = lanes[row, column // per_lane] >> np.uint32(28)
                sector = np.int64(address // sector_bytes - first[texture[row], mip])
                touched[start[texture[row], mip] + sector] = True


@njit(cache=True, nogil=True)
def _slot(keys: Any, last: Any, line: Any) -> Any:
    """Where `line` is, or belongs, in the hash table."""
    mask = np.uint64(len(keys) - 1)
    slot = ((line * _HASH_FACTOR) >> np.uint64(20)) & mask
    while last[slot] != 0 and keys[slot] != line:
        slot = (slot + np.uint64(1)) & mask
    return slot


@njit(cache=True, nogil=True)
def _insert(from_keys: Any, from_last: Any, from_row: Any, keys: Any, last: Any, row: Any) -> None:
    for i in range(len(from_keys)):
        slot = _slot(keys, last, from_keys[i])
        keys[slot], last[slot], row[slot] = from_keys[i], from_last[i], from_row[i]


@njit(cache=True, nogil=True)
def _touch(addresses: Any, line_bytes: Any, keys: Any, last: Any, row: Any, tree: Any,
           histogram: Any, time: Any, num_lines: Any, num_rows: Any) -> Any:  # fmt: skip
    """Take all requests; the arrays have room for them. Returns the new (time, num_lines)."""
    for r in range(addresses.shape[0]):
        serial = num_rows + r + 1
        for column in range(addresses.shape[1]):
            if addresses[r, column] == INACTIVE_ADDRESS:
                continue
            line = addresses[r, column] // line_bytes
            slot = _slot(keys, last, line)
            if last[slot] and row[slot] == serial:
                continue
            if last[slot]:
                # All lines but those whose last time is this line's or earlier came after it.
                distance = num_lines
                i = last[slot]
                while i > 0:
                    distance -= tree[i]
                    i -= i & -i
                histogram[distance] += 1
                i = last[slot]
                while i < len(tree):
                    tree[i] -= 1
                    i += i & -i
            else:
                keys[slot] = line
                num_lines += 1
            time += 1
            last[slot], row[slot] = time, serial
            i = time
            while i < len(tree):
                tree[i] += 1
                i += i & -i
    return time, num_lines
