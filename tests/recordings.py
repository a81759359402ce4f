"""Recordings held to the NumPy reference's launches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from traces.trace import Trace


def assert_launches_equal(trace: Trace, launches: Sequence[Any]) -> None:
    """A recording has these launches, each a (step, offsets, lanes) of the reference, bit for bit,
    however it is cut into chunks.
    """
    chunks = list(trace.chunks())
    assert [v.pass_name for v in trace.launches] == [step.pass_name for step, _, _ in launches]
    for number, (step, offsets, lanes) in enumerate(launches):
        assert trace.launches[number].num_ctas == step.grid.num_ctas
        mine = [chunk for chunk in chunks if chunk.launch == number]
        if not step.grid.num_ctas:
            assert not mine
            continue
        rows = np.concatenate([np.diff(chunk.warp_offsets) for chunk in mine])
        assert np.array_equal(rows, np.diff(offsets)), step.pass_name
        assert np.array_equal(np.concatenate([c.lanes for c in mine]), lanes), step.pass_name
