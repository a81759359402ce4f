"""Coalescing: the lanes of each issued row to requests, one per distinct line, with the mask of
distinct sectors.

Requests of a row are in ascending address order, whatever the order of its lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.compiled import compiled, inlined
from cachesim.stream import GROUP_BITS, OPERATION_CODES, STORE
from traces.footprint import texel_offset
from traces.placement import AddressMap
from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, MAX_MIPS
from traces.trace import Trace

U64, U32, U8 = np.uint64, np.uint32, np.uint8


class Program(NamedTuple):
    """What coalescing needs to know of each instruction. I = number of instructions.

    operation, bilinear: (I,) uint8; texture, access_bytes, group: (I,) int32; `group` is that of
        the texture's mip 0.
    """

    operation: npt.NDArray[np.uint8]
    bilinear: npt.NDArray[np.uint8]
    texture: npt.NDArray[np.int32]
    access_bytes: npt.NDArray[np.int32]
    group: npt.NDArray[np.int32]


class Placement(NamedTuple):
    """`AddressMap` as the loop wants it: addresses relative to the base, mip boundaries as well. T
    textures.
    """

    x_start: npt.NDArray[np.int64]
    y_start: npt.NDArray[np.int64]
    x_tables: npt.NDArray[np.uint32]
    y_tables: npt.NDArray[np.uint32]
    base: npt.NDArray[np.uint64]
    low_mask: npt.NDArray[np.uint32]
    width: npt.NDArray[np.int32]
    height: npt.NDArray[np.int32]
    last_mip: npt.NDArray[np.int32]


def groups_of(trace: Trace) -> list[tuple[str, int]]:
    """The (pass, texture) pairs of a trace's instructions, in order of first use; each has
    `MAX_MIPS` groups.
    """
    return list(dict.fromkeys((i.pass_name, i.texture) for i in trace.instructions))


def program_of(trace: Trace) -> Program:
    """The trace's instructions as arrays."""
    pairs = {pair: k for k, pair in enumerate(groups_of(trace))}
    return Program(
        operation=np.array([OPERATION_CODES[i.operation] for i in trace.instructions], np.uint8),
        bilinear=np.array([i.footprint == "bilinear" for i in trace.instructions], np.uint8),
        texture=np.array([i.texture for i in trace.instructions], np.int32),
        access_bytes=np.array(
            [i.access_bytes or trace.textures[i.texture].texel_bytes for i in trace.instructions],
            np.int32,
        ),
        group=np.array(
            [pairs[i.pass_name, i.texture] * MAX_MIPS for i in trace.instructions], np.int32
        ),
    )


def placement_of(address_map: AddressMap | None) -> Placement:
    """The loop's view of an address map; empty for a lane-address trace."""
    if address_map is None:
        none64, none32 = np.zeros((0, MAX_MIPS), np.int64), np.zeros((0, MAX_MIPS), np.int32)
        empty = np.zeros(0, np.uint32)
        return Placement(
            none64,
            none64,
            empty,
            empty,
            none64.astype(np.uint64),
            empty,
            none32,
            none32,
            none32[:, 0],
        )
    return Placement(
        address_map.x_start,
        address_map.y_start,
        address_map.x_tables,
        address_map.y_tables,
        address_map.base,
        address_map.low_mask,
        address_map.width,
        address_map.height,
        np.array([t.num_mips - 1 for t in address_map.textures], np.int32),
    )


@inlined
def _address(x_tables, y_tables, x_start, y_start, base, low_mask, y, x):  # type: ignore[no-untyped-def]
    """Byte address of a texel of one level."""
    return base + U64(texel_offset(x_tables[x_start + x], y_tables[y_start + y], low_mask))


@compiled
def _texel_sectors(  # type: ignore[no-untyped-def]
    lanes, slot, texture, bilinear, place, shift, first, scratch, lane_fetches, group
):
    """Sectors of a row's texels, less `first`, into scratch.keys; lane fetches counted per mip.

    Returns how many keys, or -1 where a lane asks for a texel that its texture does not have.
    """
    keys = scratch.keys
    x_tables, y_tables = place.x_tables, place.y_tables
    low_mask = place.low_mask[texture]
    num_mips = U64(place.last_mip[texture] + 1)
    level = ~U64(0)
    x_start, y_start, base, width, height = U64(0), U64(0), U64(0), U64(0), U64(0)
    count = 0
    n = U64(0)
    for lane in range(lanes.shape[1]):
        texel = lanes[slot, lane]
        if texel == INACTIVE_TEXEL:
            continue
        mip = U64(texel >> U32(28))
        y, x = U64((texel >> U32(14)) & U32(16383)), U64(texel & U32(16383))
        if mip != level:
            # Lanes of a row mostly share their level.
            if mip >= num_mips:
                return -1
            if count:
                lane_fetches[U64(group) + level] += count
            level, count = mip, 0
            x_start, y_start = U64(place.x_start[texture, mip]), U64(place.y_start[texture, mip])
            base = place.base[texture, mip]
            width, height = U64(place.width[texture, mip]), U64(place.height[texture, mip])
        if x >= width or y >= height:
            return -1
        count += 1
        address = _address(x_tables, y_tables, x_start, y_start, base, low_mask, y, x)
        keys[n] = (address >> shift) - first
        n += U64(1)
        if bilinear:
            x1, y1 = min(x + U64(1), width - U64(1)), min(y + U64(1), height - U64(1))
            address = _address(x_tables, y_tables, x_start, y_start, base, low_mask, y, x1)
            keys[n] = (address >> shift) - first
            address = _address(x_tables, y_tables, x_start, y_start, base, low_mask, y1, x)
            keys[n + U64(1)] = (address >> shift) - first
            address = _address(x_tables, y_tables, x_start, y_start, base, low_mask, y1, x1)
            keys[n + U64(2)] = (address >> shift) - first
            n += U64(3)
    if count:
        lane_fetches[U64(group) + level] += count
    return np.int64(n)


@compiled
def _address_sectors(lanes, slot, access_bytes, shift, scratch, lane_fetches, group):  # type: ignore[no-untyped-def]
    """Sectors of a row's byte addresses; an access over a sector's end has two. Returns how many
    keys.
    """
    keys = scratch.keys
    n = U64(0)
    for lane in range(lanes.shape[1]):
        address = U64(lanes[slot, lane])
        if address == INACTIVE_ADDRESS:
            continue
        lane_fetches[group] += 1
        first, last = address >> shift, (address + U64(access_bytes - 1)) >> shift
        keys[n] = first
        n += U64(1)
        if last != first:
            keys[n] = last
            n += U64(1)
    return np.int64(n)


@compiled
def _sort_distinct(scratch, n):  # type: ignore[no-untyped-def]
    """Each key to ranked[number of smaller keys], and how often it occurs to weight there: sorted,
    with gaps after repeats.

    Comparing all pairs is branch-free and vectorises; at 32 keys it beats a sort.
    """
    keys, rank, ranked, weight = scratch.keys, scratch.rank, scratch.ranked, scratch.weight
    # Whole vectors, of a length that the compiler does not know (else it unrolls instead of
    # vectorising), and four keys at a time, because a rank that was just written is slow to read.
    # The largest key of all is below none.
    padded = (n + U64(15)) & ~U64(15)
    for k in range(n, padded):
        keys[k] = ~keys.dtype.type(0)
    for k in range(padded):
        rank[k] = 0
        weight[k] = 0
    for other in range(U64(0), n, U64(4)):
        a, b, c, d = keys[other], keys[other + U64(1)], keys[other + U64(2)], keys[other + U64(3)]
        for k in range(padded):
            key = keys[k]
            rank[k] += U32(a < key) + U32(b < key) + U32(c < key) + U32(d < key)
    for k in range(n):
        ranked[rank[k]] = keys[k]
        weight[rank[k]] += U32(1)


@compiled
def _store_bytes(  # type: ignore[no-untyped-def]
    lanes, slot, texture, access_bytes, place, sector_shift, line_shift, begin, end, requests
):
    """OR the bytes that each lane writes into its request's byte masks."""
    sector_bytes = U64(1) << sector_shift
    granule = max(U64(1), sector_bytes // U64(32))
    sector_in_line = (U64(1) << (line_shift - sector_shift)) - U64(1)
    for lane in range(lanes.shape[1]):
        if texture >= 0:
            texel = lanes[slot, lane]
            if texel == INACTIVE_TEXEL:
                continue
            mip = U64(texel >> U32(28))
            address = _address(
                place.x_tables,
                place.y_tables,
                U64(place.x_start[texture, mip]),
                U64(place.y_start[texture, mip]),
                place.base[texture, mip],
                place.low_mask[texture],
                U64((texel >> U32(14)) & U32(16383)),
                U64(texel & U32(16383)),
            )
        else:
            address = U64(lanes[slot, lane])
            if address == INACTIVE_ADDRESS:
                continue
        for byte in range(access_bytes):
            at = address + U64(byte)
            number = at >> line_shift
            for i in range(begin, end):
                if requests.line[i] == number:
                    sector = (at >> sector_shift) & sector_in_line
                    bit = (at & (sector_bytes - U64(1))) // granule
                    requests.bytes_written[requests.written[i], sector] |= U32(1) << U32(bit)


class Scratch(NamedTuple):
    """Working memory of `coalesce`: room for every key of one row.

    keys, ranked: (k,) of the key's type; rank, weight: (k,) uint32.
    """

    keys: npt.NDArray[np.uint32] | npt.NDArray[np.uint64]
    rank: npt.NDArray[np.uint32]
    ranked: npt.NDArray[np.uint32] | npt.NDArray[np.uint64]
    weight: npt.NDArray[np.uint32]


def new_scratch(warp_size: int, key_dtype: npt.DTypeLike) -> Scratch:
    """Scratch for rows of `warp_size` lanes with up to four keys each."""
    room = 4 * warp_size
    keys, ranked = np.zeros(room, key_dtype), np.zeros(room, key_dtype)
    return Scratch(keys, np.zeros(room, np.uint32), ranked, np.zeros(room, np.uint32))


@compiled
def coalesce(  # type: ignore[no-untyped-def]
    slots,
    lanes,
    instruction,
    program,
    place,
    sector_shift,
    line_shift,
    first,
    scratch,
    requests,
    lane_fetches,
):
    """Coalesce the rows at `slots` of the store, in that order, into `requests`, a segment each.

    lanes: (capacity, warp_size) packed texels or addresses. first: uint64 subtracted from texels'
        sectors so that the scratch's
    keys hold them. lane_fetches: (num_groups,) int64, added to. Returns -1, or the slot of a row
        with a texel outside its texture.
    """
    sector_in_line = (U64(1) << (line_shift - sector_shift)) - U64(1)
    to_line = line_shift - sector_shift
    lines, masks, metas = requests.line, requests.mask, requests.meta
    ranked, weight = scratch.ranked, scratch.weight
    num, stores = U64(0), 0
    requests.segments[0] = 0
    for k in range(len(slots)):
        slot = slots[k]
        code = instruction[slot]
        operation = program.operation[code]
        texture, group = program.texture[code], U32(program.group[code])
        last_mip = 0
        if texture >= 0:
            found = _texel_sectors(
                lanes,
                slot,
                texture,
                program.bilinear[code],
                place,
                sector_shift,
                first,
                scratch,
                lane_fetches,
                group,
            )
            if found < 0:
                return slot
            last_mip = place.last_mip[texture]
        else:
            found = _address_sectors(
                lanes, slot, program.access_bytes[code], sector_shift, scratch, lane_fetches, group
            )
        n = U64(found)
        _sort_distinct(scratch, n)
        begin = num
        mip = 0
        at = U64(0)
        previous = U64(0)
        while at < n:
            sector = U64(ranked[at]) + first
            at += U64(weight[at])
            number = sector >> to_line
            bit = U8(1) << U8(sector & sector_in_line)
            if num > begin and number == previous:
                masks[num - U64(1)] |= bit
                continue
            # Mips follow each other in memory, so that the mip never falls along sorted sectors.
            while mip < last_mip and (place.base[texture, mip + 1] >> sector_shift) <= sector:
                mip += 1
            previous = number
            lines[num], masks[num] = number, bit
            metas[num] = (U32(operation) << U32(GROUP_BITS)) | (group + U32(mip))
            if operation == STORE:
                requests.written[num] = stores
                for s in range(8):
                    requests.bytes_written[stores, s] = 0
                stores += 1
            num += U64(1)
        if operation == STORE:
            _store_bytes(
                lanes,
                slot,
                texture,
                program.access_bytes[code],
                place,
                sector_shift,
                line_shift,
                begin,
                num,
                requests,
            )
        requests.segments[k + 1] = num
    return -1


__all__ = [
    "Placement",
    "Program",
    "Scratch",
    "coalesce",
    "groups_of",
    "new_scratch",
    "placement_of",
    "program_of",
]
