"""The SM's clock rate while something is measured."""

from __future__ import annotations

from ctypes import c_uint64

import numpy as np

from experiments.silicon.session import Session

SPIN_NS = 1_000_000


def measure_clock(session: Session) -> float:
    """Hz: cycles over nanoseconds of a kernel that spins."""
    gpu = session.gpu
    out = gpu.allocate(32)
    gpu.launch(
        session.micro().function("clock_rate"), 1, 1, c_uint64(SPIN_NS), c_uint64(out.address)
    )
    begin_ns, end_ns, begin, end = (int(v) for v in gpu.read(out, np.uint64, 4))
    gpu.free(out)
    if end_ns <= begin_ns:
        raise ValueError(f"the GPU's timer stands still: {begin_ns} to {end_ns} ns")
    return (end - begin) / (end_ns - begin_ns) * 1e9
