"""Holds a device to the NumPy reference on a small frame: the number of lane fetches that
differ.
"""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.opencl.device import Device
from kernels.pipeline import Pipeline, TraceTarget
from kernels.reference import render_reference
from traces.texture import WARP_SIZE

_counted: dict[tuple[Device, Method], int] = {}


def small_gbuffer(width: int = 44, height: int = 27, depth_cm: float = 30.0) -> GBuffer:
    """A tilted, wavy disc with a hard shadow edge on an empty background; `depth_cm` sets the
    texels per mm.
    """
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    disc = ((x - width / 2) / (width / 2.2)) ** 2 + ((y - height / 2) / (height / 2.1)) ** 2 < 1
    depth = depth_cm * (1 + 0.05 * (x / width - 0.5) + 0.03 * (y > height * 0.7))
    normal = np.stack([0.4 * np.sin(x / 3), 0.3 * np.cos(y / 4), np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = np.where(x + 0.4 * y > width * 0.6, 0.9, 0.04)[..., None] * np.array([1.0, 0.8, 0.7])
    mask = disc[..., None]
    return GBuffer(
        name="check",
        irradiance=np.where(mask, light, 0).astype(np.float32),
        albedo=np.full((height, width, 3), 0.7, np.float32),
        non_subsurface=np.where(mask, 0.02, 0.3).astype(np.float32) * np.ones(3, np.float32),
        depth_cm=np.where(disc, depth, 0).astype(np.float32),
        normal=np.where(mask, normal, 0).astype(np.float32),
        profile_id=disc.astype(np.uint8),
        projection_x=3.732,
    )


def count_differences(device: Device, method: Method) -> int:
    """Lane fetches of a small frame (adaptive: of two) that differ between device and reference; 0
    = the device complies.

    A launch whose rows are laid out differently counts with every lane of the reference.
    """
    key = (device, method)
    if key not in _counted:
        gbuffer, num_frames = small_gbuffer(), 2 if method.adaptive or method.taa else 1
        expected = render_reference(gbuffer, method, num_frames)
        pipeline = Pipeline(method, gbuffer.width, gbuffer.height, device)
        pipeline.load(gbuffer)
        _counted[key] = sum(
            _count_in_frame(pipeline, frame, found.launches) for frame, found in enumerate(expected)
        )
    return _counted[key]


def _count_in_frame(pipeline: Pipeline, frame: int, launches: list) -> int:  # type: ignore[type-arg]
    """Run a frame traced and compare it with the reference's launches."""
    differing = 0
    for step, offsets, expected in launches:
        states = pipeline.states_of(step, frame)
        if not step.grid.num_warps:
            continue
        rows = step.program(pipeline.method, frame).row_offsets(states)
        lanes = np.empty((int(rows[-1]), WARP_SIZE), np.uint32)
        target = TraceTarget(
            pipeline.allocate(lanes.nbytes), pipeline.upload(rows[:-1].astype(np.uint32)), 0
        )
        pipeline.run_warps(step, frame, pipeline.upload(states), 0, step.grid.num_warps, target)
        if np.array_equal(rows, offsets):
            cl.enqueue_copy(pipeline.device.queue, lanes, target.lanes)
            differing += int(np.count_nonzero(lanes != expected))
        else:
            differing += expected.size
    return differing
