"""Which tiles of a launch are walked, and with what: the windows, the textures and the caches.

A launch that is short is walked from its start to its end, on some of its SMs. Of a longer one some
moments are taken, on some SMs each: the tiles that run then, in the phases that they are in, and
those that follow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cachesim.address import set_hash, set_indices
from cachesim.config import CacheLevel
from cachesim.cost.dispatch import Schedule
from cachesim.cost.lru import Cache
from cachesim.cost.machine import Machine
from cachesim.cost.memory import Memory
from cachesim.cost.walk import Counts, Reads, Rule, Tiles, walk
from cachesim.cost.workload import (
    APPROXIMATE_C,
    MAX_LEVEL,
    MIP_DAMPING,
    TILE_SIDE,
    Floats,
    Ints,
    Optics,
    Scatter,
    Workload,
)

#: Reads of lanes that are drawn for a launch, about; windows that they are drawn in, at least.
NUM_DRAWN = 1_500_000
_MIN_WINDOWS = 3
#: An SM's tiles are walked in full where they are so many times what it holds, or fewer.
_FULL = 3.0
_SEED = 20
_GOLDEN = 0.6180339887498949
_NO_CACHE = Cache(
    np.zeros(0, np.uint32), 0, 1, 1, np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.int32),
    np.zeros((0, 0), np.int32), np.zeros((0, 0), np.int32), np.zeros(0, np.int64),
)  # fmt: skip
_AXES = {"around": 0, "x": 1, "y": 2}


def _rule(optics: Optics, workload: Workload) -> Rule:
    kind = {"mip0": 0, "eq-5.12": 1, "textbook": 2}[optics.mip_rule]
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
class Drawing:
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
