"""Texel layouts: where the texels of one mip level lie in memory, one function per layout.

In go the sides and texel size of a level, out come two tables. Every layout here is separable, so
that a texel's byte offset is two look-ups:

    offset(x, y) = (X[x] & ~low) + (Y[y] & ~low) + ((X[x] ^ Y[y]) & low)

`low` is 0 where the axes add up, and 0xFFFF where AMD's pipe bits XOR bits of x and y inside a 64
KiB block. To add a layout, write one function and name it in `LAYOUTS`. `traces.placement` puts the
levels of many textures into one address space.

Sources: [nil] Mesa nil `tiling.rs` and `copy.rs`, [TRM] Tegra X1 Technical Reference Manual,
[addrlib] AMD PAL `gfx10SwizzlePattern.h`, [GPGPU-Sim] `cuda-sim.cc` and `instructions.cc` at
667834cf.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.errors import unknown

#: Rows of a row-major level start at multiples of this, as Direct3D 12 asks of linear textures.
PITCH_ALIGNMENT_BYTES = 256
#: No level starts at less than this.
LEVEL_ALIGNMENT_BYTES = 256
GOB_WIDTH_BYTES = 64
GOB_HEIGHT = 8
GOB_BYTES = GOB_WIDTH_BYTES * GOB_HEIGHT
MAX_BLOCK_HEIGHT_LOG2 = 5
AMD_BLOCK_BYTES = 1 << 16
#: The texture line for which GPGPU-Sim shapes its blocks; the configurations it ships have 128 B.
GPGPUSIM_LINE_BYTES = 128
GPGPUSIM_BLOCK_STRIDE_BYTES = 64


@dataclass(frozen=True, eq=False)
class LevelTables:
    """The separable address tables of one mip level.

    x: (width,) uint32, byte offset terms of the columns. y: (height,) uint32, of the rows.
    low_mask: bits in which the two terms XOR; in all others they add up.
    size_bytes: every texel lies within [0, size_bytes). alignment_bytes: what the level's base must
        be a multiple of.
    """

    x: npt.NDArray[np.uint32]
    y: npt.NDArray[np.uint32]
    low_mask: int
    size_bytes: int
    alignment_bytes: int

    def offset(self, y: Any, x: Any) -> npt.NDArray[np.uint64]:
        """Byte offsets of texels, uint64. `y`, `x`: broadcastable integer arrays in the level."""
        x_term = self.x[x].astype(np.uint64)
        y_term = self.y[y].astype(np.uint64)
        low = np.uint64(self.low_mask)
        offset: npt.NDArray[np.uint64] = (x_term & ~low) + (y_term & ~low)
        offset += (x_term ^ y_term) & low
        return offset


Layout = Callable[[int, int, int], LevelTables]


def row_major(width: int, height: int, texel_bytes: int) -> LevelTables:
    """Pitch-linear: rows one after the other, the pitch rounded up to `PITCH_ALIGNMENT_BYTES`."""
    pitch = round_up(width * texel_bytes, PITCH_ALIGNMENT_BYTES)
    x, y = np.arange(width) * texel_bytes, np.arange(height) * pitch
    return _tables(x, y, 0, height * pitch, LEVEL_ALIGNMENT_BYTES)


def morton(width: int, height: int, texel_bytes: int) -> LevelTables:
    """Z-order, x in the even bits.

    Both sides are padded to powers of two; the longer side's spare bits go on top.
    """
    x_bits, y_bits = (width - 1).bit_length(), (height - 1).bit_length()
    shared = min(x_bits, y_bits)
    x = _scatter(np.arange(width), [2 * i if i < shared else shared + i for i in range(x_bits)])
    y = _scatter(
        np.arange(height), [2 * i + 1 if i < shared else shared + i for i in range(y_bits)]
    )
    size = texel_bytes << (x_bits + y_bits)
    return _tables(x * texel_bytes, y * texel_bytes, 0, size, LEVEL_ALIGNMENT_BYTES)


def block_linear_turing(width: int, height: int, texel_bytes: int) -> LevelTables:
    """NVIDIA block-linear with the GOB of 2D colour textures from Turing on. [nil]

    With x in bytes, address bits 4 to 8 of a GOB are y0 y1 x4 y2 x5.
    """
    return _block_linear(width, height, texel_bytes, x_bits=(0, 1, 2, 3, 6, 8), y_bits=(4, 5, 7))


def block_linear(width: int, height: int, texel_bytes: int) -> LevelTables:
    """NVIDIA block-linear with the older GOB. [TRM]; for the desktop GPUs from Fermi to Volta:
    assumed.

    With x in bytes, address bits 4 to 8 of a GOB are y0 x4 y1 y2 x5.
    """
    return _block_linear(width, height, texel_bytes, x_bits=(0, 1, 2, 3, 5, 8), y_bits=(4, 6, 7))


def block_height_log2(height: int) -> int:
    """log2 of a block's height in GOBs. [nil]

    The largest of 0 to 5 at which the block is less than twice as tall as the level; 0 where none
    is.
    """
    k = MAX_BLOCK_HEIGHT_LOG2
    while k > 0 and (GOB_HEIGHT << k) >= 2 * height:
        k -= 1
    return k


def _block_linear(
    width: int, height: int, texel_bytes: int, x_bits: tuple[int, ...], y_bits: tuple[int, ...]
) -> LevelTables:
    """Blocks in row-major order, 64 B wide and 2^k GOBs tall; the GOBs of a block lie one under the
    other. [nil]

    x_bits: GOB address bit of each of the 6 bits of the byte column. y_bits: of each of the 3 bits
        of the row.
    """
    gobs_per_row = -(-width * texel_bytes // GOB_WIDTH_BYTES)
    block_height = GOB_HEIGHT << block_height_log2(height)
    block_bytes = GOB_WIDTH_BYTES * block_height
    x_bytes, rows = np.arange(width) * texel_bytes, np.arange(height)
    x = x_bytes // GOB_WIDTH_BYTES * block_bytes + _scatter(x_bytes % GOB_WIDTH_BYTES, x_bits)
    y = (
        rows // block_height * (block_bytes * gobs_per_row)
        + rows % block_height // GOB_HEIGHT * GOB_BYTES
        + _scatter(rows % GOB_HEIGHT, y_bits)
    )
    size = -(-height // block_height) * block_bytes * gobs_per_row
    return _tables(x, y, 0, size, block_bytes)


# Address bits of a 64 KiB block from bit log2(texel_bytes) up, by texel size in bytes; ^ is XOR.
_Pattern = dict[int, str]

# 64K_S. [addrlib]
_AMD_S: _Pattern = {
    1: "X0 X1 X2 X3 Y0 Y1 Y2 Y3  Y4 X4 Y5 X5  Y6 X6 Y7 X7",
    2: "X0 X1 X2 Y0 Y1 Y2 X3  Y3 X4 Y4 X5  Y5 X6 Y6 X7",
    4: "X0 X1 Y0 Y1 Y2 X2  Y3 X3 Y4 X4  Y5 X5 Y6 X6",
    8: "X0 Y0 Y1 X1 X2  Y2 X3 Y3 X4  Y4 X5 Y5 X6",
    16: "Y0 Y1 X0 X1  Y2 X2 Y3 X3  Y4 X4 Y5 X5",
}
# 64K_R_X with 16 pipes, one sample; bits 8 to 11 are the pipes. [addrlib]
_AMD_RX_NAVI10: _Pattern = {
    1: "X0 X1 X2 Y1 Y0 Y2 X3 Y4  X3^Y3 X4^Y4 X6^Y5 X5^Y6  Y6 X6 Y7 X7",
    2: "X0 X1 X2 Y0 Y1 Y2 X3  X3^Y3 X4^Y4 X6^Y5 X5^Y6  Y4 X6 Y6 X7",
    4: "X0 X1 Y0 Y1 Y2 X2  X3^Y3 X4^Y4 X6^Y5 X5^Y6  Y3 X4 Y6 X6",
    8: "X0 Y0 X1 X2 Y1  X3^Y3 X4^Y4 X6^Y5 X5^Y6  Y2 X3 Y4 X6",
    16: "X0 Y0 X1 Y1  X3^Y3 X4^Y4 X6^Y5 X5^Y6  Y2 X2 Y3 X4",
}
# 64K_R_X with 32 pipes and 8 packers (RB+), one sample; bits 8 to 12 are the pipes. [addrlib]
_AMD_RX_NAVI21: _Pattern = {
    1: "X0 X1 X2 X3 Y0 Y1 Y2 Y3  X7^Y4^Y7 X4^Y4 X6^Y5 X5^Y6  X6^X8^Y8 Y6 X7 X8^Y7",
    2: "X0 X1 X2 Y0 Y1 Y2 X3  X7^Y4^Y7 X4^Y4 X6^Y5 X5^Y6  X6^X8^Y8 Y3 Y6 X7^Y7",
    4: "X0 X1 Y0 Y1 X2 Y2  X7^Y4^Y7 X4^Y4 X6^Y5 X5^Y6  X6^X8^Y8 X3 Y3 X7^Y6",
    8: "X0 Y0 X1 X2 Y1  X7^Y4^Y7 X4^Y4 X6^Y5 X5^Y6  X6^X8^Y8 Y2 X3 X7^Y3",
    16: "X0 Y0 X1 Y1  X7^Y4^Y7 X4^Y4 X6^Y5 X5^Y6  X3^X8^Y8 X2 Y2 X6^Y3",
}


def _amd_64k(pattern: _Pattern, width: int, height: int, texel_bytes: int) -> LevelTables:
    """AMD gfx10: row-major 64 KiB blocks, the order inside a block given by `pattern`. [addrlib]

    An XOR may take in coordinate bits beyond the block; it then moves whole blocks to other pipes.
    The pipe-bank XOR of each surface is 0, and small levels have blocks of their own instead of
    sharing a mip tail: assumed.
    """
    texel_log2 = texel_bytes.bit_length() - 1
    terms = pattern[texel_bytes].split()
    # A block is as wide as it is tall, or twice as wide.
    y_bits = len(terms) // 2
    x_bits = len(terms) - y_bits
    blocks_per_row, block_rows = -(-width >> x_bits), -(-height >> y_bits)
    columns, rows = np.arange(width), np.arange(height)
    x = (columns >> x_bits) * AMD_BLOCK_BYTES
    y = (rows >> y_bits) * (AMD_BLOCK_BYTES * blocks_per_row)
    for bit, term in enumerate(terms, start=texel_log2):
        for variable in term.split("^"):
            source = int(variable[1:])
            if variable[0] == "X":
                x ^= ((columns >> source) & 1) << bit
            else:
                y ^= ((rows >> source) & 1) << bit
    size = blocks_per_row * block_rows * AMD_BLOCK_BYTES
    return _tables(x, y, AMD_BLOCK_BYTES - 1, size, AMD_BLOCK_BYTES)


def gpgpusim(width: int, height: int, texel_bytes: int) -> LevelTables:
    """GPGPU-Sim's own: blocks of one 128 B texture line, but 64 B apart, so that each overlaps the
    next. [GPGPU-Sim]

    The overlap is the simulator's, and is kept: two texels may share bytes here, as they do there.
    GPGPU-Sim has no mip chain; each level stands as a texture of its own.
    """
    block_width = 16
    words = texel_bytes >> 2
    while words:
        block_width, words = block_width // 2, words >> 2
    row_bytes = block_width * texel_bytes
    block_height = GPGPUSIM_LINE_BYTES // row_bytes
    x_bytes, rows = np.arange(width) * texel_bytes, np.arange(height)
    x = x_bytes // row_bytes * GPGPUSIM_BLOCK_STRIDE_BYTES + x_bytes % row_bytes
    y = (
        rows // block_height * width // block_width * GPGPUSIM_BLOCK_STRIDE_BYTES
        + rows % block_height * row_bytes
    )
    return _tables(x, y, 0, int(x.max() + y.max()) + texel_bytes, LEVEL_ALIGNMENT_BYTES)


LAYOUTS: dict[str, Layout] = {
    "row-major": row_major,
    "morton": morton,
    "block-linear-turing": block_linear_turing,
    "block-linear": block_linear,
    "amd-64k-s": partial(_amd_64k, _AMD_S),
    "amd-64k-rx-navi10": partial(_amd_64k, _AMD_RX_NAVI10),
    "amd-64k-rx-navi21": partial(_amd_64k, _AMD_RX_NAVI21),
    "gpgpusim": gpgpusim,
}


def layout_function(name: str, where: str = "") -> Layout:
    """The layout of that name.

    Raises:
        InputError: no such layout; the message names the nearest and all of them, after `where`.
    """
    if name not in LAYOUTS:
        raise unknown("layout", name, LAYOUTS, where)
    return LAYOUTS[name]


def _tables(
    x: npt.NDArray[np.int64], y: npt.NDArray[np.int64], low: int, size: int, alignment: int
) -> LevelTables:
    alignment = max(alignment, LEVEL_ALIGNMENT_BYTES)
    return LevelTables(x.astype(np.uint32), y.astype(np.uint32), low, size, alignment)


def _scatter(
    values: npt.NDArray[np.int64], positions: tuple[int, ...] | list[int]
) -> npt.NDArray[np.int64]:
    """Bit i of each value moved to bit positions[i]; the bits above are dropped."""
    moved = np.zeros_like(values)
    for i, position in enumerate(positions):
        moved |= ((values >> i) & 1) << position
    return moved


def round_up(value: int, multiple: int) -> int:
    """The smallest multiple that is not below `value`."""
    return -(-value // multiple) * multiple
