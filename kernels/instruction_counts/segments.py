"""Counts the instructions of a way through a kernel between its accesses, with the waits.

A wait of the machine code is for the results that one counter stands for. Here it becomes a wait
for all the warp's traced loads up to the latest of those: in the trace loads answer in order. Waits
for what the trace does not hold (special registers, tables, transcendentals) are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from kernels.instruction_counts.machine import CHARGED_KINDS, MachineCode
from traces.trace import WAIT

#: What is issued between two accesses, as `Instruction.arithmetic`.
Segment = tuple[tuple[str, int], ...]


def join(*segments: Segment) -> Segment:
    """Segments in a row as one: counts of a kind are added up between two waits."""
    found: list[tuple[str, int]] = []
    run: dict[str, int] = {}
    for kind, count in (pair for segment in segments for pair in segment):
        if kind != WAIT:
            run[kind] = run.get(kind, 0) + count
            continue
        found += run.items()
        if found and found[-1][0] == WAIT and not run:
            count = min(count, found.pop()[1])
        found.append((WAIT, count))
        run = {}
    return (*found, *run.items())


def to_text(segment: Segment) -> str:
    """Such as "int 12 wait 0 fp32 3"."""
    return " ".join(f"{kind} {count}" for kind, count in segment)


def from_text(text: str) -> Segment:
    """The inverse of `to_text`."""
    words = text.split()
    return tuple((kind, int(count)) for kind, count in zip(words[::2], words[1::2], strict=True))


class Walk:
    """A warp on its way: the loads that it has issued, and those that it has waited for.

    access_of: the access of each traced load and store, by instruction: any hashable name, the same
    for all instructions that fetch parts of one texel.
    """

    def __init__(self, code: MachineCode, access_of: dict[int, str]) -> None:
        self._code = code
        self._access_of = access_of
        self._num_issued = 0
        self._num_done = 0
        self._pending: dict[int, list[int]] = {}

    def take(self, instructions: Iterable[int]) -> tuple[list[Segment], list[str]]:
        """The segments before each access and after the last, and the accesses in order. An access
        is where its first instruction is.
        """
        segments: list[Segment] = []
        accesses: list[str] = []
        numbers: dict[str, int] = {}
        current: list[tuple[str, int]] = []
        for i in instructions:
            instruction = self._code.instructions[i]
            for counter, num_pending in instruction.waits:
                current += self._wait(counter, num_pending)
            access = self._access_of.get(i)
            if access is not None and access not in accesses:
                segments.append(join(tuple(current)))
                current = []
                accesses.append(access)
                if instruction.access == "load":
                    numbers[access] = self._num_issued
                    self._num_issued += 1
            if instruction.barrier >= 0:
                number = numbers.get(access, -1) if access is not None else -1
                self._pending.setdefault(instruction.barrier, []).append(number)
            if instruction.kind in CHARGED_KINDS:
                current.append((instruction.kind, 1))
        return [*segments, join(tuple(current))], accesses

    def _wait(self, counter: int, num_pending: int) -> list[tuple[str, int]]:
        pending = self._pending.get(counter, [])
        end = max(0, len(pending) - num_pending)
        latest = max(pending[:end], default=-1)
        self._pending[counter] = pending[end:]
        if latest < self._num_done:
            return []
        self._num_done = latest + 1
        return [(WAIT, self._num_issued - 1 - latest)]


def total(segments: Sequence[Segment]) -> dict[str, int]:
    """Instructions of each kind."""
    found = dict.fromkeys(CHARGED_KINDS, 0)
    for kind, count in (pair for segment in segments for pair in segment):
        if kind != WAIT:
            found[kind] += count
    return found
