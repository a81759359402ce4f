"""Velocity: where the surface of each pixel stood in the picture of the previous frame's camera.

Positions are those of the pictures without jitter, so that a still view has velocity 0 whatever its
jitter. Only + - * / and sqrt: the same bits on every machine.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.scenes.camera import Camera

#: What lay behind the previous camera gets this velocity, texels: off every screen.
BEHIND = -32768.0


def camera_velocity(
    depth_cm: npt.NDArray[np.float32], now: Camera, before: Camera
) -> npt.NDArray[np.float32] | None:
    """The velocity of still surfaces under a moving camera.

    depth_cm: (height, width) view depth of each pixel's ray, cm; 0 = infinitely far, whose velocity
        is that of the camera's rotation. now: the camera that saw it. before: the previous frame's.
    Returns (height, width, 2) float32, texels right and down: the place in the previous picture
        minus the place now; None where the cameras differ in nothing but name and jitter.
    """
    if _unjittered(now) == _unjittered(before):
        return None
    height, width = depth_cm.shape
    x = np.arange(width)[None, :] + (0.5 + now.jitter[0])
    y = np.arange(height)[:, None] + (0.5 + now.jitter[1])
    pixel = 2.0 / (width * now.projection_x)
    rays = _ray(now, (x - width / 2) * pixel, (height / 2 - y) * pixel)

    # From the previous camera: depth times ray plus the move; what is infinitely far has no move.
    right, up, forward = before.basis()
    exists = depth_cm > 0
    depth = np.where(exists, depth_cm, 1).astype(np.float64)
    move = [a - b for a, b in zip(now.position, before.position, strict=True)]
    seen = [ray * depth + step * exists for ray, step in zip(rays, move, strict=True)]
    ahead = _dot(seen, forward)
    in_front = ahead > 0
    ahead = np.where(in_front, ahead, 1)
    pixel = 2.0 / (width * before.projection_x)
    past_x = width / 2 + _dot(seen, right) / (ahead * pixel)
    past_y = height / 2 - _dot(seen, up) / (ahead * pixel)
    moved = np.stack([past_x - x, past_y - y], axis=-1)
    moved = np.where(in_front[..., None], np.clip(moved, BEHIND, -BEHIND), BEHIND)
    return moved.astype(np.float32)


def _ray(camera: Camera, x: Any, y: Any) -> list[Any]:
    """The three components of the ray, 1 long along the view axis, through a point of the plane at
    depth 1.
    """
    right, up, forward = camera.basis()
    return [f + r * x + u * y for r, u, f in zip(right, up, forward, strict=True)]


def _dot(vector: list[Any], axis: Any) -> Any:
    return vector[0] * axis[0] + vector[1] * axis[1] + vector[2] * axis[2]


def _unjittered(camera: Camera) -> Camera:
    return replace(camera, name="", jitter=(0.0, 0.0), coverage_rate=None, pixels_per_mm=None)
