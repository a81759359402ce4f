"""A recording's workload: tiles, counts and steps exactly as recorded, the scale by the samples'
distances.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from cachesim.cost.scales import NEAR_SHARE, find_scales
from cachesim.cost.workload import (
    TILE_SIDE,
    Floats,
    Ints,
    LaunchWork,
    Optics,
    Read,
    Scatter,
    Sweep,
    Workload,
    taps_mm,
)
from traces.errors import InputError
from traces.texture import INACTIVE_TEXEL
from traces.trace import WAIT, Chunk, Trace, warp_of_rows

#: The passes whose pixels read around themselves, and along which line.
DIRECTIONS = {"sampling": "around", "pilot": "around", "separable_h": "x", "separable_v": "y"}
#: Lanes of a tile whose distances are looked at.
_MAX_DISTANCES = 4096
_SIDE_BITS = 14


def measure_workload(trace: Trace, where: str = "trace") -> Workload:
    """Read a recording once and describe it.

    where: the trace's name, for messages.

    Raises:
        InputError: a trace of byte addresses, or one that no method of ours made, or without a pass
            that scatters.
    """
    if trace.is_lane_address:
        raise InputError(f"{where}: a trace of byte addresses: the cost function needs texels")
    method = trace.manifest.get("method")
    width, height = trace.manifest.get("width"), trace.manifest.get("height")
    if not isinstance(method, dict) or not isinstance(width, int) or not isinstance(height, int):
        raise InputError(f"{where}: manifest: needs method, width and height, as recordings have")
    num_levels = max(t.num_mips for t in trace.textures)
    optics = Optics.of_method(method, num_levels, f"{where}: manifest")
    launches: dict[int, _Launch] = {}
    for chunk in trace.chunks():
        if chunk.launch not in launches:
            launches[chunk.launch] = _Launch(trace, chunk.launch, width, height)
        launches[chunk.launch].add(chunk)
    measured = [launches[k] for k in sorted(launches)]
    scatters = tuple(
        s for s in (launch.scatter(optics, method) for launch in measured) if s is not None
    )
    if not scatters:
        raise InputError(
            f"{where}: no pass that scatters is recorded; need one of {', '.join(DIRECTIONS)}"
        )
    return Workload(
        str(trace.manifest.get("scene", where)),
        width,
        height,
        optics,
        tuple(trace.textures),
        scatters,
        tuple(sweep for launch in measured for sweep in launch.sweeps()),
        tuple(launch.work() for launch in measured),
    )


@dataclass(eq=False)
class _Tiles:
    """What is known of the tiles of some CTAs, per CTA in order."""

    x: Ints
    y: Ints
    counts: Ints
    distance: Floats


@dataclass(eq=False)
class _Launch:
    """What the chunks of one launch have shown so far."""

    trace: Trace
    index: int
    width: int
    height: int
    rows: npt.NDArray[np.int64] = field(init=False)
    lanes: npt.NDArray[np.int64] = field(init=False)
    loop: set[int] = field(default_factory=set)
    tiles: list[_Tiles] = field(default_factory=list)

    def __post_init__(self) -> None:
        shape = (len(self.trace.instructions), 16)
        self.rows, self.lanes = np.zeros(shape, np.int64), np.zeros(shape, np.int64)

    @property
    def pass_name(self) -> str:
        return self.trace.launches[self.index].pass_name

    def add(self, chunk: Chunk) -> None:
        """Take a chunk of the launch."""
        lanes, instruction = np.asarray(chunk.lanes), chunk.instruction.astype(np.int64)
        active = lanes != INACTIVE_TEXEL
        found = np.zeros(len(instruction), np.bool_)
        if self.pass_name in DIRECTIONS:
            found = self._add_tiles(chunk, lanes, active)
        rest = np.flatnonzero(~found & active.any(axis=1))
        # A row that goes over the frame has one level; its first active lane tells which.
        first = lanes[rest, active[rest].argmax(axis=1)] >> np.uint32(28)
        np.add.at(self.rows, (instruction[rest], first), 1)
        np.add.at(self.lanes, (instruction[rest], first), active[rest].sum(axis=1))
        scattered = np.flatnonzero(found)
        np.add.at(self.rows[:, 15], instruction[scattered], 1)

    def _add_tiles(
        self, chunk: Chunk, lanes: npt.NDArray[Any], active: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.bool_]:
        """Take the tiles of a chunk; (num_rows,) bool: the rows of the sample loop."""
        instructions = self.trace.instructions
        warp, index = warp_of_rows(chunk), chunk.instruction.astype(np.int64)
        is_store = np.array([i.operation == "store" for i in instructions])[index]
        own = np.full((chunk.num_warps, lanes.shape[1]), INACTIVE_TEXEL, np.uint32)
        stores = np.flatnonzero(is_store)
        own[warp[stores]] = lanes[stores]
        dx, dy, level = _offsets(lanes, own[warp])
        away = active & ((dx != 0) | (dy != 0) | (level > 0))
        self.loop |= self._loop_instructions(index, warp, away.any(axis=1) & ~is_store)
        in_loop = np.isin(index, sorted(self.loop))
        warps_per_cta = self.trace.launches[self.index].warps_per_cta
        cta, num_ctas = warp // warps_per_cta, chunk.num_warps // warps_per_cta
        counted = np.flatnonzero(np.isin(index, self._counted()))
        turns = np.zeros((chunk.num_warps, lanes.shape[1]), np.int64)
        np.add.at(turns, warp[counted], active[counted])
        inside = (own != INACTIVE_TEXEL).reshape(num_ctas, -1)
        lane = inside.argmax(axis=1)
        pixel = own.reshape(num_ctas, -1)[np.arange(num_ctas), lane].astype(np.int64)
        side = (1 << _SIDE_BITS) - 1
        on_screen = inside.any(axis=1)
        self.tiles.append(
            _Tiles(
                np.where(on_screen, (pixel & side) // TILE_SIDE, 0),
                np.where(on_screen, (pixel >> _SIDE_BITS & side) // TILE_SIDE, 0),
                turns.reshape(num_ctas, -1),
                self._distances(cta[counted], dx[counted], dy[counted], active[counted], num_ctas),
            )
        )
        return in_loop

    def _loop_instructions(self, index: Ints, warp: Ints, away: npt.NDArray[np.bool_]) -> set[int]:
        """The loop's instructions: those that a warp executes again, and those of their textures
        that read away from their pixels, the loop's first turn.
        """
        instructions = self.trace.instructions
        code, times = np.unique(warp * len(instructions) + index, return_counts=True)
        again = set((code[times > 1] % len(instructions)).tolist())
        displaced = set(np.unique(index[away]).tolist())
        if not again:
            return {i for i in displaced if "history" not in self._texture_name(i)}
        textures = {instructions[i].texture for i in again}
        return again | {i for i in displaced if instructions[i].texture in textures}

    def _texture_name(self, instruction: int) -> str:
        return self.trace.textures[self.trace.instructions[instruction].texture].name

    def _counted(self) -> list[int]:
        """The loop's instructions of one texture, at full resolution where there is one."""
        textures = {self.trace.instructions[i].texture for i in self.loop}
        if not textures:
            return []
        chosen = min(textures, key=lambda t: (self.trace.textures[t].num_mips, t))
        return [i for i in self.loop if self.trace.instructions[i].texture == chosen]

    def _distances(
        self, cta: Ints, dx: Floats, dy: Floats, active: npt.NDArray[np.bool_], num_ctas: int
    ) -> Floats:
        """(num_ctas, 2) of a tile's samples in texels: the mean distance and the distance of
        `NEAR_SHARE` of them; 0 where there are none.
        """
        found = np.zeros((num_ctas, 2))
        for tile in np.unique(cta):
            rows = slice(*np.searchsorted(cta, [tile, tile + 1]))
            chosen = active[rows]
            if self.pass_name in ("separable_h", "separable_v"):
                # The coordinate of a bilinear read is half a texel before its middle.
                along = dx if self.pass_name == "separable_h" else dy
                found[tile] = np.abs(along[rows][chosen] + 0.5).mean()
            else:
                away = np.hypot(dx[rows][chosen], dy[rows][chosen])[:_MAX_DISTANCES]
                found[tile] = away.mean(), np.quantile(away, NEAR_SHARE)
        return found

    def scatter(self, optics: Optics, method: dict[str, Any]) -> Scatter | None:
        """The launch as a scattering one; None where it is none, or nothing scattered."""
        if not self.tiles or not self.loop:
            return None
        joined = {
            name: np.concatenate([getattr(t, name) for t in self.tiles])
            for name in ("x", "y", "counts", "distance")
        }
        direction, counts = DIRECTIONS[self.pass_name], joined["counts"]
        taps = () if direction == "around" else taps_mm(method)
        if taps:
            scale = joined["distance"][:, 0] / np.mean(np.abs(taps))
        else:
            scale = find_scales(optics, joined, self.width, self.height)
        textures = dict.fromkeys(self.trace.instructions[i].texture for i in sorted(self.loop))
        described = [(self.trace.textures[t], t) for t in textures]
        reads = tuple(
            Read(
                texture.name,
                texture.texel_bytes,
                texture.num_mips > 1,
                any(
                    self.trace.instructions[i].footprint == "bilinear"
                    for i in self.loop
                    if self.trace.instructions[i].texture == t
                ),
            )
            for texture, t in described
        )
        return Scatter(
            self.pass_name,
            direction,
            joined["x"],
            joined["y"],
            np.where(counts > 0, len(taps), 0) if taps else counts,
            np.where(counts.any(axis=1), scale, 0.0),
            reads,
            taps,
            self.index,
            int(counts.sum()),
        )

    def sweeps(self) -> list[Sweep]:
        """The accesses that go over the frame."""
        found: dict[tuple[Any, ...], list[int]] = {}
        for index, mip in zip(*np.nonzero(self.rows[:, :15]), strict=True):
            instruction = self.trace.instructions[index]
            key = (instruction.texture, mip, instruction.operation, instruction.footprint)
            held = found.setdefault(key, [0, 0])
            held[0] += int(self.rows[index, mip])
            held[1] += int(self.lanes[index, mip])
        sweeps = []
        for (texture, mip, operation, footprint), (rows, lanes) in found.items():
            described = self.trace.textures[texture]
            sweeps.append(
                Sweep(
                    self.pass_name,
                    described.name,
                    described.texel_bytes,
                    int(mip),
                    described.mip_size(int(mip))[0],
                    described.mip_size(int(mip))[1],
                    operation,
                    footprint == "bilinear",
                    rows,
                    lanes,
                    self.index,
                )
            )
        return sweeps

    def work(self) -> LaunchWork:
        """What the launch issues."""
        launch = self.trace.launches[self.index]
        rows = self.rows.sum(axis=1)
        arithmetic = np.array([_issued(i.arithmetic) for i in self.trace.instructions])
        trailing = _issued(launch.trailing_arithmetic) * launch.num_ctas * launch.warps_per_cta
        return LaunchWork(
            self.index,
            launch.pass_name,
            launch.num_ctas,
            launch.warps_per_cta,
            launch.registers_per_thread,
            launch.shared_bytes_per_cta,
            int(rows @ (arithmetic + 1)) + trailing,
            int(rows.sum()),
        )


def _issued(arithmetic: tuple[tuple[str, int], ...]) -> int:
    """Warp instructions of an arithmetic list; waits issue nothing."""
    return sum(count for kind, count in arithmetic if kind != WAIT)


def _offsets(texels: npt.NDArray[Any], own: npt.NDArray[Any]) -> tuple[Floats, Floats, Ints]:
    """(x, y) of texels from their lanes' own pixels, in texels of level 0, and the level."""
    side = np.int64((1 << _SIDE_BITS) - 1)
    texel, pixel = texels.astype(np.int64), own.astype(np.int64)
    level = texel >> 28
    size = np.left_shift(1, np.minimum(level, 15)).astype(np.float64)
    middle = (size - 1.0) / 2.0
    x = (texel & side) * size + middle - (pixel & side)
    y = (texel >> _SIDE_BITS & side) * size + middle - (pixel >> _SIDE_BITS & side)
    return x, y, level


__all__ = ["DIRECTIONS", "measure_workload"]
