"""The access instructions of each pass, and which row of a trace each execution of one gets.

A warp's rows are its pass's accesses in program order: those before the sample loop, the loop's
once per step, those after it. A row's place therefore follows from the warp's state and step alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kernels.grid import OUTSIDE, WARPS_PER_CTA
from traces.texture import INACTIVE_TEXEL, WARP_SIZE
from traces.trace import Instruction

States = npt.NDArray[np.int32]
Offsets = npt.NDArray[np.int64]


def scattering_tiles(states: States) -> npt.NDArray[np.bool_]:
    """(num_warps,) bool: whether a lane of the warp's CTA scatters. states: of whole CTAs."""
    any_of_tile = (states.reshape(-1, WARPS_PER_CTA) > 0).any(axis=1)
    return np.repeat(any_of_tile, WARPS_PER_CTA)


@dataclass(frozen=True)
class Access:
    """One access instruction of a pass's kernel.

    texture: name. subsurface_only: executed by warps with a scattering lane, for those lanes; else
        by every lane in the frame.
    in_loop: executed once per sample; implies subsurface_only.
    of_tile: executed by all lanes of both warps of a CTA in which any lane scatters; goes with
        subsurface_only, and stands before the accesses that do not.
    argument: the kernel's name of the buffer, where it reads a texture a second time.
    arithmetic: as in `Instruction`. first: the same in the loop's first turn. scattering: the same
        in warps with a scattering lane, where others execute the access too. None: no different.
    """

    texture: str
    operation: str = "load"
    footprint: str = "point"
    subsurface_only: bool = False
    in_loop: bool = False
    of_tile: bool = False
    argument: str = ""
    arithmetic: tuple[tuple[str, int], ...] = ()
    first: tuple[tuple[str, int], ...] | None = None
    scattering: tuple[tuple[str, int], ...] | None = None

    @property
    def other(self) -> tuple[tuple[str, int], ...] | None:
        """The arithmetic of a second `Instruction`, where this access needs one."""
        return self.first if self.in_loop else self.scattering


@dataclass(frozen=True)
class Program:
    """One pass as a list of accesses; the loop's stand together. first_instruction: index of the
    first in the trace. trailing_arithmetic, registers_per_thread, shared_bytes: as in `Launch`.
    """

    pass_name: str
    accesses: tuple[Access, ...]
    first_instruction: int = 0
    trailing_arithmetic: tuple[tuple[str, int], ...] = ()
    registers_per_thread: int = 0
    shared_bytes: int = 0

    @property
    def _loop(self) -> list[int]:
        return [i for i, access in enumerate(self.accesses) if access.in_loop]

    @property
    def _others(self) -> dict[int, int]:
        """The second instruction of each access that has one, counted from `first_instruction`."""
        having = [i for i, access in enumerate(self.accesses) if access.other is not None]
        return {i: len(self.accesses) + k for k, i in enumerate(having)}

    def instructions(self, textures: Sequence[str]) -> list[Instruction]:
        """The accesses as `Instruction`s, and then the second ones of those that have two.
        textures: names in the trace's order.
        """
        pairs = [(a, a.arithmetic) for a in self.accesses]
        pairs += [(a, a.other) for a in self.accesses if a.other is not None]
        return [
            Instruction(
                self.pass_name,
                textures.index(a.texture),
                a.operation,
                a.footprint,
                arithmetic=arithmetic,
            )
            for a, arithmetic in pairs
        ]

    def row_offsets(self, states: States) -> Offsets:
        """(num_warps + 1,) int64: where each warp's rows begin."""
        in_loop = len(self._loop)
        of_tile = sum(a.of_tile for a in self.accesses)
        subsurface = sum(a.subsurface_only for a in self.accesses) - of_tile
        always = len(self.accesses) - subsurface - of_tile - in_loop
        rows = np.where(states > 0, always + subsurface + in_loop * states.astype(np.int64), always)
        rows[states == OUTSIDE] = 0
        if of_tile:
            rows += of_tile * scattering_tiles(states)
        return np.concatenate([[0], np.cumsum(rows)])

    def _rows_outside_loop(
        self, states: States, offsets: Offsets
    ) -> list[tuple[int, Offsets, Offsets]]:
        """(access, warps, rows) of each access outside the loop: which warps execute it, and in
        which rows.
        """
        loop, before, found = self._loop, np.zeros(len(states), np.int64), []
        for i, access in enumerate(self.accesses):
            if access.in_loop:
                if i == loop[-1]:
                    before += len(loop) * np.maximum(states, 0)
                continue
            executes = states > 0 if access.subsurface_only else states != OUTSIDE
            if access.of_tile:
                executes = scattering_tiles(states)
            warps = np.flatnonzero(executes)
            found.append((i, warps, offsets[:-1][warps] + before[warps]))
            before += executes
        return found

    def _loop_start(self) -> int:
        """Accesses before the loop, in a warp that executes it."""
        return self._loop[0] if self._loop else 0

    def row_instructions(self, states: States, offsets: Offsets) -> npt.NDArray[np.uint16]:
        """(num_rows,) uint16: the instruction of each row of these warps; `offsets` from
        `row_offsets`.
        """
        loop, others = self._loop, self._others
        rows = np.empty(int(offsets[-1]), np.uint16)
        if loop:
            # The loop's pattern in every row, counted from each warp's first turn; the others
            # overwrite theirs.
            phase = ((offsets[:-1] + self._loop_start()) % len(loop)).astype(np.int64)
            turn = (np.arange(len(rows)) - np.repeat(phase, np.diff(offsets))) % len(loop)
            rows[:] = turn + (loop[0] + self.first_instruction)
            scatters = np.flatnonzero(states > 0)
            for k, i in enumerate(loop):
                at = offsets[:-1][scatters] + self._loop_start() + k
                rows[at] = others.get(i, i) + self.first_instruction
        for i, warps, at in self._rows_outside_loop(states, offsets):
            other = np.where(states[warps] > 0, others.get(i, i), i)
            rows[at] = other + self.first_instruction
        return rows

    def place(
        self, states: States, texels: Sequence[npt.NDArray[np.uint32]]
    ) -> tuple[Offsets, npt.NDArray[np.uint32]]:
        """The rows of a whole launch from each access's texels, for the references.

        texels: per access, (num_warps, 32), or (num_steps, num_warps, 32) for the loop's; rows that
            no warp executes are dropped.
        """
        offsets = self.row_offsets(states)
        lanes = np.full((int(offsets[-1]), WARP_SIZE), INACTIVE_TEXEL, np.uint32)
        for i, warps, at in self._rows_outside_loop(states, offsets):
            lanes[at] = texels[i][warps]
        for k, i in enumerate(self._loop):
            for step, texel in enumerate(texels[i]):
                warps = np.flatnonzero(states > step)
                at = offsets[:-1][warps] + self._loop_start() + len(self._loop) * step + k
                lanes[at] = texel[warps]
        return offsets, lanes
