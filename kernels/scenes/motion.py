"""Moving scenes: functions from frame number to G-buffer, for `frame.render` and `record.record`.

A `MovingScene` renders a scene anew for every camera and rig of its paths; `Relit` changes the
light of a still view without rendering it again; `Overlaid` draws something transparent over any
scene. All are deterministic: the same frame is the same G-buffer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.frame import Scene, gbuffer_of
from kernels.gbuffer import GBuffer
from kernels.scenes.camera import Camera
from kernels.scenes.jitter import Jitter
from kernels.scenes.light import RIG, Rig
from kernels.scenes.paths import CameraPath, Intensity, RigPath, check_finite
from kernels.scenes.velocity import camera_velocity
from traces.errors import InputError


@dataclass(eq=False)
class MovingScene:
    """A scene under a moving camera and moving lights, with the velocity of its surfaces.

    render: the view of one camera under one rig, such as
        `lambda camera, rig: render_head(camera, width, height, rig=rig)`.
    camera, rig: by frame number, see `kernels.scenes.paths`. jitter: None = every ray goes
        through its pixel's centre.
    num_kept: views that are kept, so that what comes again (a still view, a light that flashes, the
        next period of the jitter) is not rendered again; at least 2.
    """

    render: Callable[[Camera, Rig], GBuffer]
    camera: CameraPath
    rig: RigPath = field(default_factory=lambda: lambda frame: RIG)
    jitter: Jitter | None = None
    num_kept: int = 2
    _kept: dict[Any, GBuffer] = field(default_factory=dict, init=False, repr=False)

    def __call__(self, frame: int) -> GBuffer:
        """The frame's G-buffer; the very same object where nothing differs from a kept view."""
        now, before = self.camera(frame), self.camera(max(0, frame - 1))
        if self.jitter is not None:
            now = replace(now, jitter=self.jitter(frame))
        rig = self.rig(frame)
        # A camera that rests after a move has another velocity than while it moved.
        key = (now, rig, before if before != self.camera(frame) else None)
        if key not in self._kept:
            while len(self._kept) >= max(2, self.num_kept):
                del self._kept[next(iter(self._kept))]
            view = self.render(now, rig)
            velocity = camera_velocity(view.depth_cm, now, before)
            self._kept[key] = replace(view, velocity=velocity)
        return self._kept[key]


@dataclass(eq=False)
class Relit:
    """A still view whose light is dimmed and brightened: light adds up, so no view is rendered.

    lit: the view at factor 1. intensity: the factor by frame number; `paths.flash`, `paths.pulse`.
    unlit: the same view at factor 0, such as one with another light still on; None = dark skin
        before the same background.
    Raises InputError: views of different size, or, for a frame, a negative factor.
    """

    lit: GBuffer
    intensity: Intensity
    unlit: GBuffer | None = None
    _latest: tuple[float, GBuffer] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.unlit is None:
            rest = np.where(self.lit.subsurface[..., None], np.float32(0), self.lit.non_subsurface)
            dark = np.zeros_like(self.lit.irradiance)
            self.unlit = replace(self.lit, irradiance=dark, non_subsurface=rest)
        if self.unlit.depth_cm.shape != self.lit.depth_cm.shape:
            raise InputError(
                f"{self.unlit.name}: size {self.unlit.width}x{self.unlit.height}: "
                f"the lit view is {self.lit.width}x{self.lit.height}"
            )

    def __call__(self, frame: int) -> GBuffer:
        """The frame's G-buffer; `lit` and `unlit` themselves at factor 1 and 0."""
        factor = self.intensity(frame)
        if not 0 <= factor < math.inf:
            raise InputError(f"{self.lit.name}: intensity {factor} in frame {frame}: allowed: >= 0")
        assert self.unlit is not None
        if factor in (0.0, 1.0):
            return self.lit if factor else self.unlit
        if self._latest is None or self._latest[0] != factor:
            planes = {
                name: _mix(getattr(self.unlit, name), getattr(self.lit, name), factor)
                for name in ("irradiance", "non_subsurface")
            }
            self._latest = factor, replace(self.lit, **planes)
        return self._latest[1]


@dataclass(eq=False)
class Overlaid:
    """A scene with something transparent over it.

    scene: any scene. draw: (frame, height, width) to (height, width, 4) float32, linear RGB and
    opacity, as `GBuffer.overlay`; `veil`.
    """

    scene: Scene
    draw: Callable[[int, int, int], npt.NDArray[np.float32]]
    _latest: tuple[int, GBuffer] | None = field(default=None, init=False, repr=False)

    def __call__(self, frame: int) -> GBuffer:
        """The frame's G-buffer with its overlay."""
        if self._latest is None or self._latest[0] != frame:
            view = gbuffer_of(self.scene, frame)
            overlay = self.draw(frame, view.height, view.width)
            self._latest = frame, replace(view, overlay=overlay)
        return self._latest[1]


def veil(
    speed_pixels: float = 3.0, radius_rate: float = 0.25, opacity: float = 0.6
) -> Callable[[int, int, int], npt.NDArray[np.float32]]:
    """A translucent striped disc that crosses the picture from left to right again and again: what
    a transparent object looks like to a pass that knows the velocity of the surface behind it only.

    speed_pixels: per frame. radius_rate: share of the height. opacity: of its middle, falling to 0
    at the rim.
    Raises InputError: an opacity outside [0, 1], a radius outside (0, 1].
    """
    check_finite("veil", "speed_pixels", speed_pixels)
    if not 0 <= opacity <= 1:
        raise InputError(f"veil: opacity {opacity}: allowed are 0 to 1")
    if not 0 < radius_rate <= 1:
        raise InputError(f"veil: radius_rate {radius_rate}: allowed are above 0, at most 1")

    def draw(frame: int, height: int, width: int) -> npt.NDArray[np.float32]:
        radius = radius_rate * height
        across = width + 2 * radius
        # It enters at the left edge in frame 0, then moves; Python's % is never negative.
        centre = (radius + frame * speed_pixels) % across - radius
        x = np.arange(width)[None, :] + 0.5 - centre
        y = np.arange(height)[:, None] + 0.5 - 0.5 * height
        inside = np.maximum(0.0, 1.0 - (x * x + y * y) / (radius * radius))
        stripe = np.floor(8 * x / radius) % 2 == 0
        colour = np.where(stripe[..., None], (0.9, 0.95, 1.0), (0.15, 0.25, 0.45))
        colour = np.broadcast_to(colour, (height, width, 3))
        return np.concatenate([colour, opacity * inside[..., None]], axis=2).astype(np.float32)

    return draw


def _mix(dark: Any, bright: Any, factor: float) -> Any:
    return dark + np.float32(factor) * (bright - dark)
