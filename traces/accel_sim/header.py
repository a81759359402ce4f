"""The header of a kernel's trace file: lines of the form `-name = value`."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

#: Written into exported files: that of the format we write, and of the NVBit it came with.
TRACER_VERSION, NVBIT_VERSION = 5, "1.5.5"
#: Below it, instruction lines begin with the CTA's coordinates and the warp.
FIRST_BARE_TRACER_VERSION = 3

_FORMAT = (
    "#traces format = PC mask dest_num [reg_dests] opcode src_num [reg_srcs] mem_width "
    "[adrrescompress?] [mem_addresses] immediate"
)


@dataclass(frozen=True)
class KernelHeader:
    """What a kernel's header says.

    grid, block: (x, y, z), CTAs and threads of a CTA. registers: per thread. binary_version: which
        opcodes. shared_base, local_base: where generic addresses mean shared and local memory.
    tracer_version, has_line_info: what the instruction lines begin with.
    """

    name: str = "kernel"
    id: int = 1
    grid: tuple[int, int, int] = (1, 1, 1)
    block: tuple[int, int, int] = (1, 1, 1)
    shared_bytes: int = 0
    registers: int = 0
    binary_version: int = 0
    shared_base: int = 0
    local_base: int = 0
    tracer_version: int = 0
    has_line_info: bool = False

    @property
    def num_ctas(self) -> int:
        return self.grid[0] * self.grid[1] * self.grid[2]

    @property
    def num_threads(self) -> int:
        """Threads of a CTA."""
        return self.block[0] * self.block[1] * self.block[2]

    def text(self) -> str:
        """The header's lines, as the tracer writes them."""
        return "\n".join(
            (
                f"-kernel name = {self.name}",
                f"-kernel id = {self.id}",
                f"-grid dim = ({','.join(map(str, self.grid))})",
                f"-block dim = ({','.join(map(str, self.block))})",
                f"-shmem = {self.shared_bytes}",
                f"-nregs = {self.registers}",
                f"-binary version = {self.binary_version}",
                "-cuda stream id = 0",
                f"-shmem base_addr = {self.shared_base:#018x}",
                f"-local mem base_addr = {self.local_base:#018x}",
                f"-nvbit version = {NVBIT_VERSION}",
                f"-accelsim tracer version = {self.tracer_version}",
                f"-enable lineinfo = {int(self.has_line_info)}",
                "",
                _FORMAT,
                "",
            )
        )


def _dimensions(text: str) -> tuple[int, int, int]:
    match = re.fullmatch(r"\(\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*\)", text)
    if match is None:
        raise ValueError
    x, y, z = (int(number) for number in match.groups())
    if not x * y * z:
        raise ValueError
    return x, y, z


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise ValueError
    return value


def _flag(text: str) -> bool:
    return {"0": False, "1": True}[text]


#: Name in the file -> field, its reader, and what is allowed.
_FIELDS: dict[str, tuple[str, Callable[[str], Any], str]] = {
    "kernel name": ("name", str, "a name"),
    "kernel id": ("id", int, "an integer"),
    "grid dim": ("grid", _dimensions, "(x,y,z) from 1 up"),
    "block dim": ("block", _dimensions, "(x,y,z) from 1 up"),
    "shmem": ("shared_bytes", _count, "an integer from 0 up"),
    "nregs": ("registers", _count, "an integer from 0 up"),
    "binary version": ("binary_version", _count, "an integer from 0 up"),
    "shmem base_addr": ("shared_base", lambda text: int(text, 16), "a hexadecimal number"),
    "local mem base_addr": ("local_base", lambda text: int(text, 16), "a hexadecimal number"),
    "accelsim tracer version": ("tracer_version", _count, "an integer from 0 up"),
    "enable lineinfo": ("has_line_info", _flag, "0 or 1"),
}


def parse_line(line: str) -> tuple[str, Any] | None:
    """The field of `KernelHeader` that a header line gives, and its value; None for lines that do
    not matter here.

    Raises:
        ValueError: no `-name = value`, or a bad value, saying what is allowed.
    """
    name, equals, value = line.partition("=")
    if not line.startswith("-") or not equals:
        raise ValueError(f"{line[:60]!r}: need a header line, -name = value")
    known = _FIELDS.get(name[1:].strip())
    if known is None:
        return None
    field, read, allowed = known
    try:
        return field, read(value.strip())
    except (ValueError, KeyError):
        raise ValueError(f"{name.strip()} = {value.strip()[:60]!r}: need {allowed}") from None
