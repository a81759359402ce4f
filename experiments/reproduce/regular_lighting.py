"""`regular-lighting`: the key light moves around the head, without control variate, with the online
and with the constant one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce import changing_light as lights
from experiments.reproduce.changing_light import CONSTANT, NO_CV, ONLINE, Film, Measured
from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    from kernels.opencl.device import Device

SIZE, QUICK_SIZE = (2560, 1440), (192, 108)
FRAMES, QUICK_FRAMES = 72, 32
#: PSNR is taken in every so many frames: each has light, and so a reference, of its own.
EVERY = 8
DEGREES_PER_FRAME = 2.0
EARLY, LATE = "early", "late"


def make_film(quick: bool) -> Film:
    """The light swings through all frames."""
    size, frames = (QUICK_SIZE, QUICK_FRAMES) if quick else (SIZE, FRAMES)
    early = {} if quick else {EARLY: frames // 4 - 1}
    return Film(
        name="regular-lighting",
        size=size,
        frames=frames,
        make_scene=lambda device: make_scene(size, device),
        key={"scene": lights.SCENE, "degrees_per_frame": DEGREES_PER_FRAME},
        reference_of=lambda frame: frame if frame % EVERY == EVERY - 1 else None,
        traced=early | {LATE: frames - 1},
    )


def make_scene(size: tuple[int, int], device: Device) -> Any:
    """The head whose key light circles around the vertical axis."""
    from kernels.scenes.camera import CAMERAS
    from kernels.scenes.head import render_head
    from kernels.scenes.light import RIG
    from kernels.scenes.motion import MovingScene
    from kernels.scenes.paths import still, swing

    return MovingScene(
        lambda camera, rig: render_head(camera, *size, device, rig),
        still(CAMERAS[lights.SCENE]),
        swing(RIG, "key", DEGREES_PER_FRAME),
    )


def run(settings: Settings) -> Outcome:
    """Play the moving light and judge."""
    film = make_film(settings.quick)
    measured = lights.measure(film, settings)
    return Outcome(
        tables={
            "summary": summary_table(measured),
            "traffic": lights.traffic_table(measured),
            "frames": lights.frame_table(measured),
        },
        figures={
            "frames": lights.frame_figure(measured),
            "counts": lights.count_figure(measured, LATE),
        },
        comparisons=judge(measured),
        words=(
            f"The key light turns by {DEGREES_PER_FRAME:g} degrees a frame around the vertical "
            "axis, and its shadows with it; the other lights rest. PSNR on luminance over the "
            f"scattering pixels, in every {EVERY}th frame against {lights.REFERENCE_SAMPLES} "
            "samples in its own light.",
            "The slides show pictures of the counts and print no numbers.",
        ),
    )


def settled(measured: Measured, control: str) -> tuple[float, float]:
    """Mean count and PSNR over the later half of the frames."""
    rows = measured.frames[control][measured.film.frames // 2 :]
    return float(rows[:, 0].mean()), float(np.nanmean(rows[:, 1]))


def summary_table(measured: Measured) -> Any:
    """Count and PSNR of each control while the light moves."""
    import pandas as pd

    from experiments.tables import Column, Table

    rows = []
    for name in measured.frames:
        count, quality = settled(measured, name)
        rows.append({"control": name, "count": count, "psnr_db": quality})
    columns = (
        Column("control", "control"),
        Column("count", "samples per pixel", ".2f"),
        Column("psnr_db", "PSNR (dB)", ".2f"),
    )
    notes = ("Means over the later half of the frames.",)
    return Table("Under a moving light", pd.DataFrame(rows), columns, notes)


def judge(measured: Measured) -> tuple[Comparison, ...]:
    """The paper's claims: fewer samples for moving light, about the same picture."""
    counts, qualities = {}, {}
    for name in measured.frames:
        counts[name], qualities[name] = settled(measured, name)
    found = []
    for control in (ONLINE, CONSTANT):
        share = counts[control] / counts[NO_CV]
        cycles = lights.ratio(measured, LATE, "sampling_cycles", control)
        fewer = share < 1
        found.append(
            Comparison(
                f"samples under a moving light, {control} / no CV",
                "fewer",
                f"{share:.3f}",
                verdict=f"{'agrees: fewer' if fewer else 'differs: not fewer'}; {cycles:.3f} of "
                f"the sampling cycles, PSNR {qualities[control] - qualities[NO_CV]:+.2f} dB",
                agrees=fewer,
            )
        )
    apart = abs(counts[ONLINE] / counts[CONSTANT] - 1)
    found.append(
        Comparison(
            "samples, online / constant CV",
            None,
            f"{counts[ONLINE] / counts[CONSTANT]:.3f}",
            verdict=f"{'alike, within a fifth' if apart <= 0.2 else 'more than a fifth apart'}; "
            "the online control has to learn a, at a weight of 0.05 per frame",
        )
    )
    found.append(lights.judge_textures(measured))
    return (*found, *lights.compare_net(measured, LATE))


EXPERIMENT = Experiment(
    name="regular-lighting",
    title="A moving light: counts, cycles, traffic and PSNR with control variates",
    chapter="6",
    figure="slides: regular lighting, 2560x1440",
    minutes=60,
    quick_minutes=0.3,
    run=run,
)
