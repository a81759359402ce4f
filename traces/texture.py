"""Texture descriptors and packed texel coordinates.

A texel coordinate is one uint32, `mip << 28 | y << 14 | x`: 15 mips (0..14) and sides up to 16384
texels. Mip 15 is not used, so that 0xFFFFFFFF can mark an inactive lane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.errors import InputError, unknown

WARP_SIZE = 32
MAX_SIDE_TEXELS = 1 << 14
MAX_MIPS = 15
INACTIVE_TEXEL = np.uint32(0xFFFFFFFF)
INACTIVE_ADDRESS = np.uint64(0xFFFFFFFFFFFFFFFF)

#: Bytes of one texel of each format.
FORMATS: dict[str, int] = {
    "R8": 1,
    "R16F": 2,
    "RGBA8": 4,
    "R32F": 4,
    "R11G11B10F": 4,
    "RGBA16F": 8,
    "RGBA32F": 16,
}


def pack_texel(mip: Any, y: Any, x: Any) -> npt.NDArray[np.uint32]:
    """Pack texel coordinates. `mip`, `y`, `x`: broadcastable integer arrays; no range check."""
    mip, y, x = (np.asarray(v).astype(np.uint32) for v in (mip, y, x))
    packed: npt.NDArray[np.uint32] = (mip << np.uint32(28)) | (y << np.uint32(14)) | x
    return packed


def unpack_texel(
    texel: npt.NDArray[np.uint32],
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32], npt.NDArray[np.uint32]]:
    """The (mip, y, x) of packed texels; undefined for `INACTIVE_TEXEL`."""
    low = np.uint32(MAX_SIDE_TEXELS - 1)
    return texel >> np.uint32(28), (texel >> np.uint32(14)) & low, texel & low


@dataclass(frozen=True)
class Texture:
    """A two-dimensional texture with a mip chain; where its texels lie in memory is a layout's
    matter.

    name: as tables print it. format: a key of `FORMATS`. width, height: texels of mip 0. num_mips:
        levels, at least 1.
    """

    name: str
    format: str
    width: int
    height: int
    num_mips: int = 1

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise unknown("texel format", self.format, FORMATS, f"texture {self.name!r}")
        for field, side in (("width", self.width), ("height", self.height)):
            if not 1 <= side <= MAX_SIDE_TEXELS:
                raise InputError(
                    f"texture {self.name!r}: {field} {side}: "
                    f"allowed are 1 to {MAX_SIDE_TEXELS} texels"
                )
        if not 1 <= self.num_mips <= MAX_MIPS:
            raise InputError(
                f"texture {self.name!r}: num_mips {self.num_mips}: allowed are 1 to {MAX_MIPS}"
            )

    @property
    def texel_bytes(self) -> int:
        return FORMATS[self.format]

    def mip_size(self, mip: int) -> tuple[int, int]:
        """(width, height) of a level in texels: each side halves, rounded down, and never falls
        below 1.
        """
        return max(1, self.width >> mip), max(1, self.height >> mip)
