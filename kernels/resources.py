"""The textures of the method: their descriptors in a trace, and what the G-buffer puts into them.

Formats and levels as in Unreal Engine's passes. Memory here may be wider than the format where
precision does not decide a texel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.tiles import count_tiles
from traces.texture import Texture

HALF_MAX = np.float32(65504.0)
HALF_NORMAL_MIN = np.float32(2.0**-14)
MAX_LEVELS = 6

Half = npt.NDArray[np.float16]
Float = npt.NDArray[np.float32]

_FORMATS = {
    "scene_light": "RGBA16F",
    "depth": "R32F",
    "gbuffer_id": "R8",
    "normal": "RGBA8",  # 10:10:10:2 on the device: the same 4 bytes
    "velocity": "RGBA8",  # two 16-bit components in the engine: the same 4 bytes
    "setup": "RGBA16F",
    "profile_id": "R8",
    "history_0": "RGBA16F",
    "history_1": "RGBA16F",
    "scattered": "RGBA16F",
    "resolved": "RGBA16F",
    "albedo": "RGBA8",
    "scene_colour": "RGBA16F",
    "output": "RGBA16F",
    "overlay": "RGBA16F",
    "taa_0": "RGBA16F",
    "taa_1": "RGBA16F",
    "tex": "RGBA16F",
    "importance": "R8",
    "tile_class": "R8",
    "tile_list": "R32F",  # tile x and y of 16 bits: the same 4 bytes
    "pilot": "RGBA16F",
    "covariance_0": "RGBA16F",
    "covariance_1": "RGBA16F",
    "past_counts_0": "RGBA32F",  # sixteen counts of a byte: the same 16 bytes
    "past_counts_1": "RGBA32F",
}
TEXTURE_NAMES = tuple(_FORMATS)
#: The textures with a texel per tile.
_PER_TILE = ("tile_class", "tile_list")
#: The textures that a frame hands to the next.
CARRIED = (
    *("history_0", "history_1", "taa_0", "taa_1"),
    *("covariance_0", "covariance_1", "past_counts_0", "past_counts_1"),
)


def count_levels(width: int, height: int, method: Method) -> int:
    """Levels of the setup texture: at most 6, 1 without the pre-filter."""
    has_mips = method.prefilter and method.samples
    return min(MAX_LEVELS, min(width, height).bit_length()) if has_mips else 1


def unused_by(method: Method) -> tuple[str, ...]:
    """Textures of one estimator or control variate that a method does without."""
    unused: tuple[str, ...] = () if method.takes_pilots else ("pilot",)
    if not (method.updates_history and method.control == "online"):
        unused += ("covariance_0", "covariance_1")
    if not method.counts_past_frames:
        unused += ("past_counts_0", "past_counts_1")
    return unused


def textures(width: int, height: int, num_levels: int) -> list[Texture]:
    """The descriptors, in the order of `TEXTURE_NAMES`."""
    sizes = dict.fromkeys(_PER_TILE, count_tiles(width, height))
    return [
        Texture(name, fmt, *sizes.get(name, (width, height)), num_levels if name == "setup" else 1)
        for name, fmt in _FORMATS.items()
    ]


def to_half(value: Float) -> Half:
    """Round to half floats, to nearest even; clamped to the finite range."""
    return np.clip(value, -HALF_MAX, HALF_MAX).astype(np.float16)


def to_setup(value: Float) -> Half:
    """As `to_half`, with denormals and negative values made 0: what a setup texel can hold."""
    value = np.minimum(value, HALF_MAX)
    return np.where(value < HALF_NORMAL_MIN, np.float32(0), value).astype(np.float16)


def _with_alpha(rgb: Float) -> Half:
    """(h, w, 4) half floats of (h, w, 3); alpha 0."""
    return np.concatenate([to_half(rgb), np.zeros((*rgb.shape[:2], 1), np.float16)], axis=2)


def pack_normals(normal: Float) -> npt.NDArray[np.uint32]:
    """(h, w) uint32: 10 bits per component, 0..1023 for -1..1, x lowest."""
    bits = np.rint((np.clip(normal, -1, 1) + 1) * np.float32(511.5)).astype(np.uint32)
    packed: npt.NDArray[np.uint32] = bits[..., 0] | bits[..., 1] << 10 | bits[..., 2] << 20
    return packed


def inputs(gbuffer: GBuffer) -> dict[str, npt.NDArray[Any]]:
    """The contents of the textures that the G-buffer fills, by name; `velocity` only where
    something moves, `overlay` and `importance` only where there is one.
    """
    found: dict[str, npt.NDArray[Any]] = {
        "scene_light": _with_alpha(np.maximum(gbuffer.irradiance, np.float32(0))),
        "depth": gbuffer.depth_cm,
        "gbuffer_id": gbuffer.profile_id,
        "normal": pack_normals(gbuffer.normal),
        "albedo": _with_alpha(gbuffer.albedo),
        "scene_colour": _with_alpha(gbuffer.non_subsurface),
    }
    if gbuffer.velocity is not None:
        found["velocity"] = gbuffer.velocity
    if gbuffer.overlay is not None:
        found["overlay"] = to_half(gbuffer.overlay)
    if gbuffer.importance is not None:
        found["importance"] = np.rint(gbuffer.importance * np.float32(255)).astype(np.uint8)
    return {name: np.ascontiguousarray(array) for name, array in found.items()}
