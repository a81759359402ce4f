"""Pre-filter pass: each level of the setup texture from the finer one, a bilinear tap at every
destination texel's centre.

One launch per level. Not depth-aware: texels that do not scatter count with their zeros, as in the
engine.
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
from traces.texture import INACTIVE_TEXEL, pack_texel

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses, the same for every method and frame."""
    return (
        Access("setup", footprint="bilinear"),
        Access("setup", "store"),
    )


def find_taps(source_size: int, size: int) -> tuple[Any, Any, Any]:
    """(left, right, weight of the right) of each of `size` destination texels along one axis;
    int64, int64, float32.
    """
    twice = (2 * np.arange(size, dtype=np.int64) + 1) * source_size - size
    left = twice // (2 * size)
    weight = (twice - left * 2 * size).astype(np.float32) / np.float32(2 * size)
    return left, np.minimum(left + 1, source_size - 1), weight


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    size = (np.int32(state.width), np.int32(state.height))
    return [state.buffers["setup"], np.uint32(level), *size]


def reference(grid: Grid, textures: dict[str, Any], level: int) -> list[npt.NDArray[np.uint32]]:
    """Append level `level + 1`, of the grid's size, to `setup`; the texels of each access."""
    source = textures["setup"][level].astype(np.float32)
    left, right, weight_x = find_taps(source.shape[1], grid.width)
    above, below, weight_y = find_taps(source.shape[0], grid.height)
    weight_x, weight_y = weight_x[:, None], weight_y[:, None, None]
    one = np.float32(1)

    def filter_rows(rows: Any) -> Any:
        return source[rows][:, left] * (one - weight_x) + source[rows][:, right] * weight_x

    filtered = filter_rows(above) * (one - weight_y) + filter_rows(below) * weight_y
    textures["setup"] = [*textures["setup"], resources.to_setup(filtered)]

    x, y = grid.lanes
    tap = pack_texel(
        level, above[np.minimum(y, grid.height - 1)], left[np.minimum(x, grid.width - 1)]
    )
    return [np.where(grid.inside, tap, INACTIVE_TEXEL), texels(grid, grid.inside, level + 1)]
