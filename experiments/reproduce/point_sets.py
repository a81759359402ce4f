"""Point sets in the unit square: R2 as the sampling pass draws it, Fibonacci's, random ones; and
how evenly a set fills the square.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
import numpy.typing as npt

from kernels.maths.sequence import pcg3d16, r2

Values = npt.NDArray[np.float64]
#: Both coordinates, each (num_starts, count).
Points = tuple[Values, Values]

GOLDEN = (sqrt(5) - 1) / 2


def random_points(num_starts: int, count: int) -> Points:
    """Independent points, each (num_starts, count)."""
    rng = np.random.default_rng(11)
    return rng.random((num_starts, count)), rng.random((num_starts, count))


def r2_points(num_starts: int, count: int) -> Points:
    """R2 from a hashed start, as the sampling pass draws it: pixel and frame give the start."""
    start = pcg3d16(np.arange(num_starts) % 64, np.arange(num_starts) // 64, 0)[0]
    index = start[:, None] + np.arange(count, dtype=np.uint32)
    first, second = r2(index)
    return np.asarray(first * 2.0**-32), np.asarray(second * 2.0**-32)


def golden_points(num_starts: int, count: int) -> Points:
    """The engine's first version: hashed radii, golden-ratio angles."""
    i = np.arange(count)
    x, y = np.arange(num_starts)[:, None] % 64, np.arange(num_starts)[:, None] // 64
    first = (pcg3d16(x, y, i)[0] + 0.5) / 65536
    second = (i + 0.5) * (1 + GOLDEN) % 1.0
    return first, np.broadcast_to(second, first.shape)


def fibonacci_points(num_starts: int, count: int) -> Points:
    """Fibonacci's lattice, whose radii need the count beforehand, shifted at random."""
    rng = np.random.default_rng(12)
    i = np.arange(count)
    shift = rng.random((2, num_starts, 1))
    return (i / count + shift[0]) % 1.0, (i * GOLDEN + shift[1]) % 1.0


SEQUENCES: dict[str, Callable[[int, int], Points]] = {
    "R2, hashed start": r2_points,
    "Fibonacci lattice, shifted": fibonacci_points,
    "random radius, golden angle": golden_points,
    "random": random_points,
}
#: Whose first n points do not depend on n.
PROGRESSIVE = ("R2, hashed start", "random radius, golden angle", "random")


def l2_star_squared(points: Values) -> float:
    """The squared L2-star discrepancy of points (n, 2) in the unit square."""
    n = len(points)
    single = float(np.prod(1 - points**2, axis=1).sum())
    larger = np.maximum(points[:, None, :], points[None, :, :])
    pairs = float(np.prod(1 - larger, axis=2).sum())
    return 1 / 9 - single / (2 * n) + pairs / (n * n)
