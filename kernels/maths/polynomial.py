"""Float32 log, exp, cbrt, gamma and sine/cosine that OpenCL and NumPy compute to the same bit.

The twins of polynomial.cl, operation by operation: only +, -, *, correctly rounded / and sqrt,
integers and bit casts. Built-in transcendentals differ between OpenCL implementations by a few
texels in a million; these do not. Truncated Taylor series on ranges short enough that the first
term left out is below half a unit in the last place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]

_F = np.float32
_LN2_HIGH = _F(float.fromhex("0x1.62ep-1"))
_LN2_LOW = _F(float.fromhex("0x1.0bfbe8p-15"))
_LOG2_E = _F(float.fromhex("0x1.715476p+0"))
# Added to a small number, it leaves the nearest integer in the low bits.
_ROUND_TO_INTEGER = _F(3 << 22)
_SQRT_HALF_BITS = np.int32(0x3F3504F3)
_TURN_TO_RADIANS = _F(float.fromhex("0x1.921fb6p-30"))
_ONE = _F(1)
_TWO = _F(2)


def _reciprocals(*denominators: int) -> list[np.float32]:
    return [_ONE / _F(n) for n in denominators]


_THIRD, _FIFTH, _SEVENTH, _NINTH = _reciprocals(3, 5, 7, 9)
_F3, _F4, _F5, _F6, _F7, _F8, _F9 = _reciprocals(6, 24, 120, 720, 5040, 40320, 362880)
_GAMMA = _ONE / _F(2.2)
_DARK = _F(2.0**-24)
# Keeps the cube of an exponential above the denormals.
_EXPONENT_MIN = _F(-28)


def poly_log(x: Float) -> Float:
    """Natural logarithm. `x`: float32, positive and normal; within 2 ulp, or 1e-7 absolute near
    1.
    """
    bits = x.view(np.int32)
    exponent = (bits - _SQRT_HALF_BITS) >> np.int32(23)
    f = (bits - (exponent << np.int32(23))).view(np.float32) - _ONE
    e = exponent.astype(np.float32)
    s = f / (f + _TWO)
    z = s * s
    series = z * (_THIRD + z * (_FIFTH + z * (_SEVENTH + z * _NINTH)))
    log_m = _TWO * s + _TWO * s * series
    result: Float = e * _LN2_HIGH + (log_m + e * _LN2_LOW)
    return result


def poly_exp(x: Float) -> Float:
    """e^x. `x`: float32 in [-86, 86]; within 2 ulp."""
    shifted = x * _LOG2_E + _ROUND_TO_INTEGER
    n = shifted - _ROUND_TO_INTEGER
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    series = _F6 + r * _F7
    series = _F5 + r * series
    series = _F4 + r * series
    series = _F3 + r * series
    series = _F(0.5) + r * series
    series = _ONE + r * series
    series = _ONE + r * series
    power = (shifted.view(np.int32) << np.int32(23)) + np.int32(0x3F800000)
    result: Float = series * power.view(np.float32)
    return result


def poly_cbrt(x: Float) -> Float:
    """Cube root. `x`: float32, positive and normal; within 2 ulp."""
    y = (x.view(np.int32) // np.int32(3) + np.int32(0x2A514067)).view(np.float32)
    for _ in range(2):
        cube = y * y * y
        y = y * ((cube + _TWO * x) / (_TWO * cube + x))
    return y


def poly_gamma(x: Float) -> Float:
    """x^(1/2.2), within 12 ulp. `x`: float32, in [0, 2^17]; 0 below 2^-24."""
    power = poly_exp(poly_log(np.maximum(x, _DARK)) * _GAMMA)
    result: Float = np.where(x < _DARK, _F(0), power)
    return result


def burley(x: Any, w_wide: np.float32 = _ONE, w_narrow: np.float32 = _ONE) -> Any:
    """w_wide e^x + w_narrow e^3x, x at least -28: with x = -r / (3 d) and weights 1, Burley's
    profile but for its factor; with weights 3/4 and 1/4, the share of the energy scattered beyond
    r.
    """
    wide = poly_exp(np.maximum(x, _EXPONENT_MIN))
    return w_narrow * (wide * wide * wide) + w_wide * wide


def poly_cos_sin(turn: npt.NDArray[np.uint32]) -> tuple[Float, Float]:
    """(cosine, sine) of 2 pi turn / 2^32. `turn`: uint32, the fraction of a turn in fixed point;
    within 1e-7.
    """
    shifted = turn + np.uint32(0x20000000)
    quadrant = shifted >> np.uint32(30)
    rest = (shifted & np.uint32(0x3FFFFFFF)).view(np.int32) - np.int32(0x20000000)
    a = rest.astype(np.float32) * _TURN_TO_RADIANS
    z = a * a
    s = _F9 * z - _F7
    s = _F5 + z * s
    s = z * s - _F3
    s = a + a * (z * s)
    c = _F8 * z - _F6
    c = _F4 + z * c
    c = z * c - _F(0.5)
    c = _ONE + z * c
    odd = (quadrant & np.uint32(1)) != 0
    cosine = np.where(odd, s, c)
    sine = np.where(odd, c, s)
    cosine = np.where(((quadrant + np.uint32(1)) & np.uint32(2)) != 0, -cosine, cosine)
    sine = np.where((quadrant & np.uint32(2)) != 0, -sine, sine)
    return cosine, sine
