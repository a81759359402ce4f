"""Combine pass: scattered light times albedo plus what does not scatter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes.setup import texels

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState


def result_name(method: Method) -> str:
    """The texture that holds the scattered light: the update pass writes a second one."""
    return "resolved" if method.updates_history else "scattered"


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses."""
    return (
        Access("profile_id"),
        Access("scene_colour"),
        Access(result_name(method), subsurface_only=True),
        Access("albedo", subsurface_only=True),
        Access("output", "store"),
    )


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    result = result_name(state.method)
    names = ("scene_colour", "profile_id", result, "albedo", "output")
    return [state.buffers[name] for name in names]


def reference(grid: Grid, textures: dict[str, Any], method: Method) -> list[npt.NDArray[np.uint32]]:
    """Write `output`; the texels of each access."""
    mask = textures["profile_id"] > 0
    colour = textures["scene_colour"].astype(np.float32)
    light = textures[result_name(method)].astype(np.float32)
    lit = colour + light * textures["albedo"].astype(np.float32)
    output = np.where(mask[..., None], lit, colour)
    output[..., 3] = 1
    textures["output"] = resources.to_half(output)

    everywhere = texels(grid, grid.inside)
    scatters = texels(grid, grid.inside & grid.gather(mask).astype(np.bool_))
    return [everywhere, everywhere, scatters, scatters, everywhere]
