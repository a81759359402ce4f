"""R(d): where the reads of a tile's samples fall, and how many different sectors they are.

A tile's samples spread around it with the density q(x) that follows from the distances d_j. N reads
with that density touch, on average, the integral of (1 - exp(-N a q)) / a different sectors of area
a. With N the lanes of a warp this is what one access asks of the L1; with N the reads of a tile in
some time, it is the tile's working set in that time. The integral is taken over rings, on points of
a low-discrepancy sequence that are smeared over the tile and over the sector, so that sectors may
lie anyhow.

A cache keeps lines of g sectors. Where reads come to each sector of a line at a mean of x in the
time T that an untouched line stays, a line's life has k reads with probability p^(k - 1) (1 - p),
p = 1 - exp(-g x), of which the first of each sector misses. So a read misses with probability

    g q / (1 + (g - 1) q),  q = exp(-g x).

T follows from the cache being full [Che, Tung, Wang 2002].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from cachesim.cost.workload import TILE_SIDE, Floats, Optics, Read
from traces.layout import layout_function

NUM_POINTS = 8192
NUM_RINGS = 28
#: Texels of the level whose layout is looked at: wide enough for every layout's usual block.
_PROBE = 256
_EXPONENT_MAX = 700.0


@cache
def granule_texels(layout: str, texel_bytes: int, granule_bytes: int) -> tuple[int, int]:
    """(width, height) in texels of the block that a granule (a sector, a line) of memory holds."""
    tables = layout_function(layout)(_PROBE, _PROBE, texel_bytes)
    at = np.arange(_PROBE)
    granule = tables.offset(at[:, None], at[None, :]) // np.uint64(granule_bytes)
    ys, xs = np.nonzero(granule == granule[_PROBE // 2, _PROBE // 2])
    return int(np.ptp(xs)) + 1, int(np.ptp(ys)) + 1


def miss_probability(x: Any, sectors_per_line: int) -> Any:
    """Probability that a read misses where each sector of the line gets x reads, on average, in the
    time that an untouched line stays.
    """
    g = sectors_per_line
    ends = np.exp(-np.minimum(g * x, _EXPONENT_MAX))
    return g * ends / (1.0 + (g - 1) * ends)


@dataclass(frozen=True, eq=False)
class Rings:
    """How one texture's reads of a tile spread.

    radius: (rings + 1,) edges, texels of level 0 from the tile's centre. area: (rings,) texels^2.
    share: (levels, rings) of the reads; sums to 1. sector_area: (levels,) texels^2 of level 0.
    """

    radius: Floats
    area: Floats
    share: Floats
    sector_area: Floats

    def per_sector(self) -> Floats:
        """(levels, rings): share of the reads that one sector of each ring gets."""
        return self.share * self.sector_area[:, None] / self.area

    def num_sectors(self) -> Floats:
        """(levels, rings): sectors in each ring."""
        return self.area / self.sector_area[:, None]

    def distinct(self, num_reads: float) -> float:
        """Different sectors among so many reads, on average."""
        hits = np.minimum(num_reads * self.per_sector(), _EXPONENT_MAX)
        return float(np.sum(self.num_sectors() * -np.expm1(-hits)))


def _halton(base: int, num: int) -> Floats:
    """The van der Corput sequence of a base, from its first point on."""
    index, value, digit = np.arange(1, num + 1), np.zeros(num), 1.0 / base
    while index.any():
        value += digit * (index % base)
        index, digit = index // base, digit / base
    return value


@cache
def _points() -> tuple[Floats, ...]:
    """Six coordinates in [0, 1): distance, angle, place in the tile, place in the sector."""
    stratified = (np.arange(NUM_POINTS) + 0.5) / NUM_POINTS
    return (stratified, *(_halton(base, NUM_POINTS) for base in (2, 3, 5, 7, 11)))


@dataclass(frozen=True)
class Spot:
    """What decides how a tile's samples spread: texels_per_mm and count, the samples of a pixel, at
    the tile; the frame's size in texels; and the directions of the reads.

    taps_mm: a filter's taps, along x or y; () for sampling around.
    """

    texels_per_mm: float
    count: float
    width: int
    height: int
    direction: str = "around"
    taps_mm: tuple[float, ...] = ()


def _reads(
    optics: Optics, spot: Spot, read: Read
) -> tuple[Floats, Floats, npt.NDArray[np.int64], tuple[Floats, ...]]:
    """(x, y) offsets of sample points in texels, their levels, and four more coordinates."""
    u, angle, *rest = _points()
    if spot.taps_mm:
        taps = np.asarray(spot.taps_mm)
        offset = taps[(u * len(taps)).astype(np.int64)] * spot.texels_per_mm
        flat = np.zeros_like(offset)
        dx, dy = (offset, flat) if spot.direction == "x" else (flat, offset)
        level = np.zeros(NUM_POINTS, np.int64)
    else:
        radius = np.maximum(optics.radii(u, spot.texels_per_mm), 1e-5)
        level = optics.levels(radius, spot.count, spot.texels_per_mm, spot.width, spot.height)
        dx, dy = radius * np.cos(2 * np.pi * angle), radius * np.sin(2 * np.pi * angle)
    if not read.follows_mip:
        level = np.zeros_like(level)
    return dx, dy, level, tuple(rest)


def warp_sectors(
    optics: Optics,
    spot: Spot,
    read: Read,
    layout: str,
    sector_bytes: int,
    block: tuple[int, int],
    lanes: float,
) -> float:
    """Different sectors that so many lanes of a warp ask for in one access, on average.

    block: pixels (x, y) of the warp, whose corner lies at the corner of a sector.
    """
    dx, dy, level, (lane_x, lane_y, *_) = _reads(optics, spot, read)
    wide, tall = granule_texels(layout, read.texel_bytes, sector_bytes)
    # The lanes' pixels are whole; samples start in their middles.
    x = np.floor(lane_x * block[0]) + 0.5 + dx
    y = np.floor(lane_y * block[1]) + 0.5 + dy
    size = np.exp2(level)
    corners: tuple[tuple[int, int], ...] = ((0, 0),)
    if read.bilinear:
        along_x = spot.direction == "x"
        corners = ((0, 0), (1, 0)) if along_x else ((0, 0), (0, 1))
        x, y = (x - 0.5, y) if along_x else (x, y - 0.5)
    codes = []
    for more_x, more_y in corners:
        column = np.floor((x / size + more_x) / wide).astype(np.int64) + (1 << 20)
        row = np.floor((y / size + more_y) / tall).astype(np.int64) + (1 << 20)
        codes.append((level << 48) | (row << 24) | column)
    if len(codes) == 1:
        hits = np.unique(codes[0], return_counts=True)[1] / NUM_POINTS
    else:
        # A lane asks for a sector once, though both its texels lie there.
        both = np.where(codes[1] == codes[0], -1, codes[1])
        found, counts = np.unique(np.concatenate([codes[0], both]), return_counts=True)
        hits = counts[found >= 0] / NUM_POINTS
    return float(np.sum(-np.expm1(-lanes * hits)))


def spread(optics: Optics, spot: Spot, read: Read, layout: str, sector_bytes: int) -> Rings:
    """How the reads of one texture spread around the pixels of a tile.

    layout: name of the texels' layout. sector_bytes: of the cache.
    """
    dx, dy, level, (tile_x, tile_y, sector_x, sector_y) = _reads(optics, spot, read)
    wide, tall = granule_texels(layout, read.texel_bytes, sector_bytes)
    texel = np.exp2(level)
    # A bilinear read takes a second texel along the line, mostly in the same sector.
    more = 1.0 if read.bilinear else 0.0
    x = dx + (tile_x - 0.5) * TILE_SIDE + (sector_x - 0.5) * (wide + more) * texel
    y = dy + (tile_y - 0.5) * TILE_SIDE + (sector_y - 0.5) * (tall + more) * texel
    away = np.hypot(x, y)
    edges = np.geomspace(min(2.0, away.max() / 4), away.max() * 1.001, NUM_RINGS)
    edges = np.concatenate([[0.0], edges])
    num_levels = int(level.max()) + 1
    ring = np.minimum(np.searchsorted(edges, away, side="right") - 1, NUM_RINGS - 1)
    share = np.bincount(level * NUM_RINGS + ring, minlength=num_levels * NUM_RINGS)
    area = np.pi * np.diff(edges**2)
    sector_area: Floats = wide * tall * np.exp2(2.0 * np.arange(num_levels))
    return Rings(edges, area, share.reshape(num_levels, -1) / NUM_POINTS, sector_area)
