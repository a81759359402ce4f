"""The frame loop: set-up, pre-filter, sampling, update and combine, with the history carried from
frame to frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.opencl.device import Device, open_device
from kernels.passes import taa, update
from kernels.pipeline import Pipeline
from traces.errors import InputError

Float = npt.NDArray[np.float32]
#: A still scene, or the G-buffer of each frame (moving light or camera), all of one size.
Scene = GBuffer | Callable[[int], GBuffer]
Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Frame:
    """The pictures of one frame; h, w: its height and width.

    index: frame number, from 0. scattered: (h, w, 3) float32, light after scattering, without
    albedo. combined: (h, w, 3) float32, the finished picture. accumulated: (h, w, 3) float32,
    `combined` blended over the frames with the history's weight alpha, as a temporal anti-aliasing
    pass would show it. counts: (h, w) uint16 samples of each pixel, 0 where nothing scatters.
    history: (h, w, 4) float32 mean count, depth in cm, variance of the mean and mean; None where
        counts do not come from it.
    shown: (h, w, 3) float32, the picture of the TAA pass; None without it.
    """

    index: int
    scattered: Float
    combined: Float
    accumulated: Float
    counts: npt.NDArray[np.uint16]
    history: Float | None
    shown: Float | None = None

    @property
    def num_samples(self) -> int:
        return int(self.counts.sum(dtype=np.int64))


def gbuffer_of(scene: Scene, frame: int) -> GBuffer:
    """The G-buffer of one frame."""
    return scene if isinstance(scene, GBuffer) else scene(frame)


def advance(pipeline: Pipeline, scene: Scene, frame: int) -> None:
    """Run one frame untraced. A still G-buffer keeps its setup texture and mip chain, which would
    come out the same.
    """
    changed = pipeline.load(gbuffer_of(scene, frame))
    for whole_step in pipeline.steps:
        if changed or whole_step.pass_name not in ("setup", "prefilter"):
            step = pipeline.listed(whole_step)
            pipeline.run(step, frame, pipeline.states_of(step, frame))


def start_pipeline(scene: Scene, method: Method, device: Device | None) -> Pipeline:
    """A pipeline with the first frame's G-buffer loaded and an empty history."""
    first = gbuffer_of(scene, 0)
    return Pipeline(method, first.width, first.height, device or open_device())


def check_num_frames(num_frames: int) -> None:
    """Raises InputError unless num_frames is at least 1."""
    if num_frames < 1:
        raise InputError(f"num_frames {num_frames}: allowed are 1 and more")


def render(
    scene: Scene,
    method: Method,
    num_frames: int = 1,
    device: Device | None = None,
    progress: Progress | None = None,
) -> Frame:
    """Render frames 0 to num_frames - 1; the last one.

    Args:
        scene: a G-buffer, or a function from frame number to G-buffer.
        method: the settings. The adaptive method takes b_max samples (engine rule: b_min) in frame
            0, which has no history.
        num_frames: at least 1. Memory does not grow with it.
        device: from `open_device`; None opens the first that works.
        progress: called with the finished share, 0 to 1, after each frame.

    Raises:
        InputError: num_frames, or frames of different size.
    """
    check_num_frames(num_frames)
    pipeline = start_pipeline(scene, method, device)
    accumulated: Float | None = None
    for frame in range(num_frames):
        advance(pipeline, scene, frame)
        combined = pipeline.read("output")[..., :3]
        if accumulated is None:
            accumulated = combined.copy()
        else:
            accumulated += np.float32(method.alpha) * (combined - accumulated)
        if progress:
            progress((frame + 1) / num_frames)
    assert accumulated is not None
    scattered = pipeline.read("scattered")
    has_history = method.updates_history or method.guided_by_last_frame
    return Frame(
        index=frame,
        scattered=scattered[..., :3],
        combined=combined,
        accumulated=accumulated,
        counts=scattered[..., 3].astype(np.uint16),
        history=pipeline.read(update.history_names(frame)[1]) if has_history else None,
        shown=pipeline.read(taa.texture_names(frame)[1])[..., :3] if method.taa else None,
    )
