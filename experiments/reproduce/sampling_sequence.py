"""`sampling-sequence`: R2 against random points and Fibonacci's, as points and in convergence.

Chapter 5 samples Burley's disc with Roberts' R2 sequence, started at a hash of pixel and frame. The
integrals here are what a pixel asks: irradiance patterns under Burley's profile whose exact answers
are known, for many starts; the error's slope over the sample count tells a sequence's worth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import acos, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings, compare
from experiments.reproduce.point_sets import PROGRESSIVE, SEQUENCES, Points, Values, l2_star_squared
from kernels.maths import profile
from kernels.maths.sequence import r2

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

NUM_STARTS, QUICK_STARTS = 4096, 512
#: Sample counts of the convergence; the adaptive sampler's range is 8 to 64.
COUNTS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
#: From where on slopes are fitted.
FITTED_FROM = 8
#: Points of the pictures.
SHOWN = 64


@dataclass(frozen=True)
class Pattern:
    """An irradiance around a pixel at the origin, lengths in d.

    value: irradiance at x. mean: its exact average under Burley's profile.
    """

    name: str
    value: Callable[[Values], Values]
    mean: float


def share_beyond(distance: float) -> float:
    """Burley's share of the half plane x > distance (in d, at least 0)."""
    from scipy.integrate import quad

    def integrand(r: float) -> float:
        return float(profile.pdf(r, 1.0)) * acos(distance / r) / pi

    if distance == 0:
        return 0.5
    near, _ = quad(integrand, distance, distance + 8, epsabs=1e-12, limit=200)
    far, _ = quad(integrand, distance + 8, 200, epsabs=1e-12, limit=200)
    return float(near + far)


def patterns() -> tuple[Pattern, ...]:
    """A smooth wave, a soft and a hard shadow edge half a d away from the pixel."""
    from scipy.integrate import quad

    k, edge, width = 0.5, 0.5, 2.0
    # Hankel transform of e^(-r/b) at wave number k: 1 / sqrt(1/b^2 + k^2).
    wave = 0.25 * (1 / sqrt(1 + k * k) + 1 / sqrt(1 / 9 + k * k))
    soft, _ = quad(lambda at: share_beyond(at) / width, edge, edge + width, epsabs=1e-10)
    return (
        Pattern(
            "smooth wave",
            lambda x: np.asarray(0.5 + 0.5 * np.cos(k * x), np.float64),
            0.5 + 0.5 * wave,
        ),
        Pattern(
            "soft shadow edge",
            lambda x: np.asarray(np.clip((x - edge) / width, 0, 1), np.float64),
            soft,
        ),
        Pattern("hard shadow edge", lambda x: (x > edge).astype(np.float64), share_beyond(edge)),
    )


def errors_of(pattern: Pattern, points: Points) -> Values:
    """(num_starts, count) error of the running mean after 1, 2, ... samples."""
    first, second = points
    x = profile.inverse_cdf_exact(first, 1.0) * np.cos(2 * np.pi * second)
    sums = np.cumsum(pattern.value(x), axis=1)
    return np.asarray(sums / np.arange(1, x.shape[1] + 1) - pattern.mean)


def convergence_frame(num_starts: int, told: Callable[[float], None]) -> pd.DataFrame:
    """One row per pattern, sequence and count: the root mean square error over the starts."""
    import pandas as pd

    rows = []
    for done, (name, make) in enumerate(SEQUENCES.items()):
        told(done / len(SEQUENCES))
        drawn = make(num_starts, COUNTS[-1]) if name in PROGRESSIVE else None
        for pattern in patterns():
            running = None if drawn is None else errors_of(pattern, drawn)
            for count in COUNTS:
                if running is None:
                    found = errors_of(pattern, make(num_starts, count))[:, -1]
                else:
                    found = running[:, count - 1]
                rms = float(np.sqrt(np.mean(found**2)))
                rows.append((pattern.name, name, count, rms, float(np.mean(found))))
    return pd.DataFrame(rows, columns=["pattern", "sequence", "samples", "rms error", "bias"])


def slopes_frame(convergence: pd.DataFrame) -> pd.DataFrame:
    """One row per pattern and sequence: the slope of log error over log count with its standard
    error, and the errors at the adaptive sampler's bounds, 8 and 64.
    """
    import pandas as pd
    from scipy.stats import linregress

    rows = []
    for (pattern, name), part in convergence.groupby(["pattern", "sequence"], sort=False):
        fitted = part[part["samples"] >= FITTED_FROM]
        line = linregress(np.log2(fitted["samples"]), np.log2(fitted["rms error"]))
        by_count = part.set_index("samples")["rms error"]
        rows.append((pattern, name, line.slope, line.stderr, by_count[8], by_count[64]))
    columns = ["pattern", "sequence", "slope", "standard error", "error, 8 samples"]
    frame = pd.DataFrame(rows, columns=[*columns, "error, 64 samples"])
    random = frame[frame["sequence"] == "random"].set_index("pattern")["error, 64 samples"]
    # Random sampling's error falls as 1 / sqrt(n).
    frame["random samples that 64 replace"] = [
        round(64 * (random[p] / e) ** 2)
        for p, e in zip(frame["pattern"], frame["error, 64 samples"], strict=True)
    ]
    return frame


def discrepancy_frame(num_starts: int) -> pd.DataFrame:
    """L2-star discrepancy of the first n points in the unit square, root mean square over starts.

    Warnock 1972: D^2 = 1/9 - 1/(2n) sum prod(1 - x^2) + 1/n^2 sum sum prod(1 - max(x, x')).
    """
    import pandas as pd

    rows = []
    for count in (8, 16, 32, 64, 256):
        row: dict[str, float] = {"samples": count}
        for name, make in SEQUENCES.items():
            u, v = make(num_starts, count)
            found = [l2_star_squared(np.stack([a, b], axis=1)) for a, b in zip(u, v, strict=True)]
            row[name] = sqrt(float(np.mean(found)))
        rows.append(row)
    return pd.DataFrame(rows).astype({"samples": int})


def float32_error() -> float:
    """The largest error of R2's fraction taken in float32 at the latest starts, against fixed
    point: why the sampling pass counts in integers.
    """
    index = np.arange(65000, 65536 + 64, dtype=np.uint32)
    exact = r2(index)[0] * 2.0**-32
    product = index.astype(np.float32) * np.float32(1 / r2_base())
    fraction = (product - np.floor(product)).astype(np.float64)
    apart = np.abs(fraction - exact)
    return float(np.minimum(apart, 1 - apart).max())


def r2_base() -> float:
    """The real root of x^3 = x + 1, by Newton's method."""
    x = 1.3
    for _ in range(8):
        x -= (x**3 - x - 1) / (3 * x * x - 1)
    return x


def run(settings: Settings) -> Outcome:
    """Points, convergence and discrepancy of every sequence."""
    starts = QUICK_STARTS if settings.quick else NUM_STARTS
    settings.progress("convergence", 0.0)
    convergence = convergence_frame(
        starts, lambda share: settings.progress("convergence", 0.8 * share)
    )
    slopes = slopes_frame(convergence)
    settings.progress("discrepancy", 0.8)
    discrepancy = discrepancy_frame(32 if settings.quick else 256)
    settings.progress("drawing", 0.95)
    by_key = slopes.set_index(["pattern", "sequence"])
    first = r2(np.arange(1, 5))[0] * 2.0**-32
    r2_name = "R2, hashed start"
    judged = []
    for pattern in dict.fromkeys(slopes["pattern"]):
        ours, random = (float(by_key.loc[(pattern, s), "slope"]) for s in (r2_name, "random"))
        agrees = ours < random - 0.1
        judged.append(
            Comparison(
                f"slope of the error, R2, {pattern}",
                None,
                round(ours, 3),
                verdict=f"{'agrees: steeper' if agrees else 'differs: not steeper'} than random "
                f"points, {random:.3f}, as the slide's low-discrepancy sequence must be",
                agrees=agrees,
            )
        )
    comparisons = (
        compare("phi_2, root of x^3 = x + 1", 1.324718, r2_base(), relative=1e-6),
        *judged,
        Comparison(
            "largest error of a float32 fraction at a late start",
            None,
            float32_error(),
            verdict="so the sequence is counted in 32-bit fixed point here",
        ),
    )
    return Outcome(
        tables={"slopes": slopes, "convergence": convergence, "discrepancy": discrepancy},
        figures={"points": _points_figure(), "convergence": _convergence_figure(convergence)},
        comparisons=comparisons,
        words=(
            f"Every sequence integrates three irradiance patterns under Burley's profile for "
            f"{starts} starts (pixels); lengths are in d. The exact means are a Hankel transform "
            f"for the wave and one-dimensional integrals for the edges. Slopes are fitted from "
            f"{FITTED_FROM} samples on; random points have -0.5, a sequence without a benefit "
            "too.",
            "Fibonacci's lattice is about as good as R2, better on smooth patterns, but must know "
            "the count before its first sample; R2 goes on from any count, which suits a count "
            "that adapts. The engine's first version took golden-ratio angles with random radii, "
            "which orders the angle alone.",
            "The slide writes psi = (1/phi, 1/phi^2, ..., 1/phi^2); for two dimensions it is "
            "(1/phi, 1/phi^2). R2's first radii are drawn from "
            f"{', '.join(f'{v:.5f}' for v in first)}.",
        ),
    )


def _points_figure() -> Figure:
    from matplotlib.figure import Figure

    from experiments.plots import FONT_SIZE, PALETTE

    figure = Figure(figsize=(9.2, 4.8), layout="constrained")
    axes = figure.subplots(2, len(SEQUENCES))
    for column, (name, make), colour in zip(axes.T, SEQUENCES.items(), PALETTE, strict=False):
        square, disc = column
        u, v = (values[5] for values in make(6, SHOWN))
        radius = profile.inverse_cdf_exact(u, 1.0)
        square.scatter(u, v, s=9, color=colour)
        square.set_xlim(0, 1)
        square.set_ylim(0, 1)
        square.set_title(name, fontsize=FONT_SIZE)
        disc.scatter(
            radius * np.cos(2 * np.pi * v), radius * np.sin(2 * np.pi * v), s=9, color=colour
        )
        disc.set_xlim(-8, 8)
        disc.set_ylim(-8, 8)
        for one in column:
            one.set_aspect("equal")
            one.tick_params(labelsize=FONT_SIZE - 2)
    axes[0, 0].set_ylabel("unit square", fontsize=FONT_SIZE)
    axes[1, 0].set_ylabel("Burley's disc, lengths in d", fontsize=FONT_SIZE)
    return figure


def _convergence_figure(convergence: pd.DataFrame) -> Figure:
    from matplotlib.figure import Figure

    from experiments.plots import FONT_SIZE, PALETTE

    figure = Figure(figsize=(9.2, 3.4), layout="constrained")
    names = list(dict.fromkeys(convergence["pattern"]))
    for axes, name in zip(figure.subplots(1, len(names), sharey=True), names, strict=True):
        of_pattern = convergence[convergence["pattern"] == name]
        for i, (sequence, part) in enumerate(of_pattern.groupby("sequence", sort=False)):
            axes.loglog(
                part["samples"],
                part["rms error"],
                color=PALETTE[i],
                marker="osD^"[i],
                markersize=3.5,
                linewidth=1.2,
                linestyle=("-", "--", "-.", ":")[i],
                label=sequence,
            )
        axes.axvspan(8, 64, color="0.93", zorder=0)
        axes.set_title(name, fontsize=FONT_SIZE)
        axes.set_xlabel("samples (grey: the adaptive range)", fontsize=FONT_SIZE)
        axes.tick_params(which="both", labelsize=FONT_SIZE - 1)
        axes.spines[["top", "right"]].set_visible(False)
        if name == names[0]:
            axes.set_ylabel("rms error over the starts", fontsize=FONT_SIZE)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=FONT_SIZE - 1)
    return figure


EXPERIMENT = Experiment(
    name="sampling-sequence",
    title="R2 against random and Fibonacci points: convergence and discrepancy",
    chapter="5",
    figure="slide: sampling sequence",
    minutes=0.3,
    quick_minutes=0.1,
    run=run,
)
