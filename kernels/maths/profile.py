"""Burley's normalised diffusion profile: value, density, distribution, its inverses, and the shape
fits.

Sources: [CB15] Christensen and Burley 2015, technical memo 15-04; [G19] Golubev, Sampling Burley's
Normalized Diffusion Profiles, 2019. Lengths are mm; `d` is the profile's scale, the diffuse mean
free path over the shape s(A).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.errors import InputError

#: The constant of the approximate inverse that minimises the mean squared error of the cdf.
APPROXIMATE_C = 2.5715

Numbers = float | npt.NDArray[np.float64]


def evaluate(r: Numbers, d: Numbers, albedo: Numbers = 1.0) -> Any:
    """R(r), 1/mm^2; its integral over the plane is the albedo. [CB15] Eq. 2. `r`: > 0."""
    r = np.asarray(r, np.float64)
    return albedo * (np.exp(-r / d) + np.exp(-r / (3 * d))) / (8 * np.pi * d * r)


def pdf(r: Numbers, d: Numbers) -> Any:
    """Density of the radius, 2 pi r R / A, 1/mm."""
    r = np.asarray(r, np.float64)
    return (np.exp(-r / d) + np.exp(-r / (3 * d))) / (4 * d)


def cdf(r: Numbers, d: Numbers) -> Any:
    """Share of the energy scattered within radius `r`. [CB15] Eq. 11."""
    r = np.asarray(r, np.float64)
    return 1 - np.exp(-r / d) / 4 - 3 * np.exp(-r / (3 * d)) / 4


def inverse_cdf_exact(xi: Numbers, d: Numbers) -> Any:
    """The radius whose cdf is `xi`, in [0, 1). [G19], in the complementary u = 1 - xi."""
    u = 1 - np.asarray(xi, np.float64)
    g = np.cbrt(1 + 4 * u * (2 * u + np.sqrt(1 + 4 * u * u)))
    return 3 * d * np.log((1 + 1 / g + g) / (4 * u))


def inverse_cdf_approximate(xi: Numbers, d: Numbers, c: float = APPROXIMATE_C) -> Any:
    """d ((2 - c) xi - 2) ln(1 - xi): the radius with a relative error of at most 2.4 % up to xi =
    0.8, -14.3 % at 1.
    """
    xi = np.asarray(xi, np.float64)
    return d * ((2 - c) * xi - 2) * np.log1p(-xi)


def shape_searchlight(albedo: Numbers) -> Any:
    """s(A) for a perpendicular beam; the length is the mean free path. [CB15] Eq. 5."""
    a = np.asarray(albedo, np.float64)
    return 1.85 - a + 7 * np.abs(a - 0.8) ** 3


def shape_diffuse(albedo: Numbers) -> Any:
    """s(A) for diffuse surface transmission; the length is the mean free path. [CB15] Eq. 6."""
    a = np.asarray(albedo, np.float64)
    return 1.9 - a + 3.5 * (a - 0.8) ** 2


def shape_dmfp(albedo: Numbers) -> Any:
    """s(A) where the length is the diffuse mean free path on the surface. [CB15] Eq. 8."""
    a = np.asarray(albedo, np.float64)
    return 3.5 + 100 * (a - 0.33) ** 4


@dataclass(frozen=True)
class Profile:
    """One material.

    albedo: per channel, in [0, 1]. dmfp_mm: diffuse mean free path per channel, above 0.
    """

    name: str
    albedo: tuple[float, float, float]
    dmfp_mm: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.albedo) != 3 or not all(0 <= a <= 1 for a in self.albedo):
            raise InputError(f"profile {self.name!r}: albedo {self.albedo}: need three in [0, 1]")
        if len(self.dmfp_mm) != 3 or not all(0 < length < float("inf") for length in self.dmfp_mm):
            raise InputError(f"profile {self.name!r}: dmfp_mm {self.dmfp_mm}: need three above 0")

    @property
    def widest_channel(self) -> int:
        """The channel with the largest diffuse mean free path, whose profile is sampled."""
        return int(np.argmax(self.dmfp_mm))

    @property
    def dmfp_max_mm(self) -> float:
        return max(self.dmfp_mm)

    @property
    def d_mm(self) -> tuple[float, float, float]:
        """Profile scale of each channel."""
        r, g, b = (
            float(length / shape_dmfp(a))
            for length, a in zip(self.dmfp_mm, self.albedo, strict=True)
        )
        return r, g, b

    @property
    def d_sampled_mm(self) -> float:
        """Profile scale of the sampled channel."""
        return self.d_mm[self.widest_channel]


#: Unreal Engine's default profile; d_sampled_mm = 1.7998.
SKIN = Profile(
    "skin",
    albedo=(0.91058, 0.338275, 0.2718),
    dmfp_mm=(26.748, 26.748 * 0.1983 / 2.229, 26.748 * 0.1607 / 2.229),
)
