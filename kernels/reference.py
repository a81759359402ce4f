"""The method in plain NumPy, bit for bit what the kernels compute: one frame after another, with
the trace of each launch.

Slow and obvious: every lane of the frame at once, one sample after another. Each pass module holds
its own `reference`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.gbuffer import GBuffer
from kernels.grid import Grid
from kernels.launches import Step, list_steps
from kernels.method import Method
from kernels.passes import (
    classify,
    combine,
    estimate,
    overlay,
    pilot,
    prefilter,
    sampling,
    separable,
    setup,
    taa,
    update,
)
from kernels.passes.constants import Constants
from kernels.tiles import CLASS_OF_PASS, ListedGrid
from traces.texture import WARP_SIZE

Array = npt.NDArray[Any]


@dataclass
class ReferenceFrame:
    """What one frame left behind.

    textures: contents by name as the device holds them (half floats as float16; `setup` a list of
        levels).
    counts: (height, width) uint16 samples of each pixel. launches: per launch its step, (num_warps
    + 1,) row offsets and (num_rows, 32) uint32 texels.
    """

    textures: dict[str, Any]
    counts: Array
    launches: list[tuple[Step, Array, Array]] = field(default_factory=list)


def render_reference(
    scene: GBuffer | Callable[[int], GBuffer],
    method: Method,
    num_frames: int = 1,
    traced: bool = True,
) -> list[ReferenceFrame]:
    """Every frame of a scene, still or a function from frame number to G-buffer, the first without
    history.
    """
    gbuffer = scene if isinstance(scene, GBuffer) else scene(0)
    height, width = gbuffer.height, gbuffer.width
    grid = Grid(width, height, method.tile_order, method.lane_map)
    num_levels = resources.count_levels(width, height, method)
    empty = np.zeros((height, width, 4), np.float16)
    textures: dict[str, Any] = {
        name: np.zeros((height, width, 4), np.uint32) if "past_counts" in name else empty
        for name in (*resources.CARRIED, "tex", "scattered")
    }
    frames = []
    for frame in range(num_frames):
        gbuffer = scene if isinstance(scene, GBuffer) else scene(frame)
        for name in ("velocity", "overlay"):
            textures.pop(name, None)
        textures |= resources.inputs(gbuffer)
        constants = Constants.of(method, width, height, gbuffer.projection_x)
        falloff = separable.depth_falloff(gbuffer.projection_x)
        mask = gbuffer.subsurface
        found = ReferenceFrame(textures, np.zeros((height, width), np.uint16))
        for step in list_steps(method, grid, num_levels):
            states = step.grid.warp_states(None if step.pass_name == "prefilter" else mask)
            if method.hybrid and step.pass_name in CLASS_OF_PASS:
                listed = ListedGrid.of(grid, textures["tile_class"], CLASS_OF_PASS[step.pass_name])
                step = replace(step, grid=listed)
                states = listed.warp_states(mask)
            if not step.grid.num_ctas:
                if traced:
                    nothing = np.zeros((0, WARP_SIZE), np.uint32)
                    found.launches.append((step, np.zeros(1, np.int64), nothing))
                continue
            if step.pass_name == "setup":
                texels = setup.reference(grid, textures)
            elif step.pass_name == "prefilter":
                texels = prefilter.reference(step.grid, textures, step.level)
            elif step.pass_name == "pilot":
                states = pilot.warp_states(states, method)
                texels = pilot.reference(grid, textures, method, constants, num_levels, frame)
            elif step.pass_name == "sampling":
                counts = estimate.reference(step.grid, textures, method, constants, frame)
                states = np.where(states > 0, counts.max(axis=1), states).astype(np.int32)
                found.counts = step.grid.scatter(counts).astype(np.uint16)
                texels = sampling.reference(
                    step.grid, textures, method, constants, num_levels, frame, counts
                )
            elif step.pass_name == "classify":
                counts = estimate.reference(grid, textures, method, constants, frame)
                texels = classify.reference(grid, textures, method, constants, frame, counts)
            elif step.pass_name in ("separable_h", "separable_v"):
                states = separable.warp_steps(states, method)
                texels = (
                    separable.VERTICAL if step.pass_name == "separable_v" else separable.HORIZONTAL
                ).reference(step.grid, textures, method, constants, falloff)
            elif step.pass_name == "update":
                texels = update.reference(grid, textures, method, frame, constants, gbuffer.jitter)
            elif step.pass_name == "overlay":
                texels = overlay.reference(grid, textures)
            elif step.pass_name == "taa":
                states = taa.warp_states(states)
                texels = taa.reference(grid, textures, method, frame)
            else:
                texels = combine.reference(grid, textures, method)
            if isinstance(step.grid, ListedGrid):
                texels = [step.grid.entry_texels(), *texels]
            if traced:
                offsets, lanes = step.program(method, frame).place(states, texels)
                found.launches.append((step, offsets, lanes))
        if method.filters:
            found.counts = textures["scattered"][..., 3].astype(np.uint16)
        found.textures = dict(textures)
        frames.append(found)
    return frames
