"""`direct-distant`: the receding wall, with direct and distant scattering tracked together, apart,
and apart with no samples where the distant share is small.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings, compare

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from experiments.reproduce.parts import Arrays
    from kernels.frame import Scene
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

SIZE, QUICK_SIZE = (1280, 720), (160, 90)
FRAMES, QUICK_FRAMES = 96, 40
REFERENCE_SAMPLES = 1024
EPSILON = 0.05
#: Pixels per mm at the wall's left and right edge.
NEAR, FAR = 0.2, 0.002
TOGETHER, APART, IGNORED = "together", "apart, epsilon_u 0", f"apart, epsilon_u {EPSILON:g}"
STILL, JITTERED = "still", "jittered"
#: Of each frame: mean count, that beyond the border and along the light's edge, share of pixels
#: that take no samples, PSNR in dB over the wall and beyond the border.
COLUMNS = ("count", "far_count", "edge_count", "idle_rate", "psnr_db", "far_psnr_db")
SOURCES = ("kernels", "experiments.reproduce.direct_distant", "experiments.reproduce.film")


def list_methods() -> dict[str, Method]:
    """The three ways to track, by name."""
    from kernels.method import Method

    plain = Method(kind="adaptive")
    return {
        TOGETHER: plain,
        APART: replace(plain, epsilon_u=0.0),
        IGNORED: replace(plain, epsilon_u=EPSILON),
    }


def run(settings: Settings) -> Outcome:
    """The wall at rest and under the TAA's jitter, each way to track."""
    from experiments.reproduce.film import make_references

    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    frames = QUICK_FRAMES if settings.quick else FRAMES
    parts = settings.parts("direct-distant", *SOURCES)
    found: dict[str, dict[str, Arrays]] = {STILL: {}, JITTERED: {}}
    methods = list_methods()
    given = {"size": [width, height], "samples": REFERENCE_SAMPLES}
    for done, motion in enumerate(found):
        settings.progress(f"{motion}, reference", done / len(found))
        scene, period = make_scene((width, height), motion == JITTERED)
        inputs = given | {"motion": motion}

        def refer(scene: Scene = scene, period: int = period) -> Arrays:
            return make_references(scene, period, methods[TOGETHER], REFERENCE_SAMPLES, device)

        references = parts.arrays(f"{motion}-references", inputs, refer)
        for number, (name, method) in enumerate(methods.items()):
            share = (done + 0.1 + 0.9 * number / len(methods)) / len(found)
            settings.progress(f"{motion}, {name}", share)

            def measure(
                method: Method = method, scene: Scene = scene, references: Arrays = references
            ) -> Arrays:
                return measure_wall(method, scene, references, frames, device)

            keyed = inputs | {"frames": frames, "method": method.as_dict()}
            found[motion][name] = parts.arrays(f"{motion}-{number}", keyed, measure)
    rows = {m: {n: c["frames"] for n, c in by_name.items()} for m, by_name in found.items()}
    counts = {name: cell["counts"] for name, cell in found[STILL].items()}
    border = border_column(width)
    return Outcome(
        tables={"summary": summary_table(rows), "frames": frame_table(rows)},
        figures={
            "counts": count_figure(counts, border),
            "frames": line_figure_of(rows),
            "columns": column_figure(counts, width),
        },
        comparisons=judge(rows, counts, width),
        words=(
            "A wall that recedes from 0.2 to 0.002 pixels per mm, lit above and dark below. The "
            "distant share of a pixel is what its profile scatters beyond the pixel, 1 - cdf(r) at "
            "the pixel's size r (our reading; the slides give no formula). Beyond the border it is "
            f"at most {EPSILON:g}.",
            "together: the variance of all scattered light is tracked. apart: that of the distant "
            f"light alone. With epsilon_u {EPSILON:g} pixels beyond the border take no samples and "
            "stay diffuse. PSNR on luminance of each frame against "
            f"{REFERENCE_SAMPLES} samples of the same camera, over the wall and beyond the border.",
        ),
    )


def border_column(width: int, epsilon: float = EPSILON) -> float:
    """Where along the wall the distant share is epsilon, pixels from the left; from the wall's
    scale, the exact cdf and bisection.
    """
    from scipy.optimize import brentq

    from kernels.maths.profile import SKIN, cdf

    def excess(x: float) -> float:
        scale = NEAR + (FAR - NEAR) * x / width
        return 1.0 - float(cdf(np.array([1.0 / scale]), SKIN.d_sampled_mm)[0]) - epsilon

    return float(brentq(excess, 0.0, float(width)))


def make_scene(size: tuple[int, int], jittered: bool) -> tuple[Scene, int]:
    """The wall, and the length of the jitter's period; each of its views is made once."""
    from kernels.scenes.analytic import wall
    from kernels.scenes.jitter import Jitter

    def view(x: float, y: float) -> GBuffer:
        return wall(*size, near_pixels_per_mm=NEAR, far_pixels_per_mm=FAR, offset=(x, y))

    if not jittered:
        return view(0.0, 0.0), 1
    jitter = Jitter("gaussian")
    views = [view(*jitter(point)) for point in range(jitter.num_points)]
    return lambda frame: views[frame % len(views)], len(views)


def measure_wall(
    method: Method, scene: Scene, references: Arrays, frames: int, device: Device
) -> Arrays:
    """(frames, 6) `COLUMNS`, and the last frame's counts (h, w)."""
    from experiments.reproduce.film import play
    from kernels.quality import psnr

    exact = [references[str(point)].astype(np.float32) for point in range(len(references))]
    height, width = exact[0].shape[:2]
    everywhere = np.ones((height, width), np.bool_)
    far = everywhere & (np.arange(width) >= border_column(width))
    edge = everywhere & (np.abs(np.arange(height) + 0.5 - height / 2) < 3)[:, None]
    rows, counts = [], np.zeros((height, width), np.uint16)
    for shot in play(scene, method, frames, device):
        counts = shot.scattered[..., 3].astype(np.uint16)
        reference, picture = exact[shot.index % len(exact)], shot.combined
        rows.append(
            [
                float(counts.mean()),
                float(counts[far].mean()),
                float(counts[edge].mean()),
                float((counts == 0).mean()),
                *(_finite(psnr(picture, reference, mask)) for mask in (everywhere, far)),
            ]
        )
    return {"frames": np.array(rows), "counts": counts}


def _finite(decibel: float) -> float:
    """Equal half floats are told as 120 dB."""
    return min(decibel, 120.0)


def settled(rows: Any, column: str) -> float:
    """Mean over the later half of the frames."""
    return float(rows[len(rows) // 2 :, COLUMNS.index(column)].mean())


def frames_to_settle(rows: Any, column: str = "count") -> int:
    """The first frame from which a quantity stays within a tenth of its settled value."""
    values = rows[:, COLUMNS.index(column)]
    far = np.flatnonzero(np.abs(values - settled(rows, column)) > 0.1 * settled(rows, column))
    return int(far[-1]) + 1 if far.size else 0


def summary_table(rows: dict[str, dict[str, Any]]) -> Any:
    """Settled means of each way to track."""
    import pandas as pd

    from experiments.tables import Column, Table

    found = [
        {
            "motion": motion,
            "tracked": name,
            "settles": frames_to_settle(cell),
            **{column: settled(cell, column) for column in COLUMNS},
        }
        for motion, by_name in rows.items()
        for name, cell in by_name.items()
    ]
    columns = (
        Column("motion", "wall"),
        Column("tracked", "tracked"),
        Column("settles", "frames to settle"),
        Column("count", "samples per pixel", ".2f"),
        Column("far_count", "beyond the border", ".2f"),
        Column("edge_count", "along the light's edge", ".2f"),
        Column("idle_rate", "pixels of 0 samples", ".1%"),
        Column("psnr_db", "PSNR (dB)", ".2f"),
        Column("far_psnr_db", "beyond the border (dB)", ".2f"),
    )
    notes = (
        "Means over the later half of the frames; settled: the mean count stays within a tenth.",
    )
    return Table("Direct and distant scattering", pd.DataFrame(found), columns, notes)


def frame_table(rows: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """Every frame."""
    from experiments.reproduce.film import long_table

    cells = {(m, n): cell for m, by_name in rows.items() for n, cell in by_name.items()}
    return long_table(cells.items(), ("wall", "tracked"), COLUMNS, "frame")


def judge(
    rows: dict[str, dict[str, Any]], counts: dict[str, Any], width: int
) -> tuple[Comparison, ...]:
    """The slides' claims: where the border lies, and what separation is for."""
    idle = (counts[IGNORED] == 0).all(axis=0)
    measured = float(np.argmax(idle)) if idle.any() else float(width)
    none_idle = bool((counts[APART] > 0).all())
    saved = settled(rows[STILL][IGNORED], "count") / settled(rows[STILL][TOGETHER], "count")
    before, after = (settled(rows[JITTERED][n], "edge_count") for n in (TOGETHER, APART))
    loss = settled(rows[STILL][TOGETHER], "far_psnr_db") - settled(
        rows[STILL][IGNORED], "far_psnr_db"
    )
    return (
        compare(
            f"border of epsilon_u {EPSILON:g}, column, by the closed form and as rendered",
            border_column(width),
            measured,
            "pixels",
            relative=1.5 / border_column(width),
            note="the sources print no number: the first is 1 - cdf(r) = 0.05 solved",
        ),
        Comparison(
            "pixels of 0 samples with epsilon_u 0",
            "none",
            int((counts[APART] == 0).sum()),
            verdict="agrees" if none_idle else "differs",
            agrees=none_idle,
        ),
        Comparison(
            f"samples, epsilon_u {EPSILON:g} / together",
            "fewer",
            f"{saved:.3f}",
            verdict="agrees" if saved < 1 else "differs: not fewer",
            agrees=saved < 1,
        ),
        Comparison(
            "samples along the light's edge under jitter, together and apart",
            "jittering's variance removed",
            f"{before:.2f} and {after:.2f}",
            verdict="agrees" if after < before else "differs: not fewer",
            agrees=after < before,
        ),
        Comparison(
            f"PSNR beyond the border, together - epsilon_u {EPSILON:g}",
            None,
            f"{loss:.2f}",
            "dB",
            f"{'the price' if loss > 0 else 'a gain'}: what stays diffuse has no noise but lacks "
            "its distant light",
        ),
    )


def count_figure(counts: dict[str, Any], border: float) -> Figure:
    """Where each way takes how many samples; the border as outline."""
    from experiments.reproduce.film_plots import map_figure

    first = next(iter(counts.values()))
    beyond = np.broadcast_to(np.arange(first.shape[1]) >= border, first.shape)
    return map_figure(
        {n: np.where(c > 0, c.astype(np.float64), np.nan) for n, c in counts.items()},
        "samples per pixel; grey: none; line: distant share 5 %",
        limits=(8, 64),
        outlines={"border": beyond},
    )


def column_figure(counts: dict[str, Any], width: int) -> Figure:
    """Mean count of each column of the wall."""
    from experiments.reproduce.film_plots import Panel, line_figure

    lines = {name: c.mean(axis=0) for name, c in counts.items()}
    marks = {border_column(width): "distant share 5 %"}
    return line_figure(
        [Panel("at rest", "samples, mean of a column", lines, x_label="column", marks=marks)]
    )


def line_figure_of(rows: dict[str, dict[str, Any]]) -> Figure:
    """Counts and PSNR over the frames."""
    from experiments.reproduce.film_plots import Panel, line_figure

    panels = []
    for column, label in (("count", "samples per pixel"), ("psnr_db", "PSNR (dB)")):
        for motion, by_name in rows.items():
            lines = {n: c[:, COLUMNS.index(column)] for n, c in by_name.items()}
            panels.append(Panel(f"wall, {motion}", label, lines))
    return line_figure(panels)


EXPERIMENT = Experiment(
    name="direct-distant",
    title="Direct and distant scattering apart: counts and convergence on a receding wall",
    chapter="4",
    figure="slides: separating direct and distant scattering",
    minutes=5,
    quick_minutes=0.2,
    run=run,
)
