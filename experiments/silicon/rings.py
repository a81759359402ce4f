"""Rings of pointers in device memory, and what following one costs."""

from __future__ import annotations

from ctypes import c_uint, c_uint64
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.silicon.driver import Memory
from experiments.silicon.session import Session

LINE_BYTES = 128
#: Steps before the clock starts, so that what fits into a cache is there; and steps that are timed.
MAX_WARM_STEPS, MIN_STEPS, MAX_STEPS = 400_000, 2048, 32768


def random_order(count: int) -> npt.NDArray[np.uint32]:
    """The places of a ring in the order in which it is followed."""
    order: npt.NDArray[np.uint32] = (
        np.random.default_rng(count).permutation(count).astype(np.uint32)
    )
    return order


@dataclass(frozen=True)
class Ring:
    """Pointers `stride_bytes` apart in `memory`; the chase starts at `start`."""

    memory: Memory
    start: int
    count: int


def make_ring(session: Session, memory: Memory, order: npt.NDArray[np.uint32], stride: int) -> Ring:
    """Write the ring of that order into memory. stride: bytes between two places."""
    gpu = session.gpu
    assert len(order) * stride <= memory.size_bytes
    places = gpu.upload(order)
    gpu.launch(
        session.micro().function("build_ring"),
        -(-len(order) // 256),
        256,
        c_uint64(memory.address),
        c_uint64(places.address),
        c_uint64(len(order)),
        c_uint64(stride),
    )
    gpu.synchronise()
    gpu.free(places)
    return Ring(memory, memory.address + int(order[0]) * stride, len(order))


def num_steps(count: int) -> tuple[int, int]:
    """(warm, timed) steps for a ring of that many places."""
    return min(max(count, 64), MAX_WARM_STEPS), min(max(count, MIN_STEPS), MAX_STEPS)


def chase(session: Session, kernel: str, ring: Ring) -> float:
    """Cycles per step of one thread that follows the ring."""
    gpu = session.gpu
    warm, timed = num_steps(ring.count)
    out = gpu.allocate(16)
    gpu.launch(
        session.micro().function(kernel),
        1,
        1,
        c_uint64(ring.start),
        c_uint(warm),
        c_uint(timed),
        c_uint64(out.address),
    )
    cycles = int(gpu.read(out, np.uint64, 2)[0])
    gpu.free(out)
    return cycles / timed
