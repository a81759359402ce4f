"""Overlay pass: the scene's transparent layer over the finished picture, in place.

It comes after combine and before the TAA, as transparent objects do: they disturb whatever
accumulates the picture, and not the history of the scattered light.
"""

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


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses; the last two for lanes under something transparent."""
    return (Access("overlay"), Access("output"), Access("output", "store"))


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    return [state.buffers["overlay"], state.buffers["output"], state.has_overlay]


def reference(grid: Grid, textures: dict[str, Any]) -> list[npt.NDArray[np.uint32]]:
    """Blend `overlay`, where there is one, over `output`; the texels of each access."""
    output = textures["output"].astype(np.float32)
    over = textures.get("overlay", np.zeros_like(output)).astype(np.float32)
    opacity = over[..., 3:]
    covered = opacity > 0
    blended = output * (np.float32(1) - opacity) + over * opacity
    blended[..., 3] = 1
    textures["output"] = resources.to_half(np.where(covered, blended, output))

    mine = texels(grid, grid.inside & grid.gather(covered[..., 0]).astype(np.bool_))
    return [texels(grid, grid.inside), mine, mine]
