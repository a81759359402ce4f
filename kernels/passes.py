"""The launches of one frame in order, and the accesses of each pass."""

from __future__ import annotations

from dataclasses import dataclass

from kernels import combine, prefilter, sampling, setup, update
from kernels.access import Access, Program
from kernels.grid import Grid
from kernels.method import Method


@dataclass(frozen=True)
class Step:
    """One kernel launch of a frame. level: the pre-filter's source level, else 0. grid: its CTAs."""

    pass_name: str
    level: int
    grid: Grid

    def program(self, method: Method, frame: int, first_instruction: int = 0) -> Program:
        """The pass's accesses in that frame."""
        return Program(self.pass_name, _accesses(self.pass_name, method, frame), first_instruction)


def list_steps(method: Method, grid: Grid, num_levels: int) -> list[Step]:
    """Every launch of a frame, traced or not; grid: the full screen's."""
    levels = [
        Step("prefilter", k, Grid(max(1, grid.width >> k + 1), max(1, grid.height >> k + 1), grid.tile_order, grid.lane_map))
        for k in range(num_levels - 1)
    ]
    after = ["sampling", *["update"] * method.adaptive, "combine"]
    return [Step("setup", 0, grid), *levels, *(Step(name, 0, grid) for name in after)]


def _accesses(pass_name: str, method: Method, frame: int) -> tuple[Access, ...]:
    return {
        "setup": lambda: setup.ACCESSES,
        "prefilter": lambda: prefilter.ACCESSES,
        "sampling": lambda: sampling.accesses(method, frame),
        "update": lambda: update.accesses(frame),
        "combine": lambda: combine.accesses(method),
    }[pass_name]()
