"""Separable passes: the setup texture filtered along x into `tex`, and that along y into
`scattered`.

[JZJ15] and facts sheet 5; the taps are those of `separable_taps`. The twin of separable.cl,
operation by operation. A tap is a bilinear fetch of colour and depth and a gather of the same
texels' profile ids: since texels that do not scatter hold 0, the fetched texel divided by the share
of its texels that scatter is the mean of those, and constant light comes out constant at
silhouettes too. Taps beyond the frame count nothing and fetch nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access, States
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes.separable_taps import make_taps
from kernels.passes.setup import texels
from traces.texture import INACTIVE_TEXEL, pack_texel

if TYPE_CHECKING:
    from kernels.passes.constants import Constants
    from kernels.passes.state import DeviceState

_F = np.float32
_ONE = _F(1)
_HALF = _F(0.5)
Texels = npt.NDArray[np.uint32]


def depth_falloff(projection_x: float) -> np.float32:
    """1/cm: how fast a tap's weight falls with its difference in depth. Facts sheet 5."""
    return _F(0.03 * projection_x)


def warp_steps(states: States, method: Method) -> States:
    """The passes' warp states: a turn of the loop for each tap but the centre's."""
    steps: States = np.where(states > 0, method.num_taps - 1, states).astype(np.int32)
    return steps


@dataclass(frozen=True)
class Separable:
    """One of the two passes. vertical: the second."""

    vertical: bool

    @property
    def source(self) -> str:
        return "tex" if self.vertical else "setup"

    @property
    def target(self) -> str:
        return "scattered" if self.vertical else "tex"

    def accesses(self, method: Method, frame: int) -> tuple[Access, ...]:
        """The pass's traced accesses."""
        colour = "colour" in method.planes
        ids = "profile_id" in method.planes
        return (
            *[Access(self.source)] * colour,
            *[Access(self.source, footprint="bilinear", in_loop=True)] * colour,
            *[Access("profile_id", footprint="bilinear", in_loop=True)] * ids,
            Access(self.target, "store"),
        )

    def arguments(self, state: DeviceState, level: int, frame: int) -> list[Any]:
        """The kernel's arguments between the warp's and the trace's."""
        names = (self.source, "profile_id", self.target, "taps")
        return [
            *(state.buffers[name] for name in names),
            state.constants.texels_per_mm_at_cm,
            state.depth_falloff,
        ]

    def reference(
        self,
        grid: Grid,
        textures: dict[str, Any],
        method: Method,
        constants: Constants,
        falloff: np.float32,
    ) -> list[Texels]:
        """Write the grid's pixels of `tex` or `scattered`; the texels of each access, those of the
        loop (num_steps, num_warps, 32).
        """
        image = textures[self.source] if self.vertical else textures[self.source][0]
        source, ids = image.astype(_F), textures["profile_id"] > 0
        centre = np.where(grid.inside[..., None], grid.gather(source), _F(0))
        scatters = centre[..., 3] > 0
        x, y = (np.where(grid.inside, at, 0) for at in grid.lanes)
        middle, size = (
            (grid.lanes[1], grid.height) if self.vertical else (grid.lanes[0], grid.width)
        )

        taps = make_taps(method)
        sums = taps[0, 1:] * centre[..., :3]
        totals = np.broadcast_to(taps[0, 1:], sums.shape)
        texels_per_mm = constants.texels_per_mm_at_cm / np.where(scatters, centre[..., 3], _ONE)
        fetched: list[Texels] = []
        for tap in taps[1:]:
            at = middle.astype(_F) + _HALF + tap[0] * texels_per_mm
            active = scatters & (at >= 0) & (at < size)
            clamped = np.clip(at, _HALF, _F(size) - _HALF) - _HALF
            first = clamped.astype(np.int32)
            second = np.minimum(first + 1, size - 1)
            of_second = clamped - first.astype(_F)
            of_first = _ONE - of_second
            near, far = ((first, x), (second, x)) if self.vertical else ((y, first), (y, second))
            filtered = source[near] * of_first[..., None] + source[far] * of_second[..., None]
            coverage = np.where(ids[near], of_first, _F(0)) + np.where(ids[far], of_second, _F(0))
            counts = active & (coverage > 0)
            behind = filtered[..., 3] / np.where(counts, coverage, _ONE) - centre[..., 3]
            kept = _ONE - np.minimum(falloff * np.abs(behind), _ONE)
            weight = tap[1:] * np.where(counts, kept, _F(0))[..., None]
            sums = sums + weight * filtered[..., :3]
            totals = totals + weight * coverage[..., None]
            fetched.append(np.where(active, pack_texel(0, *near), INACTIVE_TEXEL))

        fourth = np.full(x.shape, 2 * method.num_taps, _F) if self.vertical else centre[..., 3]
        result = np.concatenate([sums / totals, fourth[..., None]], axis=-1)
        result = np.where(scatters[..., None], result, _F(0))
        encode = resources.to_half if self.vertical else resources.to_setup
        textures[self.target] = grid.scatter_into(textures[self.target], encode(result))

        everywhere, loop = texels(grid, grid.inside), np.array(fetched)
        found = self.accesses(method, 0)
        return [loop if access.in_loop else everywhere for access in found]


HORIZONTAL, VERTICAL = Separable(vertical=False), Separable(vertical=True)
