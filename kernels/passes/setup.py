"""Set-up pass: G-buffer and light in, setup texture (irradiance, depth) and profile ids out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access
from kernels.grid import Grid
from kernels.method import Method
from traces.texture import pack_texel

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses, the same for every method and frame."""
    return (
        Access("gbuffer_id"),
        Access("depth"),
        Access("scene_light", subsurface_only=True),
        Access("setup", "store"),
        Access("profile_id", "store"),
    )


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    names = ("scene_light", "depth", "gbuffer_id", "setup", "profile_id")
    return [state.buffers[name] for name in names]


def reference(grid: Grid, textures: dict[str, Any]) -> list[npt.NDArray[np.uint32]]:
    """Write `setup` (its level 0) and `profile_id`; the texels of each access, (num_warps, 32)."""
    mask = (textures["gbuffer_id"] > 0) & (textures["depth"] > 0)
    level = textures["scene_light"].astype(np.float32)
    level[..., 3] = np.maximum(textures["depth"], resources.HALF_NORMAL_MIN)
    textures["setup"] = [resources.to_setup(np.where(mask[..., None], level, np.float32(0)))]
    textures["profile_id"] = np.where(mask, textures["gbuffer_id"], 0).astype(np.uint8)

    everywhere = texels(grid, grid.inside)
    scatters = texels(grid, grid.inside & grid.gather(mask).astype(np.bool_))
    return [everywhere, everywhere, scatters, everywhere, everywhere]


def texels(grid: Grid, active: npt.NDArray[np.bool_], mip: int = 0) -> npt.NDArray[np.uint32]:
    """(num_warps, 32) packed texels: each active lane's own pixel."""
    x, y = grid.lanes
    return np.where(active, pack_texel(mip, y, x), np.uint32(0xFFFFFFFF))
