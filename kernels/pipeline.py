"""The passes on a device: buffers that live over all frames, and one enqueue per launch or part of a launch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from kernels import combine, program, resources, sampling, update
from kernels.access import States
from kernels.device import Device
from kernels.gbuffer import GBuffer
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes import Step, list_steps
from traces.errors import InputError
from traces.texture import WARP_SIZE

_BYTES = {"depth": 4, "gbuffer_id": 1, "normal": 4, "profile_id": 1}  # of a device texel, else 8


@dataclass(frozen=True)
class TraceTarget:
    """Where a traced launch writes. lanes: device buffer. row_of_warp: device buffer, (num_warps,) uint32. first_row: row of lanes[0]."""

    lanes: cl.Buffer
    row_of_warp: cl.Buffer
    first_row: int


class Pipeline:
    """The device state of one method at one frame size.

    states: (num_warps,) int32 of the full-screen grid, as `Grid.warp_states`; of the loaded G-buffer.
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
        self._programs = {False: program.build(device, method, traced=False)}
        self._buffers = {name: self.allocate(size) for name, size in self._sizes().items()}
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
            buffer = self._buffers[name]
            cl.enqueue_fill_buffer(self.device.queue, buffer, np.uint64(0), 0, buffer.size)

    def load(self, gbuffer: GBuffer) -> bool:
        """Upload a G-buffer; False if it is the one that is loaded.

        Raises:
            InputError: its size differs from the first frame's.
        """
        if gbuffer is self._gbuffer:
            return False
        if (gbuffer.width, gbuffer.height) != (self.width, self.height):
            raise InputError(
                f"{gbuffer.name}: size {gbuffer.width}x{gbuffer.height}: all frames must be {self.width}x{self.height}"
            )
        for name, array in resources.inputs(gbuffer).items():
            if self._buffers[name].size < array.nbytes:
                self._buffers[name] = self.allocate(array.nbytes)
            cl.enqueue_copy(self.device.queue, self._buffers[name], array)
        self._gbuffer = gbuffer
        self.states = self.grid.warp_states(gbuffer.subsurface)
        constants = sampling.Constants.of(self.method, self.width, self.height, gbuffer.projection_x)
        self._constants = constants
        self._buffers["ratio"] = self.upload(constants.ratio)
        return True

    def count_samples(self, frame: int) -> States:
        """The sampling pass's warp states: steps of each warp's hungriest lane. Runs the estimate where counts adapt."""
        if not self.method.adaptive:
            steps: States = np.where(self.states > 0, self.method.num_samples, self.states).astype(np.int32)
            return steps
        method, b = self.method, self._buffers
        arguments = [
            b["setup"],
            b["velocity"],
            b[update.history_names(frame)[0]],
            b["counts"],
            self._has_velocity,
            np.float32(method.sigma0_sq),
            np.float32(method.kappa),
            np.float32(sampling.k_minus_1(method)),
            np.float32(method.b_min),
            np.float32(method.b_max),
        ]
        self._enqueue("estimate", self.grid, self._state_buffer(self.states), 0, self.grid.num_warps, arguments)
        counts = np.empty((self.grid.num_warps, WARP_SIZE), np.uint16)
        cl.enqueue_copy(self.device.queue, counts, b["counts"])
        return np.where(self.states > 0, counts.max(axis=1), self.states).astype(np.int32)

    def states_of(self, step: Step, frame: int) -> States:
        """The warp states of a launch whose inputs are ready."""
        if step.pass_name == "prefilter":
            return step.grid.warp_states()
        return self.count_samples(frame) if step.pass_name == "sampling" else self.states

    def run(self, step: Step, frame: int, states: States) -> None:
        """Enqueue a whole launch, untraced."""
        self.run_warps(step, frame, self._state_buffer(states), 0, step.grid.num_warps)

    def run_warps(
        self,
        step: Step,
        frame: int,
        states: cl.Buffer,
        first_warp: int,
        num_warps: int,
        target: TraceTarget | None = None,
    ) -> cl.Event:
        """Enqueue warps [first_warp, first_warp + num_warps) of a launch, traced where there is a target."""
        arguments = self._arguments(step, frame)
        if target is not None:
            arguments += [target.lanes, target.row_of_warp, np.uint32(target.first_row)]
        return self._enqueue(
            step.pass_name, step.grid, states, first_warp, num_warps, arguments, target is not None
        )

    def upload_states(self, states: npt.NDArray[Any]) -> cl.Buffer:
        """A device buffer of per-warp numbers."""
        return self._state_buffer(states)

    def _state_buffer(self, states: npt.NDArray[Any]) -> cl.Buffer:
        return self.upload(states)

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
        if traced not in self._programs:
            self._programs[traced] = program.build(self.device, self.method, traced)
        if grid not in self._tables:
            from kernels.grid import lane_table

            self._tables[grid] = (self.upload(grid.tiles), self.upload(lane_table(grid.lane_map)))
        tiles, lanes = self._tables[grid]
        kernel = cl.Kernel(self._programs[traced], name)
        size = (np.int32(grid.width), np.int32(grid.height))
        return kernel(
            self.device.queue,
            (num_warps * WARP_SIZE,),
            (WARP_SIZE,),
            np.uint32(first_warp),
            states,
            tiles,
            lanes,
            *size,
            *arguments,
        )

    @property
    def _has_velocity(self) -> np.int32:
        return np.int32(self._gbuffer is not None and self._gbuffer.velocity is not None)

    def _arguments(self, step: Step, frame: int) -> list[Any]:
        """The kernel's arguments between the warp's and the trace's."""
        b, c, method = self._buffers, self._constants, self.method
        if step.pass_name == "setup":
            return [b[n] for n in ("scene_light", "depth", "gbuffer_id", "setup", "profile_id")]
        if step.pass_name == "prefilter":
            return [b["setup"], np.uint32(step.level), np.int32(self.width), np.int32(self.height)]
        if step.pass_name == "sampling":
            names = ("setup", "normal", "profile_id", "counts", "velocity", "scattered")
            return [
                *(b[n] for n in names),
                self._has_velocity,
                np.int32(method.num_samples),
                np.uint32(frame),
                np.int32(self.num_levels),
                b["ratio"],
                c.texels_per_mm_at_cm,
                c.d,
                *c.rate,
                *c.density,
                c.mip_scale,
            ]
        if step.pass_name == "update":
            old, new = update.history_names(frame)
            names = ("scattered", "velocity", "depth", old, "resolved", new)
            return [
                *(b[n] for n in names),
                self._has_velocity,
                np.float32(method.alpha),
                np.float32(method.sigma0_sq),
            ]
        names = ("scene_colour", "profile_id", combine.result_name(method), "albedo", "output")
        return [b[n] for n in names]

    def read(self, name: str) -> npt.NDArray[np.float32]:
        """(height, width, 4) float32: an RGBA16F texture's content."""
        texels = np.empty((self.height, self.width, 4), np.float16)
        cl.enqueue_copy(self.device.queue, texels, self._buffers[name])
        return texels.astype(np.float32)

    def read_levels(self) -> list[npt.NDArray[np.float16]]:
        """The setup texture's levels, each (height, width, 4) float16."""
        packed = np.empty((self.height, self.width + self.width // 2, 4), np.float16)
        cl.enqueue_copy(self.device.queue, packed, self._buffers["setup"])
        levels = [packed[:, : self.width]]
        for k in range(1, self.num_levels):
            top = self.height - (self.height >> k - 1)
            rows = packed[top : top + (self.height >> k)]
            levels.append(rows[:, self.width : self.width + (self.width >> k)])
        return levels
