"""The control variate's exponential moving covariance of two scalars, and the coefficient from it.

    Sigma_t = (1 - eta) Sigma_(t-1) + eta (1 - eta) (Z_t - zeta_(t-1)) (Z_t - zeta_(t-1))^T

with Z = (f, g), zeta its exponential moving mean, Sigma_0 = 0 and zeta_0 = Z_0, [Xie21] and facts
sheet 4.2. The coefficient a_t = Sigma.xy / Sigma.yy serves the next frame's residual f - a g. Of
Sigma only xy and yy are kept, so that one texture of four channels holds all. The twin of
covariance.cl.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_F = np.float32


def find_coefficient(moments: Any, epsilon: float) -> Any:
    """float32 a of (..., 4) float32 moments (mean of f, mean of g, covariance, variance of g):
    (xy + epsilon) / (yy + epsilon), 1 where that is 0 / 0.
    """
    variance = moments[..., 3] + _F(epsilon)
    safe = np.where(variance > 0, variance, _F(1))
    return np.where(variance > 0, (moments[..., 2] + _F(epsilon)) / safe, _F(1))


def update_moments(old: Any, f: Any, g: Any, eta: float) -> Any:
    """(..., 4) float32: the moments with a frame more."""
    weight, rest = _F(eta), _F(1) - _F(eta)
    df, dg = f - old[..., 0], g - old[..., 1]
    return np.stack(
        [
            rest * old[..., 0] + weight * f,
            rest * old[..., 1] + weight * g,
            rest * old[..., 2] + weight * rest * (df * dg),
            rest * old[..., 3] + weight * rest * (dg * dg),
        ],
        axis=-1,
    )


def first_moments(f: Any, g: Any) -> Any:
    """(..., 4) float32: those of a pixel without history."""
    zero = np.zeros_like(f)
    return np.stack([f, g, zero, zero], axis=-1)
