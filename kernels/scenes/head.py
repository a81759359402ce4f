"""The procedural head: a signed-distance field of a man's head, sphere-traced in OpenCL.

Needs no data file.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels.gbuffer import GBuffer
from kernels.opencl.device import Device, open_device
from kernels.scenes.camera import Camera, check_size
from kernels.scenes.light import RIG, Rig

if TYPE_CHECKING:
    from collections.abc import Callable

    import pyopencl as cl

SOURCE_FILES = ("head_shape.cl", "head_skin.cl", "head.cl")
TILE = 8
# Work-group sizes are fixed, as PoCL compiles a kernel anew for every size it meets.
START_GROUP = (4, 4)
RENDER_GROUP = (16, 4)
# Nodes of the distance grid, as in head_shape.cl.
GRID = (54, 168, 132)
# Pixels in flight on the device at once: 53 bytes each, so 14 MB whatever the size of the picture.
BAND_PIXELS = 1 << 18
# Plane of the G-buffer: channels. In the order of the kernel's arguments.
_PLANES = {"irradiance": 3, "albedo": 3, "non_subsurface": 3, "depth_cm": 1, "normal": 3}


def source() -> str:
    """The OpenCL source of the head, all files in order."""
    return "\n".join(
        resources.files("kernels.scenes").joinpath(name).read_text("utf-8") for name in SOURCE_FILES
    )


def render_head(
    camera: Camera,
    width: int,
    height: int,
    device: Device | None = None,
    rig: Rig = RIG,
    progress: Callable[[float], None] | None = None,
) -> GBuffer:
    """Render the head, band by band of rows.

    camera: where from. width, height: pixels. device: None opens the default one. rig: the lights.
    progress: called with the share done, in [0, 1], after each band.
    Returns a GBuffer of (height, width); profile 1 is skin, eyes and shirt are profile 0.
    The same bits on every device that rounds division and square root correctly.
    Raises InputError where a side is not 1 to 16384 pixels or no skin is in view.
    """
    check_size(width, height)
    device = device or open_device()
    import pyopencl as cl  # after the drivers are set up

    start_kernel, render_kernel, grid = _kernels(device)
    view = _view(camera, width)
    lights = rig.as_array()
    flags = cl.mem_flags
    light_buffer = cl.Buffer(
        device.context,
        flags.READ_ONLY | flags.COPY_HOST_PTR,
        hostbuf=lights if lights.size else np.zeros(8, np.float32),
    )
    planes: dict[str, Any] = {
        name: np.empty((height, width, channels) if channels > 1 else (height, width), np.float32)
        for name, channels in _PLANES.items()
    }
    profile = np.empty((height, width), np.uint8)

    band_rows = min(height, max(TILE, BAND_PIXELS // width // TILE * TILE))
    tiles_x, tiles_y = -(-width // TILE), -(-band_rows // TILE)
    band = width * band_rows
    start = cl.Buffer(device.context, flags.READ_WRITE, 4 * tiles_x * tiles_y)
    outputs = [
        cl.Buffer(device.context, flags.WRITE_ONLY, 4 * channels * band)
        for channels in _PLANES.values()
    ]
    profile_buffer = cl.Buffer(device.context, flags.WRITE_ONLY, band)

    for first_row in range(0, height, band_rows):
        rows = min(band_rows, height - first_row)
        geometry: tuple[Any, ...] = (
            *view,
            np.int32(width),
            np.int32(height),
            np.int32(first_row),
            np.int32(rows),
            np.int32(tiles_x),
            grid,
        )
        tiles = (tiles_x, -(-rows // TILE))
        start_kernel(device.queue, _padded(tiles, START_GROUP), START_GROUP, *geometry, start)
        render_kernel(
            device.queue,
            _padded((width, rows), RENDER_GROUP),
            RENDER_GROUP,
            *geometry,
            start,
            np.int32(len(lights)),
            light_buffer,
            _float4(rig.ambient),
            _float4(rig.background),
            *outputs,
            profile_buffer,
        )
        for plane, buffer in zip(planes.values(), outputs, strict=True):
            cl.enqueue_copy(device.queue, plane[first_row : first_row + rows], buffer)
        cl.enqueue_copy(device.queue, profile[first_row : first_row + rows], profile_buffer)
        if progress is not None:
            progress((first_row + rows) / height)
    return GBuffer(
        name=camera.name,
        profile_id=profile,
        projection_x=camera.projection_x,
        jitter=camera.jitter,
        **planes,
    )


@cache
def _kernels(device: Device) -> tuple[cl.Kernel, cl.Kernel, cl.Buffer]:
    """The kernels and the distance grid, which depends on nothing but the shape: once per
    device.
    """
    import pyopencl as cl

    exact = device.correctly_rounded or "cl_khr_fp64" not in device.context.devices[0].extensions
    program = device.build(source(), [] if exact else ["-D HEAD_DOUBLE"])
    grid = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 4 * GRID[0] * GRID[1] * GRID[2])
    cl.Kernel(program, "head_grid")(device.queue, GRID, None, grid)
    return cl.Kernel(program, "head_start"), cl.Kernel(program, "head_render"), grid


def _view(camera: Camera, width: int) -> list[npt.NDArray[Any]]:
    """Origin, right, up, the middle ray as float4; .w of right and up is the size of a pixel at
    unit depth.
    """
    right, up, _ = camera.basis()
    pixel = 2.0 / (width * camera.projection_x)
    return [
        _float4(camera.position),
        _float4((*right, pixel)),
        _float4((*up, pixel)),
        _float4(camera.centre_ray(width)),
    ]


def _padded(size: tuple[int, int], group: tuple[int, int]) -> tuple[int, int]:
    """The next multiple of the work-group; the kernels leave out what lies beyond."""
    return -(-size[0] // group[0]) * group[0], -(-size[1] // group[1]) * group[1]


def _float4(values: tuple[float, ...] | npt.NDArray[Any]) -> npt.NDArray[Any]:
    import pyopencl as cl

    vector = np.zeros((), cl.cltypes.float4)
    for name, value in zip("xyzw", values, strict=False):
        vector[name] = value
    return vector
