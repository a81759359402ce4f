"""The scenes of `disocclusion`: surfaces that come into view, and how long each has been there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels.scenes.analytic import Circle, circle

if TYPE_CHECKING:
    from experiments.reproduce.film import Float
    from kernels.frame import Scene
    from kernels.gbuffer import GBuffer

EVENTS = ("first frame", "behind the disc", "at the picture's edge")
#: Pixels per frame by which the scrolling picture moves to the left.
SCROLL = 2

#: (h, w) frames since each pixel's surface came into view, by frame; -1 is not of the event.
Ages = Callable[[int], npt.NDArray[np.int64]]


def stage(
    event: str, references: dict[str, Float], ages: int
) -> tuple[Scene, Ages, Callable[[int], Float], int]:
    """(scene, age of each pixel by frame, reference by frame, number of frames) of an event; age -1
    is not of the event. The functions are asked for every frame in order.
    """
    still, scrolling = references["still"], references["scrolling"]
    height, width = still.shape
    if event == EVENTS[0]:
        new = np.zeros((height, width), np.int64)
        return background(width, height), lambda frame: new + frame, lambda frame: still, ages
    if event == EVENTS[1]:
        moving = circle(width, height)
        return moving, LaidOpen(moving), lambda frame: still, 2 * ages

    def rolled(frame: int) -> Float:
        return np.roll(scrolling, -frame * SCROLL, axis=1)

    return scroll(background(width, height)), scroll_age(width, height), rolled, 2 * ages


class LaidOpen:
    """Frames since each pixel's background came out behind the disc; -1 where it never was covered
    or is now. Asked for every frame in order.
    """

    def __init__(self, circle: Any) -> None:
        self._circle = circle
        self._age: Any = None

    def __call__(self, frame: int) -> npt.NDArray[np.int64]:
        disc = self._circle(frame).depth_cm == self._circle.disc_cm
        if self._age is None:
            self._covered, self._age = disc, np.full(disc.shape, -1, np.int64)
        fresh = self._covered & ~disc
        grown = np.where(self._age >= 0, self._age + 1, -1)
        self._age = np.where(disc, -1, np.where(fresh, 0, grown))
        self._covered = disc
        age: npt.NDArray[np.int64] = self._age
        return age


def scroll(view: GBuffer) -> Callable[[int], GBuffer]:
    """The picture moves to the left, and what leaves there comes in again at the right edge."""
    velocity = np.zeros((*view.depth_cm.shape, 2), np.float32)
    velocity[..., 0] = SCROLL

    def at(frame: int) -> GBuffer:
        return replace(roll(view, -frame * SCROLL), velocity=velocity if frame else None)

    return at


def scroll_age(width: int, height: int) -> Ages:
    """Frames since each column came in; -1 for those that have been there from the start."""

    def at(frame: int) -> npt.NDArray[np.int64]:
        from_right = (width - 1 - np.arange(width)) // SCROLL
        age = np.where(from_right < frame, from_right, -1)
        return np.broadcast_to(age, (height, width))

    return at


def background(width: int, height: int) -> GBuffer:
    """The circle scene without its disc."""
    return Circle(width, height, speed_pixels=0.0, radius_rate=1e-6)(0)


def roll(view: GBuffer, pixels: int) -> GBuffer:
    """The picture moved to the right; what leaves there comes in at the left."""
    planes = ("irradiance", "albedo", "non_subsurface", "depth_cm", "normal", "profile_id")
    return replace(view, **{n: np.roll(getattr(view, n), pixels, axis=1) for n in planes})
