"""From a line's address to its set and slice: the set hashes and partition hashes of the facts
sheet, sections 3.2 to 3.4.

Every hash here except division and "random" is linear over GF(2), so that it is a table look-up per
address byte: the hash of a number is the XOR of the hashes of its bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.compiled import compiled, inlined
from cachesim.config import L2, CacheLevel

U64 = np.uint64

# Primitive polynomials over GF(2) by degree, without the leading term. Degrees 4 to 6 are GPGPU-
# Sim's IPOLY (facts sheet 3.2, verified there numerically); the others are the usual primitive
# ones, assumed for slice counts GPGPU-Sim has no table for.
_POLYNOMIALS = {
    1: 0b1,
    2: 0b11,
    3: 0b011,
    4: 0b0011,
    5: 0b00101,
    6: 0b000011,
    7: 0b0000011,
    8: 0b00011101,
}
#: How many low bits of the block number IPOLY looks at (facts sheet 3.2: "up to" bit 16, 19, 24);
#: 40 for the degrees GPGPU-Sim has no table for.
_IPOLY_BITS = {4: 17, 5: 20, 6: 25}

_EXACT = np.uint64(1 << 52)

# Kinds of index function.
MASK, MODULO, TABLE, RANDOM = range(4)


class IndexHash(NamedTuple):
    """An index function on 64-bit numbers: kind, number of values, and the byte tables where it is
    GF(2)-linear.

    table: (num_bytes, 256) uint32; empty unless kind is `TABLE`.
    """

    kind: int
    size: int
    table: npt.NDArray[np.uint32]


def _table_of_columns(columns: list[int]) -> npt.NDArray[np.uint32]:
    """The byte tables of a GF(2)-linear map; columns[k] is the hash of bit k alone."""
    num_bytes = -(-len(columns) // 8)
    table = np.zeros((num_bytes, 256), np.uint32)
    for bit, column in enumerate(columns):
        has_bit = (np.arange(256) >> (bit % 8)) & 1 == 1
        table[bit // 8, has_bit] ^= np.uint32(column)
    return table


def ipoly_columns(degree: int) -> list[int]:
    """x^k mod P(x) over GF(2) for each bit k that IPOLY of this degree looks at."""
    residue, columns = 1, []
    for _ in range(_IPOLY_BITS.get(degree, 40)):
        columns.append(residue)
        residue <<= 1
        if residue >> degree:
            residue = (residue ^ _POLYNOMIALS[degree]) & ((1 << degree) - 1)
    return columns


def _fermi_columns(num_sets: int) -> list[int]:
    """Facts sheet 3.2: line-number bits 0-4, XOR bits 6, 7, 8, 10, 12; bit 5 for 64 sets."""
    columns = [0] * 13
    for bit in range(5):
        columns[bit] = 1 << bit
    for target, bit in enumerate((6, 7, 8, 10, 12)):
        columns[bit] = 1 << target
    if num_sets == 64:
        columns[5] = 32
    return columns


_NO_TABLE = np.zeros((0, 256), np.uint32)


def _linear(size: int) -> IndexHash:
    return IndexHash(MASK if size & (size - 1) == 0 else MODULO, size, _NO_TABLE)


def set_hash(level: CacheLevel) -> IndexHash:
    """The set index function of one cache instance, on its line numbers."""
    sets = level.num_sets
    bits = sets.bit_length() - 1
    if level.set_hash == "xor" and bits:
        return IndexHash(TABLE, sets, _table_of_columns([1 << (k % bits) for k in range(2 * bits)]))
    if level.set_hash == "fermi":
        return IndexHash(TABLE, sets, _table_of_columns(_fermi_columns(sets)))
    if level.set_hash == "ipoly":
        return IndexHash(TABLE, sets, _table_of_columns(ipoly_columns(bits)))
    return _linear(sets)


class Partition(NamedTuple):
    """How addresses spread over slices, and what is left of them inside a slice.

    num_channels, slices_per_channel; run_shift: binary logarithm of the bytes in a row that one
    slice holds.
    hash: index function on the run number ("random", "ipoly") or none where kind is `MASK`/`MODULO`
        (plain interleave);
    xor: 1 where the channel is XORed with the bits above it.
    """

    num_channels: int
    slices_per_channel: int
    run_shift: int
    hash: IndexHash
    xor: int


def partition_of(level: L2) -> Partition:
    """The partition function of a sliced level."""
    slices = level.num_slices
    index = _linear(slices)
    if level.partition_hash == "random":
        index = IndexHash(RANDOM, slices, _NO_TABLE)
    elif level.partition_hash == "ipoly" and slices > 1:
        # Facts sheet 3.4, mode 2: hash over the next power of two of channels, then modulo.
        entries = (1 << (level.num_channels - 1).bit_length()) * level.slices_per_channel
        degree = max(1, (entries - 1).bit_length())
        if degree not in _POLYNOMIALS:
            raise ValueError(
                f"partition_hash = 'ipoly' with {slices} slices: allowed are up to 256"
            )
        index = IndexHash(TABLE, slices, _table_of_columns(ipoly_columns(degree)))
    run = level.channel_interleave // level.slices_per_channel
    return Partition(
        level.num_channels,
        level.slices_per_channel,
        run.bit_length() - 1,
        index,
        int(level.partition_hash == "xor"),
    )


@inlined
def mix64(x):  # type: ignore[no-untyped-def]
    """A uniform 64-bit hash (splitmix64's finaliser)."""
    x = (x ^ (x >> U64(30))) * U64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> U64(27))) * U64(0x94D049BB133111EB)
    return x ^ (x >> U64(31))


@inlined
def index_of(number, kind, size, table):  # type: ignore[no-untyped-def]
    """The index in [0, size) of a 64-bit number under an `IndexHash`, as uint64."""
    if kind == MASK:
        return number & U64(size - 1)
    if kind == MODULO:
        return number % U64(size)
    if kind == RANDOM:
        return ((mix64(number) >> U64(32)) * U64(size)) >> U64(32)
    index = np.uint32(0)
    for byte in range(table.shape[0]):
        index ^= table[byte, (number >> U64(8 * byte)) & U64(255)]
    # A table may have the next power of two of values (facts sheet 3.4, mode 2).
    return U64(index) % U64(size) if size & (size - 1) else U64(index)


@compiled
def set_indices(line, count, kind, size, table, out):  # type: ignore[no-untyped-def]
    """Write the set index of line[:count] into out[:count] (uint32)."""
    for i in range(count):
        out[i] = index_of(line[i], kind, size, table)


@inlined
def slice_and_line(  # type: ignore[no-untyped-def]
    address, channels, per_channel, run_shift, kind, slices, table, xor, line_shift
):
    """(slice, line number inside the slice) of a byte address, both uint64. channels, per_channel:
    uint64.

    run_shift, line_shift: uint64 binary logarithms of a slice's run and of a line. The line number
        drops the channel and slice bits of the plain interleave, whatever the hash (facts sheet
        3.4).
    """
    run = address >> run_shift
    if per_channel == U64(1):
        block, within_channel = run, U64(0)
    elif per_channel == U64(2):
        block, within_channel = run >> U64(1), run & U64(1)
    else:
        block = run // per_channel
        within_channel = run - block * per_channel
    if block < _EXACT:
        # Exact below 2^52, and cheaper than a 64-bit integer division.
        row = U64(np.float64(np.int64(block)) / np.float64(np.int64(channels)))
    else:
        row = block // channels
    if kind == MASK or kind == MODULO:
        channel = block - row * channels
        if xor:
            channel ^= row & (channels - U64(1))
        where = channel * per_channel + within_channel
    else:
        where = index_of(run, kind, slices, table)
    lines_per_run = run_shift - line_shift
    line = (address >> line_shift) & ((U64(1) << lines_per_run) - U64(1))
    return where, (row << lines_per_run) | line
