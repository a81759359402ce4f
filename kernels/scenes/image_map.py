"""Image maps of a mesh (albedo, normals): loading, mip chain, trilinear lookup."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from traces.errors import InputError

Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ImageMap:
    """levels: (h, w, 3) float32 each, the first is the image, every next half the size, down to one
    texel.
    """

    levels: tuple[Float, ...]

    @property
    def width(self) -> int:
        return int(self.levels[0].shape[1])

    def sample(self, uv: Float, texels: Float) -> Float:
        """Look up (n, 3) values.

        uv: (n, 2), u to the right, v up, repeating.
        texels: (n,) how many texels of the image a pixel covers, along one axis.
        """
        level = np.clip(np.log2(np.maximum(texels, 1.0)), 0.0, len(self.levels) - 1)
        lower = level.astype(np.int32)
        blend = (level - lower).astype(np.float32)[:, None]
        result = np.empty((len(uv), 3), np.float32)
        for index in np.unique(lower):
            chosen = lower == index
            below = _bilinear(self.levels[index], uv[chosen])
            above = _bilinear(self.levels[min(index + 1, len(self.levels) - 1)], uv[chosen])
            result[chosen] = below + (above - below) * blend[chosen]
        return result


def load_albedo(source: str | Path | Image.Image) -> ImageMap:
    """An sRGB image as linear RGB. Raises InputError if it cannot be read."""
    encoded = _pixels(source, "albedo map")
    # IEC 61966-2-1
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return _with_mips(linear.astype(np.float32))


def load_normals(source: str | Path | Image.Image) -> ImageMap:
    """A tangent-space normal map, +y up, as vectors in [-1, 1].

    Raises InputError if it cannot be read.
    """
    return _with_mips(_pixels(source, "normal map") * np.float32(2) - np.float32(1))


def _pixels(source: str | Path | Image.Image, what: str) -> Float:
    if isinstance(source, Image.Image):
        image = source
    else:
        try:
            with Image.open(source) as opened:
                opened.load()
                image = opened
        except FileNotFoundError:
            raise InputError(f"{source}: {what}: no such file") from None
        except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
            raise InputError(f"{source}: {what}: not a readable image: {error}") from None
    return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)


def _with_mips(image: Float) -> ImageMap:
    levels = [image]
    while max(levels[-1].shape[:2]) > 1:
        level = levels[-1]
        # Repeat the last row or column of odd sizes, then average 2 x 2
        level = np.pad(
            level, [(0, s % 2 if s > 1 else 1) for s in level.shape[:2]] + [(0, 0)], "edge"
        )
        height, width = level.shape[0] // 2, level.shape[1] // 2
        levels.append(level.reshape(height, 2, width, 2, 3).mean(axis=(1, 3), dtype=np.float32))
    return ImageMap(tuple(levels))


def _bilinear(level: Float, uv: Float) -> Float:
    height, width = level.shape[:2]
    x = uv[:, 0] * width - np.float32(0.5)
    y = (1 - uv[:, 1]) * height - np.float32(0.5)
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    x0, y0 = left.astype(np.int64) % width, top.astype(np.int64) % height
    x1, y1 = (x0 + 1) % width, (y0 + 1) % height
    upper = level[y0, x0] * (1 - fx) + level[y0, x1] * fx
    lower = level[y1, x0] * (1 - fx) + level[y1, x1] * fx
    result: Float = (upper * (1 - fy) + lower * fy).astype(np.float32)
    return result
