"""Which slice an address goes to. A "random" partition is drawn at an address's first touch, as
GPGPU-Sim does it (facts sheet 3.4): the number of draws per slice, and with it the load of the
fullest slice, are then the simulator's own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cachesim.address import RANDOM, slice_and_line
from cachesim.compiled import compiled, small

U64 = np.uint64
#: Places in `Route.draws` before its hash table: how many runs were drawn, the generator's next
#: place, and its 31 numbers.
DRAWN, NEXT, NUMBERS = 0, 1, 2
TABLE = NUMBERS + 31
#: Where GPGPU-Sim's traces have their code; 16 bytes an instruction.
_CODE = 0xF0000000
_LAG = 31
#: Bits of an entry that hold the slice; those above hold the run.
_SLICE_BITS = 16
_SLICES = (1 << _SLICE_BITS) - 1
#: Runs that differ above these bits share their slice: no GPU has so many addresses.
_RUNS = (1 << 63 - _SLICE_BITS) - 1


def generator(seed: int = 1) -> npt.NDArray[np.int64]:
    """The numbers of the C library's additive feedback generator (x[i] = x[i-3] + x[i-31] modulo
    2^32, output x >> 1) after its first 310 outputs, oldest first.
    """
    numbers = [seed]
    for _ in range(30):
        numbers.append(16807 * numbers[-1] % 2147483647)
    numbers += numbers[:3]
    for i in range(34, 344):
        numbers.append((numbers[i - 3] + numbers[i - 31]) % (1 << 32))
    return np.array(numbers[-_LAG:], np.int64)


def new_draws(size: int) -> npt.NDArray[np.int64]:
    """An empty table of drawn runs with room for `size` entries (a power of two)."""
    draws = np.full(TABLE + size, -1, np.int64)
    draws[DRAWN] = draws[NEXT] = 0
    draws[NUMBERS:TABLE] = generator()
    return draws


def larger_draws(draws: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The same draws in a table of twice the size."""
    larger = new_draws(2 * (len(draws) - TABLE))
    larger[:TABLE] = draws[:TABLE]
    _copy_entries(draws, larger)
    return larger


@small
def _slot(draws, run):  # type: ignore[no-untyped-def]
    """Where a run stands in the table, or would stand."""
    mask = len(draws) - TABLE - 1
    # Eight neighbours stand together.
    at = ((((run >> 3) * 0x1E3779B97F4A7C15) >> 24 << 3) | (run & 7)) & mask
    while draws[TABLE + at] >= 0 and draws[TABLE + at] >> _SLICE_BITS != run:
        at = (at + 1) & mask
    return TABLE + at


@compiled
def _copy_entries(draws, larger):  # type: ignore[no-untyped-def]
    for place in range(TABLE, len(draws)):
        entry = draws[place]
        if entry >= 0:
            larger[_slot(larger, entry >> _SLICE_BITS)] = entry


@compiled
def _draw(draws, slices):  # type: ignore[no-untyped-def]
    """The next number of the generator, modulo the number of slices."""
    at = draws[NEXT]
    back = at + _LAG - 3
    value = (draws[NUMBERS + (back if back < _LAG else back - _LAG)] + draws[NUMBERS + at]) & (
        (1 << 32) - 1
    )
    draws[NUMBERS + at] = value
    draws[NEXT] = at + 1 if at + 1 < _LAG else 0
    return (value >> 1) % slices


@compiled
def _drawn(route, address):  # type: ignore[no-untyped-def]
    """The slice of an address under a random partition, drawn if nobody asked for it before."""
    run = (address >> route.numbers[2]) & _RUNS
    at = _slot(route.draws, run)
    if route.draws[at] < 0:
        where = _draw(route.draws, route.numbers[4])
        route.draws[at] = run << _SLICE_BITS | where
        route.draws[DRAWN] += 1
    return route.draws[at] & _SLICES


@compiled
def draw_code(route, instruction):  # type: ignore[no-untyped-def]
    """A warp comes to this instruction of a trace: in GPGPU-Sim its code's line is a first touch
    like any other, though instructions always hit.
    """
    if instruction & 7 == 0:
        _drawn(route, np.int64(_CODE + (instruction << 4)))


@small
def is_drawn(route):  # type: ignore[no-untyped-def]
    """Whether slices are drawn at an address's first touch."""
    return route.numbers[3] == RANDOM


@compiled
def locate(route, address):  # type: ignore[no-untyped-def]
    """(slice, line number inside it) of an address."""
    numbers = route.numbers
    where, number = slice_and_line(
        U64(address),
        U64(numbers[0]),
        U64(numbers[1]),
        U64(numbers[2]),
        numbers[3],
        numbers[4],
        route.table,
        numbers[5],
        U64(numbers[6]),
    )
    if numbers[3] == RANDOM:
        return _drawn(route, address), np.int64(number)
    return np.int64(where), np.int64(number)


@small
def is_filling_table(draws):  # type: ignore[no-untyped-def]
    """Whether a table of draws is half full."""
    return draws[DRAWN] * 2 > len(draws) - TABLE
