"""Reads the committed counts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from kernels.instruction_counts.segments import Segment, from_text
from kernels.instruction_counts.variants import variant
from kernels.method import Method
from traces.errors import unknown

#: The instruction sets that are counted: GPUs of the presets.
INSTRUCTION_SETS = ("sm_61", "sm_75", "sm_90", "gfx1010", "gfx1030")
#: Each with the kernels' own exact arithmetic, and with a shader's native one.
TARGETS = tuple(name for isa in INSTRUCTION_SETS for name in (isa, f"{isa}-native"))
#: The dissertation's GPUs are Pascal, and its passes are shaders.
DEFAULT_TARGET = "sm_61-native"


def split_target(target: str) -> tuple[str, bool]:
    """(instruction set, whether native) of a target."""
    return target.removesuffix("-native"), target.endswith("-native")


@dataclass(frozen=True)
class Counts:
    """A kernel's instructions between its accesses, in program order.

    elsewhere: of a warp in which nothing scatters: before each of its accesses, and after the last.
    before: of a warp in which something scatters: before each access up to the sample loop, and
        from the last of them to the loop, or to the end where there is none.
    first_turn, loop: of the loop's first turn, and of any further: before each access of a turn,
        and after its last. The turns differ in their waits alone.
    after: before each access after the loop, and after the last.
    """

    registers_per_thread: int
    shared_bytes: int
    elsewhere: tuple[Segment, ...]
    before: tuple[Segment, ...]
    first_turn: tuple[Segment, ...]
    loop: tuple[Segment, ...]
    after: tuple[Segment, ...]


def check_target(target: str) -> None:
    """Raises:
    InputError: it is not counted.
    """
    if target not in TARGETS:
        raise unknown("instruction target", target, TARGETS, "recording")


def data_file(target: str) -> Path:
    """The file that holds a target's counts."""
    return Path(__file__).parent / "data" / f"{target}.json"


@cache
def read(target: str) -> dict[str, Any]:
    """A target's file.

    Raises:
        InputError: there is none.
    """
    check_target(target)
    content: dict[str, Any] = json.loads(data_file(target).read_text(encoding="utf-8"))
    return content


def counts_of(kernel: str, method: Method, target: str = DEFAULT_TARGET) -> Counts:
    """The counts of the kernel that a method selects."""
    entry = read(target)["kernels"][kernel][variant(kernel, method)]
    parts = ("elsewhere", "before", "first_turn", "loop", "after")
    entry = {"first_turn": entry.get("loop", ())} | entry
    segments = [tuple(from_text(text) for text in entry.get(part, ())) for part in parts]
    return Counts(entry["registers_per_thread"], entry["shared_bytes"], *segments)


def describe(target: str) -> dict[str, Any]:
    """What the manifest of a trace says of its counts."""
    content = read(target)
    return {"target": content["target"], "compilers": content["compilers"]}


__all__ = [
    "DEFAULT_TARGET",
    "TARGETS",
    "Counts",
    "check_target",
    "counts_of",
    "data_file",
    "describe",
    "read",
    "split_target",
]
