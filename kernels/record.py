"""Recorder: renders a scene and streams the texel fetches of its passes as a `Trace`, in chunks of
CTAs, in launch order.

While the consumer works on one chunk, the device writes the next. The kernels write packed texels
into rows whose places follow from (warp, step), so a chunk holds the same bits whatever its size
and whatever order the device ran it in.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any

import numpy as np

from kernels import program, resources
from kernels.access import Offsets, Program, States
from kernels.frame import Progress, Scene, advance, check_num_frames, gbuffer_of
from kernels.gbuffer import GBuffer
from kernels.grid import WARPS_PER_CTA, Grid
from kernels.instruction_counts.data import DEFAULT_TARGET, describe
from kernels.lanes import ROW_BYTES, LaneBuffer, LanePool
from kernels.launches import Step, list_steps
from kernels.method import Method
from kernels.opencl.device import Device, open_device
from kernels.passes import pilot, separable, taa
from kernels.pipeline import Pipeline, TraceTarget
from kernels.selfcheck import count_differences
from traces.errors import InputError
from traces.trace import Chunk, Instruction, Launch, Trace

CHUNK_BYTES = 32 << 20


def record(
    scene: Scene,
    method: Method,
    *,
    num_frames: int = 1,
    traced_frames: str | Sequence[int] = "last",
    device: Device | None = None,
    progress: Progress | None = None,
    chunk_bytes: int = CHUNK_BYTES,
    self_check: bool = True,
    instruction_target: str = DEFAULT_TARGET,
) -> Trace:
    """A trace of rendering `scene`; each run of its chunks renders again, with memory that does not
    grow with the frames.

    Args:
        scene: a G-buffer, or a function from frame number to G-buffer.
        method: the settings; its `passes` and `planes` say what is traced.
        num_frames: frames to render; the adaptive method needs some (about 8) for its history to
            settle.
        traced_frames: "last", "all", or frame numbers.
        device: from `open_device`; None opens the first that works.
        progress: called with the finished share, 0 to 1, while chunks are consumed.
        chunk_bytes: aimed size of a chunk's lanes; a chunk holds at least one CTA.
        self_check: compare a small frame with the NumPy reference; the manifest's
            `differing_fetches` says how many differ.
        instruction_target: the instruction set whose machine code the arithmetic between the
            accesses is counted in, one of `instruction_counts.data.TARGETS`.

    Raises:
        InputError: num_frames, traced_frames or instruction_target, or frames of different size.
    """
    check_num_frames(num_frames)
    frames = _list_frames(traced_frames, num_frames)
    device = device or open_device()
    first = gbuffer_of(scene, 0)
    plan = _Plan.of(method, first.width, first.height, frames, instruction_target)
    manifest = {
        "scene": first.name,
        "attribution": first.attribution,
        "width": first.width,
        "height": first.height,
        "method": method.as_dict(),
        "num_frames": num_frames,
        "traced_frames": list(frames),
        "seed": "hash of pixel and frame number",
        "kernel_source_sha256": program.source_hash(),
        "instruction_counts": describe(instruction_target),
        "device": {"name": device.name, "version": device.version},
        "differing_fetches": count_differences(device, method) if self_check else None,
        "versions": _versions(),
    }

    def chunks() -> Iterator[Chunk]:
        return _Recording(plan, scene, num_frames, device, progress, chunk_bytes).chunks()

    textures = resources.textures(first.width, first.height, plan.num_levels)
    return Trace(manifest, textures, plan.instructions, plan.launches, chunks)


def estimate_rows(gbuffer: GBuffer, method: Method, num_traced_frames: int = 1) -> int:
    """Rows of a recording before it is made: exact for the fixed method, the most (b_max
    everywhere) for the adaptive.
    """
    width, height = gbuffer.width, gbuffer.height
    grid = Grid(width, height, method.tile_order, method.lane_map)
    states = grid.warp_states(gbuffer.subsurface)
    steps = list_steps(method, grid, resources.count_levels(width, height, method))
    return num_traced_frames * sum(_most_rows(step, method, states) for step in steps)


def estimate_bytes(gbuffer: GBuffer, method: Method, num_traced_frames: int = 1) -> int:
    """Bytes of the lanes of `estimate_rows`, uncompressed."""
    return estimate_rows(gbuffer, method, num_traced_frames) * ROW_BYTES


def _most_rows(step: Step, method: Method, states: States) -> int:
    """Rows of a launch with every scattering warp at its largest count; 0 if the pass is not
    traced.
    """
    if step.pass_name not in method.passes:
        return 0
    if step.pass_name == "prefilter":
        states = step.grid.warp_states()
    elif step.pass_name == "pilot":
        states = pilot.warp_states(states, method)
    elif step.pass_name == "taa":
        states = taa.warp_states(states)
    elif step.pass_name in ("separable_h", "separable_v"):
        states = separable.warp_steps(states, method)
    elif step.pass_name == "sampling":
        states = np.where(states > 0, method.max_samples, states).astype(np.int32)
    return int(step.program(method, 0).row_offsets(states)[-1])


def _list_frames(traced_frames: str | Sequence[int], num_frames: int) -> tuple[int, ...]:
    """The numbers of the traced frames, ascending."""
    if traced_frames == "last":
        return (num_frames - 1,)
    if traced_frames == "all":
        return tuple(range(num_frames))
    if isinstance(traced_frames, str) or not traced_frames:
        raise InputError(
            f"traced_frames {traced_frames!r}: allowed are 'last', 'all' or frame numbers"
        )
    for frame in traced_frames:
        if not 0 <= frame < num_frames:
            raise InputError(f"traced_frames: {frame}: allowed are 0 to {num_frames - 1}")
    return tuple(sorted(set(traced_frames)))


def _versions() -> dict[str, str]:
    """The packages that decide what a recording holds."""
    names = ("sss-cachesim", "numpy", "pyopencl")
    return {"python": platform.python_version()} | {n: metadata.version(n) for n in names}


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is known before rendering: programs, instructions and launches.

    programs: by (pass, frame parity), as the history textures swap. launch_of: index in `launches`
        by (frame, number of the step).
    """

    method: Method
    num_levels: int
    frames: tuple[int, ...]
    programs: dict[tuple[str, int], Program]
    instructions: list[Instruction]
    launches: list[Launch]
    launch_of: dict[tuple[int, int], int]

    @staticmethod
    def of(method: Method, width: int, height: int, frames: tuple[int, ...], target: str) -> _Plan:
        num_levels = resources.count_levels(width, height, method)
        grid = Grid(width, height, method.tile_order, method.lane_map)
        steps = list_steps(method, grid, num_levels)
        programs: dict[tuple[str, int], Program] = {}
        instructions: list[Instruction] = []
        launches: list[Launch] = []
        launch_of = {}
        for frame in frames:
            for number, step in enumerate(steps):
                if step.pass_name not in method.passes:
                    continue
                key = (step.pass_name, frame % 2)
                if key not in programs:
                    programs[key] = step.program(method, frame, len(instructions), target)
                    instructions += programs[key].instructions(resources.TEXTURE_NAMES)
                launch_of[frame, number] = len(launches)
                launches.append(
                    Launch(
                        frame,
                        step.pass_name,
                        step.grid.num_ctas,
                        WARPS_PER_CTA,
                        programs[key].registers_per_thread,
                        programs[key].shared_bytes,
                        programs[key].trailing_arithmetic,
                    )
                )
        return _Plan(method, num_levels, frames, programs, instructions, launches, launch_of)


@dataclass(eq=False)
class _Pending:
    """A part of a launch that the device is writing."""

    make_chunk: Callable[[Any], Chunk]
    lent: LaneBuffer
    num_rows: int
    share: float


class _Recording:
    """One run over the frames."""

    def __init__(
        self,
        plan: _Plan,
        scene: Scene,
        num_frames: int,
        device: Device,
        progress: Progress | None,
        chunk_bytes: int,
    ) -> None:
        first = gbuffer_of(scene, 0)
        self._plan, self._scene, self._num_frames = plan, scene, num_frames
        self._progress = progress or (lambda share: None)
        self._pipeline = Pipeline(plan.method, first.width, first.height, device)
        method = plan.method
        longest_loop = max(method.max_samples, method.num_pilots, method.num_taps, taa.NUM_STEPS)
        largest_cta = WARPS_PER_CTA * (16 + 3 * longest_loop)
        self._max_rows = max(chunk_bytes // ROW_BYTES, largest_cta)
        self._pool = LanePool(device, self._max_rows)

    def chunks(self) -> Iterator[Chunk]:
        """Render; yield each part of each traced launch while the device works on the next."""
        pending: _Pending | None = None
        for following in self._parts():
            if pending is not None:
                yield self._finish(pending)
            pending = following
        if pending is not None:
            yield self._finish(pending)
        self._progress(1.0)

    def _finish(self, part: _Pending) -> Chunk:
        chunk = part.make_chunk(self._pool.lend(part.lent, part.num_rows))
        self._progress(part.share)
        return chunk

    def _parts(self) -> Iterator[_Pending]:
        """Enqueue frame after frame; one item per part of a traced launch."""
        pipeline, method = self._pipeline, self._plan.method
        last = self._plan.frames[-1]
        for frame in range(last + 1):
            if frame not in self._plan.frames:
                advance(pipeline, self._scene, frame)
                # Wait: otherwise the work, and not the share that is done, would run ahead.
                pipeline.device.queue.finish()
                self._progress((frame + 1) / (last + 1))
                continue
            changed = pipeline.load(gbuffer_of(self._scene, frame))
            done, total = (
                0,
                max(1, sum(_most_rows(s, method, pipeline.states) for s in pipeline.steps)),
            )
            for number, whole_step in enumerate(pipeline.steps):
                step = pipeline.listed(whole_step)
                states = pipeline.states_of(step, frame)
                if (frame, number) in self._plan.launch_of:
                    for part in self._launch(number, step, frame, states):
                        done += part.num_rows
                        part.share = (frame + done / total) / (last + 1)
                        yield part
                elif changed or step.pass_name not in ("setup", "prefilter"):
                    pipeline.run(step, frame, states)

    def _launch(self, number: int, step: Step, frame: int, states: States) -> Iterator[_Pending]:
        """Enqueue a traced launch in parts of whole CTAs that fit a buffer."""
        # A launch over a list has as many CTAs as the list is long.
        launch, num_ctas = self._plan.launch_of[frame, number], step.grid.num_ctas
        self._plan.launches[launch] = replace(self._plan.launches[launch], num_ctas=num_ctas)
        if not num_ctas:
            return
        access = self._plan.programs[step.pass_name, frame % 2]
        offsets = access.row_offsets(states)
        rows_of_cta = offsets[::WARPS_PER_CTA]
        row_buffer = self._pipeline.upload(offsets[:-1].astype(np.uint32))
        state_buffer = self._pipeline.upload(states)
        cta = 0
        while cta < num_ctas:
            end = (
                int(np.searchsorted(rows_of_cta, rows_of_cta[cta] + self._max_rows, side="right"))
                - 1
            )
            first, past = cta * WARPS_PER_CTA, end * WARPS_PER_CTA
            lent = self._pool.take()
            target = TraceTarget(lent.buffer, row_buffer, int(offsets[first]))
            self._pipeline.run_warps(step, frame, state_buffer, first, past - first, target)
            self._pipeline.device.queue.flush()
            part = slice(first, past + 1)
            make = _chunk_maker(
                launch, cta, access, states[first:past], offsets[part] - offsets[first]
            )
            yield _Pending(make, lent, int(offsets[past] - offsets[first]), 0.0)
            cta = end


def _chunk_maker(
    launch: int, first_cta: int, access: Program, states: States, offsets: Offsets
) -> Callable[[Any], Chunk]:
    """Makes the chunk once its lanes are there; its instructions are written while the device still
    works.
    """
    instruction = access.row_instructions(states, offsets)
    return lambda lanes: Chunk(launch, first_cta, offsets, instruction, lanes)


__all__ = ["CHUNK_BYTES", "estimate_bytes", "estimate_rows", "record"]
