"""The taps of the separable filter: offsets along a line and a weight per channel.

[JZJ15] Jimenez et al., Separable Subsurface Scattering, Computer Graphics Forum 34(6), 2015; facts
sheet 5. Offsets lie densest at the centre: o |o| / R for o even on [-R, R], R = 3 for more than 20
taps, else 2. A tap stands for the stretch up to half way to its neighbours.

Two profiles:

- Burley's, pre-integrated: the weight of a tap is the share of the profile's light that ends
  between two parallel lines, so that light which changes along one axis alone is blurred exactly.
  (Its value on the line has a pole in the middle.) One unit of offset is the diffuse mean free path
  over 2.229, at least 1 mm.
- The skin profile: five Gaussians of the distance over each channel's falloff, times the length of
  the stretch; what the profile leaves to the surface itself is kept by `SKIN_STRENGTH`. One unit of
  offset is 1 mm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.maths.profile import Profile, cdf, pdf
from kernels.method import Method

#: (weight, variance in mm^2) of the skin profile's Gaussians but for the narrowest.
SKIN_GAUSSIANS = ((0.1, 0.0484), (0.118, 0.187), (0.113, 0.567), (0.358, 1.99), (0.078, 7.41))
#: Width of the profile, and share of the light that takes part, per channel: [JZJ15]'s demo.
SKIN_FALLOFF = (1.0, 0.37, 0.3)
SKIN_STRENGTH = (0.48, 0.41, 0.28)

_MM_PER_UNIT_MIN = 1.0
_DMFP_PER_UNIT = 2.229
#: Profile scales beyond which nothing is left of the light: e^(-60 / 3).
_REACH = 60.0
_NODES = np.polynomial.legendre.leggauss(64)

Float64 = npt.NDArray[np.float64]


def unit_offsets(num_taps: int) -> Float64:
    """(num_taps,) ascending offsets in units. num_taps: odd, so that one is 0."""
    reach = 3.0 if num_taps > 20 else 2.0
    even = (2.0 * np.arange(num_taps) - (num_taps - 1)) / (num_taps - 1)
    return reach * even * np.abs(even)


def line_share(distance: Any, d: float) -> Any:
    """Share of Burley's light that ends within a distance of a line through the point of entry.

    Light that ends at radius r does so with probability 2 / pi asin(a / r) within a of the line, or
    1 where r <= a. distance: a >= 0, mm. d: the profile's scale, mm.
    """
    a = np.atleast_1d(np.asarray(distance, np.float64))
    share = np.zeros_like(a)
    positive = (a > 0) & (a < _REACH * d)
    share[a >= _REACH * d] = 1.0
    near = a[positive][:, None]
    # r = a e^(s^2): no root at r = a, and as many nodes for each octave of r.
    end = np.sqrt(np.log(_REACH * d / near))
    s, weight = (_NODES[0] + 1) / 2 * end, _NODES[1] / 2 * end
    r = near * np.exp(s * s)
    inner = pdf(r, d) * np.arcsin(np.minimum(near / r, 1.0)) * r * 2 * s
    share[positive] = cdf(near[:, 0], d) + (2 / np.pi) * np.sum(inner * weight, axis=1)
    return share


def skin_profile(r: Any, falloff: float) -> Any:
    """The sum of Gaussians at a distance, 1/mm^2. r: mm. falloff: the channel's width."""
    scaled = np.asarray(r, np.float64) / (0.001 + falloff)
    return sum(
        weight * np.exp(-scaled * scaled / (2 * variance)) / (2 * np.pi * variance)
        for weight, variance in SKIN_GAUSSIANS
    )


def _edges(offset: Float64) -> Float64:
    """(num_taps + 1,): where the stretches of ascending offsets begin and end."""
    middle = (offset[1:] + offset[:-1]) / 2
    return np.concatenate([offset[:1], middle, offset[-1:]])


def _burley_weights(offset: Float64, profile: Profile) -> Float64:
    edges = _edges(offset)
    shares = [np.sign(edges) * line_share(np.abs(edges), d) for d in profile.d_mm]
    weights = np.diff(np.stack(shares, axis=1), axis=0)
    found: Float64 = weights / weights.sum(axis=0)
    return found


def _skin_weights(offset: Float64) -> Float64:
    stretch = np.diff(_edges(offset))
    weights = np.stack([stretch * skin_profile(offset, f) for f in SKIN_FALLOFF], axis=1)
    weights *= np.asarray(SKIN_STRENGTH) / weights.sum(axis=0)
    weights[len(offset) // 2] += 1 - np.asarray(SKIN_STRENGTH)
    return weights


def make_taps(method: Method) -> npt.NDArray[np.float32]:
    """(num_taps, 4) float32: offset in mm, and the weight of red, green and blue; weights add up to
    1. The centre tap comes first, the others in ascending order.
    """
    unit = unit_offsets(method.num_taps)
    if method.separable_profile == "burley":
        mm_per_unit = max(method.profile.dmfp_max_mm / _DMFP_PER_UNIT, _MM_PER_UNIT_MIN)
        offset = unit * mm_per_unit
        weights = _burley_weights(offset, method.profile)
    else:
        offset = unit
        weights = _skin_weights(offset)
    taps = np.concatenate([offset[:, None], weights], axis=1)
    centre = method.num_taps // 2
    order = [centre, *(i for i in range(method.num_taps) if i != centre)]
    return taps[order].astype(np.float32)
