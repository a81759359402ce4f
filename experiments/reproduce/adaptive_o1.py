"""`adaptive-o1`: error and sample count over many frames in a shadow's edge and in a flat area.

Chapter 4's estimators side by side; what the global accumulation makes of the local pass; and a
transparent thing that moves over the picture, which the global accumulation sees and the local
history does not.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.adaptive_o1_results import EDGE, FLAT, GUIDED, UNGUIDED
from experiments.reproduce.experiment import Experiment, Outcome, Settings

if TYPE_CHECKING:
    from experiments.reproduce.film import Float, Mask
    from experiments.reproduce.parts import Arrays
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

SCENE = "close"
SIZE, QUICK_SIZE = (640, 360), (128, 72)
FRAMES, QUICK_FRAMES = 600, 64
OVERLAY_FRAMES, QUICK_OVERLAY_FRAMES = 160, 32
REFERENCE_SAMPLES = 1024
#: Shares of the scattering pixels: those of the steepest and of the most even light.
EDGE_SHARE, FLAT_SHARE = 0.02, 0.2
#: Frames until a TAA of weight 0.04 has forgotten where it began, to e^-3.
SETTLED = 75
SOURCES = ("kernels", "experiments.reproduce.adaptive_o1", "experiments.reproduce.film")


def list_estimators() -> dict[str, Method]:
    """Chapter 4's ways to the count, by name; the engine's rule with its own target."""
    from kernels.method import Method

    paper = Method(kind="adaptive", scale="legacy")
    return {
        "paper, kappa 0.2": paper,
        "slides' O(1), kappa 1": replace(paper, rule="o1"),
        "exact sliding window": replace(paper, rule="sliding"),
        "engine": replace(paper, rule="engine", sigma0_sq=1e-4),
        "two-pass, pilots": replace(paper, estimator="two-pass"),
        "last frame alone": replace(paper, estimator="last-frame"),
    }


def run(settings: Settings) -> Outcome:
    """Measure every estimator, the accumulation and the overlay; tables, figures, verdicts."""
    from experiments.reproduce import adaptive_o1_results as results
    from experiments.reproduce.film import render_reference, tracked
    from kernels.scene import load_scene

    settings.progress("rendering the scene", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    frames = QUICK_FRAMES if settings.quick else FRAMES
    parts = settings.parts("adaptive-o1", *SOURCES)
    gbuffer = load_scene(SCENE, width, height, device=device)
    view = {"scene": SCENE, "size": [width, height], "frames": frames}
    estimators = list_estimators()
    plain = next(iter(estimators.values()))
    reference = parts.arrays(
        "reference",
        view | {"samples": REFERENCE_SAMPLES, "method": plain.as_dict()},
        lambda: {
            "scalar": tracked(render_reference(gbuffer, plain, REFERENCE_SAMPLES, device).scattered)
        },
    )["scalar"]
    regions = find_regions(reference, gbuffer.subsurface)
    num_cells = len(estimators) + 3
    series: dict[str, Arrays] = {}
    for done, (name, method) in enumerate(estimators.items()):
        settings.progress(name, 0.05 + 0.95 * done / num_cells)

        def measure(method: Method = method) -> Arrays:
            return measure_estimator(gbuffer, method, reference, regions, frames, device)

        inputs = view | {"method": method.as_dict()}
        series[name] = parts.arrays(f"estimator-{done}", inputs, measure)
    guided: dict[str, Any] = {}
    for name, method in list_guided(plain).items():
        settings.progress(name, 0.05 + 0.95 * (len(estimators) + len(guided)) / num_cells)

        def guide(method: Method = method) -> dict[str, Any]:
            return measure_accumulation(method, (width, height), regions, frames, device)

        inputs = view | {"method": method.as_dict()}
        guided[name] = parts.json(f"guided-{len(guided)}", inputs, guide)
    settings.progress("overlay", 0.05 + 0.95 * (num_cells - 1) / num_cells)
    seen = QUICK_OVERLAY_FRAMES if settings.quick else OVERLAY_FRAMES
    disturbed = parts.arrays(
        "overlay",
        view | {"overlay_frames": seen, "method": plain.as_dict()},
        lambda: measure_overlay(gbuffer, plain, seen, device),
    )
    return Outcome(
        tables={
            "estimators": results.estimator_table(series),
            "accumulation": results.accumulation_table(guided),
            "series": results.series_frame(series),
            "overlay-frames": results.overlay_frame(disturbed),
        },
        figures={
            "frames": results.series_figure(series),
            "counts": results.count_figure(series, regions, gbuffer.attribution),
            "overlay": results.overlay_figure(disturbed),
            "trail": results.trail_figure(disturbed, gbuffer.attribution),
        },
        comparisons=results.judge(series, guided, disturbed),
        words=results.WORDS,
    )


def find_regions(scalar: Float, scatters: Mask) -> dict[str, Mask]:
    """The shadow's edge and the flat area: where the tracked scalar of the reference is steepest
    and most even, among pixels whose eight neighbours scatter too.
    """
    inner = scatters.copy()
    for axis in (0, 1):
        for step in (1, -1):
            inner &= np.roll(inner, step, axis)
    inner[[0, -1]], inner[:, [0, -1]] = False, False
    slope = np.hypot(*np.gradient(scalar.astype(np.float64)))
    low, high = np.quantile(slope[inner], (FLAT_SHARE, 1 - EDGE_SHARE))
    return {EDGE: inner & (slope >= high), FLAT: inner & (slope <= low)}


def pick_pixel(mask: Mask) -> tuple[int, int]:
    """(y, x) of the pixel of a mask that is nearest to the mask's middle, a plain choice."""
    at = np.argwhere(mask)
    nearest = np.argmin(((at - at.mean(axis=0)) ** 2).sum(axis=1))
    y, x = at[nearest]
    return int(y), int(x)


def measure_estimator(
    gbuffer: GBuffer,
    method: Method,
    reference: Float,
    regions: dict[str, Mask],
    frames: int,
    device: Device,
) -> Arrays:
    """Of each frame, (frames, 6) per region: mean count, count of one pixel, mean change of a
    pixel's count since the frame before, the error that the estimator believes in, the true one,
    and pilots per pixel; and the last frame's counts.

    The errors are root mean squares over the region, of the tracked scalar: the square root of the
    mean tracked variance (for the estimators without history, of one frame's mean), and the
    difference from the reference.
    """
    from experiments.reproduce.film import play, rms, tracked

    rows: dict[str, list[list[float]]] = {name: [] for name in regions}
    pixels = {name: pick_pixel(mask) for name, mask in regions.items()}
    pilots = method.num_pilots if method.takes_pilots else 0
    counts: Any = None
    for shot in play(gbuffer, method, frames, device):
        scattered = shot.scattered
        before = scattered[..., 3] if counts is None else counts
        counts, error = scattered[..., 3], tracked(scattered) - reference
        variance = (shot.pilot if pilots else shot.history)[..., 2]
        for name, mask in regions.items():
            # The pilots know the variance of their own mean, not of the picture's samples.
            believed = variance[mask] * (pilots / counts[mask] if pilots else 1.0)
            rows[name].append(
                [
                    float(counts[mask].mean()),
                    float(counts[pixels[name]]),
                    float(np.abs(counts - before)[mask].mean()),
                    float(np.sqrt(np.mean(believed, dtype=np.float64))),
                    rms(error, mask),
                    float(pilots),
                ]
            )
    return {name: np.array(found) for name, found in rows.items()} | {
        "counts": counts.astype(np.uint16)
    }


def list_guided(plain: Method) -> dict[str, Method]:
    """The global accumulation behind the local guiding, and behind the least count everywhere."""
    from kernels.method import Method

    return {
        GUIDED: replace(plain, taa=True),
        UNGUIDED: Method(num_samples=plain.b_min, scale=plain.scale, taa=True),
    }


def measure_accumulation(
    method: Method,
    size: tuple[int, int],
    regions: dict[str, Mask],
    frames: int,
    device: Device,
) -> dict[str, dict[str, float]]:
    """Per region, of each frame's picture and of the picture that the TAA shows, over the settled
    frames: root mean squares of the standard deviation over time and of the error; and the mean
    count.

    The camera jitters as the TAA wants it. A frame's error is against the reference of its own
    jitter, the accumulated picture's against the mean of those. All of the finished picture's
    tracked scalar.
    """
    from experiments.reproduce.film import (
        Spread,
        jittered_head,
        play,
        render_reference,
        rms,
        tracked,
    )

    scene, period = jittered_head(SCENE, size, device)
    exact = [
        tracked(render_reference(scene(point), method, REFERENCE_SAMPLES, device).combined)
        for point in range(period)
    ]
    limit = sum(exact[1:], exact[0]) / np.float32(period)
    first = min(SETTLED, frames // 2)
    alone, shown, counts = Spread(), Spread(), Spread()
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in regions}
    for shot in play(scene, method, frames, device):
        if shot.index < first:
            continue
        pictures = tracked(shot.combined), tracked(shot.shown)
        alone.add(pictures[0])
        shown.add(pictures[1])
        counts.add(shot.scattered[..., 3])
        differences = pictures[0] - exact[shot.index % len(exact)], pictures[1] - limit
        for name, mask in regions.items():
            errors[name].append((rms(differences[0], mask), rms(differences[1], mask)))
    found = {}
    for name, mask in regions.items():
        of_frame, of_shown = np.sqrt(np.mean(np.square(errors[name]), axis=0))
        found[name] = {
            "count": float(np.asarray(counts.mean)[mask].mean()),
            "frame_deviation": float(np.sqrt(alone.variance[mask].mean())),
            "shown_deviation": float(np.sqrt(shown.variance[mask].mean())),
            "frame_error": float(of_frame),
            "shown_error": float(of_shown),
        }
    return found


def measure_overlay(gbuffer: GBuffer, plain: Method, frames: int, device: Device) -> Arrays:
    """The same frames with and without a veil that crosses the picture. Per frame: pixels whose
    local history or count differ, root mean square difference of what the TAA shows where the veil
    has left within the last frames, and the samples per pixel that the estimator would ask of a
    history that is the globally accumulated picture, without and with the veil.

    `trail`: (h, w) the difference of the shown pictures in the frame with most of it, NaN under the
    veil.
    """
    from experiments.reproduce.film import play, rms, tracked
    from kernels.scenes.motion import Overlaid, veil

    height, width = gbuffer.depth_cm.shape
    draw = veil(speed_pixels=2 * width / frames, opacity=0.8)
    method = replace(plain, taa=True, overlay=True)
    guides = [GlobalGuide(plain), GlobalGuide(plain)]
    films = [play(scene, method, frames, device) for scene in (gbuffer, Overlaid(gbuffer, draw))]
    since = np.full((height, width), np.inf)
    rows, worst = [], (-1.0, np.zeros((height, width), np.float32))
    for bare, over in zip(*films, strict=True):
        covered = draw(over.index, height, width)[..., 3] > 0
        since = np.where(covered, 0.0, since + 1)
        trail = (since >= 1) & (since <= 8)
        scattered = bare.scattered, over.scattered
        local = (scattered[0] != scattered[1]).any(axis=2)
        local |= (bare.history != over.history).any(axis=2)
        shown = tracked(bare.shown), tracked(over.shown)
        difference = np.abs(shown[1] - shown[0])
        asked = []
        for guide, shot, picture in zip(guides, (bare, over), shown, strict=True):
            counts = guide.ask(tracked(shot.combined), picture)
            asked.append(float(counts[gbuffer.subsurface].mean()))
        error = rms(difference, trail) if trail.any() else 0.0
        left = error * float(np.sqrt(trail.sum()))
        if left > worst[0]:
            worst = left, np.where(covered, np.nan, difference).astype(np.float32)
        rows.append([float(local.sum()), error, *asked, float(scattered[1][..., 3].mean())])
    return {"frames": np.array(rows), "trail": worst[1]}


class GlobalGuide:
    """What the paper's estimator would ask if the globally accumulated picture were its history.

    It watches only: the counts that it asks are not taken.
    """

    def __init__(self, method: Method) -> None:
        self._method = method
        self._shown: Any = None
        self._variance: Any = 0.0
        self._mean_count: Any = float(method.b_max)

    def ask(self, picture: Float, shown: Float) -> Float:
        """(h, w) float32: the next frame's count. picture, shown: tracked scalars of this frame as
        finished and as the TAA shows it.
        """
        from kernels.passes.estimate import estimate_count

        alpha, rest = np.float32(self._method.alpha), np.float32(1 - self._method.alpha)
        if self._shown is None:
            self._variance = np.full(picture.shape, self._method.sigma0_sq, np.float32)
        else:
            difference = picture - self._shown
            self._variance = rest * self._variance + alpha * rest * difference * difference
        self._shown = shown
        count: Float = estimate_count(self._mean_count, self._variance, self._method)
        self._mean_count = rest * self._mean_count + alpha * count
        return count


EXPERIMENT = Experiment(
    name="adaptive-o1",
    title="Error and sample count over 600 frames, local guiding and the global accumulation",
    chapter="4",
    figure="I3D'20 page: counts over frames; slides: local guiding",
    minutes=25,
    quick_minutes=0.25,
    run=run,
)
