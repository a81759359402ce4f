"""Coalescing: the lanes of each issued row to requests, one per distinct line, with the mask of distinct sectors.

Requests of a row are in ascending address order, whatever the order of its lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from cachesim.stream import GROUP_BITS, LOAD, OPERATION_CODES, STORE, Requests
from traces.footprint import texel_offset
from traces.placement import AddressMap
from traces.texture import MAX_MIPS
from traces.trace import Trace

U64, U32, U8 = np.uint64, np.uint32, np.uint8


class Program(NamedTuple):
    """What coalescing needs to know of each instruction. I = number of instructions.

    operation, bilinear: (I,) uint8; texture, access_bytes, group: (I,) int32; `group` is that of the texture's mip 0.
    """

    operation: npt.NDArray[np.uint8]
    bilinear: npt.NDArray[np.uint8]
    texture: npt.NDArray[np.int32]
    access_bytes: npt.NDArray[np.int32]
    group: npt.NDArray[np.int32]


class Placement(NamedTuple):
    """`AddressMap` as the loop wants it: addresses relative to the base, mip boundaries as well. T textures."""

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
    """The (pass, texture) pairs of a trace's instructions, in order of first use; each has `MAX_MIPS` groups."""
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


@njit(cache=True, nogil=True, inline="always")
def _texel_sector(texture, mip, y, x, place, shift):  # type: ignore[no-untyped-def]
    x_entry = place.x_tables[U64(place.x_start[texture, mip]) + x]
    y_entry = place.y_tables[U64(place.y_start[texture, mip]) + y]
    return (
        place.base[texture, mip] + U64(texel_offset(x_entry, y_entry, place.low_mask[texture]))
    ) >> shift


@njit(cache=True, nogil=True, inline="always")
def _texel_sectors(row, texture, bilinear, place, shift, first, keys, mips):  # type: ignore[no-untyped-def]
    """Sectors of the active lanes' texels, less `first`, into keys; mips: lanes per mip, added to. Returns how many keys."""
    n = U64(0)
    single = place.last_mip[texture] == 0
    for lane in range(len(row)):
        texel = row[lane]
        if texel == U32(0xFFFFFFFF):
            continue
        mip = U64(0) if single else U64(texel >> U32(28))
        y, x = U64((texel >> U32(14)) & U32(16383)), U64(texel & U32(16383))
        mips[mip] += 1
        keys[n] = _texel_sector(texture, mip, y, x, place, shift) - first
        n += U64(1)
        if bilinear:
            x1 = min(x + U64(1), U64(place.width[texture, mip]) - U64(1))
            y1 = min(y + U64(1), U64(place.height[texture, mip]) - U64(1))
            keys[n] = _texel_sector(texture, mip, y, x1, place, shift) - first
            keys[n + U64(1)] = _texel_sector(texture, mip, y1, x, place, shift) - first
            keys[n + U64(2)] = _texel_sector(texture, mip, y1, x1, place, shift) - first
            n += U64(3)
    return n


@njit(cache=True, nogil=True, inline="always")
def _address_sectors(row, access_bytes, shift, keys, mips):  # type: ignore[no-untyped-def]
    """Sectors of the active lanes' byte addresses; an access over a sector's end has two. Returns how many keys."""
    n = U64(0)
    for lane in range(len(row)):
        address = row[lane]
        if address == U64(0xFFFFFFFFFFFFFFFF):
            continue
        mips[0] += 1
        first, last = address >> shift, (address + U64(access_bytes - 1)) >> shift
        keys[n] = first
        n += U64(1)
        if last != first:
            keys[n] = last
            n += U64(1)
    return n


@njit(cache=True, nogil=True, inline="always")
def _sort_distinct(keys, n, ranked, weight):  # type: ignore[no-untyped-def]
    """Each key to ranked[number of smaller keys], and how often it occurs to weight there: sorted, with gaps after repeats.

    Comparing all pairs is branch-free and vectorises; at 32 keys it beats a sort.
    """
    for k in range(n):
        weight[k] = 0
    for k in range(n):
        key = keys[k]
        rank = U32(0)
        for other in range(n):
            rank += U32(keys[other] < key)
        ranked[rank] = key
        weight[rank] += U32(1)


@njit(cache=True, nogil=True, inline="always")
def _store_bytes(  # type: ignore[no-untyped-def]
    row,
    is_texel,
    texture,
    access_bytes,
    place,
    sector_shift,
    line_shift,
    begin,
    end,
    line,
    written,
    bytes_written,
):
    """OR the bytes that each lane writes into its request's byte masks."""
    sector_bytes = U64(1) << sector_shift
    granule = max(U64(1), sector_bytes // U64(32))
    for lane in range(len(row)):
        if is_texel:
            texel = row[lane]
            if texel == U32(0xFFFFFFFF):
                continue
            mip, y, x = (
                U64(texel >> U32(28)),
                U64((texel >> U32(14)) & U32(16383)),
                U64(texel & U32(16383)),
            )
            address = _texel_sector(texture, mip, y, x, place, U64(0))
        else:
            address = U64(row[lane])
            if address == U64(0xFFFFFFFFFFFFFFFF):
                continue
        for byte in range(access_bytes):
            at = address + U64(byte)
            number = at >> line_shift
            for i in range(begin, end):
                if line[i] == number:
                    s = (at >> sector_shift) & ((U64(1) << (line_shift - sector_shift)) - U64(1))
                    bit = (at & (sector_bytes - U64(1))) // granule
                    bytes_written[written[i], s] |= U32(1) << U32(bit)


@njit(cache=True, nogil=True)
def coalesce(  # type: ignore[no-untyped-def]
    slots,
    lanes,
    instruction,
    program,
    place,
    sector_shift,
    line_shift,
    first_sector,
    key_of,
    line,
    mask,
    meta,
    written,
    bytes_written,
    segments,
    lane_fetches,
):
    """Coalesce the rows at `slots` of the store, in that order, into requests; returns (requests, stores) written.

    lanes: (capacity, warp_size) packed texels or addresses. first_sector: uint64 subtracted from texels' sectors so that keys of
    `key_of`'s dtype hold them. segments: (len(slots) + 1,) int64, written; lane_fetches: (num_groups,) int64, added to.
    """
    keys = np.empty(4 * lanes.shape[1], key_of.dtype)
    ranked = np.empty_like(keys)
    weight = np.empty(4 * lanes.shape[1], np.uint32)
    mips = np.empty(MAX_MIPS, np.int64)
    sector_in_line = (U64(1) << (line_shift - sector_shift)) - U64(1)
    to_line = line_shift - sector_shift
    is_texel = place.base.shape[0] > 0
    num, stores = U64(0), 0
    segments[0] = 0
    for k in range(len(slots)):
        slot = slots[k]
        code = instruction[slot]
        operation = program.operation[code]
        texture, group = program.texture[code], U32(program.group[code])
        mips[:] = 0
        if is_texel:
            n = _texel_sectors(
                lanes[slot],
                texture,
                program.bilinear[code],
                place,
                sector_shift,
                first_sector,
                keys,
                mips,
            )
            last_mip = place.last_mip[texture]
        else:
            n = _address_sectors(lanes[slot], program.access_bytes[code], sector_shift, keys, mips)
            last_mip = 0
        for mip in range(last_mip + 1):
            lane_fetches[group + U32(mip)] += mips[mip]
        _sort_distinct(keys, n, ranked, weight)
        begin = num
        mip = 0
        at = U64(0)
        previous = U64(0)
        while at < n:
            sector = U64(ranked[at]) + first_sector
            at += U64(weight[at])
            number = sector >> to_line
            bit = U8(1) << U8(sector & sector_in_line)
            if num > begin and number == previous:
                mask[num - U64(1)] |= bit
                continue
            # Mips follow each other in memory, so that the mip never falls along sorted sectors.
            while mip < last_mip and (place.base[texture, mip + 1] >> sector_shift) <= sector:
                mip += 1
            previous = number
            line[num], mask[num] = number, bit
            meta[num] = (U32(operation) << U32(GROUP_BITS)) | (group + U32(mip))
            if operation == STORE:
                written[num] = stores
                for s in range(8):
                    bytes_written[stores, s] = 0
                stores += 1
            num += U64(1)
        if operation == STORE:
            _store_bytes(
                lanes[slot],
                is_texel,
                texture,
                program.access_bytes[code],
                place,
                sector_shift,
                line_shift,
                begin,
                num,
                line,
                written,
                bytes_written,
            )
        segments[k + 1] = num
    return num, stores


__all__ = [
    "LOAD",
    "Placement",
    "Program",
    "Requests",
    "coalesce",
    "groups_of",
    "placement_of",
    "program_of",
]
