"""Sampling pass: filtered importance sampling around each scattering pixel, with a fixed or an
estimated sample count.

Facts sheet 2.3 to 2.7. The twin of sampling.cl, operation by operation. Left out of the engine's
estimator: its division by 0.99995, boundary colour bleed (there is one profile) and the opacity
fade.

Estimators without history need the variance between a pixel's own samples, see
`kernels.passes.spread`: the last-frame estimator's sampling pass writes it to the history texture.
The pilot pass is the same kernel with few samples, which writes nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access
from kernels.grid import Grid
from kernels.maths.polynomial import burley, poly_cbrt, poly_cos_sin, poly_log
from kernels.maths.profile import APPROXIMATE_C
from kernels.maths.sequence import pcg3d16, r2
from kernels.method import Method
from kernels.passes import estimate
from kernels.passes.constants import Constants
from kernels.passes.history import history_names, reproject
from kernels.passes.patch import PATCH_PARTS, is_held, patch_accesses, patch_texels
from kernels.passes.setup import texels
from kernels.passes.spread import find_spread, weigh
from traces.texture import INACTIVE_TEXEL, pack_texel

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState

_F = np.float32
_ONE = _F(1)
_PDF_MIN = _F(1e-5)
_RADIUS_MIN = _F(1e-5)
_MM_PER_CM = _F(10)
_C = _F(APPROXIMATE_C)
Texels = npt.NDArray[np.uint32]


#: Set in the hash's frame number for pilots, so that the samples proper are others.
PILOT_FRAMES = 1 << 31


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's traced accesses."""
    history = [Access(history_names(frame)[1], "store")] * method.guided_by_last_frame
    before, loop = sample_accesses(method)
    store = Access("scattered", "store")
    return (
        *patch_accesses(method),
        *before,
        *estimate.accesses(method, frame),
        *loop,
        store,
        *history,
    )


def sample_accesses(method: Method) -> tuple[list[Access], list[Access]]:
    """The traced reads of samples: before the loop, and in it."""
    colour = "colour" in method.planes
    normal = "normal" in method.planes and method.normal_weights
    planes = [Access("setup", in_loop=True)] * colour
    planes += [Access("normal", in_loop=True)] * normal
    planes += [Access("profile_id", in_loop=True)] * ("profile_id" in method.planes)
    found = [Access("setup")] * colour
    found += [Access("normal", subsurface_only=True)] * normal
    return found, planes


def invert_cdf(complement: Any, exact: bool) -> Any:
    """Radius over d for xi_1, given its complement 1 - xi_1 in (0, 1]; float32."""
    if exact:
        root = np.sqrt(_ONE + _F(4) * complement * complement)
        g = poly_cbrt(_ONE + _F(4) * complement * (_F(2) * complement + root))
        return _F(3) * poly_log((_ONE + _ONE / g + g) / (_F(4) * complement))
    return ((_F(2) - _C) * (_ONE - complement) - _F(2)) * poly_log(complement)


def half_cosine(n: Any, m: Any) -> Any:
    """0.5 + 0.5 N.M of packed normals, in [0, 1]; float32."""
    dot = np.zeros(np.broadcast_shapes(n.shape, m.shape), np.int32)
    for shift in (np.uint32(0), np.uint32(10), np.uint32(20)):
        a, b = (((v >> shift) & np.uint32(1023)).astype(np.int32) * 2 - 1023 for v in (n, m))
        dot += a * b
    return np.clip(_F(0.5) + _F(0.5) * (dot.astype(_F) * (_ONE / _F(1046529))), _F(0), _ONE)


def find_level(q: Any, num_levels: int) -> Any:
    """ceil(max(-log2 q, 0) / 2), at most 5 and the last level: it exceeds k exactly where q < 4^-k.
    int32.
    """
    finer = sum((q < _F(4.0**-k)).astype(np.int32) for k in range(5))
    return np.minimum(finer, num_levels - 1)


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    return arguments_for(state, state.method.num_samples, frame, "scattered")


def arguments_for(state: DeviceState, num_samples: int, frame: int, target: str) -> list[Any]:
    """Those of a run with a fixed count, num_samples (unless counts adapt), into a texture."""
    names = ("setup", "normal", "profile_id", "counts", "velocity", target)
    constants = state.constants
    return [
        *(state.buffers[name] for name in names),
        state.has_velocity,
        np.int32(num_samples),
        np.uint32(frame),
        np.int32(state.num_levels),
        state.buffers["ratio"],
        constants.texels_per_mm_at_cm,
        constants.d,
        *constants.rate,
        *constants.density,
        constants.mip_scale,
        state.buffers[history_names(frame)[1]],
        np.float32(state.method.epsilon_u or 0.0),
        *(state.buffers[name] for name in ("setup", "normal", "profile_id") * len(PATCH_PARTS)),
    ]


def reference(
    grid: Grid,
    textures: dict[str, Any],
    method: Method,
    constants: Constants,
    num_levels: int,
    frame: int,
    counts: npt.NDArray[np.int32],
    pilots: bool = False,
) -> list[Texels]:
    """Write `scattered` (with `pilots`, `pilot` instead); the texels of each access, those of the
    loop (num_steps, num_warps, 32).
    """
    x, y = grid.lanes
    centre = np.where(grid.inside[..., None], grid.gather(textures["setup"][0]), 0).astype(_F)
    scatters = counts > 0
    centre_normal = grid.gather(textures["normal"])
    everywhere, mine = texels(grid, grid.inside), texels(grid, scatters)

    depth = np.where(scatters, centre[..., 3], _ONE)
    texels_per_mm = constants.texels_per_mm_at_cm / depth
    mip_factor = constants.mip_scale * counts.astype(_F) / (texels_per_mm * texels_per_mm)
    radius_centre = _ONE / texels_per_mm
    beyond = [burley(radius_centre * rate, _F(0.75), _F(0.25)) for rate in constants.rate]
    unit = _F(2.0**-24) * (beyond[3] if method.centre_reweighting else _ONE)

    start = pcg3d16(x, y, frame | PILOT_FRAMES if pilots else frame, method.hash)[0]
    sums = [np.zeros(x.shape, _F) for _ in range(3)]
    totals = [np.zeros(x.shape, _F) for _ in range(3)]
    moments = [np.zeros(x.shape, _F) for _ in range(5)]
    fetched: list[list[Texels]] = [[], [], []]
    for i in range(int(counts.max())):
        active = i < counts
        turn_r, turn_angle = r2(start + np.uint32(i))
        complement = (np.uint32(0x1000000) - (turn_r >> np.uint32(8))).astype(_F) * unit
        cosine, sine = poly_cos_sin(turn_angle)
        exact = method.inverse_cdf == "exact"
        r = np.maximum(constants.d * invert_cdf(complement, exact), _RADIUS_MIN)
        p = np.maximum(burley(r * constants.rate[3]) * constants.density[3], _PDF_MIN)

        at = [
            np.clip(
                middle.astype(_F) + _F(0.5) + r * texels_per_mm * direction,
                _F(0.5),
                _F(size) - _F(0.5),
            )
            for middle, direction, size in ((x, cosine, grid.width), (y, sine, grid.height))
        ]
        texel_x, texel_y = (a.astype(np.int32) for a in at)
        if method.mip_rule == "mip0" or not method.prefilter:
            level = np.zeros(x.shape, np.int32)
        else:
            q = p * mip_factor / r if method.mip_rule == "textbook" else p * mip_factor
            level = find_level(q, num_levels)
        level_x, level_y = (
            (a * constants.ratio[level, k]).astype(np.int32) for k, a in enumerate(at)
        )
        colour = np.zeros((*x.shape, 4), _F)
        for k in range(num_levels):
            here = level == k
            colour[here] = textures["setup"][k][level_y[here], level_x[here]]

        counts_here = active & (textures["profile_id"][texel_y, texel_x] > 0)
        common = np.where(counts_here, _ONE / p, _F(0))
        if method.normal_weights:
            common = common * np.sqrt(
                half_cosine(textures["normal"][texel_y, texel_x], centre_normal)
            )
        reach = r
        if method.bilateral:
            dz = (colour[..., 3] - centre[..., 3]) * _MM_PER_CM
            reach = np.sqrt(r * r + dz * dz)
        weights = [
            burley(reach * constants.rate[c]) * constants.density[c] * common for c in range(3)
        ]
        for c, weight in enumerate(weights):
            sums[c] = sums[c] + weight * colour[..., c]
            totals[c] = totals[c] + weight
        part = weigh(*(weight * colour[..., c] for c, weight in enumerate(weights)))
        normal = method.weights == "self-normalised"
        share = weigh(*weights) if normal else np.where(active, _ONE, _F(0))
        terms = (part, share, part * part, part * share, share * share)
        moments = [moment + term for moment, term in zip(moments, terms, strict=True)]
        fetches = active
        if method.lds and not pilots:
            fetches = active & ~((level == 0) & is_held(x, y, texel_x, texel_y))
        own = np.where(fetches, pack_texel(0, texel_y, texel_x), INACTIVE_TEXEL)
        fetched[0].append(np.where(fetches, pack_texel(level, level_y, level_x), INACTIVE_TEXEL))
        fetched[1].append(own)
        fetched[2].append(own)

    result = np.zeros((*x.shape, 4), _F)
    with np.errstate(divide="ignore", invalid="ignore"):
        for c in range(3):
            share = beyond[c]
            if method.weights == "self-normalised":
                value = np.where(totals[c] > 0, sums[c] / totals[c], centre[..., c])
                if method.centre_reweighting:
                    value = value + (centre[..., c] - value) * (_ONE - share)
            else:
                value = sums[c] / counts.astype(_F)
                if method.centre_reweighting:
                    value = value * beyond[3] + centre[..., c] * (_ONE - share)
            result[..., c] = value
        if pilots or method.guided_by_last_frame:
            spread, mean = find_spread(moments, result, centre, beyond, counts, method)
            texel = np.stack([counts.astype(_F), centre[..., 3], spread, mean], axis=-1)
            texel = np.where(scatters[..., None], texel, _F(0))
            name = "pilot" if pilots else history_names(frame)[1]
            textures[name] = grid.scatter(resources.to_half(texel))
    result[..., 3] = counts
    if not pilots:
        # With separation, what takes no samples keeps its light; elsewhere that is 0 already.
        unsampled = np.where(np.arange(4) < 3, centre, _F(0)) if method.separates else _F(0)
        result = np.where(scatters[..., None], result, unsampled)
        textures["scattered"] = grid.scatter_into(textures["scattered"], resources.to_half(result))

    found: list[Texels] = []
    loop = iter(np.array(plane) for plane in fetched)
    colour_loop, normal_loop, id_loop = loop
    past_x, past_y, on_screen = reproject(grid, textures, scatters)
    past = np.where(on_screen, pack_texel(0, past_y, past_x), INACTIVE_TEXEL)
    patch = dict(zip(PATCH_PARTS, patch_texels(grid), strict=True))
    before, planes = sample_accesses(method)
    recorded = (*before, *planes, Access("pilot", "store")) if pilots else accesses(method, frame)
    for access in recorded:
        by_name = {"setup": colour_loop, "normal": normal_loop, "profile_id": id_loop}
        if access.of_tile:
            found.append(patch[access.argument.split("_")[0]])
        elif access.in_loop:
            found.append(by_name[access.texture])
        elif not access.subsurface_only:
            found.append(everywhere)
        else:
            is_past = access.texture.startswith(("history", "past_counts"))
            found.append(past if is_past else mine)
    return found
