"""S(m) on the way to the L2: what the samples of each tile ask of the L1, and what they miss there.

The tiles that share an L1 share its lines. Each turn a warp reads one sample of each of its lanes;
the different sectors among them are the L1's demand. A sector stays for the T turns after which the
tiles' working sets fill the cache; a tile that ends before that misses each sector once. What
other tiles of the same L1 have read is found there too, as far as their surroundings overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cachesim.cost.dispatch import Schedule, dispatch
from cachesim.cost.footprint import Rings, Spot, miss_probability, spread, warp_sectors
from cachesim.cost.machine import Machine
from cachesim.cost.workload import TILE_SIDE, Floats, Ints, LaunchWork, Scatter, Workload

#: Classes of tiles per doubling of the scale, of the count and of the tiles that share an L1.
_PER_OCTAVE = np.array([2.0, 2.0, 1.0])
_SEARCH_STEPS = 22
#: Tiles of a class whose company is looked at, and directions around them.
_LOOKED_AT = 6
_GROUPS = 4
_ANGLES = 2.0 * np.pi * (np.arange(8) + 0.5) / 8
#: Accesses of a tile without samples, which leaves at once.
_IDLE_ACCESSES = 4.0
#: Spread of the tiles' turns, over their mean, below which they stay in step.
_ALIKE = 0.05


@dataclass(frozen=True, eq=False)
class ReadSpread:
    """One texture's reads around a tile; (levels, rings) each, and `beside` and `before` by group.

    rings: how they spread. sectors: of the frame in each ring; samples beyond the frame are clamped
    to its edge and find their sectors there. rate: accesses of the tile to a sector, in a turn,
    where those of one warp's lanes count once. beside: the same of the other tiles that share the
    L1. before: of the tiles that the L1 held before, in their whole time. accesses: sectors that a
    warp asks for in one turn, on average.
    """

    texture: str
    rings: Rings
    sectors: Floats
    rate: Floats
    beside: Floats
    before: Floats
    accesses: float


@dataclass(frozen=True, eq=False)
class TileClass:
    """Tiles of about the same scale, count and company.

    tiles: indices into the scatter. turns: of the loop, of one tile. warp_turns: the same summed
    over its warps. sharing: tiles on the L1 at a time, itself included. reads: the textures.
    """

    tiles: Ints
    turns: float
    warp_turns: float
    sharing: float
    reads: tuple[ReadSpread, ...]

    @property
    def num_tiles(self) -> int:
        return len(self.tiles)


@dataclass(frozen=True, eq=False)
class ScatterSpread:
    """The classes of a scattering launch on one machine, and when its tiles run.

    in_step: share of the tiles whose warps go through the loop together, so that they read one
    texture after the other: all where every tile takes as many turns, else those that start first.
    """

    scatter: Scatter
    schedule: Schedule
    classes: tuple[TileClass, ...]
    in_step: float = 0.0

    @property
    def l1_accesses(self) -> float:
        """Sectors asked of the L1."""
        return sum(c.num_tiles * c.warp_turns * r.accesses for c in self.classes for r in c.reads)


def spread_scatter(workload: Workload, scatter: Scatter, machine: Machine) -> ScatterSpread:
    """Schedule the tiles of a launch, class them and spread the reads of each class."""
    launch = next(w for w in workload.launches if w.launch == scatter.launch)
    works = scatter.samples > 0
    accesses = scatter.steps * float(len(scatter.reads)) + _IDLE_ACCESSES
    sms = machine.gpu.sm.count
    units = machine.levels[0].instances // sms
    schedule = dispatch(accesses, works, sms, machine.resident(launch), units)
    working = np.flatnonzero(works)
    if not len(working):
        return ScatterSpread(scatter, schedule, ())
    values = np.column_stack(
        [
            scatter.texels_per_mm[working],
            scatter.samples[working] / scatter.pixels[working],
            schedule.sharing[working],
        ]
    )
    code = np.round(np.log2(np.maximum(values, 1e-6)) * _PER_OCTAVE)
    _, of_tile = np.unique(code, axis=0, return_inverse=True)
    maker = _Maker(workload, scatter, machine, launch, schedule)
    classes = [maker.make(working[of_tile.ravel() == k]) for k in range(int(of_tile.max()) + 1)]
    turns = scatter.steps[working]
    alike = float(np.std(turns)) < _ALIKE * float(np.mean(turns))
    in_step = 1.0 if alike else float(np.mean(schedule.start[working] <= _IDLE_ACCESSES))
    return ScatterSpread(scatter, schedule, tuple(classes), in_step)


@dataclass(frozen=True, eq=False)
class _Maker:
    """Makes the classes of a launch."""

    workload: Workload
    scatter: Scatter
    machine: Machine
    launch: LaunchWork
    schedule: Schedule

    def make(self, tiles: Ints) -> TileClass:
        """The class of these tiles."""
        scatter, machine = self.scatter, self.machine
        samples = scatter.samples[tiles]
        spot = Spot(
            float(np.average(scatter.texels_per_mm[tiles], weights=samples)),
            float(samples.sum() / scatter.pixels[tiles].sum()),
            self.workload.width,
            self.workload.height,
            scatter.direction,
            scatter.taps_mm,
        )
        # A GPU with warps of 64 lanes takes two rows of a recording together.
        rows = machine.gpu.sm.warp_size // 32
        lanes = float(samples.sum() / scatter.steps[tiles].sum()) * rows
        warp_turns = float(scatter.steps[tiles].mean()) / rows
        turns = max(warp_turns * rows / self.launch.warps_per_cta, 1.0)
        layout, sector = machine.gpu.texture_layout, machine.levels[0].sector_bytes
        chosen = tiles[:: max(1, len(tiles) // _LOOKED_AT)]
        company = [self._company(tile) for tile in chosen]
        reads = []
        for read in scatter.reads:
            optics = self.workload.optics
            rings = spread(optics, spot, read, layout, sector)
            asked = warp_sectors(optics, spot, read, layout, sector, machine.warp_shape, lanes)
            sectors = rings.num_sectors() * _inside(rings, self.workload, scatter, tiles)
            rate = _rates(rings, asked) * warp_turns / turns
            beside, before = _others(rings, rate, company)
            reads.append(
                ReadSpread(read.texture, rings, sectors, rate, beside, before * turns, asked)
            )
        sharing = max(float(np.mean(self.schedule.sharing[tiles])), 1.0)
        return TileClass(tiles, turns, warp_turns, sharing, tuple(reads))

    def _company(self, tile: int) -> _Company:
        """The tiles that run on a tile's L1 beside it, and those that ran there just before."""
        plan, scatter = self.schedule, self.scatter
        there = np.flatnonzero((plan.unit == plan.unit[tile]) & (scatter.samples > 0))
        there = there[there != tile]
        start, end = plan.start[tile], plan.end[tile]
        overlap = np.minimum(plan.end[there], end) - np.maximum(plan.start[there], start)
        beside = there[overlap > 0]
        earlier = there[plan.end[there] <= start]
        latest = np.argsort(plan.end[earlier])[::-1][: len(beside) + 1]
        before = earlier[latest]
        weight = overlap[overlap > 0] / max(end - start, 1e-9)
        return _Company(self._from(tile, beside), weight, self._from(tile, before))

    def _from(self, tile: int, others: Ints) -> Floats:
        """(others, 2) texels from a tile to others."""
        dx = self.scatter.tile_x[others] - self.scatter.tile_x[tile]
        dy = self.scatter.tile_y[others] - self.scatter.tile_y[tile]
        offset: Floats = np.column_stack([dx, dy]).astype(np.float64) * TILE_SIDE
        return offset


@dataclass(frozen=True, eq=False)
class _Company:
    """Other tiles of an L1. beside, before: (n, 2) texels away. weight: (n,) share of the tile's
    time that those beside it run too.
    """

    beside: Floats
    weight: Floats
    before: Floats


def _others(rings: Rings, rate: Floats, company: list[_Company]) -> tuple[Floats, Floats]:
    """(levels, rings, groups) each: accesses of the tiles beside, and of those before, to a sector
    of each ring, in a turn. The groups are places on the ring, of equal size, by how much the
    others come there: a mean over them all would make misses too few.
    """
    middle = 0.5 * (rings.radius[1:] + rings.radius[:-1])
    points = np.stack([middle[:, None] * np.cos(_ANGLES), middle[:, None] * np.sin(_ANGLES)], -1)
    padded = np.concatenate([rate, np.zeros((len(rate), 1))], axis=1)

    def reaching(offsets: Floats, weights: Floats) -> Floats:
        away = points[None] - offsets[:, None, None, :]
        ring = np.searchsorted(rings.radius, np.hypot(away[..., 0], away[..., 1]), side="right") - 1
        found = padded[:, np.minimum(ring, padded.shape[1] - 1)]
        summed: Floats = np.einsum("lora,o->lra", found, weights)
        return summed

    beside = np.concatenate([reaching(c.beside, c.weight) for c in company], axis=2)
    before = np.concatenate([reaching(c.before, np.ones(len(c.before))) for c in company], axis=2)
    order = np.argsort(beside + 1e-3 * before, axis=2)
    grouped = []
    for found in (beside, before):
        ordered = np.take_along_axis(found, order, axis=2)
        groups = np.array_split(ordered, _GROUPS, axis=2)
        grouped.append(np.stack([g.mean(axis=2) for g in groups], axis=2))
    return grouped[0], grouped[1]


def _inside(rings: Rings, workload: Workload, scatter: Scatter, tiles: Ints) -> Floats:
    """(rings,) share of each ring around the tiles that lies in the frame."""
    chosen = tiles[:: max(1, len(tiles) // (8 * _LOOKED_AT))]
    angle = 2.0 * np.pi * (np.arange(24) + 0.5) / 24
    radius = 0.5 * (rings.radius[1:] + rings.radius[:-1])
    x = (scatter.tile_x[chosen] * TILE_SIDE + 4.0)[:, None, None]
    y = (scatter.tile_y[chosen] * TILE_SIDE + 4.0)[:, None, None]
    at_x = x + radius[:, None] * np.cos(angle)
    at_y = y + radius[:, None] * np.sin(angle)
    inside = (at_x > 0) & (at_x < workload.width) & (at_y > 0) & (at_y < workload.height)
    share: Floats = np.maximum(inside.mean(axis=(0, 2)), 1e-3)
    return share


@dataclass(frozen=True, eq=False)
class ClassMisses:
    """Misses of one tile of a class. by_read: per texture (levels, rings), in sectors."""

    tile_class: TileClass
    by_read: Mapping[str, Floats]

    @property
    def total(self) -> float:
        return float(sum(m.sum() for m in self.by_read.values()))


def l1_misses(
    found: ScatterSpread, machine: Machine, share: float, company: float
) -> list[ClassMisses]:
    """Misses of one tile of each class where `share` of the L1's lines hold what is used."""
    level = machine.levels[0]
    return [
        _miss(
            tile, level.sectors_per_line, share * level.lines / tile.sharing, company, found.in_step
        )
        for tile in found.classes
    ]


def _miss(
    tile: TileClass, sectors_per_line: int, lines: float, company: float, in_step: float
) -> ClassMisses:
    """The misses of a tile that has so many lines to itself."""
    g = sectors_per_line
    stay = _turns_to_fill(tile, g, lines, company)
    within = min(stay, tile.turns)
    earlier = min(max(stay / tile.turns - 1.0, 0.0), 1.0)
    misses = {}
    for read in tile.reads:
        rate, sectors = read.rate[..., None], read.sectors
        total = rate + company * read.beside
        # Where several tiles read a sector first, each misses its share.
        share = rate / np.maximum(total, 1e-300)
        first = share * -np.expm1(-total * within) * np.exp(-company * read.before * earlier)
        after = (tile.turns - within) * rate * miss_probability(total * stay, g)
        missed = first + after
        if stay < 1.0:
            seen = _seen_in_step(rate, company * read.beside, stay, len(tile.reads))
            together = tile.turns * rate * miss_probability(seen, g)
            missed = in_step * together + (1.0 - in_step) * missed
        misses[read.texture] = sectors * np.mean(missed, axis=2)
    return ClassMisses(tile, misses)


def _seen_in_step(own: Floats, beside: Floats, turns: float, num_reads: int) -> Floats:
    """Accesses to a sector in less than a turn, where warps read one texture after the other.

    Half of a tile's warps find what the other half has just asked for. Those beside have come to
    the same texture in the part of the turn that is the texture's: on average over that part, as
    much as has passed of it.
    """
    part = 1.0 / num_reads
    if turns < part:
        passed = (turns - turns * turns / part / 2.0) / part
    else:
        passed = 0.5 + 0.5 * max(0.0, (turns - 1.0 + part) / part)
    # A tile's own last turn comes into reach as the time nears a turn.
    own_turns = 0.25 + 0.75 * max(0.0, 5.0 * turns - 4.0)
    seen: Floats = own_turns * own + passed * beside
    return seen


def _turns_to_fill(tile: TileClass, sectors_per_line: int, lines: float, company: float) -> float:
    """Turns in which a tile touches so many lines, those that others touch too counted in part."""
    low, high = -8.0, 14.0  # log2
    for _ in range(_SEARCH_STEPS):
        turns = 2.0 ** (0.5 * (low + high))
        if _touched(tile, sectors_per_line, turns, company) < lines:
            low = 0.5 * (low + high)
        else:
            high = 0.5 * (low + high)
    return float(2.0**low)


def _touched(tile: TileClass, g: int, turns: float, company: float) -> float:
    """Lines that a tile touches in some turns."""
    touched = 0.0
    for read in tile.reads:
        rate = read.rate[..., None]
        total = rate + company * read.beside
        share = rate / np.maximum(total, 1e-300)
        lines = np.mean(share * -np.expm1(-g * turns * total), axis=2)
        touched += float(np.sum(read.sectors / g * lines))
    return touched


def _rates(rings: Rings, accesses: float) -> Floats:
    """(levels, rings): probability that a warp's turn, which asks for so many sectors, asks for one
    of each ring. Lanes that coalesce are those that crowd: few sectors where many lanes fall.
    """
    share, sectors = rings.per_sector(), rings.num_sectors()
    low, high = 0.0, 1e4
    for _ in range(_SEARCH_STEPS):
        lanes = 0.5 * (low + high)
        if float(np.sum(sectors * -np.expm1(-lanes * share))) < accesses:
            low = lanes
        else:
            high = lanes
    rate: Floats = -np.expm1(-high * share)
    return rate
