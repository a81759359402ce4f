"""The passes on a device: buffers that live over all frames, and one enqueue per launch or part of
a launch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from kernels import program, resources
from kernels.access import States
from kernels.gbuffer import GBuffer
from kernels.grid import WARPS_PER_CTA, Grid, lane_table
from kernels.launches import PASSES, Step, list_steps
from kernels.method import Method
from kernels.opencl.device import Device
from kernels.passes import classify, estimate, pilot, separable, taa
from kernels.passes.constants import Constants
from kernels.passes.separable_taps import make_taps
from kernels.tiles import CLASS_OF_PASS, ListedGrid, count_tiles
from traces.errors import InputError
from traces.texture import WARP_SIZE

_BYTES = {  # of a device texel, else 8
    **{"depth": 4, "gbuffer_id": 1, "normal": 4, "profile_id": 1},
    **{"past_counts_0": 16, "past_counts_1": 16},
    **{"importance": 1, "tile_class": 1},
}


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
    states, constants, depth_falloff, has_velocity, has_overlay, jitter: of
        the loaded G-buffer.
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
        self.buffers["taps"] = self.upload(make_taps(method))
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
        sizes |= dict.fromkeys(resources.unused_by(self.method), 8)
        if not self.method.filters:
            sizes["tex"] = 8
        if not self.method.hybrid:
            sizes["tile_class"] = 8
        if not self.method.taa:
            sizes |= dict.fromkeys(("taa_0", "taa_1"), 8)
        sizes |= {"velocity": 8, "overlay": 8, "importance": 8, "tile_list": 8}
        return sizes

    def allocate(self, num_bytes: int) -> cl.Buffer:
        """An uninitialised device buffer."""
        return cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, max(8, num_bytes))

    def upload(self, array: npt.NDArray[Any]) -> cl.Buffer:
        """A read-only device buffer that holds the array."""
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.device.context, flags, hostbuf=np.ascontiguousarray(array))

    def _clear_histories(self) -> None:
        for name in resources.CARRIED:
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
        if self.method.hybrid and "painted" in self.method.hybrid_rules:
            if gbuffer.importance is None:
                raise InputError(f"{gbuffer.name}: importance: the rule 'painted' needs it")
        for name, array in resources.inputs(gbuffer).items():
            if self.buffers[name].size < array.nbytes:
                self.buffers[name] = self.allocate(array.nbytes)
            cl.enqueue_copy(self.device.queue, self.buffers[name], array)
        self._gbuffer = gbuffer
        self.states = self.grid.warp_states(gbuffer.subsurface)
        self.jitter = gbuffer.jitter
        self.has_velocity = np.int32(gbuffer.velocity is not None)
        self.has_overlay = np.int32(gbuffer.overlay is not None)
        self.constants = Constants.of(self.method, self.width, self.height, gbuffer.projection_x)
        self.depth_falloff = separable.depth_falloff(gbuffer.projection_x)
        self.buffers["ratio"] = self.upload(self.constants.ratio)
        return True

    def listed(self, step: Step) -> Step:
        """The launch over the tiles of its class alone, where the method lists them and they have
        been classified; else the launch as it is.
        """
        tile_class = CLASS_OF_PASS.get(step.pass_name)
        if not self.method.hybrid or tile_class is None:
            return step
        across, down = count_tiles(self.width, self.height)
        classes = np.empty((down, across), np.uint8)
        cl.enqueue_copy(self.device.queue, classes, self.buffers["tile_class"])
        return replace(step, grid=ListedGrid.of(self.grid, classes, tile_class))

    def _states_on(self, grid: Grid) -> States:
        """The states of a grid's warps, as `states` of the full screen's."""
        if not isinstance(grid, ListedGrid):
            return self.states
        assert self._gbuffer is not None
        return grid.warp_states(self._gbuffer.subsurface)

    def _estimate(self, grid: Grid, frame: int) -> None:
        """Fill the counts of the grid's lanes from the history."""
        states, arguments = self.upload(self._states_on(grid)), estimate.arguments(self, frame)
        self._enqueue("estimate", grid, states, 0, grid.num_warps, arguments)

    def count_samples(self, grid: Grid, frame: int) -> States:
        """The sampling pass's warp states: steps of each warp's hungriest lane. Runs the estimate
        where counts adapt.
        """
        states = self._states_on(grid)
        if not self.method.adaptive:
            steps: States = np.where(states > 0, self.method.num_samples, states).astype(np.int32)
            return steps
        if not grid.num_warps:
            return states
        self._estimate(grid, frame)
        counts = np.empty((grid.num_warps, WARP_SIZE), np.uint16)
        cl.enqueue_copy(self.device.queue, counts, self.buffers["counts"])
        return np.where(states > 0, counts.max(axis=1), states).astype(np.int32)

    def states_of(self, step: Step, frame: int) -> States:
        """The warp states of a launch whose inputs are ready."""
        if step.pass_name == "prefilter":
            return step.grid.warp_states()
        if step.pass_name == "pilot":
            return pilot.warp_states(self.states, self.method)
        if step.pass_name in ("separable_h", "separable_v"):
            return separable.warp_steps(self._states_on(step.grid), self.method)
        if step.pass_name == "classify" and classify.reads_history(self.method):
            self._estimate(self.grid, frame)
        if step.pass_name == "taa":
            return taa.warp_states(self.states)
        if step.pass_name == "sampling":
            return self.count_samples(step.grid, frame)
        return self.states

    def run(self, step: Step, frame: int, states: States) -> None:
        """Enqueue a whole launch, untraced."""
        if step.grid.num_warps:
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
            self._kernels[name, traced] = cl.Kernel(built, program.FUNCTIONS.get(name, name))
        if grid not in self._tables:
            if isinstance(grid, ListedGrid):
                # Lists are made anew for every launch.
                full = {g: t for g, t in self._tables.items() if not isinstance(g, ListedGrid)}
                self._tables = full
            self._tables[grid] = (self.upload(grid.tiles), self.upload(lane_table(grid.lane_map)))
        tiles, lanes = self._tables[grid]
        size = (np.int32(grid.width), np.int32(grid.height))
        items = WARP_SIZE // program.lanes_per_item(self.device, name)
        shares_patch = name == "sampling" and self.method.lds and items == WARP_SIZE
        warps_per_group = WARPS_PER_CTA if name == "classify" or shares_patch else 1
        return self._kernels[name, traced](
            self.device.queue,
            (num_warps * items,),
            (items * warps_per_group,),
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
