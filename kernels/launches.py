"""The launches of one frame in order, and the accesses of each pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

from kernels.access import Access, Program
from kernels.grid import Grid
from kernels.instruction_counts.assign import count_pass
from kernels.instruction_counts.data import DEFAULT_TARGET
from kernels.instruction_counts.segments import join
from kernels.method import PLANES, Method
from kernels.passes import (
    classify,
    combine,
    overlay,
    pilot,
    prefilter,
    sampling,
    separable,
    setup,
    taa,
    update,
)
from kernels.tiles import CLASS_OF_PASS
from traces.trace import WAIT

if TYPE_CHECKING:
    from kernels.passes.state import DeviceState


class Pass(Protocol):
    """What a pass's module offers, beside its NumPy `reference` and the `.cl` file of its name."""

    def accesses(self, method: Method, frame: int) -> tuple[Access, ...]:
        """The traced accesses of its kernel, in program order."""

    def arguments(self, state: DeviceState, level: int, frame: int) -> list[Any]:
        """The kernel's arguments between the warp's and the trace's. level: as in `Step`."""


#: The passes by name; `names_run` says which of them a method runs, and in what order.
PASSES: dict[str, Pass] = {
    "setup": setup,
    "prefilter": prefilter,
    "classify": classify,
    "pilot": pilot,
    "sampling": sampling,
    "separable_h": separable.HORIZONTAL,
    "separable_v": separable.VERTICAL,
    "update": update,
    "combine": combine,
    "overlay": overlay,
    "taa": taa,
}


@dataclass(frozen=True)
class Step:
    """One kernel launch of a frame. level: the pre-filter's source level, else 0. grid: its
    CTAs.
    """

    pass_name: str
    level: int
    grid: Grid

    def program(
        self,
        method: Method,
        frame: int,
        first_instruction: int = 0,
        target: str = DEFAULT_TARGET,
    ) -> Program:
        """The pass's accesses in that frame. target: the instruction set whose machine code is
        counted.

        Raises:
            InputError: an unknown target.
        """
        list_accesses = PASSES[self.pass_name].accesses
        recorded = iter([*list_accesses(method, frame), None])
        following = next(recorded)
        is_recorded = []
        accesses = list_accesses(replace(method, planes=PLANES), frame)
        for access in accesses:
            is_recorded.append(access == following)
            following = next(recorded) if access == following else following
        counted = count_pass(self.pass_name, method, accesses, tuple(is_recorded), target)
        counted_accesses = counted.accesses
        if method.hybrid and self.pass_name in CLASS_OF_PASS:
            counted_accesses = _behind_list(counted_accesses)
        return Program(
            self.pass_name,
            counted_accesses,
            first_instruction,
            counted.trailing,
            counted.registers_per_thread,
            counted.shared_bytes,
        )


def _behind_list(accesses: tuple[Access, ...]) -> tuple[Access, ...]:
    """The accesses of a pass that reads its tile from a list first, and waits for that."""
    wait = ((WAIT, 0),)
    first, *rest = accesses
    first = replace(
        first,
        arithmetic=join(wait, first.arithmetic),
        scattering=None if first.scattering is None else join(wait, first.scattering),
    )
    return (Access("tile_list"), first, *rest)


def names_run(method: Method) -> tuple[str, ...]:
    """The passes that a frame of the method runs, in order."""
    runs = {
        "setup": True,
        "prefilter": method.prefilter and method.samples,
        "classify": method.hybrid,
        "pilot": method.takes_pilots,
        "sampling": method.samples,
        "separable_h": method.filters,
        "separable_v": method.filters,
        "update": method.updates_history,
        "combine": True,
        "overlay": method.overlay,
        "taa": method.taa,
    }
    return tuple(name for name, does in runs.items() if does)


def list_steps(method: Method, grid: Grid, num_levels: int) -> list[Step]:
    """Every launch of a frame, traced or not; grid: the full screen's."""
    steps = []
    for name in names_run(method):
        if name != "prefilter":
            steps.append(Step(name, 0, grid))
            continue
        for level in range(num_levels - 1):
            width, height = grid.width >> level + 1, grid.height >> level + 1
            coarser = Grid(width, height, grid.tile_order, grid.lane_map)
            steps.append(Step(name, level, coarser))
    return steps
