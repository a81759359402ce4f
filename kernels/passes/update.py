"""Update pass of the adaptive method: this frame into the history (mean count, depth, variance of
the mean, mean).

Exponential moving mean and variance of the luminance of the colour's 1/2.2 power, [Xie20] and facts
sheet 3.1. With a control variate, [Xie21] and 4.3, of that less a times the lighting's: the result
is read a second time, and the lighting (the setup texture) bilinearly where the pixel's centre lies
without the camera's jitter. At a texel's centre a linear sampler weighs that texel alone, so the
second read stands as a point in the trace. The colour passes through whatever is tracked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access
from kernels.grid import Grid
from kernels.maths.polynomial import poly_gamma
from kernels.method import MAX_PAST_FRAMES, Method
from kernels.passes import covariance
from kernels.passes.estimate import distant_share
from kernels.passes.history import (
    has_history,
    history_names,
    is_known,
    mask_of,
    mean_of_past,
    names_of,
    push_count,
    read_history,
    read_past_counts,
    reproject,
)
from kernels.passes.setup import texels
from traces.texture import INACTIVE_TEXEL, pack_texel

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState

_F = np.float32
_ONE = _F(1)
_LUMINANCE = (_F(0.3), _F(0.59), _F(0.11))


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses."""
    old, new = history_names(frame)
    has_control, is_online = method.control != "none", method.control == "online"
    old_covariance, new_covariance = names_of("covariance", frame)
    old_counts, new_counts = names_of("past_counts", frame)
    loads = [Access("velocity"), Access("depth"), Access(old)]
    loads += [Access(old_covariance)] * is_online
    loads += [Access(old_counts)] * method.counts_past_frames
    loads += [
        Access("scattered", argument="sampled"),
        Access("setup", footprint="bilinear", argument="lighting"),
    ] * has_control
    loads += [Access("setup", argument="centre")] * method.separates
    stores = ["resolved", new]
    stores += [new_covariance] * is_online
    stores += [new_counts] * method.counts_past_frames
    return (
        Access("scattered"),
        *(replace(load, subsurface_only=True) for load in loads),
        *(Access(name, "store") for name in stores),
    )


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    method, constants = state.method, state.constants
    old, new = history_names(frame)
    names = ("scattered", "velocity", "depth", old, "resolved", new)
    more = (
        *("scattered", "setup", "setup"),
        *names_of("covariance", frame),
        *names_of("past_counts", frame),
    )
    return [
        *(state.buffers[name] for name in names),
        state.has_velocity,
        np.float32(method.alpha),
        np.float32(method.sigma0_sq),
        *(state.buffers[name] for name in more),
        *mask_of(min(method.num_past_frames, MAX_PAST_FRAMES)),
        np.float32(method.num_past_frames),
        *(np.float32(offset) for offset in state.jitter),
        np.float32(method.eta_cov),
        np.float32(method.epsilon_a),
        constants.texels_per_mm_at_cm,
        *constants.rate[:3],
    ]


def find_luminance(colour: Any) -> Any:
    """float32 luminance of the 1/2.2 power of (..., 3 or more) float32 colours."""
    r, g, b = (w * poly_gamma(colour[..., c]) for c, w in enumerate(_LUMINANCE))
    return r + g + b


def _light_taps(at: Any, offset: float, size: int) -> tuple[Any, Any, Any]:
    """(left, right, weight of the right) along one axis of the lighting's bilinear read."""
    position = np.clip(at.astype(_F) - _F(offset), _F(0), _F(size - 1))
    left = position.astype(np.int32)
    return left, np.minimum(left + 1, size - 1), position - left.astype(_F)


def _read_light(level: Any, taps_x: tuple[Any, Any, Any], taps_y: tuple[Any, Any, Any]) -> Any:
    """(..., 4) float32: the setup texture's level 0 between four texels."""
    (left, right, weight_x), (top, bottom, weight_y) = taps_x, taps_y
    weight_x, weight_y = weight_x[..., None], weight_y[..., None]

    def row(y: Any) -> Any:
        light = level.astype(_F)
        return light[y, left] * (_ONE - weight_x) + light[y, right] * weight_x

    return row(top) * (_ONE - weight_y) + row(bottom) * weight_y


def reference(
    grid: Grid,
    textures: dict[str, Any],
    method: Method,
    frame: int,
    constants: Any,
    jitter: tuple[float, float] = (0.0, 0.0),
) -> list[npt.NDArray[np.uint32]]:
    """Write `resolved` and the frame's history; the texels of each access.

    constants: `Constants`. jitter: the camera's, texels.
    """
    old_name, new_name = history_names(frame)
    colour = grid.gather(textures["scattered"]).astype(_F)
    scatters = grid.inside & (colour[..., 3] > 0)
    past_x, past_y, on_screen = reproject(grid, textures, scatters)
    depth = grid.gather(textures["depth"]).astype(_F)
    old = read_history(textures[old_name], past_x, past_y, on_screen)
    known = is_known(method, old, depth, on_screen)
    x, y = grid.lanes
    here = np.minimum(x, grid.width - 1), np.minimum(y, grid.height - 1)

    tracked = colour[..., :3]
    share: Any = _ONE
    if method.separates:
        own = grid.gather(textures["setup"][0]).astype(_F)
        shares = [
            distant_share(own[..., 3], constants.texels_per_mm_at_cm, r) for r in constants.rate
        ]
        share = np.stack(shares[:3], axis=-1)
        tracked = np.maximum(tracked - own[..., :3] * (_ONE - share), _F(0))
    scalar = find_luminance(tracked)
    found: dict[str, Any] = {}
    taps = [
        _light_taps(at, offset, size)
        for at, offset, size in zip(here, jitter, (grid.width, grid.height), strict=True)
    ]
    if method.control != "none":
        light = _read_light(textures["setup"][0], taps[0], taps[1])[..., :3] * share
        control = find_luminance(light)
        if method.control == "online":
            names = names_of("covariance", frame)
            moments = read_history(textures[names[0]], past_x, past_y, on_screen)
            coefficient = np.where(
                known, covariance.find_coefficient(moments, method.epsilon_a), _ONE
            )
            blended = covariance.update_moments(moments, scalar, control, method.eta_cov)
            first = covariance.first_moments(scalar, control)
            found[names[1]] = np.where(known[..., None], blended, first)
            scalar = scalar - coefficient * control
        else:
            scalar = scalar - control

    alpha, rest = _F(method.alpha), _ONE - _F(method.alpha)
    difference = scalar - old[..., 3]
    count = np.where(known, rest * old[..., 0] + alpha * colour[..., 3], colour[..., 3])
    variance = rest * old[..., 2] + alpha * rest * (difference * difference)
    alone = _F(method.sigma0_sq if method.disocclusion == "variance" else 0.0)
    variance = np.where(known, variance, alone)
    mean = np.where(known, rest * old[..., 3] + alpha * scalar, scalar)
    if method.counts_past_frames:
        names = names_of("past_counts", frame)
        past = read_past_counts(textures[names[0]], past_x, past_y, on_screen)
        past = push_count(past, colour[..., 3], known)
        textures[names[1]] = grid.scatter(np.where(scatters[..., None], past, np.uint32(0)))
        count = mean_of_past(past, method.num_past_frames)
    found[new_name] = np.stack([count, depth, variance, mean], axis=-1)
    for name, values in found.items():
        kept = np.where(scatters[..., None], values, _F(0))
        textures[name] = grid.scatter(resources.to_half(kept))

    colour[..., 3] = scatters
    textures["resolved"] = grid.scatter(resources.to_half(colour))

    everywhere, mine = texels(grid, grid.inside), texels(grid, scatters)
    past_texels = np.where(on_screen, pack_texel(0, past_y, past_x), INACTIVE_TEXEL)
    lit = np.where(scatters, pack_texel(0, taps[1][0], taps[0][0]), INACTIVE_TEXEL)

    def texels_of(access: Access) -> npt.NDArray[np.uint32]:
        if not access.subsurface_only:
            return everywhere
        if access.argument == "lighting":
            return lit
        is_past = access.texture.startswith(("history", "covariance", "past_counts"))
        return past_texels if is_past else mine

    return [texels_of(access) for access in accesses(method, frame)]


__all__ = [
    "accesses",
    "arguments",
    "find_luminance",
    "has_history",
    "history_names",
    "read_history",
    "reference",
    "reproject",
]
