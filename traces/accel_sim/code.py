"""The instruction lines of a warp, with registers that make it wait where its Trace waits.

An access takes destination registers; what must come after its data names them as sources, and so
Accel-Sim's scoreboard holds it back. The lines of one access of the Trace depend on which registers
are in flight before it, and on nothing else: each such case is made once, with program counters of
its own, and then reused, as a loop's code is.

    R2            addresses                    R4 to R6     chains of integer arithmetic
    R28 to R30    chains of FMAs; R28 is also what stores write
    R32 to R34    chains of the special unit
    R8 to R27, then R36 to R254                loads in flight, from R8 again once all are back
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from traces.accel_sim.opcodes import EXIT, NOP, access_opcode, arithmetic_opcode
from traces.errors import unknown
from traces.trace import ARITHMETIC_KINDS, WAIT, Instruction

ADDRESS_REGISTER, STORE_REGISTER = "R2", "R28"
_CHAINS = {"int": 4, "fp32": 28, "sfu": 32}
_NUM_CHAINS = 3
LOAD_REGISTERS = tuple(f"R{number}" for number in (*range(8, 28), *range(36, 255)))
#: Source registers that Accel-Sim reads from a line.
MAX_SOURCES = 4
_INSTRUCTION_BYTES = 16
_ALL_LANES = "ffffffff"
#: Cases that are kept; beyond, all are made again.
_MAX_CASES = 1 << 13


class State(NamedTuple):
    """What a warp has in flight.

    pending: the registers of each load that was not yet waited for, oldest first. place: in
        `LOAD_REGISTERS`, where to look for the next one.
    """

    pending: tuple[tuple[str, ...], ...] = ()
    place: int = 0


@dataclass(frozen=True)
class Case:
    """One access of the Trace as lines.

    before: the lines before those of the access. accesses: per line of the access, what stands
        before the mask and what between mask and addresses. num_lines: of both. state: thereafter.
    """

    before: str
    accesses: tuple[tuple[str, str], ...]
    num_lines: int
    state: State


class Code:
    """Makes the lines of one kernel.

    instructions: of the Trace. access_bytes: per instruction, what its lines say. Raises:
    InputError: arithmetic of an unknown kind.
    """

    def __init__(
        self,
        instructions: Sequence[Instruction],
        access_bytes: Sequence[int],
        binary_version: int,
    ) -> None:
        self._instructions = instructions
        self._binary_version = binary_version
        self._opcodes = [
            access_opcode(i.operation, size, binary_version)
            for i, size in zip(instructions, access_bytes, strict=True)
        ]
        self._access_bytes = access_bytes
        self._cases: dict[tuple[State, int, int], Case] = {}
        self._ends: dict[tuple[State, tuple[tuple[str, int], ...]], tuple[str, int]] = {}
        self._next_pc = 0

    def access(self, state: State, instruction: int, num_lines: int) -> Case:
        """The lines of one access that is `num_lines` instruction lines long."""
        key = state, instruction, num_lines
        case = self._cases.get(key)
        if case is None:
            if len(self._cases) >= _MAX_CASES:
                self._cases.clear()
            case = self._cases[key] = self._make(*key)
        return case

    def end(self, state: State, arithmetic: tuple[tuple[str, int], ...]) -> tuple[str, int]:
        """The arithmetic after the last access and the exit: lines, and how many."""
        key = state, arithmetic
        if key not in self._ends:
            if len(self._ends) >= _MAX_CASES:
                self._ends.clear()
            # What only the exit would wait for holds back nothing.
            lines, _, _ = self._arithmetic(arithmetic, state.pending)
            lines.append(self._line("0", EXIT, ()))
            self._ends[key] = "".join(lines), len(lines)
        return self._ends[key]

    def exit(self) -> tuple[str, int]:
        """The lines of a warp that does nothing, and how many."""
        return self.end(State(), ())

    def _make(self, state: State, index: int, num_lines: int) -> Case:
        instruction = self._instructions[index]
        lines, due, pending = self._arithmetic(instruction.arithmetic, state.pending)
        if instruction.num_outstanding >= 0:
            newly, pending = _wait(pending, instruction.num_outstanding)
            due += newly
        opcode, size = self._opcodes[index], self._access_bytes[index]
        if instruction.operation == "store":
            due = self._name_some(lines, due, MAX_SOURCES - 2)
            heads = [
                self._access_head("0", opcode, (ADDRESS_REGISTER, STORE_REGISTER, *named), size)
                for named in (due, *[()] * (num_lines - 1))
            ]
            return Case(
                "".join(lines),
                tuple(heads),
                len(lines) + num_lines,
                state._replace(pending=pending),
            )
        # The last of the registers that must be back is free to be loaded again.
        due = self._name_some(lines, due, MAX_SOURCES)
        registers, pending, place = _take(due[-1:], num_lines, pending, state.place)
        heads = [
            self._access_head(f"1 {register}", opcode, (ADDRESS_REGISTER, *named), size)
            for register, named in zip(registers, (due[:-1], *[()] * (num_lines - 1)), strict=True)
        ]
        after = State((*pending, registers), place)
        return Case("".join(lines), tuple(heads), len(lines) + num_lines, after)

    def _arithmetic(
        self, arithmetic: tuple[tuple[str, int], ...], pending: tuple[tuple[str, ...], ...]
    ) -> tuple[list[str], tuple[str, ...], tuple[tuple[str, ...], ...]]:
        """Lines, the registers that the next line has to name, and what stays pending."""
        lines: list[str] = []
        due: tuple[str, ...] = ()
        for kind, count in arithmetic:
            if kind == WAIT:
                newly, pending = _wait(pending, count)
                due += newly
            elif kind not in ARITHMETIC_KINDS:
                raise unknown("kind of arithmetic", kind, (*ARITHMETIC_KINDS, WAIT))
            elif count:
                due = self._name_some(lines, due, MAX_SOURCES)
                lines += [
                    self._unit_line(kind, c, due if c == 0 else due[-1:]) for c in range(count)
                ]
                due = ()
        return lines, due, pending

    def _unit_line(self, kind: str, number: int, due: tuple[str, ...]) -> str:
        """Number `number` of a run of arithmetic, which needs the registers `due`."""
        opcode = arithmetic_opcode(kind, self._binary_version)
        if kind not in _CHAINS:
            return self._line("0", opcode, due)
        chain = f"R{_CHAINS[kind] + number % _NUM_CHAINS}"
        # The chain is waited for as a destination, too, where there is no room for another source.
        sources = (*due, chain) if len(due) < MAX_SOURCES else due
        return self._line(f"1 {chain}", opcode, sources)

    def _name_some(self, lines: list[str], due: tuple[str, ...], room: int) -> tuple[str, ...]:
        """Add lines that do nothing but wait for registers, until no more than `room` are left."""
        while len(due) > room:
            lines.append(self._line("0", NOP, due[:MAX_SOURCES]))
            due = due[MAX_SOURCES:]
        return due

    def _line(self, destination: str, opcode: str, sources: tuple[str, ...]) -> str:
        return f"{self._pc()} {_ALL_LANES} {_text(destination, opcode, sources)} 0 0\n"

    def _access_head(
        self, destination: str, opcode: str, sources: tuple[str, ...], size: int
    ) -> tuple[str, str]:
        return f"{self._pc()} ", f" {_text(destination, opcode, sources)} {size} "

    def _pc(self) -> str:
        pc = f"{self._next_pc:04x}"
        self._next_pc += _INSTRUCTION_BYTES
        return pc


def _text(destination: str, opcode: str, sources: tuple[str, ...]) -> str:
    return " ".join((destination, opcode, str(len(sources)), *sources))


def _wait(
    pending: tuple[tuple[str, ...], ...], num_outstanding: int
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """The registers of all pending loads but the latest `num_outstanding`, and those loads."""
    num_done = max(0, len(pending) - num_outstanding)
    done = tuple(register for load in pending[:num_done] for register in load)
    return done, pending[num_done:]


def _take(
    free: tuple[str, ...],
    num_lines: int,
    pending: tuple[tuple[str, ...], ...],
    place: int,
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...], int]:
    """Destination registers for `num_lines` lines, `free` before others; what stays pending; and
    the next place.

    When all registers are in flight, the oldest load's are taken and so waited for.
    """
    if not pending:
        place = 0
    while sum(map(len, pending)) + num_lines > len(LOAD_REGISTERS):
        pending = pending[1:]
    busy = {register for load in pending for register in load}
    taken = list(free)
    while len(taken) < num_lines:
        register = LOAD_REGISTERS[place]
        place = (place + 1) % len(LOAD_REGISTERS)
        if register not in busy and register not in taken:
            taken.append(register)
    return tuple(taken), pending, place


__all__ = ["LOAD_REGISTERS", "Case", "Code", "State"]
