"""Compile the loops ahead of their first use, so that a command can say what it waits for, or do
something else meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from numba import config

from cachesim.simulate import simulate
from traces.synthetic import pixel_pass, stream
from traces.texture import Texture

#: Between them, these presets use every loop of the counting model.
_PRESETS = ("titan-x-pascal", "rx-5700-xt", "h100-sxm")


def compile_loops(*, lane_address: bool = False, timing: bool = False) -> None:
    """Run every loop once on a handful of fetches: about 10 s the first time on a machine, cached
    after.

    lane_address: for traces of byte addresses, whose loops are compiled apart. timing: the clocked
        machine instead of the counting one, about 20 s.
    """
    trace = stream(8, 1) if lane_address else pixel_pass(Texture("t", "RGBA16F", 8, 8), "store")
    with _without_vectors() if timing else nullcontext():
        # The clock's loops are the same for every machine.
        for name in _PRESETS[:1] if timing else _PRESETS:
            simulate(trace, name, threaded=False, timing=timing)


@contextmanager
def _without_vectors() -> Iterator[None]:
    """The loop vectoriser off meanwhile: the clock has nothing for it, and compiles in an eighth
    less time.
    """
    before = config.LOOP_VECTORIZE  # type: ignore[attr-defined]
    config.LOOP_VECTORIZE = 0  # type: ignore[attr-defined]
    try:
        yield
    finally:
        config.LOOP_VECTORIZE = before  # type: ignore[attr-defined]
