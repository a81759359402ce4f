"""Scenes whose G-buffer is a formula: a disc that moves over a background, and a wall that recedes.

`Circle` is the dissertation's disocclusion scene, `wall` the scene of its separation of direct from
distant scattering; the sources show pictures of both and no sizes, which are ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kernels.gbuffer import GBuffer
from kernels.scenes.camera import PORTRAIT, check_size
from traces.errors import InputError

Float = npt.NDArray[np.float32]
#: Offset of each frame's rays from the pixel's centre, pixels right and down.
Offsets = Callable[[int], tuple[float, float]]

_TINT = np.array([1.0, 0.85, 0.75])
_ALBEDO = np.array([0.78, 0.57, 0.45])
_DARK, _BRIGHT = 0.08, 0.9


@dataclass(eq=False)
class Circle:
    """A disc of skin that moves to and fro before a background of skin, each half lit and half dark
    with the edge through the disc's middle: what it lays open has no history.

    width, height: pixels. speed_pixels: per frame, at first to the right; 0 = it rests.
    radius_rate: share of the height. disc_cm, background_cm: depths; more than a tenth apart, so
        that neither passes for the other's history. jitter: None = through the pixels' centres.
    Raises InputError: sizes that are not 1 to 16384, a disc that does not fit or is not in front.
    """

    width: int
    height: int
    speed_pixels: float = 2.0
    radius_rate: float = 0.25
    disc_cm: float = 30.0
    background_cm: float = 40.0
    jitter: Offsets | None = None
    _latest: tuple[object, GBuffer] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        check_size(self.width, self.height)
        if not 0 < self.radius_rate * self.height <= min(self.width, self.height) / 2:
            raise InputError(f"circle: radius_rate {self.radius_rate}: the disc does not fit")
        if not abs(self.speed_pixels) < self.width:
            raise InputError(f"circle: speed_pixels {self.speed_pixels}: need less than the width")
        if not 0 < 1.1 * self.disc_cm < self.background_cm:
            raise InputError(
                f"circle: disc_cm {self.disc_cm}: must be less than background_cm / 1.1"
            )

    def centre(self, frame: int) -> tuple[float, float]:
        """Where the disc's middle is, pixels right and down of the picture's corner."""
        radius = self.radius_rate * self.height
        room = self.width - 2 * radius
        gone = abs(frame * self.speed_pixels) % (2 * room) if room > 0 else 0.0
        return radius + min(gone, 2 * room - gone), self.height / 2

    def __call__(self, frame: int) -> GBuffer:
        """The frame's G-buffer; the very same object where the disc and the jitter rest."""
        offset = self.jitter(frame) if self.jitter else (0.0, 0.0)
        centre, before = self.centre(frame), self.centre(max(0, frame - 1))
        key = offset, centre, before
        if self._latest is None or self._latest[0] != key:
            self._latest = key, self._view(offset, centre, before)
        return self._latest[1]

    def _view(
        self,
        offset: tuple[float, float],
        centre: tuple[float, float],
        before: tuple[float, float],
    ) -> GBuffer:
        x, y = _positions(self.width, self.height, offset)
        radius = self.radius_rate * self.height
        disc = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius * radius
        # Crosswise, so that light changes where the disc passes.
        bright = np.where(disc, y < centre[1], x < self.width / 2)
        velocity = np.where(disc[..., None], np.subtract(before, centre), 0.0)
        return _skin(
            "circle",
            light=np.where(bright, _BRIGHT, _DARK),
            depth=np.where(disc, self.disc_cm, self.background_cm),
            normal=np.array([0.0, 0.0, 1.0]),
            offset=offset,
            velocity=velocity.astype(np.float32) if centre != before else None,
        )


def circle(width: int, height: int) -> Circle:
    """The scene `circle`: the disc moves by an eightieth of the width per frame, at least a pixel,
    and is smaller in pictures that are higher than wide.

    Raises InputError: sizes that are not 1 to 16384.
    """
    check_size(width, height)
    speed = min(max(1.0, width / 80), width / 2)
    return Circle(width, height, speed, radius_rate=0.25 * min(1.0, width / height))


def wall(
    width: int,
    height: int,
    *,
    near_pixels_per_mm: float = 0.2,
    far_pixels_per_mm: float = 0.002,
    offset: tuple[float, float] = (0.0, 0.0),
) -> GBuffer:
    """A flat upright wall that recedes from the left edge of the picture to the right; its upper
    half is lit.

    Its scale falls evenly from one edge to the other, as the inverse depth of any plane does: so
    far away that a pixel holds most of the scattering, whose distant share is 1 - cdf(r_px).

    near_pixels_per_mm, far_pixels_per_mm: at the left and the right edge. offset: of the rays from
        the pixels' centres, pixels right and down.
    Raises InputError: sizes that are not 1 to 16384, scales that do not fall or are not positive.
    """
    check_size(width, height)
    if not 0 < far_pixels_per_mm <= near_pixels_per_mm < np.inf:
        raise InputError(
            f"wall: far_pixels_per_mm {far_pixels_per_mm}: allowed are above 0 to "
            f"near_pixels_per_mm = {near_pixels_per_mm}"
        )
    x, y = _positions(width, height, offset)
    scale = near_pixels_per_mm + (far_pixels_per_mm - near_pixels_per_mm) * (x / width)
    # 1 / depth = slope * X + middle, X = x of the ray at depth 1: the plane slope x + middle z = 1.
    inverse = scale / (0.05 * width * PORTRAIT)
    ends = np.array([near_pixels_per_mm, far_pixels_per_mm]) / (0.05 * width * PORTRAIT)
    slope, middle = (ends[1] - ends[0]) * PORTRAIT / 2, (ends[0] + ends[1]) / 2
    # World space: x right, y up, z towards the camera.
    normal = np.array([-slope, 0.0, middle]) / np.sqrt(slope * slope + middle * middle)
    lit = np.broadcast_to(y < height / 2, (height, width))
    return _skin(
        "wall",
        light=np.where(lit, _BRIGHT, _DARK),
        depth=np.broadcast_to(1 / inverse, (height, width)),
        normal=normal,
        offset=offset,
    )


def _positions(
    width: int, height: int, offset: tuple[float, float]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(x, y) of each pixel's ray, (1, width) and (height, 1)."""
    x = np.arange(width, dtype=np.float64)[None, :] + (0.5 + offset[0])
    y = np.arange(height, dtype=np.float64)[:, None] + (0.5 + offset[1])
    return x, y


def _skin(
    name: str,
    light: npt.NDArray[np.float64],
    depth: npt.NDArray[np.float64],
    normal: npt.NDArray[np.float64],
    offset: tuple[float, float],
    velocity: Float | None = None,
) -> GBuffer:
    """A frame full of skin. light: (h, w) share of full light. normal: (3,). offset: of the rays
    from the pixels' centres.
    """
    shape = light.shape

    def plane(colour: npt.NDArray[np.float64]) -> Float:
        return np.broadcast_to(colour, (*shape, 3)).astype(np.float32)

    return GBuffer(
        name=name,
        irradiance=plane(light[..., None] * _TINT),
        albedo=plane(_ALBEDO),
        non_subsurface=np.zeros((*shape, 3), np.float32),
        depth_cm=depth.astype(np.float32),
        normal=plane(normal),
        profile_id=np.ones(shape, np.uint8),
        projection_x=PORTRAIT,
        velocity=velocity,
        jitter=offset,
    )
