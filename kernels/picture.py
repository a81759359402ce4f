"""Pictures for people: tone mapping and PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from kernels.gbuffer import GBuffer
from traces.files import replacing, writing

Rgb8 = npt.NDArray[np.uint8]


def tone_map(linear: npt.NDArray[np.float32], exposure: float = 1.0) -> Rgb8:
    """Linear RGB (h, w, 3) to sRGB bytes.

    Values up to half the range pass unchanged; above, a shoulder bends highlights into the rest of
    it.
    """
    value = np.maximum(linear * np.float32(exposure), 0.0)
    knee = np.float32(0.5)
    over = np.maximum(value - knee, 0.0)
    value = np.minimum(value, knee) + (1 - knee) * over / (over + (1 - knee))
    # IEC 61966-2-1
    srgb = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    encoded: Rgb8 = np.rint(np.clip(srgb, 0, 1) * 255).astype(np.uint8)
    return encoded


def preview(gbuffer: GBuffer) -> Rgb8:
    """The scene without scattering: irradiance x albedo + the rest, tone-mapped; (h, w, 3) sRGB
    bytes.
    """
    return tone_map(gbuffer.irradiance * gbuffer.albedo + gbuffer.non_subsurface)


def save_png(path: str | Path, picture: Rgb8) -> None:
    """Write (h, w, 3) or (h, w) bytes as PNG, whole or not at all.

    Raises InputError where the folder cannot be written to, WorkError where writing fails.
    """
    with replacing(path) as part, writing(path):
        Image.fromarray(picture).save(part, format="PNG")
