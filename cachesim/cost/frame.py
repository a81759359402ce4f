"""A frame in steps: what reaches the cache behind the L1, where in the frame and when.

The frame is cut into cells of whole tiles and its launches into steps. In each step, each cell of
each texture level gets some bytes of scattered reads, the L1's misses spread around the tiles that
run, and is swept in part by the accesses that go pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cachesim.cost.machine import Machine
from cachesim.cost.memory import Memory
from cachesim.cost.tiles import ScatterCost
from cachesim.cost.workload import TILE_SIDE, Floats, Ints, Sweep, Workload

MAX_CELLS_ACROSS = 24
SCATTER_STEPS = 24
SWEEP_STEPS = 4
_RING_POINTS = 36


@dataclass(frozen=True)
class Swept:
    """Part of a sweep. field: the texture level. requests_bytes: asked for, a sector as often as
    CTAs share it. distinct: (cells,) bytes of different sectors.
    """

    field: int
    is_store: bool
    requests_bytes: float
    distinct: Floats


@dataclass(eq=False)
class Step:
    """Some time of a launch. scattered: field -> (cells,) bytes that go on behind the L1s, and
    behind the level that some SMs share where there is one.
    """

    launch: int
    scattered: dict[int, Floats] = field(default_factory=dict)
    swept: list[Swept] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Frame:
    """The steps of a frame. size: (fields, cells) bytes. l1_accesses: bytes asked of the L1."""

    size: Floats
    steps: tuple[Step, ...]
    l1_swept_bytes: float


class Cells:
    """The cells of a frame. across, down: their number. side: texels of one."""

    def __init__(self, workload: Workload) -> None:
        tiles = -(-workload.width // TILE_SIDE)
        per_cell = -(-tiles // MAX_CELLS_ACROSS)
        self.side = per_cell * TILE_SIDE
        self.across = -(-workload.width // self.side)
        self.down = -(-workload.height // self.side)
        x = np.clip(workload.width - np.arange(self.across) * self.side, 0, self.side)
        y = np.clip(workload.height - np.arange(self.down) * self.side, 0, self.side)
        #: (cells,) share of the frame in each cell.
        self.share: Floats = np.outer(y, x).ravel() / (workload.width * workload.height)
        self.num = self.across * self.down

    def of_tiles(self, x: Ints, y: Ints) -> Ints:
        """Cells of tiles."""
        column, row = x * TILE_SIDE // self.side, y * TILE_SIDE // self.side
        cells: Ints = row * self.across + column
        return cells

    def rows(self, begin: float, end: float) -> Floats:
        """(cells,) share of each cell that a raster scan covers between two moments of [0, 1]."""
        row = np.arange(self.down)
        covered = np.clip(np.minimum(end * self.down, row + 1) - np.maximum(begin * self.down, row),
                          0, 1)  # fmt: skip
        return np.repeat(covered, self.across)


def asked_bytes(sweep: Sweep, memory: Memory, block: tuple[int, int]) -> float:
    """Bytes of the sectors that a sweep asks for, a block at a time. Where a row has only some of
    its lanes, it asks for a part of its sectors.
    """
    blocks = sweep.rows * 32.0 / (block[0] * block[1])
    filled = min(1.0, sweep.lane_fetches / (32.0 * sweep.rows))
    sectors = memory.row_sectors(sweep, block) * float(np.sqrt(filled))
    return blocks * sectors * memory.sector_bytes


def build_frame(
    workload: Workload,
    costs: Sequence[ScatterCost],
    machine: Machine,
    memory: Memory,
) -> Frame:
    """The steps of a frame on a machine. costs: of the workload's scatters."""
    cells = Cells(workload)
    fields: dict[tuple[str, int], int] = {}
    sizes: list[float] = []

    def field_of(texture: str, mip: int) -> int:
        key = texture, mip
        if key not in fields:
            fields[key] = len(fields)
            sizes.append(memory.level_bytes(texture, mip))
        return fields[key]

    scattering = np.zeros(cells.num)
    for scatter in workload.scatters:
        there = cells.of_tiles(scatter.tile_x, scatter.tile_y)
        scattering = np.maximum(scattering, np.bincount(there, scatter.pixels, cells.num))
    steps: list[Step] = []
    l1_swept = 0.0
    for launch in workload.launches:
        cost = next((c for c in costs if c.scatter.launch == launch.launch), None)
        num_steps = SWEEP_STEPS if cost is None else SCATTER_STEPS
        held = [Step(launch.launch) for _ in range(num_steps)]
        if cost is not None:
            for (texture, level), arrivals in _arrivals(cost, cells).items():
                index = field_of(texture, level)
                for step, bytes_there in zip(held, arrivals, strict=True):
                    step.scattered[index] = bytes_there
        for sweep in (s for s in workload.sweeps if s.launch == launch.launch):
            index = field_of(sweep.texture, sweep.mip)
            l1_swept += _add_sweep(
                sweep, index, sizes[index], held, cells, scattering, machine, memory
            )
        steps += held
    return Frame(np.outer(sizes, cells.share), tuple(steps), l1_swept)


def _add_sweep(
    sweep: Sweep,
    index: int,
    size: float,
    steps: Sequence[Step],
    cells: Cells,
    scattering: Floats,
    machine: Machine,
    memory: Memory,
) -> float:
    """Put a sweep into the steps of its launch; the bytes that it asks of the L1."""
    asked = asked_bytes(sweep, memory, machine.warp_shape)
    is_store = sweep.operation != "load"
    # Warps of a CTA share what they read; stores pass one by one.
    requests = asked if is_store else asked_bytes(sweep, memory, (TILE_SIDE, TILE_SIDE))
    everywhere = sweep.lane_fetches >= 0.98 * min(sweep.width * sweep.height, 32 * sweep.rows)
    everywhere = everywhere and sweep.lane_fetches >= 0.2 * sweep.width * sweep.height
    where = cells.share if everywhere or not scattering.any() else scattering / scattering.sum()
    touched = min(
        requests, size, sweep.rows * 32.0 * sweep.texel_bytes * (4 if sweep.bilinear else 1)
    )
    for k, step in enumerate(steps):
        part = cells.rows(k / len(steps), (k + 1) / len(steps)) * where
        distinct = np.minimum(touched * part, size * cells.share)
        step.swept.append(Swept(index, is_store, requests * float(part.sum()), distinct))
    return asked if machine.levels[0].takes_stores or not is_store else 0.0


def _arrivals(cost: ScatterCost, cells: Cells) -> dict[tuple[str, int], Floats]:
    """(texture, level) -> (steps, cells) bytes that go on."""
    plan, scatter = cost.schedule, cost.scatter
    finish = float(plan.end.max()) or 1.0
    edges = np.linspace(0.0, finish, SCATTER_STEPS + 1)
    shape = (2 * cells.down, 2 * cells.across)
    found: dict[tuple[str, int], Floats] = {}
    for of_class in cost.classes:
        tiles = of_class.tiles
        start, end = plan.start[tiles], plan.end[tiles]
        at = cells.of_tiles(scatter.tile_x[tiles], scatter.tile_y[tiles])
        sources = np.zeros((SCATTER_STEPS, *shape))
        for k in range(SCATTER_STEPS):
            overlap = np.minimum(end, edges[k + 1]) - np.maximum(start, edges[k])
            weight = np.maximum(overlap, 0.0) / np.maximum(end - start, 1e-12)
            there = np.bincount(at, weight, cells.num).reshape(cells.down, cells.across)
            sources[k, : cells.down, : cells.across] = there
        moved = np.fft.rfft2(sources)
        for read, by_level in zip(
            scatter.reads, of_class.passed / len(of_class.tiles), strict=True
        ):
            for level, missed in enumerate(by_level):
                total = float(missed.sum())
                if total <= 0.0:
                    continue
                kernel = np.fft.rfft2(_kernel(cost.edges, missed, cells, shape, scatter.direction))
                spread_out = np.fft.irfft2(moved * kernel, s=shape)[:, : cells.down, : cells.across]
                spread_out = np.maximum(spread_out, 0.0).reshape(SCATTER_STEPS, -1)
                weights = sources.sum(axis=(1, 2))
                # What would fall outside the frame was left out before: the sum stays.
                scale = total * weights / np.maximum(spread_out.sum(axis=1), 1e-12)
                key = read.texture, level
                found[key] = found.get(key, 0.0) + spread_out * scale[:, None]
    return found


def _kernel(
    edges: Floats, weight: Floats, cells: Cells, shape: tuple[int, int], direction: str
) -> Floats:
    """Share of a tile's misses by how many cells they lie away, wrapped as FFTs have it."""
    turn = np.arange(_RING_POINTS)
    angle = 2.0 * np.pi * (turn * 0.6180339887498949 % 1.0)
    if direction != "around":
        angle = np.pi * (turn % 2 + (0.5 if direction == "y" else 0.0))
    part = (turn + 0.5) / _RING_POINTS
    inner, outer = edges[:-1, None] ** 2, edges[1:, None] ** 2
    radius = np.sqrt(inner + (outer - inner) * part)
    # The tile lies anywhere in its cell.
    within_x, within_y = turn * 0.7548776662466927 % 1.0, turn * 0.5698402909980532 % 1.0
    column = np.floor(radius * np.cos(angle) / cells.side + within_x).astype(np.int64)
    row = np.floor(radius * np.sin(angle) / cells.side + within_y).astype(np.int64)
    column = np.clip(column, -cells.across + 1, cells.across - 1) % shape[1]
    row = np.clip(row, -cells.down + 1, cells.down - 1) % shape[0]
    mass = np.repeat(weight / _RING_POINTS, _RING_POINTS)
    flat = np.bincount((row * shape[1] + column).ravel(), mass, shape[0] * shape[1])
    kernel: Floats = flat.reshape(shape) / max(float(weight.sum()), 1e-300)
    return kernel
