"""The method in plain NumPy, bit for bit what the kernels compute: one frame after another, with
the trace of each launch.

Slow and obvious: every lane of the frame at once, one sample after another. Each pass module holds
its own `reference`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from kernels import combine, prefilter, resources, sampling, setup, update
from kernels.gbuffer import GBuffer
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes import Step, list_steps

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
    gbuffer: GBuffer, method: Method, num_frames: int = 1, traced: bool = True
) -> list[ReferenceFrame]:
    """Every frame of a still G-buffer, the first without history."""
    height, width = gbuffer.height, gbuffer.width
    grid = Grid(width, height, method.tile_order, method.lane_map)
    num_levels = resources.count_levels(width, height, method)
    empty = np.zeros((height, width, 4), np.float16)
    textures: dict[str, Any] = dict(resources.inputs(gbuffer))
    textures |= {"history_0": empty, "history_1": empty}
    constants = sampling.Constants.of(method, width, height, gbuffer.projection_x)
    mask = gbuffer.subsurface
    frames = []
    for frame in range(num_frames):
        found = ReferenceFrame(textures, np.zeros((height, width), np.uint16))
        for step in list_steps(method, grid, num_levels):
            states = step.grid.warp_states(None if step.pass_name == "prefilter" else mask)
            if step.pass_name == "setup":
                texels = setup.reference(grid, textures)
            elif step.pass_name == "prefilter":
                texels = prefilter.reference(step.grid, textures, step.level)
            elif step.pass_name == "sampling":
                counts = sampling.estimate_reference(grid, textures, method, frame)
                states = np.where(states > 0, counts.max(axis=1), states).astype(np.int32)
                found.counts = scatter(grid, counts).astype(np.uint16)
                texels = sampling.reference(
                    grid, textures, method, constants, num_levels, frame, counts
                )
            elif step.pass_name == "update":
                texels = update.reference(grid, textures, method, frame)
            else:
                texels = combine.reference(grid, textures, method)
            if traced:
                offsets, lanes = step.program(method, frame).place(states, texels)
                found.launches.append((step, offsets, lanes))
        found.textures = dict(textures)
        frames.append(found)
    return frames


def scatter(grid: Grid, values: Array) -> Array:
    """(height, width, ...): the image of values in lane order, (num_warps, 32, ...)."""
    x, y = grid.lanes
    image = np.zeros((grid.height, grid.width, *values.shape[2:]), values.dtype)
    image[y[grid.inside], x[grid.inside]] = values[grid.inside]
    return image
