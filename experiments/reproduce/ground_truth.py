"""`ground-truth`: AFIS and Separable against a dense evaluation of the integral, and the profile
itself against volumetric path tracing.

Both methods approximate one integral over the screen. Evaluated over every texel that the profile
reaches, it has no budget; the error of the methods against it falls as theirs grows, down to what
each leaves out for good. Whether the profile is right is another question, which path tracing of a
slab, a ball and meshes answers where Mitsuba is installed.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from experiments.reproduce.experiment import Experiment, Outcome, Settings
from experiments.reproduce.ground_truth_study import Study
from experiments.reproduce.ground_truth_verdicts import EXACT, PUBLISHED, SEPARABLE, SLAB

if TYPE_CHECKING:
    from experiments.reproduce.ground_truth_volume import Compared
    from experiments.reproduce.parts import Arrays, Parts
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device
    from kernels.scenes.mesh import Mesh

#: Paths of meshes, a dragon or a scanned head, separated as in PATH.
MESHES_VARIABLE = "CACHESIM_MESHES"
SIZE, QUICK_SIZE = (320, 180), (64, 36)
COUNT_SIZE, QUICK_COUNT_SIZE = (960, 540), (160, 90)
COUNT_FRAMES, QUICK_COUNT_FRAMES = 32, 8
SAMPLES, QUICK_SAMPLES = (4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048), (4, 16, 64, 256)
TAPS, QUICK_TAPS = (7, 11, 13, 17, 19, 25, 27, 51, 101, 201, 401), (11, 27, 101)
SLAB_PIXELS_PER_MM, QUICK_SLAB_PIXELS_PER_MM = 10.0, 5.0
SOURCES = ("kernels",)
VOLUME_SOURCES = (
    *("kernels", "experiments.reproduce.path_tracing"),
    "experiments.reproduce.ground_truth_volume",
)
#: The counts that stand in the pictures.
SHOWN_SAMPLES, SHOWN_TAPS = 64, 27


def list_methods(quick: bool) -> dict[str, list[tuple[int, Method]]]:
    """(budget, method) of each family, ascending."""
    from kernels.method import Method

    exact = Method(inverse_cdf="exact", mip_rule="mip0", prefilter=False)
    samples = QUICK_SAMPLES if quick else SAMPLES
    return {
        EXACT: [(n, replace(exact, num_samples=n)) for n in samples],
        PUBLISHED: [(n, Method(num_samples=n)) for n in samples],
        SEPARABLE: [
            (n, Method(kind="separable", num_taps=n)) for n in (QUICK_TAPS if quick else TAPS)
        ],
    }


def run(settings: Settings) -> Outcome:
    """Errors against the dense evaluation, pictures, sample counts and path tracing."""
    import pandas as pd

    from experiments.reproduce import ground_truth_plots as plots
    from experiments.reproduce import ground_truth_verdicts as verdicts
    from experiments.reproduce.path_tracing import MISSING

    settings.progress("loading the scenes", 0.0)
    device = settings.open_device()
    meshes = load_meshes()
    scenes = load_scenes(settings.quick, meshes, device)
    parts = settings.parts("ground-truth", *SOURCES)
    rows, studies = [], []
    for done, (name, gbuffer) in enumerate(scenes.items()):
        settings.progress(f"every texel: {name}", 0.6 * done / len(scenes))
        found, study = measure(name, gbuffer, settings.quick, parts, device)
        rows += found
        studies.append(study)
    errors = pd.DataFrame(rows)
    settings.progress("counting samples", 0.6)
    counts = draw_counts(settings, meshes, device)
    settings.progress("tracing paths", 0.75)
    compared = compare_volumes(settings, meshes, device)
    slopes = verdicts.fit_slopes(errors)
    figures: dict[str, Any] = {
        "convergence": plots.convergence_figure(errors, slopes),
        "pictures": plots.picture_figure(studies),
        **counts,
    }
    tables: dict[str, Any] = {"errors": errors, "slopes": slopes}
    if compared:
        figures["volume"] = plots.volume_figure(compared)
        tables["volume"] = verdicts.volume_frame(compared)
    owed = {s.gbuffer.attribution for s in studies} - {""}
    return Outcome(
        tables=tables,
        figures=figures,
        comparisons=(
            *verdicts.judge(slopes, errors),
            *verdicts.judge_volume(compared, settings.quick),
        ),
        words=(
            "The dense evaluation sums over every texel that the profile reaches, with the same "
            "weights as the samples; it needs no budget and no random numbers. Errors are root "
            "mean squares of the scattered light's luminance, light 1 = the key light, over the "
            "pixels that scatter, of one frame. What the methods store is half floats, so that "
            "errors below about 1e-4 cannot be told from their rounding.",
            f"{EXACT} has no bias but that. {PUBLISHED} draws its radii by the approximate "
            "inverse and reads coarser mips where samples are few: where the curves part, that "
            "bias is what separates them. Separable filters along one axis after the other: on the "
            "slab, whose light changes along one axis, more taps bring it to the integral, down to "
            "what a texel's size leaves, as its taps interpolate where samples take whole texels; "
            "in two dimensions, and across steps in depth, two line filters are not the profile, "
            "and the error stays.",
            *([] if compared else [MISSING + "."]),
            *([] if not compared else [verdicts.VOLUME_WORDS]),
            *([] if meshes else [f"No mesh was given: name one or more in {MESHES_VARIABLE}."]),
        ),
        captions=dict.fromkeys(figures, "; ".join(sorted(owed))) if owed else {},
    )


def load_meshes() -> list[Mesh]:
    """The meshes that `MESHES_VARIABLE` names.

    Raises:
        InputError: one of them cannot be read.
    """
    from kernels.scenes.mesh import load_mesh

    paths = [p for p in os.environ.get(MESHES_VARIABLE, "").split(os.pathsep) if p]
    return [load_mesh(Path(p)) for p in paths]


def load_scenes(quick: bool, meshes: list[Mesh], device: Device) -> dict[str, GBuffer]:
    """The slab, the ball, the head and the meshes."""
    from kernels.scene import load_scene
    from kernels.scenes.analytic import wall
    from kernels.scenes.mesh_render import render_mesh
    from kernels.scenes.sphere import sphere

    size = QUICK_SIZE if quick else SIZE
    scale = QUICK_SLAB_PIXELS_PER_MM if quick else SLAB_PIXELS_PER_MM
    return {
        SLAB: wall(*size, near_pixels_per_mm=scale, far_pixels_per_mm=scale),
        "ball": sphere(*size),
        "head": load_scene("front", *size, device=device),
        **{mesh.name: render_mesh(mesh, *size, camera="front") for mesh in meshes},
    }


def measure(
    name: str, gbuffer: GBuffer, quick: bool, parts: Parts, device: Device
) -> tuple[list[dict[str, Any]], Study]:
    """The errors of every method and budget in one scene, and its pictures."""
    from experiments.p4000_study import digest
    from kernels.dense import scatter_densely
    from kernels.frame import render
    from kernels.method import Method

    inputs = {"gbuffer": digest(gbuffer)}

    def sum_texels() -> Arrays:
        if name != SLAB:
            return {"light": scatter_densely(gbuffer, Method(), device)}
        # All its columns are alike.
        column = np.zeros(gbuffer.subsurface.shape, bool)
        column[:, 0] = True
        light = scatter_densely(gbuffer, Method(), device, pixels=column)
        return {"light": np.repeat(light[:, :1], gbuffer.width, axis=1)}

    dense = parts.arrays(f"dense-{name}", inputs, sum_texels)["light"]
    rows = []
    shown = {}
    for family, budgets in list_methods(quick).items():
        for budget, method in budgets:

            def draw(method: Method = method) -> Arrays:
                return {"light": render(gbuffer, method, 1, device).scattered}

            cell = f"{name}-{family.replace(',', '').replace(' ', '-')}-{budget}"
            light = parts.arrays(cell, inputs | {"method": method.as_dict()}, draw)["light"]
            wanted = SHOWN_TAPS if family == SEPARABLE else SHOWN_SAMPLES
            if budget == wanted:
                shown[f"{family}, {budget}"] = light
            error = rms_error(light, dense, gbuffer.subsurface)
            rows.append({"scene": name, "method": family, "budget": budget, "rms_error": error})
    return rows, Study(name, gbuffer, dense, shown)


def rms_error(
    light: npt.NDArray[np.float32],
    dense: npt.NDArray[np.float32],
    mask: npt.NDArray[np.bool_],
) -> float:
    """Root mean square difference of linear luminance over the pixels of `mask`."""
    difference = (light.astype(np.float64) - dense) @ [0.2126, 0.7152, 0.0722]
    return float(np.sqrt(np.mean(difference[mask] ** 2)))


def draw_counts(settings: Settings, meshes: list[Mesh], device: Device) -> dict[str, Any]:
    """The sample counts of the head and of the meshes, by the figure's name."""
    from experiments.p4000_study import digest
    from experiments.plots import count_map
    from kernels.frame import render
    from kernels.method import Method
    from kernels.scene import load_scene
    from kernels.scenes.mesh_render import render_mesh

    size = QUICK_COUNT_SIZE if settings.quick else COUNT_SIZE
    num_frames = QUICK_COUNT_FRAMES if settings.quick else COUNT_FRAMES
    method = Method(kind="adaptive", scale="legacy")
    parts = settings.parts("ground-truth", *SOURCES)
    views = {"head": load_scene("front", *size, device=device)}
    views |= {mesh.name: render_mesh(mesh, *size, camera="front") for mesh in meshes}
    figures = {}
    for name, gbuffer in views.items():
        inputs = {"gbuffer": digest(gbuffer), "method": method.as_dict(), "frames": num_frames}

        def count(gbuffer: GBuffer = gbuffer) -> Arrays:
            return {"counts": render(gbuffer, method, num_frames, device).counts}

        counts = parts.arrays(f"counts-{name}", inputs, count)["counts"]
        title = f"{name}, adaptive, frame {num_frames - 1}"
        figures[f"counts-{name}"] = count_map(counts, title, gbuffer.attribution)
    return figures


def compare_volumes(settings: Settings, meshes: list[Mesh], device: Device) -> list[Compared]:
    """The shapes that path tracing can have; empty where Mitsuba is not installed."""
    from experiments.reproduce.ground_truth_volume import compare_all

    return compare_all(
        settings.parts("ground-truth", *VOLUME_SOURCES), settings.quick, meshes, device
    )


EXPERIMENT = Experiment(
    name="ground-truth",
    title="AFIS and Separable against every texel, and the profile against path tracing",
    chapter="5",
    figure="slides: ground truth, sample counts of head and dragon",
    minutes=8,
    quick_minutes=0.3,
    run=run,
)
