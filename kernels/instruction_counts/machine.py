"""What the count needs to know of a machine instruction, the same for every instruction set."""

from __future__ import annotations

from dataclasses import dataclass

#: Kinds that the timing model charges, and "memory", which are the trace's own accesses.
CHARGED_KINDS = ("int", "fp32", "sfu", "control")
MEMORY = "memory"


class CountError(Exception):
    """The machine code is not of a form that can be counted; one line that says why."""


@dataclass(frozen=True)
class MachineInstruction:
    """One machine instruction of a kernel.

    text: as disassembled. kind: one of `CHARGED_KINDS`, `MEMORY`, or "" where nothing is issued.
    writes, reads: registers by name.
    access: "load" or "store" of global memory, else "". address: registers of that address.
    arguments: (register, byte offset) of kernel arguments that it reads into registers; the
        register "" stands for everything written.
    barrier: the counter that tells when its result is there, -1 where none does.
    waits: (counter, n): holds the warp until at most n of the counter's instructions are pending.
    target: label that it may branch to. falls_through: the next instruction may follow.
    is_call: of a subroutine. is_exit: a warp may end here.
    """

    text: str
    kind: str
    writes: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    access: str = ""
    address: tuple[str, ...] = ()
    arguments: tuple[tuple[str, int], ...] = ()
    barrier: int = -1
    waits: tuple[tuple[int, int], ...] = ()
    target: str = ""
    falls_through: bool = True
    is_call: bool = False
    is_exit: bool = False

    @property
    def ends_block(self) -> bool:
        return bool(self.target) or self.is_exit or not self.falls_through


@dataclass(frozen=True)
class MachineCode:
    """A compiled kernel. instructions: in layout order. labels: name to index in `instructions`.
    registers_per_thread, shared_bytes: as the compiler reports them. argument_registers:
    registers that hold the address of the kernel's arguments at the start.
    """

    name: str
    instructions: tuple[MachineInstruction, ...]
    labels: dict[str, int]
    registers_per_thread: int
    shared_bytes: int
    argument_registers: tuple[str, ...] = ()
