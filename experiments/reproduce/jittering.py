"""`jittering`: a static scene under the camera's jitter, with the online control variate's
coefficient as it is and with the suppressing factor epsilon_a.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.reproduce.parts import Arrays
    from kernels.frame import Scene
    from kernels.method import Method
    from kernels.opencl.device import Device

SCENE = "front"
SIZE, QUICK_SIZE = (1280, 720), (192, 108)
FRAMES, QUICK_FRAMES = 128, 64
REFERENCE_SAMPLES = 1024
#: Of each frame: mean count, PSNR in dB, mean and root mean square of a - 1.
COLUMNS = ("count", "psnr_db", "coefficient_mean", "coefficient_error")
NO_CONTROL, CONSTANT = "no control variate", "constant, a = 1"
WITHOUT, WITH = "online, epsilon_a 0", "online, epsilon_a 1e-4"
SOURCES = ("kernels", "experiments.reproduce.jittering", "experiments.reproduce.film")


def list_methods() -> dict[str, Method]:
    """The controls, by name; the sources print no value of epsilon_a."""
    from kernels.method import Method

    plain = Method(kind="adaptive", scale="legacy")
    online = replace(plain, control="online")
    return {
        NO_CONTROL: plain,
        WITHOUT: replace(online, epsilon_a=0.0),
        WITH: replace(online, epsilon_a=1e-4),
        "online, epsilon_a 1e-2": replace(online, epsilon_a=1e-2),
        CONSTANT: replace(plain, control="constant"),
    }


def run(settings: Settings) -> Outcome:
    """Every control on the same jittered frames."""
    from experiments.reproduce.film import jittered_head, long_table, make_references

    settings.progress("reference", 0.0)
    device = settings.open_device()
    size = QUICK_SIZE if settings.quick else SIZE
    frames = QUICK_FRAMES if settings.quick else FRAMES
    parts = settings.parts("jittering", *SOURCES)
    view = {"scene": SCENE, "size": list(size), "samples": REFERENCE_SAMPLES}
    methods = list_methods()
    scene, period = jittered_head(SCENE, size, device)
    references = parts.arrays(
        "references",
        view,
        lambda: make_references(scene, period, methods[NO_CONTROL], REFERENCE_SAMPLES, device),
    )
    found: dict[str, Arrays] = {}
    for done, (name, method) in enumerate(methods.items()):
        settings.progress(name, 0.1 + 0.9 * done / len(methods))

        def measure(method: Method = method) -> Arrays:
            return measure_control(method, scene, references, frames, device)

        inputs = view | {"frames": frames, "method": method.as_dict()}
        found[name] = parts.arrays(f"control-{done}", inputs, measure)
    rows = {name: cell["frames"] for name, cell in found.items()}
    return Outcome(
        tables={
            "summary": summary_table(rows),
            "frames": long_table(
                [((n,), c) for n, c in rows.items()], ("control",), COLUMNS, "frame"
            ),
        },
        figures={
            "frames": frame_figure(rows),
            "counts": count_figure({name: cell["counts"] for name, cell in found.items()}),
            "coefficients": coefficient_figure(
                {n: found[n]["coefficient"] for n in (WITHOUT, WITH)}
            ),
        },
        comparisons=judge(rows),
        words=(
            "Nothing moves but the camera's sub-pixel jitter, 8 points of a Gaussian filter. Under "
            "it the lighting of a pixel varies a little, and the covariance from which the "
            "coefficient comes is noise over next to nothing. The factor adds epsilon_a to both "
            "the covariance and the variance, which draws a to 1 where both vanish. The sources "
            "print no value; 1e-4 is ours, 1e-2 stands beside it.",
            "PSNR on luminance over the scattering pixels, each frame against 1024 samples under "
            "the same jitter.",
        ),
    )


def measure_control(
    method: Method, scene: Scene, references: Arrays, frames: int, device: Device
) -> Arrays:
    """(frames, 4) `COLUMNS`; counts (h, w), the mean over the later half; and the last frame's
    coefficient (h, w), NaN where nothing scatters or none is estimated.
    """
    from experiments.reproduce.film import Spread, play
    from kernels.passes.covariance import find_coefficient
    from kernels.quality import psnr

    exact = [references[str(point)].astype(np.float32) for point in range(len(references))]
    rows, counts = [], Spread()
    coefficient = np.full(exact[0].shape[:2], np.nan, np.float32)
    for shot in play(scene, method, frames, device):
        skin = shot.gbuffer.subsurface
        count = shot.scattered[..., 3]
        if method.control == "online":
            found = find_coefficient(shot.moments, method.epsilon_a)
            coefficient = np.where(skin, found, np.nan).astype(np.float32)
        off = coefficient[skin] - 1
        rows.append(
            [
                float(count[skin].mean()),
                psnr(shot.combined, exact[shot.index % len(exact)], skin),
                float(off.mean()),
                float(np.sqrt(np.mean(np.square(off, dtype=np.float64)))),
            ]
        )
        if shot.index >= frames // 2:
            counts.add(np.where(skin, count, np.nan))
    return {
        "frames": np.array(rows),
        "counts": np.asarray(counts.mean, np.float32),
        "coefficient": coefficient,
    }


def settled(rows: Any, column: str) -> float:
    """Mean over the later half of the frames."""
    return float(rows[len(rows) // 2 :, COLUMNS.index(column)].mean())


def summary_table(rows: dict[str, Any]) -> Any:
    """Settled means per control."""
    import pandas as pd

    from experiments.tables import Column, Table

    found = [
        {"control": name, **{column: settled(cell, column) for column in COLUMNS}}
        for name, cell in rows.items()
    ]
    columns = (
        Column("control", "control"),
        Column("count", "samples per pixel", ".2f"),
        Column("psnr_db", "PSNR (dB)", ".2f"),
        Column("coefficient_mean", "mean of a - 1", ".3f"),
        Column("coefficient_error", "rms of a - 1", ".3f"),
    )
    notes = ("Means over the later half of the frames, over the scattering pixels.",)
    return Table("A static scene under jitter", pd.DataFrame(found), columns, notes)


def judge(rows: dict[str, Any]) -> tuple[Comparison, ...]:
    """What the suppressing factor is said to do."""
    spread = [settled(rows[name], "coefficient_error") for name in (WITHOUT, WITH)]
    mean = [settled(rows[name], "coefficient_mean") for name in (WITHOUT, WITH)]
    counts = {name: settled(cell, "count") for name, cell in rows.items()}
    nearer = spread[1] < spread[0]
    fewer = counts[WITH] < counts[WITHOUT]
    quality = settled(rows[WITH], "psnr_db") - settled(rows[WITHOUT], "psnr_db")
    return (
        Comparison(
            "rms of a - 1, without and with epsilon_a",
            "a to 1 in a static scene",
            f"{spread[0]:.3f} and {spread[1]:.3f}",
            verdict=f"{'agrees: nearer to 1' if nearer else 'differs: not nearer to 1'}; the mean "
            f"of a is {1 + mean[0]:.2f} and {1 + mean[1]:.2f}",
            agrees=nearer,
        ),
        Comparison(
            "samples per pixel, without and with epsilon_a",
            "suppressed",
            f"{counts[WITHOUT]:.2f} and {counts[WITH]:.2f}",
            verdict=f"{'agrees: fewer' if fewer else 'differs: not fewer'}; "
            f"{counts[NO_CONTROL]:.2f} without a control variate, {counts[CONSTANT]:.2f} with a = "
            f"1; PSNR {quality:+.2f} dB",
            agrees=fewer,
        ),
    )


def frame_figure(rows: dict[str, Any]) -> Figure:
    """Counts, PSNR and the coefficient's distance from 1 over the frames."""
    from experiments.reproduce.film_plots import Panel, line_figure

    panels = []
    for column, label in (
        ("count", "samples per pixel"),
        ("psnr_db", "PSNR (dB)"),
        ("coefficient_error", "rms of a - 1"),
        ("coefficient_mean", "mean of a - 1"),
    ):
        lines = {n: c[:, COLUMNS.index(column)] for n, c in rows.items()}
        lines = {n: values for n, values in lines.items() if not np.isnan(values).any()}
        panels.append(Panel(label, label, lines))
    return line_figure(panels)


def count_figure(counts: dict[str, Any]) -> Figure:
    """Mean counts of the later half."""
    from experiments.reproduce.film_plots import map_figure

    return map_figure(counts, "samples per pixel, mean of the later half", limits=(8, 64))


def coefficient_figure(coefficients: dict[str, Any]) -> Figure:
    """The last frame's coefficients."""
    from experiments.reproduce.film_plots import map_figure

    return map_figure(
        coefficients, "coefficient a of the last frame", limits=(-1, 3), colours="RdBu"
    )


EXPERIMENT = Experiment(
    name="jittering",
    title="A static scene under jitter: the online coefficient with and without epsilon_a",
    chapter="6",
    figure="slides: static scene with jittering",
    minutes=8,
    quick_minutes=0.2,
    run=run,
)
