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
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cachesim.address import set_hash, set_indices
from cachesim.config import CacheLevel
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
    LaunchWork,
    Optics,
    Scatter,
    Workload,
)

NUM_RINGS = 24
#: Reads of lanes that are drawn for a launch, about; windows that they are drawn in, at least.
NUM_DRAWN = 1_500_000
_MIN_WINDOWS = 3
#: An SM's tiles are walked in full where they are so many times what it holds, or fewer.
_FULL = 3.0
#: Classes of tiles per doubling of the scale and of the count.
_PER_OCTAVE = np.array([1.0, 2.0])
_SEED = 20
_GOLDEN = 0.6180339887498949
_NO_CACHE = Cache(
    np.zeros(0, np.uint32), 0, 1, 1, np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.int32),
    np.zeros((0, 0), np.int32), np.zeros((0, 0), np.int32), np.zeros(0, np.int64),
)  # fmt: skip
_AXES = {"around": 0, "x": 1, "y": 2}


@dataclass(frozen=True, eq=False)
class TileClass:
    """Tiles of about the same scale and count, and what their reads cost.

    tiles: indices into the scatter. turns: of the loop, of one tile's warps on average. lanes,
    asked, missed: (textures, levels, rings), summed over the tiles: lanes' reads, sectors asked of
    the L1 and missed there. passed: bytes that go on behind the L1s, and behind the level that some
    SMs share where there is one.
    """

    tiles: Ints
    turns: float
    lanes: Floats
    asked: Floats
    missed: Floats
    passed: Floats


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
    beside = _accesses_beside(workload, scatter, launch)
    # A GPU with warps of 64 lanes joins two of a recording.
    by_warp = scatter.counts.reshape(len(works), -1, machine.gpu.sm.warp_size).max(axis=2)
    accesses = by_warp * len(scatter.reads) + np.where(by_warp > 0, beside[1], beside[0])
    sms = machine.gpu.sm.count
    units = machine.levels[0].instances // sms
    places = machine.resident(launch)
    schedule = dispatch(accesses, sms, places, units)
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
    drawn = _Drawing(workload, scatter, machine, memory, schedule, group, places, edges, beside)
    counts = drawn.draw(len(codes))
    classes = []
    for k in range(len(codes)):
        tiles = working[of_working.ravel() == k]
        # A class that was not drawn costs what the nearest that was does.
        has = counts.drawn.all(axis=1)
        away = np.where(has, np.abs(codes - codes[k]).sum(axis=1), np.inf)
        nearest = int(np.argmin(away))
        factor = float(scatter.samples[tiles].sum()) / np.maximum(counts.drawn[nearest], 1)
        turns = float(scatter.steps[tiles].mean()) / max(launch.warps_per_cta, 1)
        lanes, asked, missed, missed_shared = (
            part[nearest] * factor[:, None, None] for part in counts[1:]
        )
        passed = missed * machine.levels[0].sector_bytes
        if machine.shared is not None:
            passed = missed_shared * machine.shared.sector_bytes
        classes.append(TileClass(tiles, max(turns, 1.0), lanes, asked, missed, passed))
    return ScatterCost(scatter, schedule, edges, tuple(classes))


def _accesses_beside(workload: Workload, scatter: Scatter, launch: LaunchWork) -> Ints:
    """(2,) accesses beside the loop of a warp without samples, and of one with; at least 1."""
    by_warp = scatter.counts.reshape(len(scatter.counts), launch.warps_per_cta, -1)
    working = int(np.count_nonzero(by_warp.any(axis=2)))
    every = launch.num_ctas * launch.warps_per_cta
    idle = busy = 0
    for sweep in (s for s in workload.sweeps if s.launch == launch.launch):
        if sweep.rows > working or working == every:
            idle += max(1, round(sweep.rows / every))
            busy += max(1, round(sweep.rows / every))
        else:
            busy += 1
    return np.array([max(idle, 1), max(busy, 1)])


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
class _Window:
    """Some SMs from a moment on. by_sm: tiles of each, in the order that it takes them. moment: as
    in the schedule; where it is not the launch's start, the caches are to be warmed first. to_end:
    the last of the tiles are the launch's last.
    """

    by_sm: list[Ints]
    moment: float
    to_end: bool


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
    beside: Ints

    def draw(self, num_classes: int) -> Counts:
        """Walk some windows of the launch."""
        shape = (num_classes, len(self.scatter.reads), MAX_LEVEL + 1, len(self.edges) - 1)
        counts = Counts(np.zeros(shape[:2], np.int64), *(np.zeros(shape, np.int64) for _ in "1234"))
        reads, rule = self._reads(), _rule(self.workload.optics, self.workload)
        taps = np.asarray(self.scatter.taps_mm, np.float64)
        machine, gpu = self.machine, self.machine.gpu
        sms = self._sms_together()
        units = machine.levels[0].instances // gpu.sm.count
        l1 = self._cache(gpu.l1_texture or gpu.l1, units * sms)
        shared = self._cache(gpu.gl1, 1) if gpu.gl1 is not None else _NO_CACHE
        access = 0
        for seed, window in enumerate(self._windows(sms)):
            for cache in (l1, shared):
                _empty(cache)
            access = walk(
                self._tiles(window), reads, rule, taps, _AXES[self.scatter.direction], l1, shared,
                self.places, gpu.sm.warp_size, self.edges, window.moment > 0.0, window.to_end,
                _SEED + seed, access, counts,
            )  # fmt: skip
        return counts

    def _sms_together(self) -> int:
        """SMs that are walked together: those that share a level."""
        return 1 if self.machine.shared is None else self.machine.shared.sms

    def _windows(self, together: int) -> Iterator[_Window]:
        """The windows of the launch that are drawn, `together` SMs each."""
        units = self.machine.levels[0].instances // self.machine.gpu.sm.count
        sm = self.schedule.unit // units
        order = np.lexsort((np.arange(len(sm)), self.schedule.start, sm))
        edges = np.searchsorted(sm[order], np.arange(self.machine.gpu.sm.count + 1))
        per_sm = [order[a:b] for a, b in pairwise(edges)]
        groups = [per_sm[k : k + together] for k in range(0, len(per_sm), together)]
        samples = self.scatter.samples
        groups = [g for g in groups if any(samples[tiles].any() for tiles in g)]
        per_tile = float(self.scatter.samples.mean()) * len(self.scatter.reads)
        longest = max(len(tiles) for tiles in per_sm)
        if longest <= _FULL * self.places:
            wanted = max(_MIN_WINDOWS, NUM_DRAWN / (longest * per_tile * together))
            # Neighbouring SMs hold neighbouring tiles: those chosen lie all over the frame.
            chosen = np.argsort(np.arange(len(groups)) * _GOLDEN % 1.0)[: round(wanted)]
            for k in chosen:
                yield _Window(groups[k], 0.0, True)
            return
        # What runs at some moment and about twice as much: to warm up and to count.
        length = 3 * self.places
        wanted = max(_MIN_WINDOWS, round(NUM_DRAWN / (length * per_tile * together)))
        start, end, finish = self.schedule.start, self.schedule.end, float(self.schedule.end.max())
        lasts = finish * length * len(per_sm) / len(sm)
        for k in range(wanted):
            group = groups[int(((k + 1) * _GOLDEN % 1.0) * len(groups))]
            moment = max(finish - lasts, 0.0) * (k + 0.5) / wanted
            yield _Window(
                [t[(end[t] > moment) & (start[t] < moment + lasts)] for t in group],
                moment,
                moment + lasts >= finish,
            )

    def _tiles(self, window: _Window) -> Tiles:
        s, optics, chosen = self.scatter, self.workload.optics, np.concatenate(window.by_sm)
        begin, end = self.schedule.start[chosen], self.schedule.end[chosen]
        done = np.clip((window.moment - begin) / np.maximum(end - begin, 1e-9), 0.0, 0.999)
        scale = np.maximum(s.texels_per_mm[chosen], 1e-6)
        start = np.zeros(len(chosen))
        if optics.centre_reweighting and not s.taps_mm:
            reach = 1.0 / (scale * optics.d_mm)
            start = 1.0 - 0.25 * np.exp(-reach) - 0.75 * np.exp(-reach / 3.0)
        return Tiles(
            np.cumsum([0] + [len(tiles) for tiles in window.by_sm]),
            s.tile_x[chosen] * TILE_SIDE,
            s.tile_y[chosen] * TILE_SIDE,
            s.counts[chosen].astype(np.int64),
            scale,
            start,
            self.group[chosen],
            done,
            self.beside,
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

    def _cache(self, config: CacheLevel, units: int) -> Cache:
        placed, line_bytes = self.memory.placed, config.line_bytes
        num_lines = -(-placed.footprint_bytes // line_bytes) + 1
        hashed = set_hash(config)
        lines = np.arange(num_lines, dtype=np.uint64)
        lines += np.uint64(placed.base_address // line_bytes)
        set_of = np.zeros(num_lines, np.uint32)
        set_indices(lines, num_lines, hashed.kind, hashed.size, hashed.table, set_of)
        return _cache(config, units, set_of)


def _cache(config: CacheLevel, units: int, set_of: npt.NDArray[np.uint32]) -> Cache:
    num_lines = len(set_of)
    linked = (units, num_lines + config.num_sets)
    return Cache(
        set_of,
        config.ways,
        config.sectors_per_line,
        config.sector_bytes,
        np.zeros((units, num_lines), np.uint8),
        np.zeros(linked, np.int32),
        np.zeros(linked, np.int32),
        np.zeros((units, config.num_sets), np.int32),
        np.zeros(num_lines * config.sectors_per_line, np.int64),
    )


def _empty(cache: Cache) -> None:
    """Take every line out: each set's list holds its own entry alone."""
    cache.valid.fill(0)
    cache.held.fill(0)
    own = np.arange(cache.valid.shape[1], cache.newer.shape[1], dtype=np.int32)
    cache.newer[:, own] = own
    cache.older[:, own] = own
