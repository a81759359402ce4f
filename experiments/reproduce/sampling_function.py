"""`sampling-function`: how well the approximate inverses of Burley's distribution sample it.

Chapter 5's slide gives r = d ((2 - c) xi - 2) ln(1 - xi) with c = 2.5715. The constant comes back
here as the minimiser of the mean over xi of (cdf(r(xi)) - xi)^2. Beside it stand the engine's
c = 2.6 and a table of radii as pbrt keeps one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings, compare
from kernels.maths import profile

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Values = npt.NDArray[np.float64]
Inverse = Callable[[Values], Values]

#: The engine's rounding of the constant.
ENGINE_C = 2.6
#: The grid over xi in [0, 1] on which the facts sheet's minimum was found.
GRID_STEP = 0.0005
#: Radii of the table, as many as pbrt's BSSRDF table has.
TABLE_SIZE = 64
#: Of the radii that the paper's plot of the relative error spans.
PLOT_LIMIT_D = 29.0
#: Halvings that leave nothing of a double's interval.
_BISECTIONS = 60
PRINTED_PEAK, PRINTED_END = 0.024, -0.117


def xi_grid(step: float = GRID_STEP) -> Values:
    """[0, 1] in steps, without 1, where the radius is infinite and the error 0."""
    return np.arange(0.0, 1.0 - step / 2, step)


def mean_squared_cdf_error(c: float, xi: Values) -> float:
    """Mean over `xi` of (cdf(approximate(xi)) - xi)^2 for the constant `c`; d = 1."""
    found = profile.cdf(profile.inverse_cdf_approximate(xi, 1.0, c), 1.0)
    return float(np.mean((found - xi) ** 2))


def mean_squared_radius_error(c: float, xi: Values) -> float:
    """The same of the radii, in d^2."""
    exact = profile.inverse_cdf_exact(xi, 1.0)
    return float(np.mean((profile.inverse_cdf_approximate(xi, 1.0, c) - exact) ** 2))


def minimise(error: Callable[[float, Values], float], xi: Values) -> float:
    """The constant between 2 and 3.5 with the least error."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        error, bounds=(2.0, 3.5), args=(xi,), method="bounded", options={"xatol": 1e-7}
    )
    return float(found.x)


def table_inverse(size: int = TABLE_SIZE) -> Inverse:
    """The inverse by a table as pbrt's BSSRDF keeps one: the density at 0, 0.0025 d and radii each
    1.2 times the one before, a Catmull-Rom spline through it, and the spline's integral inverted.
    """
    from scipy.interpolate import CubicHermiteSpline

    radii = np.concatenate([[0.0], 0.0025 * 1.2 ** np.arange(size - 1)])
    density = profile.pdf(radii, 1.0)
    slopes = np.empty(size)
    slopes[1:-1] = (density[2:] - density[:-2]) / (radii[2:] - radii[:-2])
    # The ends have a neighbour on one side alone.
    slopes[[0, -1]] = np.diff(density)[[0, -1]] / np.diff(radii)[[0, -1]]
    integral = CubicHermiteSpline(radii, density, slopes).antiderivative()
    shares = integral(radii)

    def invert(xi: Values) -> Values:
        wanted = xi * shares[-1]
        at = np.clip(np.searchsorted(shares, wanted, side="right"), 1, size - 1)
        low, high = radii[at - 1], radii[at]
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            below = integral(middle) < wanted
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray((low + high) / 2)

    return invert


def inverses() -> dict[str, Inverse]:
    """Every approximation by the name under which it is shown; d = 1."""
    return {
        "paper, c = 2.5715": lambda xi: profile.inverse_cdf_approximate(xi, 1.0),
        "engine, c = 2.6": lambda xi: profile.inverse_cdf_approximate(xi, 1.0, ENGINE_C),
        f"table of {TABLE_SIZE} radii": table_inverse(),
    }


def errors_frame(xi: Values) -> pd.DataFrame:
    """One row per `xi`: the exact radius in d, and of each approximation its relative radius error
    and its cdf error.
    """
    import pandas as pd

    exact = profile.inverse_cdf_exact(xi, 1.0)
    columns: dict[str, Any] = {"xi": xi, "exact radius / d": exact}
    for name, inverse in inverses().items():
        radius = inverse(xi)
        columns[f"radius error, {name}"] = radius / exact - 1
        columns[f"cdf error, {name}"] = profile.cdf(radius, 1.0) - xi
    return pd.DataFrame(columns)


def bias_of_density(xi: Values, c: float) -> Values:
    """The density that the estimator divides by, the exact one at the approximate radius, over
    the density with which that radius is really drawn.
    """
    step = 1e-6
    radius = profile.inverse_cdf_approximate(xi, 1.0, c)
    ahead = profile.inverse_cdf_approximate(xi + step, 1.0, c)
    behind = profile.inverse_cdf_approximate(xi - step, 1.0, c)
    drawn = 2 * step / (ahead - behind)
    return np.asarray(profile.pdf(radius, 1.0) / drawn)


def run(settings: Settings) -> Outcome:
    """Recover the constant and show the errors."""
    import pandas as pd

    settings.progress("searching the constant", 0.0)
    grid = xi_grid()
    best, best_radius = (
        minimise(error, grid) for error in (mean_squared_cdf_error, mean_squared_radius_error)
    )
    dense = xi_grid(1e-4 if settings.quick else 1e-5)[1:]
    settings.progress("measuring the errors", 0.5)
    frame = errors_frame(dense)
    exact = profile.inverse_cdf_exact(dense, 1.0)
    in_plot = exact <= PLOT_LIMIT_D
    ours = frame["radius error, paper, c = 2.5715"].to_numpy()
    end = float(profile.inverse_cdf_approximate(_xi_of(PLOT_LIMIT_D), 1.0) / PLOT_LIMIT_D - 1)
    round_trip = np.max(np.abs(profile.cdf(exact, 1.0) - dense))
    comparisons = (
        compare("c that minimises the cdf's mean squared error", 2.5715, best, relative=2e-4),
        compare(
            "largest relative radius error of the paper's form",
            PRINTED_PEAK,
            float(ours[in_plot].max()),
            relative=0.05,
            note="read off the paper's plot",
        ),
        compare(
            "its relative radius error at 29 d",
            PRINTED_END,
            end,
            relative=0.05,
            note="read off the paper's plot",
        ),
        Comparison(
            "c that minimises the radius's mean squared error",
            None,
            best_radius,
            verdict="not the printed constant: the paper fitted the cdf, not the radius",
        ),
        Comparison(
            "largest |cdf(inverse(xi)) - xi| of the exact inverse",
            None,
            float(round_trip),
            verdict="the slide's formula wants 1 - xi where it writes xi; so read, it is exact",
        ),
    )
    rows = np.array([0.05, 0.1, 0.25, 0.37, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999])
    summary = pd.DataFrame(
        {
            "approximation": list(inverses()),
            "rms cdf error": [
                float(np.sqrt(np.mean(frame[f"cdf error, {n}"] ** 2))) for n in inverses()
            ],
            "largest cdf error": [
                float(np.abs(frame[f"cdf error, {n}"]).max()) for n in inverses()
            ],
            "largest radius error up to 29 d": [
                float(np.abs(frame[f"radius error, {n}"][in_plot]).max()) for n in inverses()
            ],
        }
    )
    bias = pd.DataFrame(
        {
            "xi": rows,
            "paper, c = 2.5715": bias_of_density(rows, profile.APPROXIMATE_C),
            "engine, c = 2.6": bias_of_density(rows, ENGINE_C),
        }
    )
    return Outcome(
        tables={"summary": summary, "errors": errors_frame(rows), "density-bias": bias},
        figures={"errors": _figure(frame, grid)},
        comparisons=comparisons,
        words=(
            "The inverse of Burley's cdf takes a cube root and a logarithm; the paper replaces it "
            "by one product and one logarithm. The errors below are relative for the radius and "
            "absolute for the cdf, with d = 1: both forms scale with d.",
            "The estimator divides by the exact density at the approximate radius, although that "
            "radius was drawn with a slightly other density; density-bias is the ratio of the two. "
            "Self-normalised weights hide most of it.",
        ),
    )


def _xi_of(radius_d: float) -> Values:
    return np.asarray(profile.cdf(radius_d, 1.0))


def _figure(frame: pd.DataFrame, grid: Values) -> Figure:
    from matplotlib.figure import Figure

    from experiments.plots import FONT_SIZE, PALETTE

    figure = Figure(figsize=(9.6, 3.1), layout="constrained")
    radius, share, fit = figure.subplots(1, 3)
    exact = frame["exact radius / d"]
    dashes = ("-", "--", ":")
    for name, colour, dash in zip(inverses(), PALETTE, dashes, strict=False):
        style: dict[str, Any] = {"color": colour, "linestyle": dash, "linewidth": 1.3}
        radius.plot(exact, 100 * frame[f"radius error, {name}"], label=name, **style)
        share.plot(frame["xi"], 100 * frame[f"cdf error, {name}"], **style)
    radius.set_xlim(0, PLOT_LIMIT_D)
    radius.set_ylim(-14, 6)
    radius.set_xlabel("exact radius / d", fontsize=FONT_SIZE)
    radius.set_title("relative radius error (%)", fontsize=FONT_SIZE)
    radius.legend(fontsize=FONT_SIZE - 1, frameon=False)
    share.set_xlabel(r"$\xi$", fontsize=FONT_SIZE)
    share.set_title("cdf error (percentage points)", fontsize=FONT_SIZE)
    constants = np.linspace(2.4, 2.75, 71)
    errors = [np.sqrt(mean_squared_cdf_error(c, grid)) for c in constants]
    fit.plot(constants, np.array(errors) * 1e3, color=PALETTE[0], linewidth=1.3)
    for c, name, colour in ((2.5715, "paper", PALETTE[0]), (ENGINE_C, "engine", PALETTE[1])):
        fit.axvline(c, color=colour, linestyle="--", linewidth=1)
        fit.annotate(
            f"{name}\n{c}", (c, 0.98), xycoords=("data", "axes fraction"), va="top",
            ha="right" if name == "paper" else "left", fontsize=FONT_SIZE - 1,
        )  # fmt: skip
    fit.set_xlabel("c", fontsize=FONT_SIZE)
    fit.set_title("rms cdf error (1e-3)", fontsize=FONT_SIZE)
    for axes in (radius, share, fit):
        axes.tick_params(labelsize=FONT_SIZE - 1)
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


EXPERIMENT = Experiment(
    name="sampling-function",
    title="Approximations of the inverse cdf: errors, and c = 2.5715 recovered",
    chapter="5",
    figure="slide: sampling function",
    minutes=0.1,
    quick_minutes=0.05,
    run=run,
)
