"""Cameras as data: where they stand, what they look at, how wide they see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from traces.errors import InputError, unknown

Vector = tuple[float, float, float]

MAX_SIZE = 16384

# 1 / tan(15 degrees) = 2 + sqrt(3): a horizontal field of view of 30 degrees, the angle of a
# portrait lens.
PORTRAIT = 3.7320508


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    name: as tables print it.
    position, target: cm, world space. up: the direction that points up in the picture.
    projection_x: M = 1 / tan(fov_x / 2); the width of the frame fixes the field of view, the height
    follows the aspect.
    coverage_rate: share of the frame that is skin at 1920x1080, None if not stated.
    pixels_per_mm: median physical scale over the skin at 1920x1080, None if not stated.
    jitter: where in its pixel each ray goes through, pixels to the right and down of the centre.
    """

    name: str
    position: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    projection_x: float = PORTRAIT
    coverage_rate: float | None = None
    pixels_per_mm: float | None = None
    jitter: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.projection_x) and self.projection_x > 0):
            raise InputError(
                f"camera {self.name}: projection_x {self.projection_x}: must be positive"
            )
        if not np.isfinite([*self.position, *self.target, *self.up]).all():
            raise InputError(f"camera {self.name}: position, target and up must be finite numbers")
        if not all(abs(offset) <= 2 for offset in self.jitter):
            raise InputError(
                f"camera {self.name}: jitter {self.jitter}: allowed are -2 to 2 pixels"
            )
        forward = np.subtract(self.target, self.position)
        if not np.cross(forward, self.up).any():
            raise InputError(
                f"camera {self.name}: cannot look from {self.position} at {self.target}"
            )

    def basis(self) -> tuple[npt.NDArray[np.float64], ...]:
        """Right, up and forward: unit vectors, each (3,).

        Only + - * / and sqrt, so that every machine gets the same bits.
        """
        forward = _unit(np.subtract(self.target, self.position, dtype=np.float64))
        right = _unit(np.cross(forward, np.asarray(self.up, dtype=np.float64)))
        return right, np.cross(right, forward), forward

    def centre_ray(self, width: int) -> npt.NDArray[np.float64]:
        """(3,): the ray through the middle of a frame, 1 long along the view axis: forward, moved
        by the jitter.
        """
        right, up, forward = self.basis()
        if self.jitter == (0.0, 0.0):
            return forward
        pixel = 2.0 / (width * self.projection_x)
        ray: npt.NDArray[np.float64] = (
            forward + right * (self.jitter[0] * pixel) - up * (self.jitter[1] * pixel)
        )
        return ray


# The views of the procedural head, named as in the dissertation. The published times suggest a
# coverage of about 100, 90 and 13 % for close, ear and front; test_scenes.py holds each to its
# stated numbers.
CAMERAS: dict[str, Camera] = {
    camera.name: camera
    for camera in (
        Camera(
            "close", (-7.5, -5.0, 24.0), (-2.2, -4.0, 8.4), coverage_rate=1.0, pixels_per_mm=21.8
        ),
        Camera("ear", (27.0, 1.0, 4.0), (6.8, -1.7, -1.1), coverage_rate=0.90, pixels_per_mm=17.6),
        Camera(
            "front", (0.0, -2.0, 140.0), (0.0, -3.5, 0.0), coverage_rate=0.13, pixels_per_mm=2.7
        ),
        Camera("side", (104.0, -2.0, 1.0), (0.0, -2.0, 0.0), coverage_rate=0.27, pixels_per_mm=3.6),
    )
}


def camera_named(name: str) -> Camera:
    """The procedural head's camera of that name. Raises InputError with the nearest match."""
    if name not in CAMERAS:
        raise unknown("camera", name, CAMERAS)
    return CAMERAS[name]


def check_size(width: int, height: int) -> None:
    """Raise InputError unless both sides are 1 to MAX_SIZE pixels."""
    for side, value in (("width", width), ("height", height)):
        if not 1 <= value <= MAX_SIZE:
            raise InputError(f"{side} {value}: must be from 1 to {MAX_SIZE} pixels")


def _unit(vector: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    x, y, z = vector
    unit: npt.NDArray[np.float64] = vector / np.sqrt(x * x + y * y + z * z)
    return unit
