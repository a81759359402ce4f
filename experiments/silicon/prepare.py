"""Render what the workload needs, on this machine's OpenCL device: G-buffer, count map, history,
and the pictures that the GPU's are held to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.silicon.cases import HISTORY_FRAMES, NUM_SAMPLES
from experiments.silicon.inputs import Expected, Picture
from kernels import resources
from kernels.frame import advance
from kernels.method import Method
from kernels.opencl.device import Device, open_device
from kernels.passes.update import history_names
from kernels.pipeline import Pipeline
from kernels.scene import load_scene


def method_of(counts: str) -> Method:
    """The method behind a case's counts."""
    if counts == "adaptive":
        return Method(kind="adaptive")
    return Method(kind="fixed", num_samples=NUM_SAMPLES)


def prepare(
    scene: str,
    width: int,
    height: int,
    device: Device | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Picture:
    """Render a scene with both counts. progress: told the share that is done.

    Raises:
        InputError: an unknown scene. DeviceError: no OpenCL device works.
    """
    device = device or open_device()
    gbuffer = load_scene(scene, width, height, device=device)
    constants: dict[str, dict[str, Any]] = {}
    expected: dict[str, Expected] = {}
    arrays = {name: _bits(array) for name, array in resources.inputs(gbuffer).items()}
    total = HISTORY_FRAMES + 1

    fixed = Pipeline(method_of("fixed64"), width, height, device)
    advance(fixed, gbuffer, 0)
    constants["fixed64"] = _constants(fixed, 0)
    expected |= _pictures(fixed, "fixed64", {"scattered": "scattered", "output": "output"})
    for level, texels in enumerate(fixed.read_levels()):
        expected[f"setup/{level}"] = Expected.of(_bits(np.ascontiguousarray(texels)))
    progress(1 / total)

    adaptive = Pipeline(method_of("adaptive"), width, height, device)
    last = HISTORY_FRAMES - 1
    for frame in range(last):
        advance(adaptive, gbuffer, frame)
        device.queue.finish()
        progress((2 + frame) / total)
    old, new = history_names(last)
    arrays["old_history"] = _halves(adaptive, old)
    advance(adaptive, gbuffer, last)
    constants["adaptive"] = _constants(adaptive, last)
    names = {"scattered": "scattered", "history": new, "resolved": "resolved", "output": "output"}
    expected |= _pictures(adaptive, "adaptive", names)
    arrays["counts"] = adaptive.read("scattered")[..., 3].astype(np.uint16)
    progress(1.0)
    return Picture(scene, width, height, constants, arrays, expected)


def _constants(pipeline: Pipeline, frame: int) -> dict[str, Any]:
    """What the kernels take by value; float32 values as Python floats, exactly."""
    found, method = pipeline.constants, pipeline.method
    return {
        "num_levels": pipeline.num_levels,
        "fixed_count": method.num_samples,
        "frame": frame,
        "texels_per_mm_at_cm": float(found.texels_per_mm_at_cm),
        "d": float(found.d),
        "mip_scale": float(found.mip_scale),
        "alpha": method.alpha,
        "sigma0_sq": method.sigma0_sq,
        "rate": [float(v) for v in found.rate],
        "density": [float(v) for v in found.density],
        "ratio": [float(v) for v in found.ratio.reshape(-1)],
    }


def _pictures(pipeline: Pipeline, counts: str, names: dict[str, str]) -> dict[str, Expected]:
    return {
        f"{counts}/{name}": Expected.of(_halves(pipeline, texture))
        for name, texture in names.items()
    }


def _halves(pipeline: Pipeline, name: str) -> npt.NDArray[Any]:
    """(h, w, 4) uint16: a texture's half floats."""
    return _bits(pipeline.read(name).astype(np.float16))


def _bits(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Half floats as integers, other arrays as they are."""
    return array.view(np.uint16) if array.dtype == np.float16 else array
