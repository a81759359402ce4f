"""Small machines and tiny traces for the tests of the timing model, and ways to run them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cachesim import presets
from cachesim.config import Gpu
from cachesim.timing import engine
from cachesim.timing.clock import Clock
from cachesim.timing.network import arrival, pop, transfer
from cachesim.timing.room import with_more_room
from cachesim.timing.state import State
from traces.lane_address import lane_address_trace
from traces.texture import INACTIVE_ADDRESS, WARP_SIZE
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

BASE = 0x7F40_0000_0000
GPGPUSIM = "titan-x-pascal-gpgpusim"
#: One SM, an L1 that loads enter, one L2 slice, memory in step with the core, launches at once.
ONE_SM = (
    "sm.count=1",
    "l1.bypass_loads=false",
    "sm_timing.launch_cycles=0",
    "l2.capacity=128KiB",
    "l2.num_channels=1",
    "l2.slices_per_channel=1",
    "l2.partition_hash=linear",
    "dram_timing.clock_hz=1417000000",
)


def one_sm(*overrides: str, preset: str = GPGPUSIM) -> Gpu:
    """GPGPU-Sim's TITAN X cut down to one SM and one slice, and what a test changes of it."""
    return presets.load(preset, [*ONE_SM, *overrides])


def single_lane(
    offsets: Sequence[Sequence[int]] | npt.NDArray[np.int64],
    *,
    warps_per_cta: int = 1,
    loads_in_flight: int = 1,
    compute_per_load: int = 0,
    stores: Sequence[bool] | None = None,
    bytes_per_lane: int = 4,
) -> Trace:
    """(warps, loads) byte offsets, one active lane per access."""
    array = np.asarray(offsets, np.int64)
    addresses = np.zeros((*array.shape, WARP_SIZE), np.uint64)
    addresses[:, :, 0] = (BASE + array).astype(np.uint64)
    return lane_address_trace(
        addresses,
        warps_per_cta=warps_per_cta,
        loads_in_flight=loads_in_flight,
        compute_per_load=compute_per_load,
        bytes_per_lane=bytes_per_lane,
        stores=None if stores is None else np.array(stores),
    )


def sectors(
    offsets: npt.NDArray[np.int64],
    *,
    warps_per_cta: int = 1,
    loads_in_flight: int = 1,
    compute_per_load: int = 0,
    stores: Sequence[bool] | None = None,
) -> Trace:
    """(warps, loads, sectors) byte offsets of 32 B sectors, up to four per access: eight lanes
    of 4 B read each.
    """
    warps, loads, count = offsets.shape
    addresses = np.zeros((warps, loads, WARP_SIZE), np.uint64)
    each = (BASE + offsets).astype(np.uint64)[..., None] + np.arange(8, dtype=np.uint64) * 4
    addresses[:, :, : count * 8] = each.reshape(warps, loads, count * 8)
    return lane_address_trace(
        addresses,
        warps_per_cta=warps_per_cta,
        loads_in_flight=loads_in_flight,
        compute_per_load=compute_per_load,
        bytes_per_lane=4,
        stores=None if stores is None else np.array(stores),
    )


def program(
    steps: Sequence[tuple[Instruction, int]],
    num_warps: int = 1,
    warps_per_cta: int = 1,
    trailing: tuple[tuple[str, int], ...] = (),
    **launch: Any,
) -> Trace:
    """Every warp runs the same accesses: (instruction, offset of lane 0, -1 = fully masked)."""
    known: dict[Instruction, int] = {}
    index = [known.setdefault(one, len(known)) for one, _ in steps]
    lanes = np.full((len(steps), WARP_SIZE), INACTIVE_ADDRESS, np.uint64)
    for row, (_, offset) in enumerate(steps):
        if offset >= 0:
            lanes[row, 0] = BASE + offset
    offsets = np.arange(num_warps + 1, dtype=np.int64) * len(steps)
    chunk = Chunk(
        0,
        0,
        offsets,
        np.tile(np.array(index, np.uint16), num_warps),
        np.tile(lanes, (num_warps, 1)),
    )
    one = Launch(
        0,
        "pass",
        num_warps // warps_per_cta,
        warps_per_cta,
        trailing_arithmetic=trailing,
        **launch,
    )
    # Without accesses there is still an instruction table.
    return from_chunks([chunk], [], list(known) or [load()], [one])


def load(
    *arithmetic: tuple[str, int], num_outstanding: int = -1, operation: str = "load"
) -> Instruction:
    """A 4-byte access of a lane-address trace."""
    return Instruction(
        "pass",
        -1,
        operation,
        access_bytes=4,
        arithmetic=arithmetic,
        num_outstanding=num_outstanding,
    )


def in_turn(*traces: Trace) -> Trace:
    """Launches of several lane-address traces, one after the other."""
    instructions: list[Instruction] = []
    chunks: list[Chunk] = []
    launches: list[Launch] = []
    for trace in traces:
        for chunk in trace.chunks():
            chunks.append(
                Chunk(
                    len(launches) + chunk.launch,
                    chunk.first_cta,
                    chunk.warp_offsets,
                    (chunk.instruction + len(instructions)).astype(np.uint16),
                    chunk.lanes,
                )
            )
        instructions += trace.instructions
        launches += trace.launches
    return from_chunks(chunks, [], instructions, launches)


def timed(trace: Trace, gpu: Gpu, path: str | None = None, **options: Any) -> Clock:
    """A clock that has run the trace."""
    clock = Clock(trace, gpu, path, **options)
    for chunk in trace.chunks():
        clock.add(chunk)
    clock.finish()
    return clock


def cycles_of(trace: Trace, gpu: Gpu, path: str | None = None) -> int:
    """Cycles of the last launch, without the launch latency."""
    last = timed(trace, gpu, path).launches[-1]
    return last.cycles - last.launch_cycles


def stepped(trace: Trace, gpu: Gpu, path: str | None = None) -> Iterator[State]:
    """The machine's state after every cycle of a trace of one launch."""
    clock = Clock(trace, gpu, path)
    clock._run = lambda: None  # type: ignore[method-assign]
    for chunk in trace.chunks():
        clock.add(chunk)
    clock.state.pool.machine[0]["complete"] = 1
    while True:
        why = engine.run(clock.state, clock.cycles + 1)
        if why == engine.NEEDS_ROOM:
            clock.state = with_more_room(clock.state)
            continue
        assert why in (engine.DONE, engine.PAUSED)
        yield clock.state
        if why == engine.DONE:
            return


def taken(machine: Any, net: Any, cycles: int) -> list[list[tuple[int, int]]]:
    """Per output of a network, (cycle, packet) in the order they can be taken."""
    found: list[list[tuple[int, int]]] = [[] for _ in net.outputs]
    for now in range(cycles):
        for output, packets in enumerate(found):
            while arrival(net, output) <= now:
                packets.append((now, int(pop(net, output)[0])))
        transfer(machine, net, now)
    return found


def held_in(clock: Clock) -> dict[str, int]:
    """Everything that holds a request or a warp: all 0 when the machine is idle."""
    state = clock.state
    held: dict[str, int] = {}
    for name in ("l1", "gl1", "l2", "llc"):
        tags = getattr(state, name)
        for queue in ("in", "delay", "miss", "down", "fill", "out"):
            held[f"{name}.{queue}"] = int(tags.nodes[f"{queue}_count"].sum())
        held[f"{name}.mshrs"] = int(tags.nodes["mshr_used"].sum())
        held[f"{name}.ready"] = int((tags.nodes["ready_first"] >= 0).sum())
        held[f"{name}.chains"] = int((tags.mshr_buckets >= 0).sum())
        held[f"{name}.reserved"] = int((tags.lines["reserved"] != 0).sum())
        held[f"{name}.reserved lines"] = int(tags.sets["reserved_lines"].sum())
    for name in ("up", "down"):
        net = getattr(state, name)
        held[f"{name}.inputs"] = int(net.inputs["count"].sum()) + int(net.scalars[0])
        held[f"{name}.outputs"] = int(net.outputs["count"].sum())
    for field in ("response_count", "in_banks", "fragment_count", "request_count", "result_count"):
        held[f"pipe.{field}"] = int(state.pipes[field].sum())
    for field in ("warp", "next_writeback", "next_global"):
        held[f"pipe.{field}"] = int((state.pipes[field] >= 0).sum())
    for field in ("resident", "blocked"):
        held[f"sm.{field}"] = int(np.count_nonzero(state.sms[field]))
    for field in ("num_resident", "num_timed", "num_collecting", "eject_count"):
        held[f"sm.{field}"] = int(state.sms[field].sum())
    held["sm.queues"] = int(state.sms["queue_count"].sum())
    held["warps"] = int(state.warps["alive"].sum())
    channels = state.memory.channels
    for field in ("latency", "entry", "data", "return"):
        held[f"dram.{field}"] = int(channels[f"{field}_count"].sum())
    for field in ("pending", "num_serving", "shared_credit", "private_credit"):
        held[f"dram.{field}"] = int(channels[field].sum())
    held["dram.serving"] = int((state.memory.banks["serving"] >= 0).sum())
    return held
