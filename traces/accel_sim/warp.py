"""One warp's instructions as accesses of a Trace: what each access waits for follows from the
registers.

An instruction that reads or writes the destination register of a load waits for it, and in our
Trace for all the warp's loads before it. Only the register that a line names counts, as in
Accel-Sim's scoreboard, not those that a wide load also fills.
"""

from __future__ import annotations

from typing import NamedTuple

from traces.accel_sim.lines import Line
from traces.accel_sim.opcodes import EXIT, NOP
from traces.trace import WAIT

Arithmetic = tuple[tuple[str, int], ...]


class Access(NamedTuple):
    """What tells the static access instructions of a kernel apart; fields as in `Instruction`."""

    operation: str
    access_bytes: int
    arithmetic: Arithmetic
    num_outstanding: int


class Warp:
    """Follows a warp through its instructions."""

    def __init__(self) -> None:
        self._loading: dict[str, int] = {}
        self._num_loads = 0
        #: Loads that are known to be back: the first ones.
        self._num_done = 0
        self._arithmetic: list[tuple[str, int]] = []

    def access(self, line: Line, operation: str) -> Access:
        """The access that a line makes."""
        num_outstanding = self._wait_for(line)
        if self._arithmetic and self._arithmetic[-1][0] == WAIT:
            _, earlier = self._arithmetic.pop()
            num_outstanding = earlier if num_outstanding < 0 else num_outstanding
        made = Access(operation, line.width, tuple(self._arithmetic), num_outstanding)
        self._arithmetic = []
        if operation != "store":
            if line.destination:
                self._loading[line.destination] = self._num_loads
            self._num_loads += 1
        return made

    def other(self, line: Line, opcode: str, kind: str) -> None:
        """Anything else: one instruction of `kind`, which may wait as well.

        opcode: without modifiers. A NOP with registers is an export's way to wait, nothing more.
        """
        num_outstanding = self._wait_for(line)
        if num_outstanding >= 0:
            if self._arithmetic and self._arithmetic[-1][0] == WAIT:
                self._arithmetic.pop()
            self._arithmetic.append((WAIT, num_outstanding))
        if opcode == NOP and line.registers:
            return
        if self._arithmetic and self._arithmetic[-1][0] == kind:
            kind, count = self._arithmetic.pop()
            self._arithmetic.append((kind, count + 1))
        else:
            self._arithmetic.append((kind, 1))
        self._loading.pop(line.destination, None)

    def trailing(self, last_opcode: str) -> Arithmetic:
        """What follows the last access; the exit at the end is every warp's and does not count."""
        rest = self._arithmetic
        if last_opcode == EXIT and rest and rest[-1][0] == "control":
            rest = [*rest[:-1], ("control", rest[-1][1] - 1)] if rest[-1][1] > 1 else rest[:-1]
        return tuple(rest[:-1] if rest and rest[-1][0] == WAIT else rest)

    def _wait_for(self, line: Line) -> int:
        """How many loads may be in flight when the line issues; -1 if it waits for none."""
        needed = 0
        for name in line.registers:
            needed = max(needed, self._loading.get(name, -1) + 1)
        if needed <= self._num_done:
            return -1
        self._num_done = needed
        return self._num_loads - needed
