"""Estimate: this frame's sample count of each pixel, from its history or from its pilots.

Facts sheet 3.2 and 4.3. The twin of estimate.cl, operation by operation. The kernel runs before the
sampling pass, which the recorder charges with its reads: on a GPU they are one pass.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels.access import Access
from kernels.grid import Grid
from kernels.maths.polynomial import burley
from kernels.method import Method
from kernels.passes.history import (
    history_names,
    is_known,
    names_of,
    oldest_of_past,
    read_history,
    read_past_counts,
    reproject,
)

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState

_F = np.float32
_ONE = _F(1)


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """What the estimate reads beside the pixel's depth, in program order."""
    if not method.adaptive:
        return ()
    if method.takes_pilots:
        return (Access("pilot", subsurface_only=True),)
    found: tuple[Access, ...] = (
        Access("velocity", subsurface_only=True),
        Access(history_names(frame)[0], subsurface_only=True),
    )
    if method.counts_past_frames:
        found += (Access(names_of("past_counts", frame)[0], subsurface_only=True),)
    return found


def arguments(state: DeviceState, frame: int) -> list[Any]:
    """The kernel's arguments behind the warp's."""
    method, constants = state.method, state.constants
    history = "pilot" if method.takes_pilots else history_names(frame)[0]
    names = ("setup", "velocity", history, "counts")
    return [
        *(state.buffers[name] for name in names),
        state.has_velocity,
        np.float32(method.sigma0_sq),
        np.float32(_kappa(method)),
        np.float32(k_minus_1(method)),
        np.float32(method.b_min),
        np.float32(method.b_max),
        state.buffers[names_of("past_counts", frame)[0]],
        np.int32(method.num_past_frames),
        constants.texels_per_mm_at_cm,
        constants.rate[3],
        np.float32(method.epsilon_u or 0.0),
    ]


def k_minus_1(method: Method) -> float:
    """k - 1 for the simple moving average of k = 2 / alpha - 1 frames that the history's alpha
    stands for.
    """
    return 2.0 / method.alpha - 2.0


def _kappa(method: Method) -> float:
    """The slides' O(1) form is the paper's without damping."""
    return 1.0 if method.rule == "o1" else method.kappa


def estimate_count(mean_count: Any, variance: Any, method: Method, oldest_count: Any = None) -> Any:
    """The next frame's count before rounding, clamped to [b_min, b_max]; float32.

    mean_count, variance: of the history, or of the last frame's samples alone. oldest_count: of 2 /
    alpha - 1 frames ago, for the sliding rule.
    """
    s0 = _F(method.sigma0_sq)
    if method.estimator != "history":
        count = variance * mean_count / s0
    elif method.rule == "sliding":
        count = (variance - s0) / s0 * mean_count * _F(method.num_past_frames) + oldest_count
    elif method.rule == "engine":
        count = variance / s0
    else:
        delta = (variance - s0) / s0 * mean_count * _F(k_minus_1(method))
        count = _F(_kappa(method)) * delta + variance / s0 * mean_count
    return np.clip(count, _F(method.b_min), _F(method.b_max))


def distant_share(depth: Any, texels_per_mm_at_cm: np.float32, rate: np.float32) -> Any:
    """float32 share 1 - cdf(r_px) of a profile's energy that leaves a pixel, at depths in cm (0
    counts as 1). rate: -1 / (3 d), 1/mm.
    """
    texels_per_mm = texels_per_mm_at_cm / np.where(depth > 0, depth, _ONE)
    return burley(_ONE / texels_per_mm * rate, _F(0.75), _F(0.25))


def takes_samples(depth: Any, method: Method, constants: Any) -> Any:
    """Whether a scattering pixel at this depth, cm, takes samples at all: `Method.epsilon_u`."""
    if not method.separates:
        return depth > 0
    share = distant_share(depth, constants.texels_per_mm_at_cm, constants.rate[3])
    return (depth > 0) & (share > _F(method.epsilon_u or 0.0))


def reference(
    grid: Grid, textures: dict[str, Any], method: Method, constants: Any, frame: int
) -> npt.NDArray[np.int32]:
    """(num_warps, 32) samples of each lane; 0 where nothing scatters, or only inside its pixel."""
    depth = grid.gather(textures["setup"][0][..., 3]).astype(_F)
    scatters = grid.inside & takes_samples(depth, method, constants)
    if not method.adaptive:
        return np.where(scatters, method.num_samples, 0).astype(np.int32)
    oldest: Any = None
    if method.takes_pilots:
        texel = grid.gather(textures["pilot"]).astype(_F)
        mean_count, variance = texel[..., 0], texel[..., 2]
    else:
        past_x, past_y, on_screen = reproject(grid, textures, scatters)
        history = read_history(textures[history_names(frame)[0]], past_x, past_y, on_screen)
        known = is_known(method, history, depth, on_screen)
        absent = (method.b_max, method.sigma0_sq) if method.disocclusion == "variance" else (0, 0)
        mean_count = np.where(known, history[..., 0], _F(absent[0]))
        variance = np.where(known, history[..., 2], _F(absent[1]))
        if method.counts_past_frames:
            name = names_of("past_counts", frame)[0]
            past = read_past_counts(textures[name], past_x, past_y, on_screen)
            oldest = oldest_of_past(past, method.num_past_frames)
            oldest = np.where(known, oldest, _F(absent[0]))
    count = estimate_count(mean_count, variance, method, oldest)
    return np.where(scatters, np.floor(count + _F(0.5)).astype(np.int32), 0)
