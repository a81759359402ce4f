"""Update pass of the adaptive method: this frame into the history (mean count, depth, variance of
the mean, mean).

Exponential moving mean and variance of the luminance of the colour's 1/2.2 power, [Xie20] and facts
sheet 3.1; the target variance and this frame alone where there is no history. The engine's second
read of the result and its bilinear read of the lighting belong to its control variate, which this
method does not have.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access
from kernels.grid import Grid
from kernels.method import Method
from kernels.polynomial import poly_gamma
from kernels.setup import texels
from traces.texture import INACTIVE_TEXEL, pack_texel

if TYPE_CHECKING:
    from kernels.pipeline import Pipeline

_F = np.float32
_LUMINANCE = (_F(0.3), _F(0.59), _F(0.11))


def history_names(frame: int) -> tuple[str, str]:
    """(read, written): the history texture of the previous frame and of this one."""
    return f"history_{(frame + 1) % 2}", f"history_{frame % 2}"


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses."""
    old, new = history_names(frame)
    return (
        Access("scattered"),
        Access("velocity", subsurface_only=True),
        Access("depth", subsurface_only=True),
        Access(old, subsurface_only=True),
        Access("resolved", "store"),
        Access(new, "store"),
    )


def reproject(grid: Grid, textures: dict[str, Any], active: Any) -> tuple[Any, Any, Any]:
    """(x, y, whether on screen) of each lane's pixel in the previous frame; no movement for
    inactive lanes.
    """
    x, y = grid.lanes
    velocity = textures.get("velocity")
    moved: Any = np.zeros((*x.shape, 2), _F) if velocity is None else grid.gather(velocity)
    moved = np.where(active[..., None], moved, _F(0))
    past = [
        np.floor(np.clip(at.astype(_F) + _F(0.5) + moved[..., k], _F(-1), _F(32768))).astype(
            np.int32
        )
        for k, at in enumerate((x, y))
    ]
    on_screen = (past[0] >= 0) & (past[0] < grid.width) & (past[1] >= 0) & (past[1] < grid.height)
    return past[0], past[1], on_screen & active


def read_history(history: Any, x: Any, y: Any, on_screen: Any) -> Any:
    """(..., 4) float32 history texels; 0 off screen."""
    at = history[np.where(on_screen, y, 0), np.where(on_screen, x, 0)].astype(_F)
    return np.where(on_screen[..., None], at, _F(0))


def has_history(history: Any, depth: Any) -> Any:
    """Whether history texels belong to a surface at this depth: within a tenth of it."""
    near = np.abs(history[..., 1] - depth) <= _F(0.1) * depth
    return (history[..., 1] > 0) & near


def arguments(pipeline: Pipeline, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    old, new = history_names(frame)
    names = ("scattered", "velocity", "depth", old, "resolved", new)
    return [
        *(pipeline.buffers[name] for name in names),
        pipeline.has_velocity,
        np.float32(pipeline.method.alpha),
        np.float32(pipeline.method.sigma0_sq),
    ]


def reference(
    grid: Grid, textures: dict[str, Any], method: Method, frame: int
) -> list[npt.NDArray[np.uint32]]:
    """Write `resolved` and the frame's history; the texels of each access."""
    from kernels.reference import scatter

    old_name, new_name = history_names(frame)
    colour = grid.gather(textures["scattered"]).astype(_F)
    scatters = grid.inside & (colour[..., 3] > 0)
    past_x, past_y, on_screen = reproject(grid, textures, scatters)
    depth = grid.gather(textures["depth"]).astype(_F)
    old = read_history(textures[old_name], past_x, past_y, on_screen)

    r, g, b = (w * poly_gamma(colour[..., c]) for c, w in enumerate(_LUMINANCE))
    scalar = r + g + b
    alpha, rest = _F(method.alpha), _F(1) - _F(method.alpha)
    difference = scalar - old[..., 3]
    known = has_history(old, depth)
    count = np.where(known, rest * old[..., 0] + alpha * colour[..., 3], colour[..., 3])
    variance = rest * old[..., 2] + alpha * rest * (difference * difference)
    variance = np.where(known, variance, _F(method.sigma0_sq))
    mean = np.where(known, rest * old[..., 3] + alpha * scalar, scalar)
    blended = np.stack([count, depth, variance, mean], axis=-1)
    blended = np.where(scatters[..., None], blended, _F(0))

    colour[..., 3] = scatters
    textures["resolved"] = scatter(grid, resources.to_half(colour))
    textures[new_name] = scatter(grid, resources.to_half(blended))

    everywhere, mine = texels(grid, grid.inside), texels(grid, scatters)
    past = np.where(on_screen, pack_texel(0, past_y, past_x), INACTIVE_TEXEL)
    return [everywhere, mine, mine, past, everywhere, everywhere]
