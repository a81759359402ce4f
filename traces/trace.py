"""The Trace: every texel fetch of a frame as warp-wide access instructions with provenance.

One row is one access instruction of one warp. A row names its `Instruction` (the static access in
the pass's program: pass, texture, operation, footprint, the arithmetic before it) and has one
packed texel coordinate, or one byte address, per lane. Rows come in `Chunk`s of whole CTAs of one
launch, in launch, CTA, warp, step order; no stage needs more than a chunk at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, WARP_SIZE, Texture

OPERATIONS = ("load", "store", "atomic")
FOOTPRINTS = ("point", "bilinear")
#: Units that arithmetic runs on; "control" are branches, barriers and the like.
ARITHMETIC_KINDS = ("int", "fp32", "sfu", "control")
#: The kind in `Instruction.arithmetic` that issues nothing, see there.
WAIT = "wait"


@dataclass(frozen=True)
class Instruction:
    """One static access instruction of a pass, as a program counter would name it.

    pass_name: "setup", "prefilter", "sampling", "update", "combine", or what the importer says.
    texture: index into `Trace.textures`; -1 for a lane-address trace, which has none.
    operation: one of `OPERATIONS`. footprint: one of `FOOTPRINTS`; a bilinear row's coordinate is
        the top-left texel of the 2x2 footprint, whose other texels are clamped to the level's edge.
    access_bytes: bytes each lane moves at its address; the texel's size unless this is a
        lane-address trace.
    arithmetic: what the warp issues after its previous access, in order, as (kind, count) pairs:
        count warp instructions of one of `ARITHMETIC_KINDS`, in a run of three dependent chains
        (number c of the run needs the result of number c - 3); or ("wait", n), which issues nothing
        and holds the warp until all its loads but the n latest have their data.
    num_outstanding: such a wait directly before the access; -1 = none. Waits count loads, and
        atomics as they return data too; stores are never waited for.
    """

    pass_name: str
    texture: int
    operation: str = "load"
    footprint: str = "point"
    access_bytes: int = 0
    arithmetic: tuple[tuple[str, int], ...] = ()
    num_outstanding: int = -1


@dataclass(frozen=True)
class Launch:
    """One kernel launch: a grid of CTAs of one pass of one frame.

    registers_per_thread, shared_bytes_per_cta: limits of occupancy; 0 = no limit.
    trailing_arithmetic: warp instructions after the last access, as in `Instruction.arithmetic`.
    """

    frame: int
    pass_name: str
    num_ctas: int
    warps_per_cta: int
    registers_per_thread: int = 0
    shared_bytes_per_cta: int = 0
    trailing_arithmetic: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True, eq=False)
class Chunk:
    """The rows of the CTAs [first_cta, first_cta + num_ctas) of one launch.

    launch: index into `Trace.launches`. first_cta: first CTA of the chunk in launch order.
    warp_offsets: (num_ctas * warps_per_cta + 1,) int64; warp w of the chunk owns rows
        warp_offsets[w] to warp_offsets[w+1] - 1, its accesses in program order.
    instruction: (num_rows,) uint16, index into `Trace.instructions`.
    lanes: (num_rows, 32) uint32 packed texels with `INACTIVE_TEXEL` where a lane is inactive, or
        uint64 byte addresses with `INACTIVE_ADDRESS` there.
    """

    launch: int
    first_cta: int
    warp_offsets: npt.NDArray[np.int64]
    instruction: npt.NDArray[np.uint16]
    lanes: npt.NDArray[Any]

    @property
    def num_rows(self) -> int:
        return len(self.instruction)

    @property
    def num_warps(self) -> int:
        return len(self.warp_offsets) - 1

    @property
    def active(self) -> npt.NDArray[np.bool_]:
        """(num_rows, 32) bool: the mask of active lanes."""
        inactive = INACTIVE_ADDRESS if self.lanes.dtype == np.uint64 else INACTIVE_TEXEL
        mask: npt.NDArray[np.bool_] = self.lanes != inactive
        return mask

    @property
    def num_lane_fetches(self) -> int:
        return int(np.count_nonzero(self.active))


@dataclass(eq=False)
class Trace:
    """A recording: descriptions, and a source of chunks that can be opened again for every pass
    over the data.

    manifest: JSON-able provenance: scene, method, parameters, seed, kernel source hash, device,
        versions.
    textures, instructions: what rows refer to. launches: in execution order; a live recording may
        append to it while its chunks are consumed, a chunk's own launch is always there.
    source: makes a new iterator of chunks. A live recording renders again; a file is read again.
    """

    manifest: dict[str, Any]
    textures: Sequence[Texture]
    instructions: Sequence[Instruction]
    launches: list[Launch]
    source: Callable[[], Iterator[Chunk]] = field(repr=False)

    def chunks(self) -> Iterator[Chunk]:
        """A new iterator over the rows, in launch and CTA order."""
        return self.source()

    @property
    def is_lane_address(self) -> bool:
        """True where lanes hold byte addresses instead of packed texels."""
        return not self.textures


def from_chunks(
    chunks: Sequence[Chunk],
    textures: Sequence[Texture],
    instructions: Sequence[Instruction],
    launches: Sequence[Launch],
    manifest: dict[str, Any] | None = None,
) -> Trace:
    """A trace that is held in memory."""
    held = list(chunks)
    return Trace(dict(manifest or {}), textures, instructions, list(launches), lambda: iter(held))


def warp_of_rows(chunk: Chunk) -> npt.NDArray[np.int64]:
    """(num_rows,) int64: the warp within the chunk that owns each row."""
    return np.repeat(np.arange(chunk.num_warps), np.diff(chunk.warp_offsets))


__all__ = [
    "ARITHMETIC_KINDS",
    "FOOTPRINTS",
    "OPERATIONS",
    "WAIT",
    "WARP_SIZE",
    "Chunk",
    "Instruction",
    "Launch",
    "Trace",
    "from_chunks",
    "warp_of_rows",
]
