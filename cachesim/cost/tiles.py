"""S(m) on the way to the L2: what the samples of each tile ask of the L1, and what they miss there.

A read's cost depends on what the warp's other lanes ask, on the tiles that share its L1 and on how
long lines last there, for which there is no closed form. It is drawn instead (`walk`): for some SMs
and some times of a launch, whose tiles `dispatch` tells, made-up samples of those tiles go through
one L1. What a read of a class of tiles asks and misses there, on average, is taken for all reads of
the class.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cachesim.address import set_hash, set_indices
from cachesim.cost.dispatch import Schedule, dispatch
from cachesim.cost.machine import Machine
from cachesim.cost.memory import Memory
from cachesim.cost.walk import Cache, Counts, Reads, Rule, Tiles, walk
from cachesim.cost.workload import (
    APPROXIMATE_C,
    MAX_LEVEL,
    MIP_DAMPING,
    MIP_RULES,
    TILE_SIDE,
    Floats,
    Ints,
    Optics,
    Scatter,
    Workload,
)

NUM_RINGS = 24
#: Reads of lanes that are drawn for a launch, about; windows that they are drawn in, at least.
NUM_DRAWN = 600_000
_MIN_WINDOWS = 3
#: An SM's tiles are walked in full where they are so many times what it holds, or fewer.
_FULL = 3.0
#: Classes of tiles per doubling of the scale and of the count.
_PER_OCTAVE = np.array([1.0, 2.0])
#: Accesses of a tile without samples, which leaves at once.
_IDLE_ACCESSES = 4.0
_SEED = 20
_GOLDEN = 0.6180339887498949
_AXES = {"around": 0, "x": 1, "y": 2}


@dataclass(frozen=True, eq=False)
class TileClass:
    """Tiles of about the same scale and count, and what their reads cost.

    tiles: indices into the scatter. turns: of the loop, of one tile's warps on average. lanes,
    asked, missed: (textures, levels, rings), summed over the tiles: lanes' reads, sectors asked of
    the L1 and missed there.
    """

    tiles: Ints
    turns: float
    lanes: Floats
    asked: Floats
    missed: Floats


@dataclass(frozen=True, eq=False)
class ScatterCost:
    """The classes of a scattering launch on one machine, and when its tiles run.

    edges: (rings + 1,) distances in texels of level 0.
    """

    scatter: Scatter
    schedule: Schedule
    edges: Floats
    classes: tuple[TileClass, ...]

    @property
    def asked(self) -> float:
        """Sectors asked of the L1."""
        return float(sum(c.asked.sum() for c in self.classes))

    @property
    def missed(self) -> float:
        """Sectors missed in the L1."""
        return float(sum(c.missed.sum() for c in self.classes))


def cost_scatter(
    workload: Workload, scatter: Scatter, machine: Machine, memory: Memory
) -> ScatterCost:
    """Schedule the tiles of a launch, class them, and draw what the reads of each class cost."""
    launch = next(w for w in workload.launches if w.launch == scatter.launch)
    works = scatter.samples > 0
    accesses = scatter.steps * float(len(scatter.reads)) + _IDLE_ACCESSES
    sms = machine.gpu.sm.count
    units = machine.levels[0].instances // sms
    places = machine.resident(launch)
    schedule = dispatch(accesses, works, sms, places, units)
    edges = _ring_edges(workload, scatter)
    working = np.flatnonzero(works)
    if not len(working):
        return ScatterCost(scatter, schedule, edges, ())
    values = np.column_stack(
        [scatter.texels_per_mm[working], scatter.samples[working] / scatter.pixels[working]]
    )
    code = np.round(np.log2(np.maximum(values, 1e-6)) * _PER_OCTAVE)
    codes, of_working = np.unique(code, axis=0, return_inverse=True)
    group = np.zeros(len(works), np.int64)
    group[working] = of_working.ravel()
    drawn = _Drawing(workload, scatter, machine, memory, schedule, group, places, edges)
    counts = drawn.draw(len(codes))
    classes = []
    for k in range(len(codes)):
        tiles = working[of_working.ravel() == k]
        # A class that was not drawn costs what the nearest that was does.
        has = counts.drawn > 0
        away = np.where(has, np.abs(codes - codes[k]).sum(axis=1), np.inf)
        nearest = int(np.argmin(away))
        factor = float(scatter.samples[tiles].sum()) / max(float(counts.drawn[nearest]), 1.0)
        turns = float(scatter.steps[tiles].mean()) / max(launch.warps_per_cta, 1)
        found = (part[nearest] * factor for part in (counts.lanes, counts.asked, counts.missed))
        classes.append(TileClass(tiles, max(turns, 1.0), *found))
    return ScatterCost(scatter, schedule, edges, tuple(classes))


def _ring_edges(workload: Workload, scatter: Scatter) -> Floats:
    """Rings of distances: the first ends at 2 texels, the last holds whatever is beyond it."""
    scale = float(scatter.texels_per_mm.max(initial=1e-3))
    if scatter.taps_mm:
        furthest = max(abs(tap) for tap in scatter.taps_mm) * scale
    else:
        furthest = float(workload.optics.radii(np.array(0.9995), scale))
    edges = np.geomspace(2.0, max(furthest, 8.0), NUM_RINGS)
    return np.concatenate([[0.0], edges])


def _rule(optics: Optics, workload: Workload) -> Rule:
    kind = {"mip0": 0, "eq-5.12": 1, "textbook": 2}[optics.mip_rule]
    assert optics.mip_rule in MIP_RULES
    if kind == 1:
        damping = MIP_DAMPING * workload.width * workload.height / optics.dmfp_mm**2
    else:
        damping = 1.0 / (2.0 * np.pi)
    return Rule(
        kind if optics.num_levels > 1 else 0,
        optics.d_mm,
        APPROXIMATE_C,
        damping,
        min(optics.num_levels, MAX_LEVEL + 1),
    )


@dataclass(frozen=True, eq=False)
class _Drawing:
    """Draws the reads of a launch."""

    workload: Workload
    scatter: Scatter
    machine: Machine
    memory: Memory
    schedule: Schedule
    group: Ints
    places: int
    edges: Floats

    def draw(self, num_classes: int) -> Counts:
        """Walk some windows of the launch."""
        shape = (num_classes, len(self.scatter.reads), MAX_LEVEL + 1, len(self.edges) - 1)
        counts = Counts(np.zeros(num_classes, np.int64), *(np.zeros(shape, np.int64) for _ in "123"))
        reads, rule = self._reads(), _rule(self.workload.optics, self.workload)
        taps = np.asarray(self.scatter.taps_mm, np.float64)
        cache, access = self._cache(), 0
        for seed, (tiles, warm, to_end) in enumerate(self._windows()):
            for array in (cache.valid, cache.held):
                array.fill(0)
            self._empty(cache)
            access = walk(
                self._tiles(tiles), reads, rule, taps, _AXES[self.scatter.direction], cache,
                self.places, self.machine.gpu.sm.warp_size, self.edges, warm, to_end,
                _SEED + seed, access, counts,
            )  # fmt: skip
        return counts

    def _windows(self) -> Iterator[tuple[Ints, bool, bool]]:
        """Tiles of one SM in the order that it takes them; whether the L1 is to be warmed first,
        and whether the last of them ends the launch.
        """
        units = self.machine.levels[0].instances // self.machine.gpu.sm.count
        sm = self.schedule.unit // units
        working = np.flatnonzero(self.scatter.samples > 0)
        order = working[np.lexsort((working, self.schedule.start[working], sm[working]))]
        per_sm = np.split(order, np.flatnonzero(np.diff(sm[order])) + 1)
        per_tile = float(self.scatter.samples[working].mean()) * len(self.scatter.reads)
        longest = max(len(tiles) for tiles in per_sm)
        if longest <= _FULL * self.places:
            wanted = max(_MIN_WINDOWS, round(NUM_DRAWN / (longest * per_tile)))
            # Neighbouring SMs hold neighbouring tiles: those chosen lie all over the frame.
            order_of_sms = np.argsort(np.arange(len(per_sm)) * _GOLDEN % 1.0)
            for k in order_of_sms[:wanted]:
                yield per_sm[k], False, True
            return
        # One generation to warm up, at most, and one to count.
        length = 2 * self.places
        wanted = max(_MIN_WINDOWS, round(NUM_DRAWN / (length * per_tile)))
        for k in range(wanted):
            tiles = per_sm[int(((k + 1) * _GOLDEN % 1.0) * len(per_sm))]
            first = int((len(tiles) - length) * (k + 0.5) / wanted)
            first = max(first, 0)
            chosen_tiles = tiles[first : first + length]
            yield chosen_tiles, first > 0, first + length >= len(tiles)

    def _tiles(self, chosen: Ints) -> Tiles:
        s, optics = self.scatter, self.workload.optics
        scale = np.maximum(s.texels_per_mm[chosen], 1e-6)
        start = np.zeros(len(chosen))
        if optics.centre_reweighting and not s.taps_mm:
            reach = 1.0 / (scale * optics.d_mm)
            start = 1.0 - 0.25 * np.exp(-reach) - 0.75 * np.exp(-reach / 3.0)
        return Tiles(
            s.tile_x[chosen] * TILE_SIDE,
            s.tile_y[chosen] * TILE_SIDE,
            s.counts[chosen].astype(np.int64),
            scale,
            start,
            self.group[chosen],
        )

    def _reads(self) -> Reads:
        m, reads = self.memory.placed, self.scatter.reads
        t = [self.memory.index[read.texture] for read in reads]
        levels = slice(0, MAX_LEVEL + 1)
        return Reads(
            m.x_tables, m.y_tables, m.x_start[t, levels], m.y_start[t, levels],
            (m.base[t, levels] - np.uint64(m.base_address)).astype(np.int64), m.low_mask[t],
            m.width[t, levels].astype(np.int64), m.height[t, levels].astype(np.int64),
            np.array([read.follows_mip and not self.scatter.taps_mm for read in reads]),
            np.array([4 if read.bilinear else 1 for read in reads]),
        )  # fmt: skip

    def _cache(self) -> Cache:
        machine, level = self.machine, self.machine.levels[0]
        config = machine.gpu.l1_texture or machine.gpu.l1
        units = level.instances // machine.gpu.sm.count
        num_lines = -(-self.memory.placed.footprint_bytes // level.line_bytes) + 1
        hashed = set_hash(config)
        lines = np.arange(num_lines, dtype=np.uint64)
        lines += np.uint64(self.memory.placed.base_address // level.line_bytes)
        set_of = np.zeros(num_lines, np.uint32)
        set_indices(lines, num_lines, hashed.kind, hashed.size, hashed.table, set_of)
        linked = (units, num_lines + config.num_sets)
        return Cache(
            set_of,
            config.ways,
            level.sectors_per_line,
            level.sector_bytes,
            np.zeros((units, num_lines), np.uint8),
            np.zeros(linked, np.int32),
            np.zeros(linked, np.int32),
            np.zeros((units, config.num_sets), np.int32),
            np.zeros(num_lines * level.sectors_per_line, np.int64),
        )

    def _empty(self, cache: Cache) -> None:
        """Every set's list holds its own entry alone."""
        own = np.arange(cache.valid.shape[1], cache.newer.shape[1], dtype=np.int32)
        cache.newer[:, own] = own
        cache.older[:, own] = own
