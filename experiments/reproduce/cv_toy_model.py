"""The control variate's toy problem: one integral of one number under a light that changes.

F(t) = T(t) int_0^1 1/(1+y) dy = T ln 2, with the control G(t) = T int_0^1 (1-y) dy = T / 2; source:
supplementary of the I3D'21 paper [SUP21] and chapter 6's slides. Arrays are (num_seeds, num_frames)
unless said otherwise; a frame's f_bar and g_bar are means over the same `num_samples` points.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]

NUM_FRAMES = 100
NUM_SAMPLES = 16
#: The table's errors are averages over frames 25 to 100.
AVERAGED = slice(24, 100)
ETA_COVARIANCE, ETA_RESIDUAL = 0.05, 0.2

MEAN_F, MEAN_G = log(2), 0.5
VAR_F, VAR_G = 0.5 - log(2) ** 2, 1 / 12
#: E[(1-y)/(1+y)] - E[f] E[g] = (2 ln 2 - 1) - ln 2 / 2.
COV_FG = 1.5 * log(2) - 1
#: a* = Cov(F, G) / Var(G) in a frame, 18 ln 2 - 12, and with a constant G, ln 4.
A_STATIC = COV_FG / VAR_G
A_CONSTANT_G = MEAN_F / MEAN_G


def f(y: Values) -> Values:
    """The integrand, without the light."""
    return 1 / (1 + y)


def g(y: Values) -> Values:
    """The control, without the light."""
    return 1 - y


def light(dynamic: bool, first_t: int = 1) -> Values:
    """(NUM_FRAMES,) T of the frames t = first_t, first_t + 1, ...: 1, or 1 + 3 sin(t / 10)."""
    t = np.arange(first_t, first_t + NUM_FRAMES, dtype=np.float64)
    return 1 + 3 * np.sin(t / 10) if dynamic else np.ones_like(t)


def temporal_coefficient(num_samples: int) -> float:
    """Cov(T f_bar, T g_bar) / Var(T g_bar) over the frames of the dynamic light, expected; tends to
    ln 4 as a frame's samples grow.
    """
    t = light(dynamic=True)
    square, variance = float(np.mean(t * t)), float(np.var(t))
    covariance = square * COV_FG / num_samples + variance * MEAN_F * MEAN_G
    return covariance / (square * VAR_G / num_samples + variance * MEAN_G**2)


@dataclass(frozen=True, eq=False)
class Draws:
    """What many seeds' frames sampled.

    t: (num_frames,) light. f_bar, g_bar: frame means, light included. a_frame: coefficient from
    each frame's own samples, Cov(f, g) / Var(g).
    """

    t: Values
    f_bar: Values
    g_bar: Values
    a_frame: Values


def draw(t: Values, num_seeds: int, num_samples: int = NUM_SAMPLES, first_seed: int = 0) -> Draws:
    """Sample every frame for seeds first_seed .. first_seed + num_seeds - 1, each on its own."""
    shape = (len(t), num_samples)
    rows = [
        _draw_seed(np.random.default_rng(first_seed + s).random(shape)) for s in range(num_seeds)
    ]
    f_bar, g_bar, a_frame = (np.array(column) for column in zip(*rows, strict=True))
    return Draws(t, t * f_bar, t * g_bar, a_frame)


def _draw_seed(y: Values) -> tuple[Values, Values, Values]:
    """(num_frames,) means of f and g and the in-frame coefficient. y: (num_frames, n)."""
    of_f, of_g = f(y), g(y)
    f_bar, g_bar = of_f.mean(1), of_g.mean(1)
    covariance = ((of_f - f_bar[:, None]) * (of_g - g_bar[:, None])).mean(1)
    return f_bar, g_bar, covariance / ((of_g - g_bar[:, None]) ** 2).mean(1)


def ema(values: Values, eta: float) -> Values:
    """The exponential moving average of every frame, started at the first value."""
    out = np.empty_like(values)
    mean = values[:, 0]
    for t in range(values.shape[1]):
        mean = mean + eta * (values[:, t] - mean)
        out[:, t] = mean
    return out


def emv(values: Values, eta: float) -> Values:
    """The exponential moving variance, V' = (1-eta) V + eta (1-eta) (x - mean)^2, from 0."""
    out = np.empty_like(values)
    mean, variance = values[:, 0], np.zeros(len(values))
    for t in range(values.shape[1]):
        offset = values[:, t] - mean
        variance = (1 - eta) * variance + eta * (1 - eta) * offset * offset
        mean = mean + eta * offset
        out[:, t] = variance
    return out


def emcm_coefficient(f_bar: Values, g_bar: Values, eta: float = ETA_COVARIANCE) -> Values:
    """a_t = Sigma_t.xy / Sigma_t.yy of the exponential moving covariance matrix; 0 before there is
    a variance. Its mean starts at the first observation, its matrix at 0.
    """
    out = np.zeros_like(f_bar)
    mean_f, mean_g = f_bar[:, 0], g_bar[:, 0]
    xy, yy = np.zeros(len(f_bar)), np.zeros(len(f_bar))
    for t in range(f_bar.shape[1]):
        of_f, of_g = f_bar[:, t] - mean_f, g_bar[:, t] - mean_g
        xy = (1 - eta) * xy + eta * (1 - eta) * of_f * of_g
        yy = (1 - eta) * yy + eta * (1 - eta) * of_g * of_g
        mean_f, mean_g = mean_f + eta * of_f, mean_g + eta * of_g
        out[:, t] = np.divide(xy, yy, out=np.zeros_like(xy), where=yy > 0)
    return out


def delay(coefficient: Values) -> Values:
    """Each frame's coefficient as the next frame uses it; the first frame uses its own."""
    return np.concatenate([coefficient[:, :1], coefficient[:, :-1]], axis=1)


def coefficients(draws: Draws, a_best: float) -> dict[str, Values]:
    """By the row of [SUP21]'s table, what multiplies the control. a_best: the best constant."""
    return {
        "no CV": np.zeros_like(draws.f_bar),
        "single-frame a": delay(draws.a_frame),
        "single-frame a + EMA": delay(ema(draws.a_frame, ETA_COVARIANCE)),
        "EMCM, sampled g": delay(emcm_coefficient(draws.f_bar, draws.g_bar)),
        "EMCM, known G": delay(emcm_coefficient(draws.f_bar, draws.g_bar)),
        "best constant a, sampled g": np.full_like(draws.f_bar, a_best),
    }


def residuals(draws: Draws, a_best: float) -> dict[str, Values]:
    """f_bar - a g_bar by row, with the known G(t) for g_bar where the row says so."""
    known = MEAN_G * draws.t
    return {
        name: draws.f_bar - a * (known if "known" in name else draws.g_bar)
        for name, a in coefficients(draws, a_best).items()
    }


def errors(draws: Draws, a_best: float) -> dict[str, Values]:
    """(num_seeds, num_frames) square root of each residual's exponential moving variance."""
    found = residuals(draws, a_best)
    return {name: np.sqrt(emv(value, ETA_RESIDUAL)) for name, value in found.items()}
