"""Pilot pass of two-pass adaptive sampling: a few samples per pixel that measure the variance and
are then discarded, so that the picture's own samples do not depend on how they decided the count.

The sampling kernel with `Method.num_pilots` samples of its own; it writes (count, depth, variance
of the mean, mean) of each pixel, from which the estimate makes the count of the sampling pass.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels.access import Access, States
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes import estimate, sampling
from kernels.passes.constants import Constants

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState


def warp_states(states: States, method: Method) -> States:
    """The pass's warp states: a turn of the loop per pilot."""
    steps: States = np.where(states > 0, method.num_pilots, states).astype(np.int32)
    return steps


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's traced accesses."""
    before, loop = sampling.sample_accesses(method)
    return (*before, *loop, Access("pilot", "store"))


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    number = frame | sampling.PILOT_FRAMES
    return sampling.arguments_for(state, state.method.num_pilots, number, "pilot")


def reference(
    grid: Grid,
    textures: dict[str, Any],
    method: Method,
    constants: Constants,
    num_levels: int,
    frame: int,
) -> list[npt.NDArray[np.uint32]]:
    """Write `pilot`; the texels of each access, as those of `sampling.reference`."""
    depth = grid.gather(textures["setup"][0][..., 3]).astype(np.float32)
    takes = grid.inside & estimate.takes_samples(depth, method, constants)
    counts = np.where(takes, method.num_pilots, 0).astype(np.int32)
    return sampling.reference(
        grid, textures, method, constants, num_levels, frame, counts, pilots=True
    )
