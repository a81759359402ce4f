"""Many frames of a scene, one after the other: what the experiments over time measure in each.

The frame loop of `kernels.frame`, opened between the frames, so that an experiment reads counts,
histories and pictures of every frame without keeping them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels.frame import advance, check_num_frames, gbuffer_of, render, start_pipeline
from kernels.passes import taa
from kernels.passes.history import names_of
from kernels.passes.update import find_luminance

if TYPE_CHECKING:
    import pandas as pd

    from kernels.frame import Frame, Scene
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device
    from kernels.pipeline import Pipeline
    from kernels.scenes.motion import MovingScene

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame that is on the device; what is read of it holds until the next one is rendered.

    h, w: height and width. A picture is read from the device whenever it is asked for.
    """

    index: int
    gbuffer: GBuffer
    pipeline: Pipeline

    @property
    def scattered(self) -> Float:
        """(h, w, 4) float32: the light after scattering, and the count."""
        return self.pipeline.read("scattered")

    @property
    def combined(self) -> Float:
        """(h, w, 3) float32: the finished picture, with the overlay where the method draws it."""
        return self.pipeline.read("output")[..., :3]

    @property
    def shown(self) -> Float:
        """(h, w, 3) float32: the picture of the TAA pass."""
        return self.pipeline.read(taa.texture_names(self.index)[1])[..., :3]

    @property
    def history(self) -> Float:
        """(h, w, 4) float32: mean count, depth in cm, variance of the mean and mean."""
        return self.pipeline.read(names_of("history", self.index)[1])

    @property
    def moments(self) -> Float:
        """(h, w, 4) float32: of the online control variate, see `kernels.passes.covariance`."""
        return self.pipeline.read(names_of("covariance", self.index)[1])

    @property
    def pilot(self) -> Float:
        """(h, w, 4) float32: as `history`, of the two-pass estimator's pilots."""
        return self.pipeline.read("pilot")


def play(scene: Scene, method: Method, num_frames: int, device: Device) -> Iterator[Shot]:
    """Render frames 0 to num_frames - 1 and stop at each.

    Raises:
        InputError: num_frames, or frames of different size.
    """
    check_num_frames(num_frames)
    pipeline = start_pipeline(scene, method, device)
    for frame in range(num_frames):
        advance(pipeline, scene, frame)
        yield Shot(frame, gbuffer_of(scene, frame), pipeline)


def jittered_head(name: str, size: tuple[int, int], device: Device) -> tuple[MovingScene, int]:
    """A still view of the procedural head under the TAA's jitter, and the jitter's period, each of
    whose views is rendered once.

    name: of the camera. size: (width, height).
    """
    from kernels.scenes.camera import camera_named
    from kernels.scenes.head import render_head
    from kernels.scenes.jitter import Jitter
    from kernels.scenes.motion import MovingScene
    from kernels.scenes.paths import still

    jitter = Jitter("gaussian")
    scene = MovingScene(
        lambda camera, rig: render_head(camera, *size, device, rig),
        still(camera_named(name)),
        jitter=jitter,
        num_kept=jitter.num_points,
    )
    return scene, jitter.num_points


def render_reference(gbuffer: GBuffer, method: Method, num_samples: int, device: Device) -> Frame:
    """The frame with `num_samples` everywhere, all from level 0; other settings are the method's
    but for what comes after combining.
    """
    exact = replace(
        method,
        kind="fixed",
        num_samples=num_samples,
        mip_rule="mip0",
        taa=False,
        overlay=False,
        lds=False,
    )
    return render(gbuffer, exact, 1, device)


def make_references(
    scene: Scene, period: int, method: Method, num_samples: int, device: Device
) -> dict[str, npt.NDArray[np.float16]]:
    """The finished picture of each frame of the jitter's period, (h, w, 3) half floats as on the
    device, by its number.
    """
    return {
        str(point): render_reference(
            gbuffer_of(scene, point), method, num_samples, device
        ).combined.astype(np.float16)
        for point in range(period)
    }


def long_table(
    cells: Iterable[tuple[tuple[str, ...], Any]],
    keys: Sequence[str],
    columns: Sequence[str],
    row: str,
) -> pd.DataFrame:
    """One row per cell and frame. cells: pairs of a key and (frames, columns); row: what the number
    of the frame is called.
    """
    import pandas as pd

    frames = []
    for key, values in cells:
        frame = pd.DataFrame(values, columns=list(columns))
        frame.insert(0, row, range(len(frame)))
        for name, value in reversed(list(zip(keys, key, strict=True))):
            frame.insert(0, name, value)
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)


def tracked(colour: Any) -> Float:
    """(h, w) float32: the scalar whose variance the method tracks."""
    found: Float = find_luminance(np.asarray(colour, np.float32))
    return found


def rms(values: Any, mask: Mask) -> float:
    """Root mean square over the pixels of a mask."""
    return float(np.sqrt(np.mean(np.square(values[mask], dtype=np.float64))))


@dataclass(eq=False)
class Spread:
    """Running mean and variance over frames of an array, by Welford's recurrence."""

    count: int = 0
    mean: Any = 0.0
    squares: Any = 0.0

    def add(self, values: npt.NDArray[Any]) -> None:
        """Take in another frame."""
        self.count += 1
        difference = values - np.asarray(self.mean, np.float64)
        self.mean = self.mean + difference / self.count
        self.squares = self.squares + difference * (values - self.mean)

    @property
    def variance(self) -> npt.NDArray[np.float64]:
        """Of the frames so far, with n - 1; needs two of them."""
        found: npt.NDArray[np.float64] = self.squares / (self.count - 1)
        return found
