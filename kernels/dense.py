"""Dense evaluation of the scattering integral: every texel that the profile reaches around a pixel.

What importance sampling estimates and tends to, without sampling: with w the profile at a texel's
distance in space times its normal's weight,

    scattered = sum over texels of  w area colour  /  sum of  w area

over all texels beyond a texel's distance from the pixel, whose own light then enters with the share
of the profile within that distance (facts sheet 2.7). Coordinates beyond the frame show its border,
as they do to the samples. An untraced reference: the texels near the pixel, over which the profile
changes, are divided into points.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import resources as files
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.gbuffer import GBuffer
from kernels.maths.profile import cdf
from kernels.method import Method
from kernels.opencl.device import Device, open_device
from kernels.passes.constants import Constants
from traces.errors import InputError

if TYPE_CHECKING:
    import pyopencl as cl

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[float], None]

#: Share of the widest channel's light beyond the reach.
_TAIL = 1e-6
_MM_PER_CM = 10.0
_WIDTH = 8
#: Texel visits of one launch, so that progress is told.
_VISITS_PER_LAUNCH = 4e8
_MAX_TEXELS = 1 << 26
#: (texels to each side of the pixel, points along a side of each of those), widest first; dense.cl.
DIVISIONS = ((6, 8), (1, 32))


def reach_mm(method: Method) -> float:
    """Radius that all but a millionth of the widest channel's light stays within."""
    return float(3 * max(method.profile.d_mm) * np.log(0.75 / _TAIL))


def scatter_densely(
    gbuffer: GBuffer,
    method: Method,
    device: Device | None = None,
    *,
    pixels: Mask | None = None,
    progress: Progress | None = None,
) -> Float:
    """(h, w, 3) float32: the light after scattering, without albedo; 0 where it is not evaluated.

    Args:
        gbuffer: the scene.
        method: its profile, scale, weights, bilateral and normal_weights; the rest plays no part.
        device: from `open_device`; None opens the first that works.
        pixels: (h, w) bool, where to evaluate; None is all that scatter. Work grows with the
            square of the pixels per mm.
        progress: called with the share done, 0 to 1.

    Raises:
        InputError: a method without centre_reweighting, or a scale at which the reach is too many
            texels.
    """
    import pyopencl as cl

    device = device or open_device()
    mask = _checked(gbuffer, method, pixels)
    result = np.zeros((gbuffer.height, gbuffer.width, 3), np.float32)
    y, x = np.nonzero(mask)
    if not len(x):
        return result
    constants = Constants.of(method, gbuffer.width, gbuffer.height, gbuffer.projection_x)
    planes = _planes(gbuffer)
    scale = float(constants.texels_per_mm_at_cm) / planes[3][mask]
    reach = np.ceil(reach_mm(method) * scale)
    margin = int(reach.max()) + _WIDTH + 1
    rows, pitch = gbuffer.height + 2 * margin, gbuffer.width + 2 * margin
    if rows * pitch > _MAX_TEXELS:
        raise InputError(
            f"{gbuffer.name}: the profile reaches {margin} texels: allowed is what a frame of "
            f"{_MAX_TEXELS} texels holds; take a smaller frame"
        )
    padded = np.pad(planes, ((0, 0), (margin, margin), (margin, margin)), mode="edge")
    flags = cl.mem_flags
    source = _upload(device, padded)
    places = np.stack([x, y], axis=1).astype(np.int32)
    found = np.empty((len(x), 3), np.float32)
    kernel = _kernel(device, _macros(method))
    # Parts of about the same work.
    done = np.cumsum(np.pi * reach**2)
    ends = np.searchsorted(done, np.arange(1, done[-1] / _VISITS_PER_LAUNCH) * _VISITS_PER_LAUNCH)
    bounds = np.unique([0, *ends, len(x)])
    for first, end in pairwise(bounds):
        part = np.empty((end - first, 3), np.float32)
        buffer = cl.Buffer(device.context, flags.WRITE_ONLY, part.nbytes)
        kernel(
            device.queue,
            (int(end - first),),
            None,
            _upload(device, places[first:end]),
            source,
            np.int32(pitch),
            np.int32(rows),
            np.int32(margin),
            constants.texels_per_mm_at_cm,
            np.float32(reach_mm(method)),
            *constants.rate[:3],
            *constants.density[:3],
            buffer,
        )
        cl.enqueue_copy(device.queue, part, buffer)
        found[first:end] = part
        if progress is not None:
            progress(float(done[end - 1] / done[-1]))
    result[y, x] = found
    return result


def combine_densely(gbuffer: GBuffer, scattered: Float) -> Float:
    """(h, w, 3) float32: the finished picture of scattered light."""
    lit = scattered * gbuffer.albedo + gbuffer.non_subsurface
    return np.where(gbuffer.subsurface[..., None], lit, gbuffer.non_subsurface)


def reference(
    gbuffer: GBuffer,
    method: Method,
    pixels: Mask | None = None,
    divisions: tuple[tuple[int, int], ...] = DIVISIONS,
) -> npt.NDArray[np.float64]:
    """The same in NumPy and float64, pixel by pixel. divisions: as `DIVISIONS`."""
    mask = _checked(gbuffer, method, pixels)
    planes = _planes(gbuffer).astype(np.float64)
    constants = Constants.of(method, gbuffer.width, gbuffer.height, gbuffer.projection_x)
    d = np.array(method.profile.d_mm)
    result = np.zeros((gbuffer.height, gbuffer.width, 3))
    for y, x in zip(*np.nonzero(mask), strict=True):
        centre = planes[:, y, x]
        mm = centre[3] / float(constants.texels_per_mm_at_cm)
        reach = int(np.ceil(reach_mm(method) / mm))
        at = np.arange(-reach, reach + 1)
        dy, dx = (a.reshape(-1) for a in np.meshgrid(at, at, indexing="ij"))
        inside = dx * dx + dy * dy <= reach * reach
        points = _points(dx[inside], dy[inside], divisions)
        texel_x = np.clip(x + points["dx"], 0, gbuffer.width - 1)
        texel_y = np.clip(y + points["dy"], 0, gbuffer.height - 1)
        texel = planes[:, texel_y, texel_x]
        r = np.hypot(points["x"], points["y"]) * mm
        counts = (texel[3] > 0) & (r > mm)
        dz = (texel[3] - centre[3]) * _MM_PER_CM if method.bilateral else 0.0
        away = np.hypot(r, dz)
        weight = np.where(counts, points["area"] * mm * mm / np.where(r > 0, r, 1), 0.0)
        if method.normal_weights:
            weight = weight * np.sqrt(np.clip(0.5 + 0.5 * centre[4:] @ texel[4:], 0, 1))
        for c in range(3):
            w = weight * (np.exp(-away / d[c]) + np.exp(-away / (3 * d[c]))) / (4 * d[c])
            sum_c, within = float(w @ texel[c]), float(cdf(mm, d[c]))
            if method.weights == "self-normalised":
                mean = sum_c / w.sum() if w.sum() > 0 else centre[c]
                result[y, x, c] = mean * (1 - within) + centre[c] * within
            else:
                result[y, x, c] = sum_c / (2 * np.pi) + centre[c] * within
    return result


def _points(
    dx: npt.NDArray[np.int64], dy: npt.NDArray[np.int64], divisions: tuple[tuple[int, int], ...]
) -> dict[str, npt.NDArray[Any]]:
    """The points of texels: their texel's offset dx, dy, their own x, y, in texels, and area."""
    parts = np.ones(len(dx), np.int64)
    for side, divided in divisions:
        parts[np.maximum(abs(dx), abs(dy)) <= side] = divided
    columns: dict[str, list[npt.NDArray[Any]]] = {n: [] for n in ("dx", "dy", "x", "y", "area")}
    for divided in np.unique(parts):
        own_x, own_y = dx[parts == divided], dy[parts == divided]
        at = (np.arange(divided) + 0.5) / divided - 0.5
        down, across = (a.reshape(-1) for a in np.meshgrid(at, at, indexing="ij"))
        columns["dx"].append(np.repeat(own_x, divided**2))
        columns["dy"].append(np.repeat(own_y, divided**2))
        columns["x"].append((own_x[:, None] + across).reshape(-1))
        columns["y"].append((own_y[:, None] + down).reshape(-1))
        columns["area"].append(np.full(len(own_x) * divided**2, 1.0 / divided**2))
    return {name: np.concatenate(values) for name, values in columns.items()}


def _checked(gbuffer: GBuffer, method: Method, pixels: Mask | None) -> Mask:
    if not method.centre_reweighting:
        raise InputError(
            "method: centre_reweighting False: the dense evaluation needs True, as a texel's own "
            "light has no distance"
        )
    return gbuffer.subsurface if pixels is None else gbuffer.subsurface & pixels


def _planes(gbuffer: GBuffer) -> Float:
    """(7, h, w) float32: light, depth in cm (0 where nothing scatters) and normal, as the set-up
    and the normals' texture round them.
    """
    mask = gbuffer.subsurface
    light = resources.to_setup(np.maximum(gbuffer.irradiance, np.float32(0)))
    depth = resources.to_setup(np.maximum(gbuffer.depth_cm, resources.HALF_NORMAL_MIN))
    packed = resources.pack_normals(gbuffer.normal)
    normal = [
        ((packed >> np.uint32(shift) & np.uint32(1023)).astype(np.float32) * 2 - 1023) / 1023
        for shift in (0, 10, 20)
    ]
    lit = [np.where(mask, light[..., c], 0) for c in range(3)]
    return np.stack([*lit, np.where(mask, depth, 0), *normal]).astype(np.float32)


def _macros(method: Method) -> tuple[str, ...]:
    values = {
        "WIDTH": _WIDTH,
        "BILATERAL": int(method.bilateral),
        "NORMAL_WEIGHTS": int(method.normal_weights),
        "SELF_NORMALISED": int(method.weights == "self-normalised"),
    }
    return tuple(f"-D{name}={value}" for name, value in values.items())


@cache
def _kernel(device: Device, macros: tuple[str, ...]) -> cl.Kernel:
    import pyopencl as cl

    folder = files.files("kernels")
    text = "\n".join(
        folder.joinpath(name).read_text() for name in ("maths/polynomial.cl", "dense.cl")
    )
    return cl.Kernel(device.build(text, macros), "dense")


def _upload(device: Device, array: npt.NDArray[Any]) -> cl.Buffer:
    import pyopencl as cl

    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    return cl.Buffer(device.context, flags, hostbuf=np.ascontiguousarray(array))
