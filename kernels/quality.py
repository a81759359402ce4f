"""Image quality as the dissertation measures it, PSNR on luminance against 1024 samples per pixel,
and as people see it, FLIP.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from kernels.frame import Float, render
from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.opencl.device import Device
from traces.errors import InputError

#: Rec. 709 luminance of linear RGB.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def reference_image(
    gbuffer: GBuffer, method: Method, device: Device | None = None, num_samples: int = 1024
) -> Float:
    """(h, w, 3) float32: the finished picture with `num_samples` everywhere, all from level 0;
    other settings are the method's.
    """
    exact = dataclasses.replace(method, kind="fixed", num_samples=num_samples, mip_rule="mip0")
    return render(gbuffer, exact, 1, device).combined


def luminance(image: Float) -> npt.NDArray[np.float64]:
    """(h, w) float64 luminance of the picture as shown: linear RGB clipped to [0, 1], weighted, to
    the power 1/2.2.
    """
    return np.asarray((np.clip(image, 0, 1).astype(np.float64) @ _LUMINANCE) ** (1 / 2.2))


def psnr(image: Float, reference: Float, mask: npt.NDArray[np.bool_]) -> float:
    """Peak signal-to-noise ratio in dB of the shown luminance, peak 1, over the pixels of `mask`;
    infinite for equal pictures.

    Args:
        image, reference: (h, w, 3) float32, linear.
        mask: (h, w) bool, the population: for this study the pixels that scatter,
            `GBuffer.subsurface`.

    Raises:
        InputError: shapes differ, or the mask is empty.
    """
    _check_shapes("psnr", image, reference, mask)
    error = float(np.mean((luminance(image)[mask] - luminance(reference)[mask]) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def flip(image: Float, reference: Float, mask: npt.NDArray[np.bool_]) -> float:
    """Mean FLIP error over the pixels of `mask`, in [0, 1]; 0 for equal pictures. [ANA20] LDR-FLIP
    at 67 pixels per degree, of linear RGB clipped to [0, 1].

    [ANA20] Andersson et al., FLIP: A Difference Evaluator for Alternating Images, Proc. ACM
    Comput. Graph. Interact. Tech. 3(2), 2020.

    Args:
        image, reference, mask: as for `psnr`.

    Raises:
        InputError: shapes differ, or the mask is empty.
    """
    _check_shapes("flip", image, reference, mask)
    import flip_evaluator

    shown, wanted = (np.clip(picture, 0, 1).astype(np.float32) for picture in (image, reference))
    errors, _, _ = flip_evaluator.evaluate(
        wanted, shown, "LDR", inputsRGB=False, applyMagma=False, computeMeanError=False
    )
    return float(np.asarray(errors, np.float64)[..., 0][mask].mean())


def _check_shapes(metric: str, image: Float, reference: Float, mask: npt.NDArray[np.bool_]) -> None:
    if image.shape != reference.shape or image.shape[:2] != mask.shape:
        raise InputError(
            f"{metric}: shapes {image.shape}, {reference.shape}, {mask.shape} do not match"
        )
    if not mask.any():
        raise InputError(f"{metric}: the mask is empty")
