"""Placement: the textures of a trace, under a layout, in one flat address space.

In go texture descriptors and the name of a layout, out comes an `AddressMap`: flat arrays from
which a compiled loop finds the byte address of any texel with two look-ups (`traces.footprint`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.errors import InputError, unknown
from traces.layout import LAYOUTS, LevelTables, layout_function, round_up
from traces.texture import MAX_MIPS, Texture

#: Textures start at multiples of this.
TEXTURE_ALIGNMENT_BYTES = 1 << 16
#: Above 0, which a lane-address trace keeps for inactive lanes.
DEFAULT_BASE_ADDRESS = 1 << 32
_ADDRESS_SPACE_BYTES = 1 << 63


@dataclass(frozen=True, eq=False)
class AddressMap:
    """Where every texel of a list of T textures lies.

    textures, layouts: what was placed, and under which layout each. base_address: of the first
        texture.
    footprint_bytes: from there to the end of the last level, padding included.
    x_tables, y_tables: (n,) uint32, the `LevelTables` of all levels end to end; equal levels share
        theirs.
    x_start, y_start: (T, 15) int64, index of column 0 and row 0 of a texture's mip in these.
    base: (T, 15) uint64, byte address of the level. size_bytes: (T, 15) uint64, from there.
    low_mask: (T,) uint32, the bits in which the tables' entries XOR.
    width, height: (T, 15) int32, texels of the level. texel_bytes: (T,) int32.

    In the (T, 15) arrays everything is 0 where a texture has no such mip.
    """

    textures: tuple[Texture, ...]
    layouts: tuple[str, ...]
    base_address: int
    footprint_bytes: int
    x_tables: npt.NDArray[np.uint32]
    y_tables: npt.NDArray[np.uint32]
    x_start: npt.NDArray[np.int64]
    y_start: npt.NDArray[np.int64]
    base: npt.NDArray[np.uint64]
    size_bytes: npt.NDArray[np.uint64]
    low_mask: npt.NDArray[np.uint32]
    width: npt.NDArray[np.int32]
    height: npt.NDArray[np.int32]
    texel_bytes: npt.NDArray[np.int32]

    def address(self, texture: int, mip: int, y: int, x: int) -> int:
        """Byte address of one texel.

        Raises:
            InputError: no such texture, mip or texel.
        """
        if not 0 <= texture < len(self.textures):
            raise InputError(f"texture {texture}: allowed are 0 to {len(self.textures) - 1}")
        name, num_mips = self.textures[texture].name, self.textures[texture].num_mips
        if not 0 <= mip < num_mips:
            raise InputError(f"texture {name!r}: mip {mip}: allowed are 0 to {num_mips - 1}")
        width, height = int(self.width[texture, mip]), int(self.height[texture, mip])
        for axis, value, side in (("x", x, width), ("y", y, height)):
            if not 0 <= value < side:
                raise InputError(
                    f"texture {name!r}: mip {mip}: {axis} {value}: allowed are 0 to {side - 1}"
                )
        x_term = int(self.x_tables[self.x_start[texture, mip] + x])
        y_term = int(self.y_tables[self.y_start[texture, mip] + y])
        low = int(self.low_mask[texture])
        offset = (x_term & ~low) + (y_term & ~low) + ((x_term ^ y_term) & low)
        return int(self.base[texture, mip]) + offset


def place(
    textures: Sequence[Texture],
    layout: str = "block-linear-turing",
    base_address: int = DEFAULT_BASE_ADDRESS,
    overrides: Mapping[str, str] | None = None,
) -> AddressMap:
    """Place textures one after the other, the levels of each from the largest to the smallest.

    Addresses ascend with the mip inside a texture, and from texture to texture.

    layout: a key of `LAYOUTS`. base_address: a multiple of 64 KiB. overrides: {texture name:
        layout}, for example "row-major" for a buffer. Textures start at multiples of 64 KiB, levels
        at multiples of what their layout asks, at least 256 B.

    Raises:
        InputError: an unknown layout or texture name, or a base address that is negative, unaligned
        or too high.
    """
    overrides = dict(overrides or {})
    names = {texture.name for texture in textures}
    for name in overrides:
        if name not in names:
            raise unknown("texture", name, names, "layout overrides")
    if base_address < 0 or base_address % TEXTURE_ALIGNMENT_BYTES:
        raise InputError(
            f"base address {base_address:#x}: allowed are multiples of "
            f"{TEXTURE_ALIGNMENT_BYTES:#x} from 0"
        )
    # An unknown default is an error even where the overrides cover every texture.
    layout_function(layout)
    pool = _TablePool()
    levels = _empty_levels(len(textures))
    layouts: list[str] = []
    cursor = base_address
    for index, texture in enumerate(textures):
        layouts.append(overrides.get(texture.name, layout))
        layout_function(layouts[-1], f"texture {texture.name!r}")
        cursor = round_up(cursor, TEXTURE_ALIGNMENT_BYTES)
        levels["texel_bytes"][index] = texture.texel_bytes
        for mip in range(texture.num_mips):
            width, height = texture.mip_size(mip)
            tables, x_start, y_start = pool.get(layouts[-1], width, height, texture.texel_bytes)
            cursor = round_up(cursor, tables.alignment_bytes)
            if cursor + tables.size_bytes > _ADDRESS_SPACE_BYTES:
                raise InputError(
                    f"base address {base_address:#x}: texture {texture.name!r} ends above 2^63"
                )
            levels["low_mask"][index] = tables.low_mask
            levels["width"][index, mip], levels["height"][index, mip] = width, height
            levels["x_start"][index, mip], levels["y_start"][index, mip] = x_start, y_start
            levels["base"][index, mip] = cursor
            levels["size_bytes"][index, mip] = tables.size_bytes
            cursor += tables.size_bytes
    return AddressMap(
        textures=tuple(textures),
        layouts=tuple(layouts),
        base_address=base_address,
        footprint_bytes=cursor - base_address,
        x_tables=_concatenate([tables.x for tables in pool.tables]),
        y_tables=_concatenate([tables.y for tables in pool.tables]),
        **levels,
    )


class _TablePool:
    """The distinct tables so far, and where each starts when they are put end to end."""

    def __init__(self) -> None:
        self.tables: list[LevelTables] = []
        self._found: dict[tuple[str, int, int, int], tuple[LevelTables, int, int]] = {}
        self._x_end = self._y_end = 0

    def get(
        self, layout: str, width: int, height: int, texel_bytes: int
    ) -> tuple[LevelTables, int, int]:
        key = (layout, width, height, texel_bytes)
        if key not in self._found:
            tables = LAYOUTS[layout](width, height, texel_bytes)
            self._found[key] = (tables, self._x_end, self._y_end)
            self.tables.append(tables)
            self._x_end += width
            self._y_end += height
        return self._found[key]


def _empty_levels(num_textures: int) -> dict[str, npt.NDArray[Any]]:
    levels = (num_textures, MAX_MIPS)
    return {
        "x_start": np.zeros(levels, np.int64),
        "y_start": np.zeros(levels, np.int64),
        "base": np.zeros(levels, np.uint64),
        "size_bytes": np.zeros(levels, np.uint64),
        "low_mask": np.zeros(num_textures, np.uint32),
        "width": np.zeros(levels, np.int32),
        "height": np.zeros(levels, np.int32),
        "texel_bytes": np.zeros(num_textures, np.int32),
    }


def _concatenate(arrays: list[npt.NDArray[np.uint32]]) -> npt.NDArray[np.uint32]:
    return np.concatenate(arrays) if arrays else np.zeros(0, np.uint32)
