"""The passes on a device: buffers that live over all frames, and one enqueue per launch or part of
a launch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from kernels import program, resources, sampling
from kernels.access import States
from kernels.device import Device
from kernels.gbuffer import GBuffer
from kernels.grid import Grid, lane_table
from kernels.method import Method
from kernels.passes import PASSES, Step, list_steps
from traces.errors import InputError
from traces.texture import WARP_SIZE

_BYTES = {"depth": 4, "gbuffer_id": 1, "normal": 4, "profile_id": 1}  # of a device texel, else 8


@dataclass(frozen=True)
class TraceTarget:
    """Where a traced launch writes. lanes: device buffer. row_of_warp: device buffer, (num_warps,)
    uint32. first_row: row of lanes[0].
    """

    lanes: cl.Buffer
    row_of_warp: cl.Buffer
    first_row: int


class Pipeline:
    """The device state of one method at one frame size.

    buffers: device buffers by texture name, and "counts" and "ratio".
    states: (num_warps,) int32 of the full-screen grid, as `Grid.warp_states`.
    states, constants, has_velocity: of the loaded G-buffer.
    """

    def __init__(self, method: Method, width: int, height: int, device: Device) -> None:
        self.method = method
        self.device = device
        self.width, self.height = width, height
        self.grid = Grid(width, height, method.tile_order, method.lane_map)
        self.num_levels = resources.count_levels(width, height, method)
        self.steps = list_steps(method, self.grid, self.num_levels)
        self.states: States = self.grid.warp_states()
        self._gbuffer: GBuffer | None = None
        self._kernels: dict[tuple[str, bool], cl.Kernel] = {}
        self.buffers = {name: self.allocate(size) for name, size in self._sizes().items()}
        self._tables: dict[Grid, tuple[cl.Buffer, cl.Buffer]] = {}
        self._clear_histories()

    def _sizes(self) -> dict[str, int]:
        """Bytes of each buffer."""
        pixels = self.width * self.height
        sizes = {name: pixels * _BYTES.get(name, 8) for name in resources.TEXTURE_NAMES}
        # The levels below the first stand beside it: common.cl, setup_index.
        sizes["setup"] = (self.width + self.width // 2) * self.height * 8
        sizes["counts"] = self.grid.num_warps * WARP_SIZE * 2
        if not self.method.adaptive:
            sizes |= dict.fromkeys(("resolved", "history_0", "history_1", "counts"), 8)
        sizes["velocity"] = 8
        return sizes

    def allocate(self, num_bytes: int) -> cl.Buffer:
        """An uninitialised device buffer."""
        return cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, max(8, num_bytes))

    def upload(self, array: npt.NDArray[Any]) -> cl.Buffer:
        """A read-only device buffer that holds the array."""
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.device.context, flags, hostbuf=np.ascontiguousarray(array))

    def _clear_histories(self) -> None:
        for name in ("history_0", "history_1"):
            buffer = self.buffers[name]
            cl.enqueue_fill_buffer(
                self.device.queue, buffer, np.zeros(1, np.uint64), 0, buffer.size
            )

    def load(self, gbuffer: GBuffer) -> bool:
        """Upload a G-buffer; False if it is the one that is loaded.

        Raises:
            InputError: its size differs from the first frame's.
        """
        if gbuffer is self._gbuffer:
            return False
        if (gbuffer.width, gbuffer.height) != (self.width, self.height):
            raise InputError(
                f"{gbuffer.name}: size {gbuffer.width}x{gbuffer.height}: "
                f"all frames must be {self.width}x{self.height}"
            )
        for name, array in resources.inputs(gbuffer).items():
            if self.buffers[name].size < array.nbytes:
                self.buffers[name] = self.allocate(array.nbytes)
            cl.enqueue_copy(self.device.queue, self.buffers[name], array)
        self._gbuffer = gbuffer
        self.states = self.grid.warp_states(gbuffer.subsurface)
        self.has_velocity = np.int32(gbuffer.velocity is not None)
        self.constants = sampling.Constants.of(
            self.method, self.width, self.height, gbuffer.projection_x
        )
        self.buffers["ratio"] = self.upload(self.constants.ratio)
        return True

    def count_samples(self, frame: int) -> States:
        """The sampling pass's warp states: steps of each warp's hungriest lane. Runs the estimate
        where counts adapt.
        """
        if not self.method.adaptive:
            steps: States = np.where(self.states > 0, self.method.num_samples, self.states).astype(
                np.int32
            )
            return steps
        arguments = sampling.estimate_arguments(self, frame)
        self._enqueue(
            "estimate",
            self.grid,
            self.upload(self.states),
            0,
            self.grid.num_warps,
            arguments,
        )
        counts = np.empty((self.grid.num_warps, WARP_SIZE), np.uint16)
        cl.enqueue_copy(self.device.queue, counts, self.buffers["counts"])
        return np.where(self.states > 0, counts.max(axis=1), self.states).astype(np.int32)

    def states_of(self, step: Step, frame: int) -> States:
        """The warp states of a launch whose inputs are ready."""
        if step.pass_name == "prefilter":
            return step.grid.warp_states()
        return self.count_samples(frame) if step.pass_name == "sampling" else self.states

    def run(self, step: Step, frame: int, states: States) -> None:
        """Enqueue a whole launch, untraced."""
        self.run_warps(step, frame, self.upload(states), 0, step.grid.num_warps)

    def run_warps(
        self,
        step: Step,
        frame: int,
        states: cl.Buffer,
        first_warp: int,
        num_warps: int,
        target: TraceTarget | None = None,
    ) -> cl.Event:
        """Enqueue warps [first_warp, first_warp + num_warps) of a launch, traced where there is a
        target.
        """
        arguments = PASSES[step.pass_name].arguments(self, step.level, frame)
        if target is not None:
            arguments += [target.lanes, target.row_of_warp, np.uint32(target.first_row)]
        return self._enqueue(
            step.pass_name, step.grid, states, first_warp, num_warps, arguments, target is not None
        )

    def _enqueue(
        self,
        name: str,
        grid: Grid,
        states: cl.Buffer,
        first_warp: int,
        num_warps: int,
        arguments: list[Any],
        traced: bool = False,
    ) -> cl.Event:
        if (name, traced) not in self._kernels:
            built = program.build(self.device, self.method, name, traced)
            self._kernels[name, traced] = cl.Kernel(built, name)
        if grid not in self._tables:
            self._tables[grid] = (self.upload(grid.tiles), self.upload(lane_table(grid.lane_map)))
        tiles, lanes = self._tables[grid]
        size = (np.int32(grid.width), np.int32(grid.height))
        items = WARP_SIZE // program.lanes_per_item(self.device, name)
        return self._kernels[name, traced](
            self.device.queue,
            (num_warps * items,),
            (items,),
            np.uint32(first_warp),
            states,
            tiles,
            lanes,
            *size,
            *arguments,
        )

    def read(self, name: str) -> npt.NDArray[np.float32]:
        """(height, width, 4) float32: an RGBA16F texture's content."""
        texels = np.empty((self.height, self.width, 4), np.float16)
        cl.enqueue_copy(self.device.queue, texels, self.buffers[name])
        return texels.astype(np.float32)

    def read_levels(self) -> list[npt.NDArray[np.float16]]:
        """The setup texture's levels, each (height, width, 4) float16."""
        packed = np.empty((self.height, self.width + self.width // 2, 4), np.float16)
        cl.enqueue_copy(self.device.queue, packed, self.buffers["setup"])
        levels = [packed[:, : self.width]]
        for k in range(1, self.num_levels):
            top = self.height - (self.height >> k - 1)
            rows = packed[top : top + (self.height >> k)]
            levels.append(rows[:, self.width : self.width + (self.width >> k)])
        return levels
