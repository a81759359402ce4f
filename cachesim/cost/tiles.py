"""S(m) on the way to the L2: what the samples of each tile ask of the L1, and what they miss there.

A read's cost depends on what the warp's other lanes ask, on the tiles that share its L1 and on how
long lines last there, for which there is no closed form. It is drawn instead (`walk`): for some SMs
and some times of a launch, whose tiles `dispatch` tells, made-up samples of those tiles go through
one L1. What a read of a class of tiles asks and misses there, on average, is taken for all reads of
the class.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cachesim.cost.dispatch import Schedule, dispatch
from cachesim.cost.drawing import Drawing
from cachesim.cost.machine import Machine
from cachesim.cost.memory import Memory
from cachesim.cost.workload import Floats, Ints, LaunchWork, Scatter, Workload

NUM_RINGS = 24
#: Classes of tiles per doubling of the scale and of the count.
_PER_OCTAVE = np.array([1.0, 2.0])


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
    drawn = Drawing(workload, scatter, machine, memory, schedule, group, places, edges, beside)
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
