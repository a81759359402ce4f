"""`gallery`: each method's picture side by side, and every picture of the experiments that ran.

The last of the catalogue: `cachesim reproduce all` makes it when the others are there.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from experiments.reproduce.experiment import Experiment, Outcome, Settings

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from experiments.reproduce.parts import Arrays, Parts
    from kernels.frame import Float
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

NAME = "gallery"
SCENES = ("close", "ear", "front")
SIZE, QUICK_SIZE = (960, 540), (192, 108)
FRAMES, QUICK_FRAMES = 32, 6
REFERENCE_SAMPLES, QUICK_REFERENCE_SAMPLES = 1024, 256
SOURCES = ("kernels", "experiments.reproduce.reference")
UNSCATTERED, REFERENCE = "no scattering", "reference"
#: Errors are shown this many times larger; details are this share of the frame's width.
GAIN, DETAIL_RATE = 8.0, 0.2


def list_methods() -> dict[str, Method]:
    """The methods by name, in the scale on which the paper's constants were tuned."""
    from kernels.method import Method

    return {
        "AFIS, 8 samples": Method(num_samples=8, scale="legacy"),
        "AFIS, 64 samples": Method(scale="legacy"),
        "AFIS, adaptive": Method(kind="adaptive", scale="legacy"),
        "Separable": Method(kind="separable", scale="legacy"),
        "hybrid": Method(kind="hybrid", scale="legacy"),
    }


def run(settings: Settings) -> Outcome:
    """A figure per scene, a table of qualities, and links to every other picture."""
    import pandas as pd

    from kernels.scene import load_scene

    device = settings.open_device()
    size = QUICK_SIZE if settings.quick else SIZE
    parts = settings.parts(NAME, *SOURCES)
    figures: dict[str, Any] = {}
    rows = []
    for done, scene in enumerate(SCENES):
        settings.progress(scene, done / len(SCENES))
        gbuffer = load_scene(scene, *size, device=device)
        pictures = draw_pictures(gbuffer, settings.quick, parts, device)
        qualities = judge_pictures(pictures, gbuffer)
        rows += [{"scene": scene, **quality} for quality in qualities]
        figures[scene] = methods_figure(pictures, qualities, gbuffer)
    qualities_of_all = pd.DataFrame(rows)
    return Outcome(
        tables={"quality": qualities_of_all},
        figures=figures,
        words=(
            "Top: the finished frame. Middle: a detail of it, where the light changes most. "
            f"Below: the difference from the reference, {GAIN:.0f} times as bright. The reference "
            f"has {QUICK_REFERENCE_SAMPLES if settings.quick else REFERENCE_SAMPLES} samples per "
            "pixel from the finest mip; every frame is shown by itself, not blended over time.",
            *list_pictures(settings.out),
        ),
        verdict=summarise(qualities_of_all),
    )


def draw_pictures(gbuffer: GBuffer, quick: bool, parts: Parts, device: Device) -> dict[str, Float]:
    """The finished pictures by method, the light without scattering first, the reference second."""
    from experiments.p4000_study import digest
    from experiments.reproduce.parts import cell_name
    from experiments.reproduce.reference import draw_reference
    from kernels.frame import render

    methods = list_methods()
    num_frames = QUICK_FRAMES if quick else FRAMES
    num_reference = QUICK_REFERENCE_SAMPLES if quick else REFERENCE_SAMPLES
    inputs = {"gbuffer": digest(gbuffer), "frames": num_frames}

    def draw(method: Method) -> Arrays:
        count = num_frames if method.adaptive else 1
        return {"image": render(gbuffer, method, count, device).combined}

    pictures = {
        UNSCATTERED: gbuffer.irradiance * gbuffer.albedo + gbuffer.non_subsurface,
        REFERENCE: draw_reference(
            gbuffer, methods["AFIS, 64 samples"], num_reference, parts, device
        ),
    }
    for name, method in methods.items():
        cell = cell_name(f"{gbuffer.name}-{name}")
        keyed = inputs | {"method": method.as_dict()}
        pictures[name] = parts.arrays(cell, keyed, partial(draw, method))["image"]
    return pictures


def judge_pictures(pictures: dict[str, Float], gbuffer: GBuffer) -> list[dict[str, Any]]:
    """PSNR in dB and FLIP of each picture against the reference."""
    from kernels.quality import flip, psnr

    reference, mask = pictures[REFERENCE], gbuffer.subsurface
    return [
        {
            "method": name,
            "psnr_db": psnr(picture, reference, mask),
            "flip": flip(picture, reference, mask),
        }
        for name, picture in pictures.items()
        if name != REFERENCE
    ]


def summarise(qualities: pd.DataFrame) -> str:
    """The range of each method's PSNR over the scenes."""
    told = []
    for method, part in qualities.groupby("method", sort=False):
        low, high = part["psnr_db"].min(), part["psnr_db"].max()
        told.append(f"{method} {low:.0f} to {high:.0f} dB")
    return f"pictures to look at; PSNR over the scenes: {'; '.join(told)}"


def find_detail(gbuffer: GBuffer) -> tuple[slice, slice]:
    """Rows and columns of the window in which the light on the skin changes most."""
    from scipy.ndimage import uniform_filter

    width = max(8, int(gbuffer.width * DETAIL_RATE))
    height = max(8, int(gbuffer.height * DETAIL_RATE))
    light = np.where(gbuffer.subsurface, gbuffer.irradiance.mean(axis=2), 0)
    across, down = np.abs(np.diff(light, axis=1)), np.abs(np.diff(light, axis=0))
    change = np.zeros(light.shape)
    inner = gbuffer.subsurface
    change[:, 1:] += np.where(inner[:, 1:] & inner[:, :-1], across, 0)
    change[1:] += np.where(inner[1:] & inner[:-1], down, 0)
    found = uniform_filter(change, (height, width), mode="constant")
    y, x = np.unravel_index(int(found.argmax()), found.shape)
    top = int(np.clip(y - height // 2, 0, gbuffer.height - height))
    left = int(np.clip(x - width // 2, 0, gbuffer.width - width))
    return slice(top, top + height), slice(left, left + width)


def methods_figure(
    pictures: dict[str, Float], qualities: list[dict[str, Any]], gbuffer: GBuffer
) -> Figure:
    """A column per method: picture, detail, difference from the reference."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    from experiments.plots import FONT_SIZE
    from kernels.picture import tone_map

    rows, columns = find_detail(gbuffer)
    psnr_of = {q["method"]: q["psnr_db"] for q in qualities}
    ratio = gbuffer.height / gbuffer.width
    figure = Figure(figsize=(2.2 * len(pictures), 3 * 2.2 * ratio + 0.6), layout="constrained")
    grid = figure.subplots(3, len(pictures), squeeze=False)
    for axes in grid.flat:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    for column, (name, picture) in zip(grid.T, pictures.items(), strict=True):
        told = f"\n{psnr_of[name]:.1f} dB" if name in psnr_of else "\n"
        column[0].set_title(name + told, fontsize=FONT_SIZE)
        shown = tone_map(picture)
        column[0].imshow(shown)
        column[0].add_patch(
            Rectangle(
                (columns.start, rows.start),
                columns.stop - columns.start,
                rows.stop - rows.start,
                fill=False,
                edgecolor="white",
                linewidth=0.7,
            )
        )
        column[1].imshow(shown[rows, columns], interpolation="nearest")
        if name != REFERENCE:
            column[2].imshow(_difference(picture, pictures[REFERENCE]))
    figure.suptitle(f"{gbuffer.name}, {gbuffer.width}x{gbuffer.height}", fontsize=FONT_SIZE + 1)
    if gbuffer.attribution:
        figure.supxlabel(gbuffer.attribution, fontsize=FONT_SIZE - 2)
    return figure


def _difference(picture: Float, reference: Float) -> npt.NDArray[np.float32]:
    shown: npt.NDArray[np.float32] = np.clip(np.abs(picture - reference) * GAIN, 0, 1)
    return shown


def list_pictures(out: Path) -> tuple[str, ...]:
    """A paragraph of Markdown for each experiment with pictures in the folder of results, in the
    catalogue's order.
    """
    from experiments.reproduce import catalogue

    paragraphs = []
    for name in catalogue.NAMES:
        pictures = [] if name == NAME else sorted((out / name).glob("*.png"))
        if pictures:
            lines = [f"### [{name}]({name}.md)"]
            lines += [f"![{p.stem}]({quote(p.relative_to(out).as_posix())})" for p in pictures]
            paragraphs.append("\n\n".join(lines))
    return tuple(paragraphs)


EXPERIMENT = Experiment(
    name=NAME,
    title="Pictures of each method side by side, and every picture of the other experiments",
    chapter="1 to 6",
    figure="pictures of the methods",
    minutes=2,
    quick_minutes=0.2,
    run=run,
    after_others=True,
)
