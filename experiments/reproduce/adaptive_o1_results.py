"""Tables, figures and verdicts of `adaptive-o1`, from what its cells measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.experiment import Comparison

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from experiments.reproduce.film import Mask
    from experiments.reproduce.parts import Arrays

EDGE, FLAT = "shadow edge", "flat area"
#: Of each region in each frame: `adaptive_o1.measure_estimator`.
COLUMNS = ("count", "pixel_count", "step", "estimated_error", "true_error", "pilots")
GUIDED, UNGUIDED = "local guiding + TAA", "TAA alone, 8 samples"
PAPER, LAST, ENGINE = "paper, kappa 0.2", "last frame alone", "engine"
#: A value within this factor of the printed one agrees with it.
AGREES_WITHIN = 1.5
#: Frames of one pixel's count that the figure shows.
PIXEL_FRAMES = 120
OVERLAY_COLUMNS = (
    "local pixels that differ",
    "difference in the trail",
    "asked by a global guide, bare",
    "asked by a global guide, veiled",
    "local count",
)
WORDS = (
    "A still view of skin with a soft shadow's edge. The edge is the 2 % of the pixels where the "
    "reference (1024 samples, mip 0) is steepest, the flat area the 20 % where it is most even. "
    "Errors are root mean squares over a region, of the scalar that the method tracks (luminance "
    "of the 1/2.2 power): the estimator's own belief, and the difference from the reference. The "
    "true error holds the bias of the pre-filtered mips too, which no count removes.",
    "All estimators aim at a variance of 0.001 but for the engine's rule, whose target is 0.0001. "
    "The two-pass estimator takes 8 pilots per pixel and frame more than its count says.",
    "What 11x and 2x compare is not said. The table sets the readings side by side: how much less "
    "the accumulated picture varies from frame to frame than each frame's own picture, as a "
    "variance over the frames and as a squared error, and how much less with guided counts than "
    "with 8 samples everywhere. Over fewer than some hundred frames an accumulated picture hardly "
    "varies, so that a quick run overstates the first reading.",
    "Overlay: the same frames with and without a translucent disc that crosses the picture. The "
    "local pass comes before transparent things are drawn. A global guide is the paper's own "
    "estimator with the globally accumulated picture as its history; it watches, and its counts "
    "are not taken.",
)


def settled(values: Any) -> Any:
    """The later three quarters of the frames."""
    return values[len(values) // 4 :]


def column(series: Arrays, region: str, name: str) -> Any:
    """(frames,) one quantity of a region."""
    return series[region][:, COLUMNS.index(name)]


def estimator_table(series: dict[str, Arrays]) -> Any:
    """Settled means per estimator and region."""
    import pandas as pd

    from experiments.tables import Column, Table

    rows = []
    for name, found in series.items():
        for region in (EDGE, FLAT):
            pixel = settled(column(found, region, "pixel_count"))
            low, high = np.percentile(pixel, (1, 99))
            rows.append(
                {
                    "estimator": name,
                    "region": region,
                    "count": settled(column(found, region, "count")).mean(),
                    "pilots": settled(column(found, region, "pilots")).mean(),
                    "pixel_low": low,
                    "pixel_high": high,
                    "step": settled(column(found, region, "step")).mean(),
                    "estimated_error": settled(column(found, region, "estimated_error")).mean(),
                    "true_error": settled(column(found, region, "true_error")).mean(),
                }
            )
    columns = (
        Column("estimator", "estimator"),
        Column("region", "region"),
        Column("count", "mean count", ".1f"),
        Column("pilots", "pilots", ".0f"),
        Column("pixel_low", "one pixel, 1 %", ".0f"),
        Column("pixel_high", "99 %", ".0f"),
        Column("step", "change from frame to frame", ".1f"),
        Column("estimated_error", "estimated error", ".4f"),
        Column("true_error", "true error", ".4f"),
    )
    notes = ("Of the later three quarters of the frames.",)
    return Table("Counts and errors, settled", pd.DataFrame(rows), columns, notes)


def series_frame(series: dict[str, Arrays]) -> pd.DataFrame:
    """Every frame of every estimator and region."""
    from experiments.reproduce.film import long_table

    cells = {(name, r): found[r] for name, found in series.items() for r in (EDGE, FLAT)}
    return long_table(cells.items(), ("estimator", "region"), COLUMNS, "frame")


def read_gains(guided: dict[str, Any]) -> dict[str, dict[str, float]]:
    """The readings of "global quality", by name and region."""
    found: dict[str, dict[str, float]] = {}
    for region in (EDGE, FLAT):
        own, other = guided[GUIDED][region], guided[UNGUIDED][region]
        for name, value in (
            ("variance, each frame / accumulated", own["frame_deviation"] / own["shown_deviation"]),
            ("squared error, each frame / accumulated", own["frame_error"] / own["shown_error"]),
            (
                "accumulated variance, 8 samples / local guiding",
                other["shown_deviation"] / own["shown_deviation"],
            ),
            (
                "accumulated squared error, 8 samples / local guiding",
                other["shown_error"] / own["shown_error"],
            ),
        ):
            value = value**2
            found.setdefault(name, {})[region] = value
    return found


def accumulation_table(guided: dict[str, Any]) -> Any:
    """The readings of 11x and 2x, and the deviations that they come from."""
    import pandas as pd

    from experiments.tables import Column, Table

    rows: list[dict[str, Any]] = [
        {"reading": "as printed", EDGE: 11.0, FLAT: 2.0},
        *({"reading": name, **values} for name, values in read_gains(guided).items()),
    ]
    for name, regions in guided.items():
        for key, text in (
            ("count", "mean count"),
            ("frame_deviation", "deviation of each frame"),
            ("shown_deviation", "deviation of the accumulated"),
            ("frame_error", "error of each frame"),
            ("shown_error", "error of the accumulated"),
        ):
            rows.append({"reading": f"{name}: {text}", **{r: regions[r][key] for r in regions}})
    columns = (Column("reading", "reading"), Column(EDGE, EDGE, ".4g"), Column(FLAT, FLAT, ".4g"))
    return Table("Global quality of local guiding", pd.DataFrame(rows), columns)


def overlay_frame(disturbed: Arrays) -> pd.DataFrame:
    """Every frame of the overlay's measurement."""
    from experiments.reproduce.film import long_table

    return long_table([((), disturbed["frames"])], (), OVERLAY_COLUMNS, "frame")


def judge(
    series: dict[str, Arrays], guided: dict[str, Any], disturbed: Arrays
) -> tuple[Comparison, ...]:
    """The paper's numbers and claims beside ours."""
    found = [*judge_counts(series), *judge_gains(guided)]
    frames = disturbed["frames"]
    differing, trail = int(frames[:, 0].sum()), float(frames[:, 1].max())
    found.append(
        Comparison(
            "pixels whose local history or count an overlay changes, all frames",
            "none",
            differing,
            verdict="agrees: bit for bit the same" if differing == 0 else "differs",
            agrees=differing == 0,
        )
    )
    more = float((frames[:, 3] - frames[:, 2]).max())
    disturbs = trail > 0 and more > 0
    found.append(
        Comparison(
            "global TAA behind an overlay: largest rms difference that it leaves",
            "affected",
            f"{trail:.4f}",
            verdict=f"{'agrees' if disturbs else 'differs'}: a guide that reads the global picture "
            f"would ask up to {more:.1f} samples more per pixel",
            agrees=disturbs,
        )
    )
    return tuple(found)


def judge_counts(series: dict[str, Arrays]) -> list[Comparison]:
    """Counts and deviations of the published plot, and that the last frame alone is unstable."""
    ranges = {
        region: np.percentile(settled(column(series[PAPER], region, "pixel_count")), (1, 99))
        for region in (EDGE, FLAT)
    }
    flat = float(settled(column(series[PAPER], FLAT, "count")).mean())
    still = bool(ranges[FLAT][1] - ranges[FLAT][0] <= 1 and abs(ranges[FLAT][0] - 8) <= 1)
    wanders = bool(ranges[EDGE][1] - ranges[EDGE][0] >= 16)
    shown = {region: f"{low:.0f} to {high:.0f}" for region, (low, high) in ranges.items()}
    found = [
        Comparison(
            "samples of one pixel in a flat area",
            "8, constant",
            shown[FLAT],
            verdict=f"{'agrees' if still else 'differs'}; the region's mean is {flat:.2f}",
            agrees=still,
        ),
        Comparison(
            "samples of one pixel in a shadow's edge",
            "8 to about 55",
            shown[EDGE],
            verdict=f"{'agrees: it wanders' if wanders else 'differs: it hardly wanders'}; the "
            "published pixel and its light are not known",
            agrees=wanders,
        ),
    ]
    for name in (PAPER, ENGINE):
        edge, even = (
            float(settled(column(series[name], region, "estimated_error")).mean())
            for region in (EDGE, FLAT)
        )
        found.append(
            Comparison(
                f"local standard deviation, edge and flat; {name}",
                "about 0.01 and 0.004",
                f"{edge:.4f} and {even:.4f}",
                verdict=f"{edge / even:.2f} times as much at the edge; printed is 2.5, of a light "
                "and a target that are not said",
            )
        )
    steps = [float(settled(column(series[n], EDGE, "step")).mean()) for n in (PAPER, LAST)]
    unstable = steps[1] > steps[0]
    told = "agrees" if unstable else "differs: the last frame alone is the steadier"
    found.append(
        Comparison(
            "change of an edge pixel's count per frame: history, last frame alone",
            "unstable without history",
            f"{steps[0]:.1f}, {steps[1]:.1f}",
            "samples",
            told,
            unstable,
        )
    )
    return found


def judge_gains(guided: dict[str, Any]) -> list[Comparison]:
    """Each reading of 11x and 2x. None is claimed: with some to choose from, one may fit by
    chance.
    """
    found, readings = [], read_gains(guided)
    for name, gains in readings.items():
        more = gains[EDGE] > gains[FLAT]
        near = all(
            1 / AGREES_WITHIN <= gains[region] / printed <= AGREES_WITHIN
            for region, printed in ((EDGE, 11.0), (FLAT, 2.0))
        )
        told = (
            f"this reading comes within a factor of {AGREES_WITHIN} of both"
            if near
            else "this reading does not give the printed numbers"
        )
        order = "more" if more else "less"
        found.append(
            Comparison(
                f"global quality, {name}",
                "11x edge, 2x flat",
                f"{gains[EDGE]:.2f}x edge, {gains[FLAT]:.2f}x flat",
                verdict=f"no claim, one of {len(readings)} readings: {told}; the edge gains "
                f"{order} than the flat area",
            )
        )
    return found


def series_figure(series: dict[str, Arrays]) -> Figure:
    """Counts and errors over the frames, a column per region."""
    from experiments.reproduce.film_plots import Panel, line_figure

    panels = []
    for name, label, is_log in (
        ("count", "mean samples", False),
        ("pixel_count", "samples of one pixel", False),
        ("estimated_error", "estimated error", True),
        ("true_error", "true error", True),
    ):
        for region in (EDGE, FLAT):
            lines = {key: column(found, region, name) for key, found in series.items()}
            if name == "pixel_count":
                # One pixel's count jumps every frame: all lines over all frames hide one another.
                lines = {key: lines[key][:PIXEL_FRAMES] for key in (PAPER, LAST) if key in lines}
            limits = (0.0, 68.0) if not is_log else None
            panels.append(Panel(region, label, lines, is_log=is_log, limits=limits))
    return line_figure(panels, 2)


def count_figure(series: dict[str, Arrays], regions: dict[str, Mask], attribution: str) -> Figure:
    """The last frame's counts of each estimator, the regions outlined."""
    from experiments.reproduce.film_plots import map_figure

    maps = {
        name: np.where(found["counts"] > 0, found["counts"].astype(np.float64), np.nan)
        for name, found in series.items()
    }
    return map_figure(
        maps,
        "samples per pixel; outlined: the shadow's edge",
        limits=(8, 64),
        outlines={EDGE: regions[EDGE]},
        attribution=attribution,
    )


def overlay_figure(disturbed: Arrays) -> Figure:
    """What a veil does to the picture's accumulation and to a guide that reads it."""
    from experiments.reproduce.film_plots import Panel, line_figure

    of = dict(zip(OVERLAY_COLUMNS, disturbed["frames"].T, strict=True))
    return line_figure(
        [
            Panel(
                "What the TAA still shows of the veil",
                "rms difference, last 8 frames",
                {"accumulated by the TAA": of["difference in the trail"]},
            ),
            Panel(
                "What local guiding sees of the veil",
                "pixels that differ",
                {"local history or count": of["local pixels that differ"]},
                limits=(-0.5, max(10.0, 1.05 * float(of["local pixels that differ"].max()))),
            ),
            Panel(
                "Samples asked per pixel",
                "samples",
                {
                    "global guide, bare": of["asked by a global guide, bare"],
                    "global guide, veiled": of["asked by a global guide, veiled"],
                    "local guiding, veiled": of["local count"],
                },
            ),
        ],
        num_columns=3,
    )


def trail_figure(disturbed: Arrays, attribution: str) -> Figure:
    """Where the globally accumulated picture still shows the veil."""
    from experiments.reproduce.film_plots import map_figure

    return map_figure(
        {"with veil - without, as accumulated": disturbed["trail"]},
        "difference of the tracked scalar; grey: under the veil",
        colours="magma",
        attribution=attribution,
    )
