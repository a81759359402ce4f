"""What `ground-truth` concludes: slopes of convergence, errors against path tracing, verdicts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from experiments.reproduce.experiment import Comparison

if TYPE_CHECKING:
    import pandas as pd

    from experiments.reproduce.ground_truth_volume import Compared

EXACT, PUBLISHED, SEPARABLE = "AFIS, exact inverse, mip 0", "AFIS as published", "Separable"
SLAB = "slab"
#: An error against path tracing that is called close, in the evenly lit slab's brightness.
VOLUME_WITHIN = 0.03
#: Random sampling falls with the square root of the count.
RANDOM_SLOPE = -0.5
VOLUME_WORDS = (
    "Path tracing: a medium of mean free path 1 mm and single-scattering albedo 0.95 without a "
    "refracting surface, in grey, under parallel light. The profile follows from the mean free "
    "path and from the brightness of the evenly lit slab, with the searchlight fit; nothing is "
    "fitted to the pictures. What the profile spreads there is the brightness of flat ground that "
    "is lit and seen at each pixel's angles, as such a medium does not follow the cosine. The "
    "profile knows flat ground alone: light that crosses a curved shape from the side or from "
    "behind is not in it, which shows where the shape is a few mean free paths across."
)


def fit_slopes(errors: pd.DataFrame) -> pd.DataFrame:
    """The slope of log error against log budget of each scene and method, with its standard error;
    first and last error.
    """
    import pandas as pd
    from scipy.stats import linregress

    rows = []
    for (scene, method), part in errors.groupby(["scene", "method"], sort=False):
        fit = linregress(np.log(part["budget"]), np.log(part["rms_error"]))
        first, last = (float(part["rms_error"].iloc[i]) for i in (0, -1))
        rows.append(
            {"scene": scene, "method": method, "slope": float(fit.slope),
             "slope_error": float(fit.stderr), "first_error": first, "last_error": last,
             "last_budget": int(part["budget"].iloc[-1])}
        )  # fmt: skip
    return pd.DataFrame(rows)


def volume_frame(compared: list[Compared]) -> pd.DataFrame:
    """The errors against path tracing, in the evenly lit slab's brightness."""
    import pandas as pd

    return pd.DataFrame(
        [
            {
                "shape": c.name,
                "rms_error": c.error(),
                "rms_error_unscattered": c.error(False),
                "rms_error_in_shade": c.error(shade=True),
                "rms_error_in_shade_unscattered": c.error(False, shade=True),
            }
            for c in compared
        ]
    )


def judge(slopes: pd.DataFrame, errors: pd.DataFrame) -> tuple[Comparison, ...]:
    """Whether the methods converge to the dense integral, and how fast."""
    found = []
    for _, row in slopes[slopes["method"] == EXACT].iterrows():
        converges = row["slope"] + 2 * row["slope_error"] < 0 and (
            row["last_error"] < 0.5 * row["first_error"]
        )
        found.append(
            Comparison(
                f"{row['scene']}, {EXACT}: slope of the error against the samples",
                None,
                f"{row['slope']:.2f} +- {row['slope_error']:.2f}",
                verdict=f"{'converges' if converges else 'does not converge'}: random samples "
                f"have {RANDOM_SLOPE}; {row['last_error']:.1e} at {row['last_budget']}",
                agrees=bool(converges),
            )
        )
    indexed = slopes.set_index(["scene", "method"])
    for scene in slopes["scene"].unique():
        part = errors[errors["scene"] == scene]
        afis = part[part["method"] == PUBLISHED]
        filtered = float(indexed.loc[(scene, SEPARABLE), "last_error"])
        better = afis[afis["rms_error"] < filtered]["budget"]
        least = f"{int(better.min())} samples" if len(better) else "none of the counts"
        first = float(indexed.loc[(scene, SEPARABLE), "first_error"])
        # Elsewhere its limit is another picture.
        converges = filtered < 0.2 * first if scene == SLAB else None
        told = "" if converges is None else "converges: " if converges else "does not converge: "
        found.append(
            Comparison(
                f"{scene}, Separable: error left with the most taps",
                None,
                f"{filtered:.1e}",
                verdict=f"{told}{first / filtered:.1f} times smaller than with the fewest; "
                f"{PUBLISHED} is below it from {least} on",
                agrees=converges,
            )
        )
    return tuple(found)


def judge_volume(compared: list[Compared], quick: bool) -> tuple[Comparison, ...]:
    """The profile's error against path tracing, and in the shade that of light without scattering.

    A quick run traces so few paths that their noise is most of the error.
    """
    found = []
    for c in compared:
        close = c.error() <= VOLUME_WITHIN
        told = "agrees" if close else "differs"
        if quick:
            told = "no claim from so few paths"
        found.append(
            Comparison(
                f"{c.name}: error of the profile against path tracing",
                None,
                f"{c.error():.3f}",
                "of the evenly lit slab",
                f"{told}: within {VOLUME_WITHIN} is called close; in the shade "
                f"{c.error(shade=True):.3f}, without scattering {c.error(False, shade=True):.3f}",
                None if quick else close,
            )
        )
    return tuple(found)
