"""`disocclusion`: how lighting and sample counts settle where a pixel has no history, with each of
the three rules for it.

The dissertation's circle scene in three events: everything is new in the first frame; a disc that
moves lays its background open; the picture scrolls and its edge brings in what was off the screen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.disocclusion_scenes import EVENTS, background, roll, stage
from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    import numpy.typing as npt
    import pandas as pd
    from matplotlib.figure import Figure

    from experiments.reproduce.film import Float
    from experiments.reproduce.parts import Arrays
    from kernels.method import Method
    from kernels.opencl.device import Device

SIZE, QUICK_SIZE = (960, 540), (128, 72)
AGES, QUICK_AGES = 48, 32
#: The target variance of the slide on disocclusion.
TARGET_VARIANCE = 0.08**2
REFERENCE_SAMPLES = 1024
RULES = ("none", "offscreen", "variance")
#: Of each age: mean count, rms errors of the history's mean and of the error it believes in.
COLUMNS = ("pixels", "count", "lighting_error", "believed_error", "true_error")
SOURCES = (
    "kernels",
    *(f"experiments.reproduce.{m}" for m in ("disocclusion", "disocclusion_scenes", "film")),
)
#: The lighting has converged where its error is at most this many times the settled one.
CONVERGED = 1.5


def run(settings: Settings) -> Outcome:
    """Every rule in every event."""
    settings.progress("reference", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    ages = QUICK_AGES if settings.quick else AGES
    parts = settings.parts("disocclusion", *SOURCES)
    method = list_methods()["variance"]
    given = {"size": [width, height], "samples": REFERENCE_SAMPLES, "method": method.as_dict()}
    references = parts.arrays(
        "reference", given, lambda: reference_scalars(width, height, method, device)
    )
    found: dict[str, dict[str, Any]] = {}
    cells = [(event, rule) for event in EVENTS for rule in RULES]
    for done, (event, rule) in enumerate(cells):
        settings.progress(f"{event}, {rule}", 0.05 + 0.95 * done / len(cells))
        chosen = list_methods()[rule]

        def measure(event: str = event, chosen: Method = chosen) -> Arrays:
            return measure_event(event, chosen, references, ages, device)

        inputs = {
            "event": event, "size": [width, height], "ages": ages, "method": chosen.as_dict(),
        }  # fmt: skip
        kept = parts.arrays(f"{event.split()[0]}-{rule}-{done}", inputs, measure)
        found.setdefault(event, {})[rule] = kept
    curves = {e: {r: c["ages"] for r, c in by_rule.items()} for e, by_rule in found.items()}
    return Outcome(
        tables={"summary": summary_table(curves), "ages": age_frame(curves)},
        figures={
            "ages": age_figure(curves),
            "counts": count_figure({r: c["counts"] for r, c in found[EVENTS[1]].items()}),
        },
        comparisons=judge(curves),
        words=(
            "Age is the number of frames since a surface came into view. Lighting is the mean that "
            "the history tracks, its error the root mean square difference from the reference "
            f"({REFERENCE_SAMPLES} samples, mip 0) over the surfaces of an age. The target "
            "variance is the slide's, 0.08^2.",
            "none: the history counts whatever it holds, also where there is none and it holds 0. "
            "offscreen: what comes from off the screen takes this frame alone and variance 0. "
            "variance, the slides' rule: that, and what is more than a tenth off in depth, takes "
            "this frame alone and the target variance; its first frame takes the most samples.",
            "Behind the disc the first two rules go on with the disc's own history; a rule that "
            "knows the screen's border alone cannot tell.",
        ),
    )


def list_methods() -> dict[str, Method]:
    """The paper's rule with each disocclusion rule, by name; physical scale, in which the circle
    scene's edge is some pixels wide.
    """
    from kernels.method import Method

    return {
        rule: Method(kind="adaptive", sigma0_sq=TARGET_VARIANCE, disocclusion=rule)
        for rule in RULES
    }


def reference_scalars(width: int, height: int, method: Method, device: Device) -> dict[str, Float]:
    """(h, w) float32 tracked scalars of the background: `still`, and `scrolling`, whose left and
    right edges meet.
    """
    from experiments.reproduce.film import render_reference, tracked

    view, half = background(width, height), width // 2
    still, turned = (
        tracked(render_reference(v, method, REFERENCE_SAMPLES, device).scattered)
        for v in (view, roll(view, half))
    )
    near = np.abs(np.arange(width) - (width - 1) / 2) > width / 4
    return {"still": still, "scrolling": np.where(near, np.roll(turned, -half, axis=1), still)}


def measure_event(
    event: str, method: Method, references: dict[str, Float], ages: int, device: Device
) -> dict[str, npt.NDArray[Any]]:
    """(ages, 5) `COLUMNS` by age, and the counts (h, w) of a frame in the middle."""
    from experiments.reproduce.film import play, tracked

    height, width = references["still"].shape
    scene, age_of, target_of, num_frames = stage(event, references, ages)
    sums = np.zeros((ages, len(COLUMNS)))
    picture = np.zeros((height, width), np.uint16)
    for shot in play(scene, method, num_frames, device):
        age, target = age_of(shot.index), target_of(shot.index)
        scattered, history = shot.scattered, shot.history
        if shot.index == num_frames // 2:
            picture = scattered[..., 3].astype(np.uint16)
        counted = (age >= 0) & (age < ages)
        values: tuple[npt.NDArray[Any], ...] = (
            np.ones(age.shape),
            scattered[..., 3],
            (history[..., 3] - target) ** 2,
            history[..., 2],
            (tracked(scattered) - target) ** 2,
        )
        for i, value in enumerate(values):
            sums[:, i] += np.bincount(
                age[counted], weights=value[counted].astype(np.float64), minlength=ages
            )
    means = sums / np.maximum(sums[:, :1], 1)
    means[:, 2:] = np.sqrt(means[:, 2:])
    means[:, 0] = sums[:, 0]
    return {"ages": means, "counts": picture}


def converged_at(errors: Sequence[float]) -> int:
    """The first age from which the error stays within `CONVERGED` of its settled value, the mean of
    the last quarter.
    """
    values = np.asarray(errors)
    settled = values[-max(1, len(values) // 4) :].mean()
    above = np.flatnonzero(values > CONVERGED * settled)
    return int(above[-1]) + 1 if above.size else 0


def excess(counts: Sequence[float]) -> float:
    """Samples per pixel beyond the settled count, summed over the ages."""
    values = np.asarray(counts)
    settled = values[-max(1, len(values) // 4) :].mean()
    return float(np.maximum(values - settled, 0).sum())


def summarise(curve: npt.NDArray[Any]) -> dict[str, float]:
    """What one rule does in one event."""
    of = dict(zip(COLUMNS, curve.T, strict=True))
    # Belief beside truth: geometric mean of their ratio in the first frames that have a history.
    known = slice(1, max(2, len(curve) // 2))
    ratio = np.maximum(of["believed_error"][known], 1e-6) / np.maximum(
        of["true_error"][known], 1e-6
    )
    return {
        "converged_at": converged_at(of["lighting_error"]),
        "first_error": float(of["lighting_error"][:8].mean()),
        "excess": excess(of["count"]),
        "settled_count": float(of["count"][-max(1, len(curve) // 4) :].mean()),
        "belief": float(np.exp(np.log(ratio).mean())),
    }


def summary_table(curves: dict[str, dict[str, Any]]) -> Any:
    """One row per event and rule."""
    import pandas as pd

    from experiments.tables import Column, Table

    rows = [
        {"event": event, "rule": rule, **summarise(curve)}
        for event, by_rule in curves.items()
        for rule, curve in by_rule.items()
    ]
    columns = (
        Column("event", "event"),
        Column("rule", "rule"),
        Column("converged_at", "frames to converge", ".0f"),
        Column("first_error", "lighting error, first 8 frames", ".4f"),
        Column("excess", "samples beyond the settled count", ".1f"),
        Column("settled_count", "settled count", ".1f"),
        Column("belief", "estimated / true error", ".2f"),
    )
    notes = (
        f"Converged: the lighting's error stays within {CONVERGED:g} times its settled value. "
        "Samples beyond the settled count are summed over the frames, per pixel.",
    )
    return Table("After a disocclusion", pd.DataFrame(rows), columns, notes)


def age_frame(curves: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """Every age of every event and rule."""
    from experiments.reproduce.film import long_table

    cells = {(e, r): curve for e, by_rule in curves.items() for r, curve in by_rule.items()}
    return long_table(cells.items(), ("event", "rule"), COLUMNS, "age")


def judge(curves: dict[str, dict[str, Any]]) -> tuple[Comparison, ...]:
    """The slides' three claims for their rule against none, in each event."""
    found = []
    for event, by_rule in curves.items():
        none, rule = (summarise(by_rule[name]) for name in ("none", "variance"))
        belief = [abs(float(np.log(max(s["belief"], 1e-6)))) for s in (none, rule)]
        for quantity, paper, values, holds, unit in (
            (
                "lighting's error in the first 8 frames",
                "converges faster",
                f"{none['first_error']:.4f} to {rule['first_error']:.4f}",
                rule["first_error"] < none["first_error"],
                "",
            ),
            (
                "samples beyond the settled count",
                "overestimation resolved",
                f"{none['excess']:.0f} to {rule['excess']:.0f}",
                rule["excess"] < none["excess"],
                "samples/pixel",
            ),
            (
                "estimated / true error",
                "better error estimation",
                f"{none['belief']:.2f} to {rule['belief']:.2f}",
                belief[1] < belief[0],
                "",
            ),
        ):
            told = "agrees" if holds else "differs: not better than without a rule"
            found.append(Comparison(f"{event}: {quantity}", paper, values, unit, told, holds))
    return tuple(found)


def age_figure(curves: dict[str, dict[str, Any]]) -> Figure:
    """Count, lighting error and estimated beside true error over age, a column per event."""
    from experiments.reproduce.film_plots import Panel, line_figure

    panels = []
    for column, label, is_log in (
        ("count", "samples", False),
        ("lighting_error", "error of the lighting", True),
        ("believed_error", "estimated error", True),
        ("true_error", "true error of a frame", True),
    ):
        at = COLUMNS.index(column)
        for event, by_rule in curves.items():
            # An estimated error of 0 has no place on a logarithmic axis.
            lines = {
                rule: np.where(c[:, at] > 0, c[:, at], np.nan) if is_log else c[:, at]
                for rule, c in by_rule.items()
            }
            panels.append(Panel(event, label, lines, x_label="age (frames)", is_log=is_log))
    return line_figure(panels, len(curves))


def count_figure(counts: dict[str, npt.NDArray[np.uint16]]) -> Figure:
    """The counts behind the moving disc."""
    from experiments.reproduce.film_plots import map_figure

    maps = {f"rule: {rule}": values.astype(np.float64) for rule, values in counts.items()}
    return map_figure(maps, "samples per pixel, the disc moving to the right", limits=(8, 64))


EXPERIMENT = Experiment(
    name="disocclusion",
    title="Lighting and counts where there is no history, by rule: the circle scene",
    chapter="4",
    figure="slides: disocclusion",
    minutes=5,
    quick_minutes=0.15,
    run=run,
)
