"""Temporal anti-aliasing pass: the picture as shown, from the finished picture and its own past.

[Karis14] Karis, High Quality Temporal Supersampling, SIGGRAPH 2014: the history is looked up where
the nearest surface of the 3x3 neighbourhood stood (bilinear), clamped to the box of the
neighbourhood's colours in YCoCg, and blended with both sides weighed by 1 / (1 + luma). The weight
of the new frame grows with the speed, up to that of the local history: the method's alpha is the
largest weight the TAA uses, [Xie20] and facts sheet 3.5. Its picture is its history, one texture of
half floats.

The neighbourhood is a loop, nine steps in every warp; its loads are counted as the machine code of
that loop issues them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access, States
from kernels.grid import OUTSIDE, Grid
from kernels.method import Method
from kernels.passes.setup import texels
from traces.texture import INACTIVE_TEXEL, pack_texel

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState

_F = np.float32
NUM_STEPS = 9
#: Texels per frame at which the weight has reached its largest.
FULL_SPEED = 40.0


def texture_names(frame: int) -> tuple[str, str]:
    """(read, written): the picture as shown in the previous frame and in this one."""
    return f"taa_{(frame + 1) % 2}", f"taa_{frame % 2}"


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses; those of the loop once per neighbour."""
    old, new = texture_names(frame)
    return (
        Access("depth", in_loop=True),
        Access("output", in_loop=True),
        Access("velocity"),
        Access(old, footprint="bilinear"),
        Access(new, "store"),
    )


def warp_states(states: States) -> States:
    """The pass's warp states from those of the grid: every warp in the frame goes through the
    loop.
    """
    return np.where(states == OUTSIDE, OUTSIDE, NUM_STEPS).astype(np.int32)


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    old, new = texture_names(frame)
    names = ("depth", "output", "velocity", old, new)
    return [
        *(state.buffers[name] for name in names),
        state.has_velocity,
        np.float32(state.method.taa_weight),
        np.float32(state.method.alpha),
        np.float32(FULL_SPEED),
    ]


def reference(
    grid: Grid, textures: dict[str, Any], method: Method, frame: int
) -> list[npt.NDArray[np.uint32]]:
    """Write the frame's texture; the texels of each access, (9, num_warps, 32) for the loop's."""
    old_name, new_name = texture_names(frame)
    x, y = grid.lanes
    picture = textures["output"].astype(_F)
    # Depth 0 is nothing, farther than all. Among equals, the pixel itself is the nearest.
    depth = np.where(textures["depth"] > 0, textures["depth"], np.inf)
    centre: Any = None
    low, high = np.inf, -np.inf
    nearest, nearest_x, nearest_y = np.full(x.shape, np.inf), x, y
    near_texels = []
    for step in range(NUM_STEPS):
        near_x = np.clip(x + step % 3 - 1, 0, grid.width - 1)
        near_y = np.clip(y + step // 3 - 1, 0, grid.height - 1)
        z = depth[near_y, near_x]
        closer = z < nearest
        colour = _to_ycocg(picture[near_y, near_x])
        if step == 4:
            centre, closer = colour, z <= nearest
        nearest = np.where(closer, z, nearest)
        nearest_x = np.where(closer, near_x, nearest_x)
        nearest_y = np.where(closer, near_y, nearest_y)
        low, high = np.minimum(low, colour), np.maximum(high, colour)
        near_texels.append(np.where(grid.inside, pack_texel(0, near_y, near_x), INACTIVE_TEXEL))

    velocity = textures.get("velocity")
    moved: Any = np.zeros((*x.shape, 2), _F)
    if velocity is not None:
        moved = velocity[nearest_y, nearest_x]
    past_x = x.astype(_F) + _F(0.5) + moved[..., 0]
    past_y = y.astype(_F) + _F(0.5) + moved[..., 1]
    on_screen = grid.inside & (past_x >= 0) & (past_x < grid.width)
    on_screen = on_screen & (past_y >= 0) & (past_y < grid.height)
    old, corner = _filter(textures[old_name].astype(_F), past_x, past_y)
    old = np.where(on_screen[..., None], old, _F(0))

    speed = np.sqrt(moved[..., 0] * moved[..., 0] + moved[..., 1] * moved[..., 1])
    share = np.minimum(speed / _F(FULL_SPEED), _F(1))
    least, largest = _F(method.taa_weight), _F(method.alpha)
    weight = np.where(old[..., 3] > 0, least + (largest - least) * share, _F(1))

    history = np.clip(_to_ycocg(old), low, high)
    of_new = (weight / (_F(1) + np.maximum(centre[..., 0], _F(0))))[..., None]
    of_old = ((_F(1) - weight) / (_F(1) + np.maximum(history[..., 0], _F(0))))[..., None]
    mixed = (centre * of_new + history * of_old) / (of_new + of_old)
    luma, co, cg = mixed[..., 0], mixed[..., 1], mixed[..., 2]
    shown = np.stack([luma - cg + co, luma + cg, luma - cg - co, np.ones_like(luma)], axis=-1)
    textures[new_name] = grid.scatter(resources.to_half(np.maximum(shown, _F(0))))

    loop = np.stack(near_texels)
    own = np.where(grid.inside, pack_texel(0, nearest_y, nearest_x), INACTIVE_TEXEL)
    past = np.where(on_screen, pack_texel(0, *corner), INACTIVE_TEXEL)
    return [loop, loop, own, past, texels(grid, grid.inside)]


def _to_ycocg(colour: Any) -> Any:
    """(..., 3) luma and chroma of (..., 4) RGBA."""
    r, g, b = (colour[..., channel] for channel in range(3))
    quarter, half = _F(0.25), _F(0.5)
    luma = quarter * r + half * g + quarter * b
    return np.stack([luma, half * r - half * b, half * g - quarter * r - quarter * b], axis=-1)


def _filter(image: Any, at_x: Any, at_y: Any) -> tuple[Any, tuple[Any, Any]]:
    """An image's bilinear values at points given in texels, and the (y, x) of each footprint's
    top-left texel; clamped to the edge.
    """
    height, width = image.shape[:2]
    at_x = np.clip(at_x - _F(0.5), _F(0), _F(width - 1))
    at_y = np.clip(at_y - _F(0.5), _F(0), _F(height - 1))
    left, above = at_x.astype(np.int32), at_y.astype(np.int32)
    right, below = np.minimum(left + 1, width - 1), np.minimum(above + 1, height - 1)
    of_right, of_below = (at_x - left.astype(_F))[..., None], (at_y - above.astype(_F))[..., None]
    rest = _F(1) - of_right
    top = image[above, left] * rest + image[above, right] * of_right
    bottom = image[below, left] * rest + image[below, right] * of_right
    return top * (_F(1) - of_below) + bottom * of_below, (above, left)
