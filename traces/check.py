"""Invariants of a Trace: a bad trace is caught here, before it becomes a bad number.

`check` reads a whole trace; `Checker` does the same chunk by chunk, for readers and writers that
stream.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from traces.errors import InputError
from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, WARP_SIZE, unpack_texel
from traces.trace import FOOTPRINTS, OPERATIONS, Chunk, Instruction, Launch, Trace

#: Bytes one lane may move at its address; wider accesses do not exist on the machines we model.
ACCESS_BYTES = (1, 2, 4, 8, 16)
MAX_INSTRUCTIONS = 1 << 16
#: 1024 work-items, the most that any of our machines takes in one group.
MAX_WARPS_PER_CTA = 32
MAX_INT32 = (1 << 31) - 1


@dataclass(frozen=True)
class Summary:
    """What `check` counted on its way. num_rows: access instructions of warps. num_lane_fetches:
    active lanes of all rows.
    """

    num_launches: int
    num_ctas: int
    num_warps: int
    num_rows: int
    num_lane_fetches: int


def check(
    trace: Trace, where: str = "trace", progress: Callable[[int], None] | None = None
) -> Summary:
    """Read every chunk of a trace and check all invariants.

    where: what messages call the trace, for example its path. progress: told the number of lane
        fetches read so far.

    Raises:
        InputError: the first broken invariant, with its place, its value and what is allowed.
    """
    checker = Checker(trace, where)
    for chunk in trace.chunks():
        checker.chunk(chunk)
        if progress:
            progress(checker.num_lane_fetches)
    return checker.finish()


class Checker:
    """Checks chunks as they pass by, in order; `finish` then says whether anything is missing.

    Invariants: launches in order; the CTAs of a launch contiguous from 0 and complete (a launch of
    0 CTAs has no chunk); `warp_offsets` int64 from 0, never falling, up to the number of rows,
    whole CTAs; instructions uint16, in range, of the launch's pass; texels inside a level that
    exists, or addresses that are multiples of the access size.
    """

    def __init__(self, trace: Trace, where: str = "trace") -> None:
        self.trace = trace
        self.where = where
        self.num_lane_fetches = 0
        self._num_ctas = self._num_warps = self._num_rows = 0
        self._launch = 0
        self._next_cta = 0
        self._of_pass: dict[str, npt.NDArray[np.bool_]] = {}
        self._num_launches_checked = 0
        self._check_instructions()
        self._widths, self._heights = level_sizes(trace)
        self._access_bytes = np.array([i.access_bytes for i in trace.instructions], np.uint64)

    def chunk(self, chunk: Chunk) -> None:
        """Check the next chunk. Raises: InputError."""
        launch = self._check_place(chunk)
        self._check_arrays(chunk, launch)
        self._check_rows(chunk, launch)
        num_ctas = chunk.num_warps // launch.warps_per_cta
        self._next_cta += num_ctas
        self._num_ctas += num_ctas
        self._num_warps += chunk.num_warps
        self._num_rows += chunk.num_rows

    def finish(self) -> Summary:
        """Check that every launch was complete. Raises: InputError."""
        self._advance_to(len(self.trace.launches))
        return Summary(
            len(self.trace.launches),
            self._num_ctas,
            self._num_warps,
            self._num_rows,
            self.num_lane_fetches,
        )

    def _fail(self, what: str) -> InputError:
        return InputError(f"{self.where}: {what}")

    def _check_instructions(self) -> None:
        trace = self.trace
        if len(trace.instructions) > MAX_INSTRUCTIONS:
            raise self._fail(
                f"{len(trace.instructions)} instructions: allowed are up to {MAX_INSTRUCTIONS}"
            )
        for index, instruction in enumerate(trace.instructions):
            problem = _instruction_problem(instruction, trace)
            if problem:
                raise self._fail(f"instruction {index}: {problem}")

    def check_launch(self, index: int) -> Launch:
        """The launch `index`, with its fields in range. Raises: InputError."""
        launch = self.trace.launches[index]
        for field, value, least, most in (
            ("num_ctas", launch.num_ctas, 0, MAX_INT32),
            ("warps_per_cta", launch.warps_per_cta, 1, MAX_WARPS_PER_CTA),
            ("frame", launch.frame, 0, MAX_INT32),
            ("registers_per_thread", launch.registers_per_thread, 0, MAX_INT32),
            ("shared_bytes_per_cta", launch.shared_bytes_per_cta, 0, MAX_INT32),
        ):
            if not least <= value <= most:
                raise self._fail(f"launch {index}: {field} {value}: allowed are {least} to {most}")
        if any(count < 0 for _, count in launch.trailing_arithmetic):
            raise self._fail(f"launch {index}: trailing_arithmetic has a negative count")
        return launch

    def _advance_to(self, launch: int) -> None:
        """Leave the launches before `launch`, each of which must be complete."""
        while self._launch < launch:
            num_ctas = self.check_launch(self._launch).num_ctas
            if self._next_cta != num_ctas:
                raise self._fail(
                    f"launch {self._launch}: CTAs {self._next_cta} to {num_ctas - 1} are missing"
                )
            self._launch += 1
            self._next_cta = 0

    def _check_place(self, chunk: Chunk) -> Launch:
        num_launches = len(self.trace.launches)
        if not self._launch <= chunk.launch < num_launches:
            raise self._fail(
                f"chunk of launch {chunk.launch}: allowed are {self._launch} to {num_launches - 1} "
                "(launches in order)"
            )
        self._advance_to(chunk.launch)
        if chunk.first_cta != self._next_cta:
            raise self._fail(
                f"launch {chunk.launch}: chunk starts at CTA {chunk.first_cta}: "
                f"must be {self._next_cta} (CTAs in order, none left out)"
            )
        return self.check_launch(chunk.launch)

    def _check_arrays(self, chunk: Chunk, launch: Launch) -> None:
        place = f"launch {chunk.launch}, CTA {chunk.first_cta}"
        offsets, num_rows = chunk.warp_offsets, len(chunk.instruction)
        if offsets.dtype != np.int64 or offsets.ndim != 1 or not len(offsets):
            raise self._fail(
                f"{place}: warp_offsets {offsets.dtype} of shape {offsets.shape}: "
                "need int64 (warps + 1,)"
            )
        if offsets[0] != 0 or offsets[-1] != num_rows or (np.diff(offsets) < 0).any():
            raise self._fail(
                f"{place}: warp_offsets must rise from 0 to the number of rows, {num_rows}"
            )
        num_ctas, rest = divmod(len(offsets) - 1, launch.warps_per_cta)
        if rest or chunk.first_cta + num_ctas > launch.num_ctas:
            raise self._fail(
                f"{place}: {len(offsets) - 1} warps: need whole CTAs of {launch.warps_per_cta} "
                f"warps, at most {launch.num_ctas - chunk.first_cta} of them"
            )
        if chunk.instruction.dtype != np.uint16 or chunk.instruction.ndim != 1:
            raise self._fail(
                f"{place}: instruction {chunk.instruction.dtype} of shape "
                f"{chunk.instruction.shape}: need uint16 (rows,)"
            )
        dtype = np.uint64 if self.trace.is_lane_address else np.uint32
        if chunk.lanes.dtype != dtype or chunk.lanes.shape != (num_rows, WARP_SIZE):
            raise self._fail(
                f"{place}: lanes {chunk.lanes.dtype} of shape {chunk.lanes.shape}: "
                f"need {np.dtype(dtype)} of {(num_rows, WARP_SIZE)}"
            )

    def _check_rows(self, chunk: Chunk, launch: Launch) -> None:
        of_pass = self._of_pass.get(launch.pass_name)
        if of_pass is None:
            of_pass = np.array(
                [i.pass_name == launch.pass_name for i in self.trace.instructions], bool
            )
            self._of_pass[launch.pass_name] = of_pass
        args = chunk.instruction, of_pass
        if self.trace.is_lane_address:
            row, lane, active = first_bad_address(chunk.lanes, *args, self._access_bytes)
        else:
            row, lane, active = first_bad_texel(chunk.lanes, *args, self._widths, self._heights)
        if row >= 0:
            raise self._fail(self._row_problem(chunk, launch, row, lane))
        self.num_lane_fetches += active

    def _row_problem(self, chunk: Chunk, launch: Launch, row: int, lane: int) -> str:
        warp = int(np.searchsorted(chunk.warp_offsets, row, side="right")) - 1
        step = row - int(chunk.warp_offsets[warp])
        cta = chunk.first_cta + warp // launch.warps_per_cta
        place = f"launch {chunk.launch}, CTA {cta}, warp {warp % launch.warps_per_cta}, step {step}"
        index = int(chunk.instruction[row])
        if index >= len(self.trace.instructions):
            return (
                f"{place}: instruction {index}: allowed are 0 to {len(self.trace.instructions) - 1}"
            )
        instruction = self.trace.instructions[index]
        if instruction.pass_name != launch.pass_name:
            return (
                f"{place}: instruction {index} is of pass {instruction.pass_name!r}: "
                f"the launch's pass is {launch.pass_name!r}"
            )
        value = chunk.lanes[row, lane]
        if self.trace.is_lane_address:
            return (
                f"{place}, lane {lane}: address {int(value):#x}: "
                f"allowed are multiples of the access size, {instruction.access_bytes} B"
            )
        texture = self.trace.textures[instruction.texture]
        mip, y, x = (int(v) for v in unpack_texel(value))
        if mip >= texture.num_mips:
            return (
                f"{place}, lane {lane}: mip {mip} of texture {texture.name!r}: "
                f"allowed are 0 to {texture.num_mips - 1}"
            )
        width, height = texture.mip_size(mip)
        return (
            f"{place}, lane {lane}: texel x {x}, y {y} of mip {mip} of texture {texture.name!r}: "
            f"allowed are x below {width}, y below {height}"
        )


def _instruction_problem(instruction: Instruction, trace: Trace) -> str:
    """What is wrong with an instruction, "" if nothing."""
    if instruction.operation not in OPERATIONS:
        return f"operation {instruction.operation!r}: allowed are {', '.join(OPERATIONS)}"
    if instruction.footprint not in FOOTPRINTS:
        return f"footprint {instruction.footprint!r}: allowed are {', '.join(FOOTPRINTS)}"
    if instruction.num_outstanding < -1:
        return f"num_outstanding {instruction.num_outstanding}: allowed are -1 (any number) and up"
    if any(count < 0 for _, count in instruction.arithmetic):
        return f"arithmetic {instruction.arithmetic}: counts must not be negative"
    if trace.is_lane_address:
        if instruction.texture != -1 or instruction.footprint != "point":
            return (
                f"texture {instruction.texture}, footprint {instruction.footprint!r}: "
                "a lane-address trace has texture -1 and footprint 'point'"
            )
        if instruction.access_bytes not in ACCESS_BYTES:
            return f"access_bytes {instruction.access_bytes}: allowed are {ACCESS_BYTES}"
        return ""
    if not 0 <= instruction.texture < len(trace.textures):
        return f"texture {instruction.texture}: allowed are 0 to {len(trace.textures) - 1}"
    texel_bytes = trace.textures[instruction.texture].texel_bytes
    if instruction.access_bytes not in (0, texel_bytes):
        return (
            f"access_bytes {instruction.access_bytes}: "
            f"allowed are 0 and the texel's size, {texel_bytes}"
        )
    return ""


def level_sizes(trace: Trace) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32]]:
    """Two (num_instructions, 16) uint32: texels across and down of each level of each instruction's
    texture; 0 = no such level.
    """
    widths, heights = np.zeros((2, len(trace.instructions), 16), np.uint32)
    if not trace.is_lane_address:
        for index, instruction in enumerate(trace.instructions):
            texture = trace.textures[instruction.texture]
            for mip in range(texture.num_mips):
                widths[index, mip], heights[index, mip] = texture.mip_size(mip)
    return widths, heights


@njit(cache=True, nogil=True)
def first_bad_texel(lanes: Any, instruction: Any, of_pass: Any, widths: Any, heights: Any) -> Any:
    """(row, lane, active lanes of all rows) of the first row with a wrong instruction or texel; row
    -1 if all are right.
    """
    active = 0
    low = np.uint32(0x3FFF)
    for row in range(lanes.shape[0]):
        index = instruction[row]
        if index >= of_pass.shape[0] or not of_pass[index]:
            return row, 0, active
        for lane in range(WARP_SIZE):
            texel = lanes[row, lane]
            if texel != INACTIVE_TEXEL:
                active += 1
                mip = texel >> np.uint32(28)
                y = (texel >> np.uint32(14)) & low
                if (texel & low) >= widths[index, mip] or y >= heights[index, mip]:
                    return row, lane, active
    return -1, 0, active


@njit(cache=True, nogil=True)
def first_bad_address(lanes: Any, instruction: Any, of_pass: Any, access_bytes: Any) -> Any:
    """As `first_bad_texel`, for byte addresses, which must be multiples of the access size (a power
    of two).
    """
    active = 0
    for row in range(lanes.shape[0]):
        index = instruction[row]
        if index >= of_pass.shape[0] or not of_pass[index]:
            return row, 0, active
        low = access_bytes[index] - np.uint64(1)
        for lane in range(WARP_SIZE):
            address = lanes[row, lane]
            if address != INACTIVE_ADDRESS:
                active += 1
                if address & low:
                    return row, lane, active
    return -1, 0, active
