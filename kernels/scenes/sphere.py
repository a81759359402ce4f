"""A ball of skin under one distant light without shadows: curved geometry whose G-buffer is a
formula.

World space: x right, y up, the camera on +z looking at the ball's middle, the origin.
"""

from __future__ import annotations

import numpy as np

from kernels.gbuffer import GBuffer
from kernels.scenes.camera import PORTRAIT, Vector, check_size
from traces.errors import InputError

ALBEDO = (0.78, 0.57, 0.45)
#: Towards the light: from the side, so that the edge of the shade lies across the ball.
SIDEWAYS: Vector = (1.0, 0.4, 0.3)


def sphere(
    width: int,
    height: int,
    *,
    radius_cm: float = 5.0,
    distance_cm: float = 40.0,
    towards: Vector = SIDEWAYS,
) -> GBuffer:
    """The ball's G-buffer; light of irradiance 1 on a surface that faces it.

    width, height: pixels. radius_cm: of the ball. distance_cm: from the camera to its middle.
    towards: to the light, any length.
    Raises InputError: sizes that are not 1 to 16384, a camera inside the ball, no direction.
    """
    check_size(width, height)
    if not 0 < radius_cm < distance_cm:
        raise InputError(
            f"sphere: radius_cm {radius_cm}: allowed are above 0 to distance_cm = {distance_cm}"
        )
    length = float(np.linalg.norm(towards))
    if not 0 < length < np.inf:
        raise InputError(f"sphere: towards {towards}: must be a finite direction")
    pixel = 2.0 / (width * PORTRAIT)
    x = ((np.arange(width) + 0.5 - width / 2) * pixel)[None, :]
    y = ((height / 2 - np.arange(height) - 0.5) * pixel)[:, None]
    # Of the ray (x, y, -1) t: (1 + x^2 + y^2) t^2 - 2 distance t + distance^2 - radius^2 = 0.
    a = 1 + x * x + y * y
    root = distance_cm**2 - a * (distance_cm**2 - radius_cm**2)
    hit = root > 0
    depth = np.where(hit, (distance_cm - np.sqrt(np.where(hit, root, 0))) / a, 0)
    normal = np.stack([x * depth, y * depth, distance_cm - depth], axis=-1) / radius_cm
    normal = np.where(hit[..., None], normal, 0)
    received = np.maximum(normal @ (np.asarray(towards) / length), 0)
    skin = hit[..., None] * np.asarray(ALBEDO)
    return GBuffer(
        name="sphere",
        irradiance=np.repeat(received[..., None], 3, axis=2).astype(np.float32),
        albedo=skin.astype(np.float32),
        non_subsurface=np.zeros((height, width, 3), np.float32),
        depth_cm=depth.astype(np.float32),
        normal=normal.astype(np.float32),
        profile_id=hit.astype(np.uint8),
        projection_x=PORTRAIT,
    )
