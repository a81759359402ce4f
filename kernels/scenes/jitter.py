"""Sub-pixel jitter: where inside its pixel each frame samples, so that accumulated frames filter
the picture.

Points of Halton's sequence in bases 2 and 3 [Karis14], spread as the filter weighs, so that equal
weights accumulate to it. [Karis14] Karis, High Quality Temporal Supersampling, SIGGRAPH 2014: the
sequence, and a normal distribution near the Blackman-Harris window of 3.3 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from kernels.maths.polynomial import poly_cos_sin, poly_exp, poly_log
from traces.errors import InputError, unknown

FILTERS = ("box", "gaussian")
#: Standard deviation of the Gaussian, pixels: e^(-2.29 x^2) fits the window of [Karis14].
SIGMA = 0.467
#: It is cut off at this distance, pixels.
CUT = 1.5


@dataclass(frozen=True)
class Jitter:
    """A periodic sequence of offsets from the pixel's centre.

    filter: "box" fills the pixel evenly; "gaussian" as the normal distribution of `SIGMA`, cut off
        at `CUT`. num_points: length of the period, 1 to 1024; Karis takes 8.
    """

    filter: str = "box"
    num_points: int = 8

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise unknown("filter", self.filter, FILTERS, "jitter")
        if not 1 <= self.num_points <= 1024:
            raise InputError(f"jitter: num_points {self.num_points}: allowed are 1 to 1024")

    @cached_property
    def points(self) -> npt.NDArray[np.float64]:
        """(num_points, 2): offsets to the right and down, pixels; their mean is 0."""
        index = np.arange(1, self.num_points + 1)
        u, v = radical_inverse(index, 2), radical_inverse(index, 3)
        points = np.stack([u, v], axis=-1) - 0.5
        if self.filter == "gaussian":
            points = _to_gaussian(u, v)
        # A mean beside the centre would shift the picture.
        centred: npt.NDArray[np.float64] = points - sum(points) / self.num_points
        return centred

    def __call__(self, frame: int) -> tuple[float, float]:
        """The frame's offset, pixels to the right and down."""
        x, y = self.points[frame % self.num_points]
        return float(x), float(y)


def radical_inverse(index: npt.NDArray[np.int64], base: int) -> npt.NDArray[np.float64]:
    """The digits of each index mirrored at the point: in [0, 1)."""
    result, share, rest = np.zeros(index.shape), 1.0 / base, np.asarray(index)
    while rest.any():
        result = result + share * (rest % base)
        rest, share = rest // base, share / base
    return result


def _to_gaussian(u: npt.NDArray[np.float64], v: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Box and Muller's transform, cut off at radius `CUT`; our own functions, for the same bits."""
    beyond = poly_exp(np.array([-0.5 * (CUT / SIGMA) ** 2], np.float32))
    kept = (1 - u * (1 - beyond)).astype(np.float32)
    radius = SIGMA * np.sqrt(-2.0 * poly_log(kept).astype(np.float64))
    cosine, sine = poly_cos_sin((v * 2.0**32).astype(np.uint64).astype(np.uint32))
    return np.stack([radius * cosine, radius * sine], axis=-1)
