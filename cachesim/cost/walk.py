"""R(d), drawn: made-up samples of some tiles, and which of their sectors the near caches hold.

The distance and direction of each sample are random, as the profile has them; its mip follows by Eq
5.12, its texel by the lane's pixel, its sector by the layout. Warps of the tiles that an SM holds
take turns, one access each, as in the counting model. An L1 has the sets, ways and sectors of the
configuration and replaces the least recently used line; so has a level that a few SMs share (RDNA's
GL1), and then these SMs are walked together. What is counted is by the tile's class, the texture,
the level and the distance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from cachesim.cost.lru import look_up

#: Times that as many sectors were missed as there are lines, after which a cache counts as filled.
_FILLS = 3


class Rule(NamedTuple):
    """How a distance becomes a level. kind: 0 none, 1 Eq 5.12, 2 the textbook's. c: of the
    approximate inverse cdf. damping: of Eq 5.12, with the frame's size and the mean free path.
    """

    kind: int
    d_mm: float
    c: float
    damping: float
    num_levels: int


class Tiles(NamedTuple):
    """The tiles of a window, SM by SM.

    first: (SMs + 1,) where those of each SM begin. x, y: (n,) of the first pixel. samples: (n, 64)
    of each pixel. scale: (n,) texels per mm. start: (n,) of the profile's cdf, which lies in the
    own pixel. group: (n,) class. done: (n,) share of its turns that is over when the window begins.
    beside: (2,) accesses beside the loop of a warp without samples, and of one with.
    """

    first: npt.NDArray[np.int64]
    x: npt.NDArray[np.int64]
    y: npt.NDArray[np.int64]
    samples: npt.NDArray[np.int64]
    scale: npt.NDArray[np.float64]
    start: npt.NDArray[np.float64]
    group: npt.NDArray[np.int64]
    done: npt.NDArray[np.float64]
    beside: npt.NDArray[np.int64]


class Reads(NamedTuple):
    """What each sample reads, R textures; the tables are those of `AddressMap`, from the first byte
    that is placed. follows: (R,) at the sample's level. corners: (R,) 4 where bilinear, else 1.
    """

    x_tables: npt.NDArray[np.uint32]
    y_tables: npt.NDArray[np.uint32]
    x_start: npt.NDArray[np.int64]
    y_start: npt.NDArray[np.int64]
    base: npt.NDArray[np.int64]
    low_mask: npt.NDArray[np.uint32]
    width: npt.NDArray[np.int64]
    height: npt.NDArray[np.int64]
    follows: npt.NDArray[np.bool_]
    corners: npt.NDArray[np.int64]


class Counts(NamedTuple):
    """(classes, textures, levels, rings) int64 each: reads of lanes, sectors asked of the L1,
    missed there, and missed by the level that SMs share too. drawn: (classes, textures) samples,
    those beyond the frame too that a filter does not read.
    """

    drawn: npt.NDArray[np.int64]
    lanes: npt.NDArray[np.int64]
    asked: npt.NDArray[np.int64]
    missed: npt.NDArray[np.int64]
    missed_shared: npt.NDArray[np.int64]


@njit(cache=True, nogil=True)
def _address(reads: Any, k: Any, level: Any, row: Any, column: Any) -> Any:
    """Byte of a texel, from the first that is placed."""
    x_term = np.int64(reads.x_tables[reads.x_start[k, level] + column])
    y_term = np.int64(reads.y_tables[reads.y_start[k, level] + row])
    low = np.int64(reads.low_mask[k])
    return reads.base[k, level] + (x_term & ~low) + (y_term & ~low) + ((x_term ^ y_term) & low)


@njit(cache=True, nogil=True)
def _sample(
    tiles: Any,
    tile: Any,
    lane: Any,
    rule: Any,
    taps: Any,
    turn: Any,
    axis: Any,
    size: Any,
    out: Any,
) -> bool:
    """Place a lane's sample: x, y in texels, level and distance into `out`; whether it is read."""
    x = tiles.x[tile] + lane % 8 + 0.5
    y = tiles.y[tile] + lane // 8 + 0.5
    scale = tiles.scale[tile]
    if axis:
        # A filter's tap reads nothing beyond the frame; a bilinear read begins half a texel before.
        away = taps[turn] * scale
        along = (x if axis == 1 else y) + away
        limit = size[0] if axis == 1 else size[1]
        if along < 0.0 or along >= limit:
            return False
        along = min(max(along, 0.5), limit - 0.5) - 0.5
        out[0], out[1] = (along, y - 0.5) if axis == 1 else (x - 0.5, along)
        out[2], out[3] = 0.0, abs(away)
        return True
    start = tiles.start[tile]
    xi = min(start + np.random.random() * (1.0 - start), 1.0 - 2.0**-24)  # noqa: NPY002 -- numba's own
    r = max(rule.d_mm * ((2.0 - rule.c) * xi - 2.0) * np.log1p(-xi), 1e-5)
    turned = 2.0 * np.pi * np.random.random()  # noqa: NPY002
    reach = r * scale
    out[0] = min(max(x + reach * np.cos(turned), 0.5), size[0] - 0.5)
    out[1] = min(max(y + reach * np.sin(turned), 0.5), size[1] - 0.5)
    out[3] = reach
    level = 0
    if rule.kind:
        far = np.exp(-r / (3.0 * rule.d_mm))
        q = max((far * far * far + far) / (4.0 * rule.d_mm), 1e-5)
        q *= rule.damping * tiles.samples[tile, lane] / (scale * scale)
        if rule.kind == 2:
            q /= r
        while level < 5 and q < 4.0**-level:
            level += 1
        level = min(level, rule.num_levels - 1)
    out[2] = level
    return True


@njit(cache=True, nogil=True)
def walk(
    tiles: Any,
    reads: Any,
    rule: Any,
    taps: Any,
    axis: Any,
    l1: Any,
    shared: Any,
    places: Any,
    warp_size: Any,
    edges: Any,
    warm: Any,
    to_end: Any,
    seed: Any,
    access: Any,
    counts: Any,
) -> Any:
    """Take the tiles of some SMs, each SM's in order, through their L1s and what they share.

    taps: (T,) mm of a filter, along `axis` 1 (x) or 2 (y); 0 samples around. places: tiles that an
    SM holds at a time. edges: (rings + 1,) texels. warm: whether to count only once the caches have
    been filled or all first tiles have left. to_end: count until the last tile ends, else until
    most SMs have none waiting. access: number of the first access, above all earlier ones. Returns
    that of the next. Adds to `counts`.
    """
    np.random.seed(seed)  # noqa: NPY002
    sms = len(tiles.first) - 1
    warps = 64 // warp_size
    num_reads, units, num_rings = len(reads.follows), len(l1.valid) // sms, len(edges) - 1
    size = np.array([reads.width[0, 0], reads.height[0, 0]], np.float64)
    following = tiles.first[:-1].copy()
    tile_at = np.full((sms, places), -1, np.int64)
    left = np.zeros((sms, places), np.int64)
    turn = np.zeros((sms, places, warps), np.int64)
    turns = np.zeros((sms, places, warps), np.int64)
    read = np.zeros((sms, places, warps), np.int64)
    pause = np.zeros((sms, places, warps), np.int64)
    drawn = np.zeros((sms, places, warps), np.bool_)
    counted = np.zeros((sms, places, warps), np.bool_)
    tried = np.zeros((sms, places, warps), np.int64)
    active = np.zeros((sms, places, warps, warp_size), np.bool_)
    sample = np.zeros((sms, places, warps, warp_size, 4))
    ring = np.zeros((sms, places, warps, warp_size), np.int64)
    has_shared = len(shared.set_of) > 0
    filled, filled_shared, replaced = 0, 0, 0
    enough = _FILLS * l1.ways * l1.held.size if warm else 0
    enough_shared = _FILLS * shared.ways * shared.held.size if warm else 0
    while True:
        running, waiting = 0, 0
        for place in range(places):
            for w in range(warps):
                for sm in range(sms):
                    tile = tile_at[sm, place]
                    if w == 0 and tile < 0 and following[sm] < tiles.first[sm + 1]:
                        tile = tile_at[sm, place] = following[sm]
                        following[sm] += 1
                        replaced += tile - tiles.first[sm] >= places
                        for v in range(warps):
                            held = tiles.samples[tile, v * warp_size : (v + 1) * warp_size]
                            turns[sm, place, v] = held.max()
                            done = int(tiles.done[tile] * turns[sm, place, v] * num_reads)
                            turn[sm, place, v] = done // num_reads
                            read[sm, place, v] = done % num_reads
                            drawn[sm, place, v] = False
                            pause[sm, place, v] = tiles.beside[1 if held.max() else 0]
                            if done:
                                pause[sm, place, v] = 0
                        left[sm, place] = warps
                    if tile < 0:
                        continue
                    running += 1
                    here = (sm, place, w)
                    if pause[here]:
                        # What a warp does beside its loop comes first; it takes its time.
                        pause[here] -= 1
                        if turns[here] == 0 and pause[here] == 0:
                            left[sm, place] -= 1
                            if left[sm, place] == 0:
                                tile_at[sm, place] = -1
                        continue
                    if turn[here] >= turns[here]:
                        continue
                    k = read[here]
                    if k == 0 or not drawn[here]:
                        drawn[here] = True
                        tried[here] = 0
                        counted[here] = replaced >= places * sms or (
                            filled >= enough and filled_shared >= enough_shared
                        )
                        for lane in range(warp_size):
                            pixel = w * warp_size + lane
                            active[here][lane] = turn[here] < tiles.samples[tile, pixel]
                            if not active[here][lane]:
                                continue
                            tried[here] += 1
                            out = sample[here][lane]
                            active[here][lane] = _sample(
                                tiles, tile, pixel, rule, taps, turn[here], axis, size, out
                            )
                            at = np.searchsorted(edges, out[3], side="right") - 1
                            ring[here][lane] = min(max(at, 0), num_rings - 1)
                    access += 1
                    counting = counted[here]
                    if counting:
                        counts.drawn[tiles.group[tile], k] += tried[here]
                    for lane in range(warp_size):
                        if not active[here][lane]:
                            continue
                        out = sample[here][lane]
                        level = int(out[2]) if reads.follows[k] else 0
                        wide, tall = reads.width[k, level], reads.height[k, level]
                        x = int(out[0] * wide / size[0]) if level else int(out[0])
                        y = int(out[1] * tall / size[1]) if level else int(out[1])
                        where = (tiles.group[tile], k, level, ring[here][lane])
                        if counting:
                            counts.lanes[where] += 1
                        for corner in range(reads.corners[k]):
                            column = min(x + (corner & 1), wide - 1)
                            row = min(y + (corner >> 1), tall - 1)
                            address = _address(reads, k, level, row, column)
                            number = address // l1.sector_bytes
                            if l1.asked_at[number] == access:
                                continue
                            l1.asked_at[number] = access
                            counts.asked[where] += counting
                            if look_up(l1, sm * units + place % units, number):
                                continue
                            filled += 1
                            counts.missed[where] += counting
                            if has_shared and not look_up(
                                shared, 0, address // shared.sector_bytes
                            ):
                                filled_shared += 1
                                counts.missed_shared[where] += counting
                    read[here] = k + 1
                    if k + 1 == num_reads:
                        read[here] = 0
                        turn[here] += 1
                        left[sm, place] -= turn[here] == turns[here]
                        if left[sm, place] == 0:
                            tile_at[sm, place] = -1
        for sm in range(sms):
            waiting += following[sm] < tiles.first[sm + 1]
        if 2 * waiting < sms and not to_end:
            return access
        if running == 0 and waiting == 0:
            return access
