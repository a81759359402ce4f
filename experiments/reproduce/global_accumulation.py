"""`global-accumulation`: what a global TAA makes of the local pass, with and without local guiding,
under two intensities of light, and Separable beside it.

Every picture is held to what it stands for: a single frame to the reference under its own jitter,
an accumulated one to the mean of the references over the jitter's period.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.reproduce.parts import Arrays
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device
    from kernels.scenes.motion import MovingScene

SCENE = "close"
SIZE, QUICK_SIZE = (1280, 720), (128, 72)
FRAMES, QUICK_FRAMES = 128, 40
REFERENCE_SAMPLES = 1024
#: Factors of all light: powers of two, which leave the bits of a picture's half floats alone.
INTENSITIES = {"full light": 1.0, "a quarter": 0.25}
GUIDED, EQUAL, LEAST, SEPARABLE = (
    "local guiding",
    "fixed, as many samples",
    "fixed, 8 samples",
    "Separable",
)
#: Of each frame: mean count, PSNR in dB of the frame alone and of the TAA's picture.
COLUMNS = ("count", "frame_psnr_db", "taa_psnr_db")
SOURCES = ("kernels", "experiments.reproduce.global_accumulation", "experiments.reproduce.film")


def list_methods(mean_count: int) -> dict[str, Method]:
    """The methods behind the TAA, by name. mean_count: of local guiding under the same light."""
    from kernels.method import Method

    guided = Method(kind="adaptive", scale="legacy", taa=True)
    return {
        GUIDED: guided,
        EQUAL: replace(guided, kind="fixed", num_samples=mean_count),
        LEAST: replace(guided, kind="fixed", num_samples=guided.b_min),
        SEPARABLE: replace(guided, kind="separable"),
    }


def run(settings: Settings) -> Outcome:
    """Every method under every light."""
    from experiments.reproduce.film import jittered_head, long_table

    device = settings.open_device()
    size = QUICK_SIZE if settings.quick else SIZE
    frames = QUICK_FRAMES if settings.quick else FRAMES
    parts = settings.parts("global-accumulation", *SOURCES)
    view = {"scene": SCENE, "size": list(size), "samples": REFERENCE_SAMPLES}
    scene, period = jittered_head(SCENE, size, device)
    first = list_methods(1)[GUIDED]
    references: Arrays = {}
    for point in range(period):
        settings.progress(f"reference {point + 1} of {period}", 0.4 * point / period)

        def refer(point: int = point) -> Arrays:
            return {"picture": make_reference(scene(point), first, device)}

        found = parts.arrays(f"reference-{point}", view | {"point": point}, refer)
        references[str(point)] = found["picture"]
    cells: dict[str, dict[str, Arrays]] = {}
    names = list(list_methods(1))
    for done, (light, factor) in enumerate(INTENSITIES.items()):
        mean_count = 1
        for number, name in enumerate(names):
            share = (done + number / len(names)) / len(INTENSITIES)
            settings.progress(f"{light}, {name}", 0.4 + 0.6 * share)
            method = list_methods(mean_count)[name]

            def measure(method: Method = method, factor: float = factor) -> Arrays:
                return measure_method(method, scene, factor, references, frames, device)

            inputs = view | {"frames": frames, "factor": factor, "method": method.as_dict()}
            cell = parts.arrays(f"light-{done}-{number}", inputs, measure)
            cells.setdefault(light, {})[name] = cell
            if name == GUIDED:
                mean_count = max(1, round(settled(cell["frames"], "count")))
    rows = {
        light: {name: cell["frames"] for name, cell in by_name.items()}
        for light, by_name in cells.items()
    }
    return Outcome(
        tables={
            "summary": summary_table(rows),
            "frames": long_table(
                [((light, n), c) for light, by_name in rows.items() for n, c in by_name.items()],
                ("light", "method"),
                COLUMNS,
                "frame",
            ),
        },
        figures={
            "frames": frame_figure(rows),
            "errors": error_figure(
                {n: c["error"] for n, c in cells[next(iter(cells))].items()},
                scene(0).attribution,
            ),
        },
        comparisons=judge(rows),
        words=(
            "A still patch of skin under the TAA's jitter, 8 points of a Gaussian filter. PSNR on "
            f"luminance over the scattering pixels, against {REFERENCE_SAMPLES} samples from mip "
            "0: a single frame against the reference of its own jitter, the TAA's picture against "
            "the mean of the references of all jitters. a quarter: all light times 1/4.",
            "The published figure's intensities and numbers are not in the sources at hand, and "
            "its DLSS 2.0 is a closed binary. as many samples: a fixed count, the rounded mean of "
            "local guiding's under the same light. Local guiding starts with a frame of 64 "
            "samples, which the TAA, at a weight of 0.04, forgets by half in 17 frames.",
        ),
    )


def dim(view: GBuffer, factor: float) -> GBuffer:
    """The same view with all light times a factor."""
    scale = np.float32(factor)
    return replace(
        view, irradiance=view.irradiance * scale, non_subsurface=view.non_subsurface * scale
    )


def make_reference(view: GBuffer, method: Method, device: Device) -> Any:
    """(h, w, 3) half floats: the finished picture in full light."""
    from experiments.reproduce.film import render_reference

    return render_reference(view, method, REFERENCE_SAMPLES, device).combined.astype(np.float16)


def measure_method(
    method: Method,
    scene: MovingScene,
    factor: float,
    references: Arrays,
    frames: int,
    device: Device,
) -> Arrays:
    """(frames, 3) `COLUMNS`; and the last frame's error (h, w) of the TAA's luminance."""
    from experiments.reproduce.film import play
    from kernels.quality import luminance, psnr

    period = len(references)
    views = [dim(scene(point), factor) for point in range(period)]
    # A power of two: the reference under less light is the reference times it.
    exact = [
        references[str(point)].astype(np.float32) * np.float32(factor) for point in range(period)
    ]
    limit = sum(exact[1:], exact[0]) / np.float32(period)
    rows, error = [], np.zeros(limit.shape[:2], np.float32)
    for shot in play(lambda frame: views[frame % period], method, frames, device):
        skin, shown = shot.gbuffer.subsurface, shot.shown
        count = shot.scattered[..., 3][skin].mean() if method.samples else np.nan
        rows.append(
            [
                float(count),
                psnr(shot.combined, exact[shot.index % period], skin),
                psnr(shown, limit, skin),
            ]
        )
        if shot.index == frames - 1:
            error = (luminance(shown) - luminance(limit)).astype(np.float32)
            error[~skin] = np.nan
    return {"frames": np.array(rows), "error": error}


def settled(rows: Any, column: str) -> float:
    """Mean over the last quarter of the frames."""
    return float(rows[-(-3 * len(rows) // 4) :, COLUMNS.index(column)].mean())


def summary_table(rows: dict[str, dict[str, Any]]) -> Any:
    """Settled means per light and method."""
    import pandas as pd

    from experiments.tables import Column, Table

    found = [
        {"light": light, "method": name, **{c: settled(cell, c) for c in COLUMNS}}
        for light, by_name in rows.items()
        for name, cell in by_name.items()
    ]
    columns = (
        Column("light", "light"),
        Column("method", "method"),
        Column("count", "samples per pixel", ".2f"),
        Column("frame_psnr_db", "a frame alone (dB)", ".2f"),
        Column("taa_psnr_db", "with the TAA (dB)", ".2f"),
    )
    return Table("PSNR on luminance, last quarter of the frames", pd.DataFrame(found), columns)


def judge(rows: dict[str, dict[str, Any]]) -> tuple[Comparison, ...]:
    """The slides' claims: local guiding hands better pictures to the global accumulation, a lower
    bound on quality, and more of it than Separable.
    """
    found = []
    for light, by_name in rows.items():
        quality = {name: settled(cell, "taa_psnr_db") for name, cell in by_name.items()}
        alone = settled(by_name[GUIDED], "frame_psnr_db")
        for quantity, paper, first, second in (
            (f"{GUIDED} + TAA / {LEAST} + TAA", "better quality input", GUIDED, LEAST),
            (f"{GUIDED} + TAA / {EQUAL} + TAA", None, GUIDED, EQUAL),
            (f"{GUIDED} + TAA / {SEPARABLE} + TAA", "AFIS the higher quality", GUIDED, SEPARABLE),
        ):
            gain = quality[first] - quality[second]
            told = f"{gain:+.2f} dB"
            agrees = None if paper is None else gain > 0
            if agrees is not None:
                told = f"{'agrees' if agrees else 'differs'}: {told}"
            found.append(
                Comparison(
                    f"{light}: {quantity}",
                    paper,
                    f"{quality[first]:.2f} / {quality[second]:.2f}",
                    "dB",
                    told,
                    agrees,
                )
            )
        bound = quality[GUIDED] >= alone
        found.append(
            Comparison(
                f"{light}: {GUIDED}, a frame alone / with the TAA",
                "a lower bound",
                f"{alone:.2f} / {quality[GUIDED]:.2f}",
                "dB",
                "agrees: the TAA adds to it" if bound else "differs: the TAA loses quality",
                bound,
            )
        )
    return tuple(found)


def frame_figure(rows: dict[str, dict[str, Any]]) -> Figure:
    """PSNR of the frames alone and with the TAA, a column per light."""
    from experiments.reproduce.film_plots import Panel, line_figure

    panels = []
    for column, label in (("frame_psnr_db", "a frame alone"), ("taa_psnr_db", "with the TAA")):
        for light, by_name in rows.items():
            lines = {n: c[:, COLUMNS.index(column)] for n, c in by_name.items()}
            panels.append(Panel(f"{light}, {label}", "PSNR (dB)", lines))
    return line_figure(panels)


def error_figure(errors: dict[str, Any], attribution: str) -> Figure:
    """What is left between each accumulated picture and the reference, in full light."""
    from experiments.reproduce.film_plots import map_figure

    most = max(float(np.nanquantile(np.abs(e), 0.999)) for e in errors.values())
    return map_figure(
        {f"{name} + TAA": error for name, error in errors.items()},
        "luminance - reference, last frame, full light",
        num_columns=2,
        limits=(-most, most),
        colours="RdBu",
        attribution=attribution,
    )


EXPERIMENT = Experiment(
    name="global-accumulation",
    title="TAA, local guiding and Separable under two intensities: PSNR against 1024 samples",
    chapter="4",
    figure="Fig. 2",
    minutes=35,
    quick_minutes=0.3,
    run=run,
)
