"""The variance between one pixel's own samples, which estimators without history count by.

Facts sheet 3.1 tracks the variance of the mean over frames; [Xie20]'s single-frame metric and
two-pass sampling take it from one frame's samples instead: n = sigma^2 n / sigma_0^2. The twin of
what sampling.cl does under SPREAD.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kernels.method import Method
from kernels.passes.update import find_luminance

_F = np.float32
_ONE = _F(1)


def find_spread(
    moments: Any, result: Any, centre: Any, beyond: Any, counts: Any, method: Method
) -> tuple[Any, Any]:
    """(variance of the mean, mean) of what the update pass would track, from a frame's own samples:
    the luminance of the colour's, or of its distant part's, 1/2.2 power; float32.

    With each sample's part u of the luminance and its weight w in it, the estimate is Y = sum u /
    sum w, a ratio of two sums, whose variance is n / (n - 1) sum (u - Y w)^2 / (sum w)^2. The share
    of the profile beyond the centre pixel and the slope of the 1/2.2 power scale it.

    moments: sums of u, w, u^2, u w and w^2. result, centre: (..., 4) colours. beyond: share of red,
        green, blue and the sampled channel.
    """
    sum_y, total_y, square_y, cross_y, square_w = moments
    tracked = [result[..., c] for c in range(3)]
    if method.separates:
        tracked = [
            np.maximum(value - centre[..., c] * (_ONE - beyond[c]), _F(0))
            for c, value in enumerate(tracked)
        ]
    if not method.centre_reweighting:
        share: Any = _ONE
    elif method.weights == "self-normalised":
        share = weigh(*beyond[:3])
    else:
        share = beyond[3]
    linear = weigh(*tracked)
    mean = find_luminance(np.stack(tracked, axis=-1))
    total = np.where(total_y > 0, total_y, _ONE)
    mean_y = sum_y / total
    squares = square_y - _F(2) * mean_y * cross_y + mean_y * mean_y * square_w
    drawn = counts.astype(_F)
    of_mean = np.maximum(squares, _F(0)) / (total * total) * (drawn / (drawn - _ONE))
    slope = mean * share / (_F(2.2) * np.where(linear > 0, linear, _ONE))
    return slope * slope * of_mean, mean


def weigh(red: Any, green: Any, blue: Any) -> Any:
    """Luminance, in the weights of the tracked scalar."""
    return _F(0.3) * red + _F(0.59) * green + _F(0.11) * blue
