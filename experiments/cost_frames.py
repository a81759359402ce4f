"""A scene's workload for the cost function: the G-buffer and the estimator's counts, no recording.

The counts m' = f(m, sigma_0^2) come from rendering the frames before, as the estimator needs them;
everything else is known beforehand: which accesses each pass makes, for which pixels, and how much
arithmetic stands between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cachesim.cost.measure import DIRECTIONS
from cachesim.cost.workload import (
    LaunchWork,
    Optics,
    Read,
    Scatter,
    Sweep,
    Workload,
    taps_mm,
)
from traces.errors import InputError
from traces.trace import WAIT

if TYPE_CHECKING:
    from kernels.access import Access, Program
    from kernels.frame import Scene
    from kernels.gbuffer import GBuffer
    from kernels.grid import Grid
    from kernels.launches import Step
    from kernels.method import Method
    from kernels.opencl.device import Device


def scene_workload(
    scene: Scene, method: Method, num_frames: int = 1, device: Device | None = None
) -> Workload:
    """Describe the last of some frames of a scene.

    Args:
        scene, method, num_frames, device: as `kernels.record.record` takes them.

    Raises:
        InputError: a method whose samples come from local memory, or num_frames below 1.
    """
    from kernels.frame import advance, check_num_frames, gbuffer_of, start_pipeline
    from kernels.resources import count_levels, textures

    check_num_frames(num_frames)
    if method.lds:
        raise InputError("method: lds True: the cost function has no model of the local patch")
    pipeline = start_pipeline(scene, method, device)
    for frame in range(num_frames):
        advance(pipeline, scene, frame)
    gbuffer, frame = gbuffer_of(scene, num_frames - 1), num_frames - 1
    counts = pipeline.read("scattered")[..., 3].astype(np.int64)
    width, height = gbuffer.width, gbuffer.height
    num_levels = count_levels(width, height, method)
    described = {t.name: t for t in textures(width, height, num_levels)}
    optics = Optics.of_method(method.as_dict(), num_levels)
    maker = _Maker(gbuffer, method, optics, counts, described)
    for listed in (pipeline.listed(step) for step in pipeline.steps):
        if method.hybrid and listed.pass_name == "sampling":
            maker.leave_to_sampling(listed.grid)
    for step in pipeline.steps:
        listed = pipeline.listed(step)
        if listed.grid.num_ctas and step.pass_name in method.passes:
            maker.add(listed, listed.program(method, frame))
    return Workload(
        gbuffer.name,
        width,
        height,
        optics,
        tuple(described.values()),
        tuple(maker.scatters),
        tuple(maker.sweeps),
        tuple(maker.launches),
    )


class _Maker:
    """Collects the launches of a frame."""

    def __init__(
        self,
        gbuffer: GBuffer,
        method: Method,
        optics: Optics,
        counts: Any,
        textures: dict[str, Any],
    ) -> None:
        self.gbuffer, self.method, self.optics = gbuffer, method, optics
        self.counts, self.textures = counts, textures
        self.scatters: list[Scatter] = []
        self.sweeps: list[Sweep] = []
        self.launches: list[LaunchWork] = []
        self.sampled = 0, 0

    def leave_to_sampling(self, grid: Grid) -> None:
        """The classify pass writes no result for the tiles that are sampled: those of this grid."""
        inside = grid.inside.any(axis=1)
        self.sampled = int(np.count_nonzero(inside)), int(np.count_nonzero(grid.inside))

    def add(self, step: Step, program: Program) -> None:
        """Take one launch."""
        grid, number = step.grid, len(self.launches)
        turns, samples, pixels, counts = self._loop(step)
        inside = int(np.count_nonzero(grid.inside.any(axis=1)))
        is_level = step.pass_name == "prefilter"
        scattering = np.zeros(grid.num_warps, np.bool_)
        if not is_level:
            scattering = (self._scattering(grid)).any(axis=1)
        rows = {
            True: int(np.count_nonzero(scattering)),
            False: inside,
        }
        lanes = {True: int(pixels.sum()), False: int(np.count_nonzero(grid.inside))}
        loop = [a for a in program.accesses if a.in_loop]
        in_launch: dict[tuple[Any, ...], list[int]] = {}
        instructions = accesses = 0
        for access in program.accesses:
            if access.in_loop:
                num = int(turns.sum())
                instructions += num * (1 + _issued(access.arithmetic))
                if access.first is not None:
                    more = _issued(access.first) - _issued(access.arithmetic)
                    instructions += rows[True] * more
                accesses += num
                if step.pass_name in DIRECTIONS:
                    continue
                held = (num, int(samples.sum()))
            else:
                num = rows[access.subsurface_only]
                instructions += num * (1 + _issued(access.arithmetic))
                if access.scattering is not None:
                    more = _issued(access.scattering) - _issued(access.arithmetic)
                    instructions += rows[True] * more
                accesses += num
                held = (num, lanes[access.subsurface_only])
                if step.pass_name == "classify" and access.texture in ("tile_class", "scattered"):
                    # A texel per tile; and the light of what is not sampled.
                    per_tile = access.texture == "tile_class"
                    taken = (num - grid.num_ctas, held[1] - grid.num_ctas)
                    fewer = taken if per_tile else self.sampled
                    instructions -= fewer[0] * (1 + _issued(access.arithmetic))
                    accesses -= fewer[0]
                    held = (num - fewer[0], held[1] - fewer[1])
            mip = step.level + (access.operation == "store") if is_level else 0
            key = access.texture, mip, access.operation, access.footprint
            kept = in_launch.setdefault(key, [0, 0])
            kept[0], kept[1] = kept[0] + held[0], kept[1] + held[1]
        for (texture, mip, operation, footprint), (num, fetches) in in_launch.items():
            if num:
                self.sweeps.append(
                    Sweep(
                        step.pass_name,
                        texture,
                        self.textures[texture].texel_bytes,
                        mip,
                        self.textures[texture].mip_size(mip)[0],
                        self.textures[texture].mip_size(mip)[1],
                        operation,
                        footprint == "bilinear",
                        num,
                        fetches,
                        number,
                    )
                )
        if loop and step.pass_name in DIRECTIONS:
            self.scatters.append(self._scatter(step, grid, loop, counts, number))
        warps = grid.num_warps // grid.num_ctas
        instructions += _issued(program.trailing_arithmetic) * grid.num_warps
        self.launches.append(
            LaunchWork(
                number,
                step.pass_name,
                grid.num_ctas,
                warps,
                program.registers_per_thread,
                program.shared_bytes,
                instructions,
                accesses,
            )
        )

    def _scattering(self, grid: Grid) -> Any:
        """(num_warps, 32) bool: the lanes whose pixels scatter."""
        return grid.gather(self.gbuffer.subsurface).astype(np.bool_) & grid.inside

    def _loop(self, step: Step) -> tuple[Any, Any, Any, Any]:
        """(num_warps,) turns of the loop, samples and scattering pixels; (num_warps, 32) counts."""
        from kernels.passes import taa

        grid = step.grid
        if step.pass_name == "prefilter":
            none = np.zeros(grid.num_warps, np.int64)
            return none, none, none, none
        scatters = self._scattering(grid)
        pixels = scatters.sum(axis=1)
        if step.pass_name == "sampling":
            counts = np.where(scatters, grid.gather(self.counts), 0)
        else:
            each = {
                "pilot": self.method.num_pilots,
                "separable_h": self.method.num_taps - 1,
                "separable_v": self.method.num_taps - 1,
                "taa": taa.NUM_STEPS,
            }.get(step.pass_name, 0)
            shown = grid.inside if step.pass_name == "taa" else scatters
            counts = np.where(shown, each, 0)
        return counts.max(axis=1), counts.sum(axis=1), pixels, counts

    def _read_samples(
        self, grid: Grid, direction: str, taps: Sequence[float], counts: Any, scale: Any
    ) -> int:
        """Samples that are read: a filter's taps beyond the frame are not. scale: (num_warps, 32)
        texels per mm.
        """
        if not taps:
            return int(counts.sum())
        vertical = direction == "y"
        limit = grid.height if vertical else grid.width
        middle = grid.lanes[1 if vertical else 0] + 0.5
        inside = 0
        for tap in taps:
            at = middle + tap * scale
            inside += int(np.count_nonzero((counts > 0) & (at >= 0.0) & (at < limit)))
        return inside

    def _scatter(
        self,
        step: Step,
        grid: Grid,
        loop: Sequence[Access],
        counts: Any,
        number: int,
    ) -> Scatter:
        direction = DIRECTIONS[step.pass_name]
        taps = () if direction == "around" else taps_mm(self.method.as_dict())
        # Facts sheet 2.5: pixels per mm at a depth.
        step_mm = 1.0 / 6.0 if self.method.scale == "legacy" else 0.05
        per_mm = step_mm * self.gbuffer.width * self.gbuffer.projection_x
        scatters = self._scattering(grid)
        depth = np.where(scatters, grid.gather(self.gbuffer.depth_cm), 1.0)
        scale = np.where(scatters, per_mm / depth, 0.0)
        num_pixels = scatters.reshape(grid.num_ctas, -1).sum(axis=1)
        summed = scale.reshape(grid.num_ctas, -1).sum(axis=1)
        names = list(dict.fromkeys(a.texture for a in loop))
        reads = []
        for name in names:
            texture = self.textures[name]
            bilinear = any(a.footprint == "bilinear" for a in loop if a.texture == name)
            reads.append(Read(name, texture.texel_bytes, texture.num_mips > 1, bilinear))
        tiles = grid.tiles.astype(np.int64)
        return Scatter(
            step.pass_name,
            direction,
            tiles & 0xFFFF,
            tiles >> 16,
            counts.reshape(grid.num_ctas, -1).astype(np.int64),
            summed / np.maximum(num_pixels, 1),
            tuple(reads),
            taps,
            number,
            self._read_samples(grid, direction, taps, counts, scale),
        )


def _issued(arithmetic: tuple[tuple[str, int], ...]) -> int:
    """Warp instructions of an arithmetic list; waits issue nothing."""
    return sum(count for kind, count in arithmetic if kind != WAIT)


__all__ = ["scene_workload"]
