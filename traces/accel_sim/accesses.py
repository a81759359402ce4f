"""Which addresses the lines of an exported access carry, in the two modes.

    per-texel        a line per texel of the footprint (a bilinear one has 4), each lane its own
    packed-sectors   a load's distinct 32 B sectors, one per lane, 4 bytes each: as many lines as
                     they need; lanes lose their meaning. Stores and atomics stay per texel, since
                     caches care which bytes of a sector they cover.

The second is exact traffic with one L1 access per needed sector; in the first, the texels of one
footprint often ask for the same sector again.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from traces.errors import unknown
from traces.footprint import NUM_CORNERS, texel_addresses
from traces.placement import AddressMap
from traces.texture import INACTIVE_ADDRESS, WARP_SIZE
from traces.trace import Chunk, Instruction, Trace

MODES = ("per-texel", "packed-sectors")
SECTOR_BYTES = 32
_PACKED_BYTES = 4


class Lines(NamedTuple):
    """The addresses of the lines of some rows.

    offsets: (num_rows + 1,) int64; row r has the lines offsets[r] to offsets[r + 1] - 1, at least
        one. addresses: (num_lines, 32) uint64, `INACTIVE_ADDRESS` where a lane is inactive.
    """

    offsets: npt.NDArray[np.int64]
    addresses: npt.NDArray[np.uint64]


class Accesses:
    """Turns rows of one trace into lines.

    address_map: where the trace's textures lie; None for a lane-address trace.

    Raises:
        InputError: an unknown mode.
    """

    def __init__(self, trace: Trace, mode: str, address_map: AddressMap | None) -> None:
        if mode not in MODES:
            raise unknown("export mode", mode, MODES)
        self._instructions = trace.instructions
        self._packed = [mode == MODES[1] and i.operation == "load" for i in trace.instructions]
        self._address_map = address_map
        #: Bytes per lane that the lines of each instruction say.
        self.access_bytes = [
            _PACKED_BYTES if packed else i.access_bytes or trace.textures[i.texture].texel_bytes
            for i, packed in zip(trace.instructions, self._packed, strict=True)
        ]

    def lines(self, chunk: Chunk) -> Lines:
        """The lines of a chunk's rows, which must have been checked."""
        counts = np.ones(chunk.num_rows, np.int64)
        found: list[tuple[npt.NDArray[np.intp], npt.NDArray[np.uint64]]] = []
        for index, rows in _rows_of_instructions(chunk):
            addresses = self._addresses(self._instructions[index], chunk.lanes[rows])
            if self._packed[index]:
                addresses, num_sectors = _distinct_sectors(addresses)
                counts[rows] = np.maximum(1, -(-num_sectors // WARP_SIZE))
            else:
                counts[rows] = addresses.shape[1] // WARP_SIZE
            found.append((rows, addresses))
        offsets = np.concatenate([[0], counts.cumsum()])
        made = np.full((int(offsets[-1]), WARP_SIZE), INACTIVE_ADDRESS, np.uint64)
        for rows, addresses in found:
            for line in range(addresses.shape[1] // WARP_SIZE):
                has = counts[rows] > line
                part = addresses[has, line * WARP_SIZE : (line + 1) * WARP_SIZE]
                made[offsets[rows[has]] + line] = part
        return Lines(offsets, made)

    def _addresses(
        self, instruction: Instruction, lanes: npt.NDArray[np.generic]
    ) -> npt.NDArray[np.uint64]:
        """(n, 32 k) uint64 byte addresses, corner by corner of the footprint."""
        if self._address_map is None:
            return lanes.astype(np.uint64, copy=False)
        bilinear = instruction.footprint == "bilinear"
        made = texel_addresses(
            lanes.astype(np.uint32, copy=False), instruction.texture, bilinear, self._address_map
        )
        if not bilinear:
            return made
        by_lane = made.reshape(len(made), WARP_SIZE, NUM_CORNERS)
        return by_lane.transpose(0, 2, 1).reshape(len(made), -1)


def _rows_of_instructions(chunk: Chunk) -> Iterator[tuple[int, npt.NDArray[np.intp]]]:
    """The instructions of a chunk and the rows of each."""
    for index in np.unique(chunk.instruction).tolist():
        yield index, np.flatnonzero(chunk.instruction == index)


def _distinct_sectors(
    addresses: npt.NDArray[np.uint64],
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64]]:
    """Each row's distinct sectors, ascending and to the left, then `INACTIVE_ADDRESS`; and how
    many they are.
    """
    sectors = addresses & np.uint64(~(SECTOR_BYTES - 1) & (1 << 64) - 1)
    sectors[addresses == INACTIVE_ADDRESS] = INACTIVE_ADDRESS
    sectors.sort(axis=1)
    sectors[:, 1:][sectors[:, 1:] == sectors[:, :-1]] = INACTIVE_ADDRESS
    sectors.sort(axis=1)
    return sectors, np.count_nonzero(sectors != INACTIVE_ADDRESS, axis=1).astype(np.int64)


__all__ = ["MODES", "SECTOR_BYTES", "Accesses", "Lines"]
