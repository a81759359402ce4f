"""The G-buffer: what a scene hands to the subsurface passes, whatever made it (procedural head,
mesh, capture).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from traces.errors import InputError

Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class GBuffer:
    """One view of a scene.

    name: as tables print it. attribution: the line to show beside pictures, "" if none is owed.
    irradiance: (h, w, 3) float32, linear, diffuse lighting without albedo; what subsurface
        scattering blurs.
    albedo: (h, w, 3) float32 in [0, 1], linear base colour, multiplied after scattering.
    non_subsurface: (h, w, 3) float32, linear: speculars, background and everything that does not
        scatter.
    depth_cm: (h, w) float32, linear view depth in cm; 0 where nothing is.
    normal: (h, w, 3) float32, unit world-space normal; 0 where nothing is.
    profile_id: (h, w) uint8; 0 = no subsurface scattering, 1 = skin.
    projection_x: M = 1 / tan(fov_x / 2), so that pixels per mm at depth z cm = 0.05 * w * M / z
        (facts sheet 2.5).
    velocity: (h, w, 2) float32, texels: where the surface of a pixel stood in the previous frame,
        minus where it stands now; None = nothing moves.
    overlay: (h, w, 4) float32, linear RGB and opacity in [0, 1] of something transparent before all
        the rest, which no plane above knows of; None = nothing.
    importance: (h, w) float32 in [0, 1], painted: where the hybrid method should sample; None = no
        such picture.
    jitter: pixels to the right and down of each pixel's centre, where the camera's rays go through.
    """

    name: str
    irradiance: Float
    albedo: Float
    non_subsurface: Float
    depth_cm: Float
    normal: Float
    profile_id: npt.NDArray[np.uint8]
    projection_x: float
    attribution: str = ""
    velocity: Float | None = None
    overlay: Float | None = None
    importance: Float | None = None
    jitter: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        height, width = self.depth_cm.shape if self.depth_cm.ndim == 2 else (0, 0)
        if not height or not width:
            raise InputError(
                f"{self.name}: depth: shape {self.depth_cm.shape}: need (height, width)"
            )
        for field in ("irradiance", "albedo", "non_subsurface", "normal"):
            self._check(field, (height, width, 3), np.float32)
        self._check("depth_cm", (height, width), np.float32)
        self._check("profile_id", (height, width), np.uint8)
        if self.velocity is not None:
            self._check("velocity", (height, width, 2), np.float32)
        if self.overlay is not None:
            self._check("overlay", (height, width, 4), np.float32)
            if not (0 <= self.overlay[..., 3].min() and self.overlay[..., 3].max() <= 1):
                raise InputError(f"{self.name}: overlay: opacity: allowed are 0 to 1")
        if (self.depth_cm < 0).any():
            raise InputError(
                f"{self.name}: depth_cm: negative values; allowed are 0 (nothing) and up"
            )
        if self.importance is not None:
            self._check("importance", (height, width), np.float32)
            if not (0 <= self.importance.min() and self.importance.max() <= 1):
                raise InputError(f"{self.name}: importance: allowed are 0 to 1")
        if not all(abs(offset) <= 2 for offset in self.jitter):
            raise InputError(f"{self.name}: jitter {self.jitter}: allowed are -2 to 2 pixels")
        if not self.projection_x > 0:
            raise InputError(f"{self.name}: projection_x {self.projection_x}: must be positive")
        if not ((self.profile_id > 0) & (self.depth_cm > 0)).any():
            raise InputError(
                f"{self.name}: the G-buffer is empty: no pixel has a profile and a depth"
            )

    def _check(self, field: str, shape: tuple[int, ...], dtype: type) -> None:
        value = getattr(self, field)
        if value.shape != shape or value.dtype != dtype:
            raise InputError(
                f"{self.name}: {field}: {value.dtype} of shape {value.shape}: "
                f"need {np.dtype(dtype)} of {shape}"
            )
        if not np.isfinite(value).all():
            raise InputError(
                f"{self.name}: {field}: NaN or infinite values; only finite ones are allowed"
            )

    @property
    def height(self) -> int:
        return int(self.depth_cm.shape[0])

    @property
    def width(self) -> int:
        return int(self.depth_cm.shape[1])

    @property
    def subsurface(self) -> npt.NDArray[np.bool_]:
        """(h, w) bool: the pixels that scatter."""
        mask: npt.NDArray[np.bool_] = (self.profile_id > 0) & (self.depth_cm > 0)
        return mask

    @property
    def coverage_rate(self) -> float:
        """Share of the frame's pixels that scatter."""
        return float(self.subsurface.mean())

    def pixels_per_mm(self) -> float:
        """Median over the scattering pixels, physical scale."""
        depth = np.median(self.depth_cm[self.subsurface])
        return float(0.05 * self.width * self.projection_x / depth)
