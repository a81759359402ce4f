"""The text of a kernel's trace file as warps of instruction lines, with the place of every error.

header, then per CTA:
#BEGIN_TB / thread block = x,y,z / per warp: warp = w, insts = n, n lines / #END_TB
"""

from __future__ import annotations

import lzma
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from traces.accel_sim.header import FIRST_BARE_TRACER_VERSION, KernelHeader, parse_line
from traces.check import MAX_INT32, MAX_WARPS_PER_CTA
from traces.errors import InputError
from traces.texture import WARP_SIZE

XZ_MAGIC = b"\xfd7zXZ\x00"
#: The register that is always 0: nothing waits for it.
ZERO_REGISTER = "R255"
_REGISTER = re.compile(r"R\d{1,3}")
_NUM_COORDINATES = 4
_MAX_REPEATED_CHARACTERS = 64


class Line(NamedTuple):
    """One instruction of a warp.

    mask: bit l = lane l is active. registers: all that are named, `ZERO_REGISTER` left out;
        destination: of those, the one that is written, or "". opcode: with modifiers.
    width: bytes per lane, 0 = no memory. rest: what follows the width.
    """

    mask: int
    destination: str
    registers: tuple[str, ...]
    opcode: str
    width: int
    rest: list[str]


class KernelFile:
    """Reads one kernel. Every error is an `InputError` with the file and the line.

    header: filled by `open`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header = KernelHeader()
        self._line = 0
        self._text: Iterator[str] = iter(())

    def fail(self, what: object) -> InputError:
        """An error at the present line."""
        return InputError(f"{self.path}: line {self._line}: {what}")

    @contextmanager
    def open(self) -> Iterator[KernelHeader]:
        """The header, checked; warps can be read inside the block."""
        with _opened(self.path) as file:
            self._line = 0
            self._text = self._stripped(file)
            self.header = self._header()
            yield self.header

    def ctas(self) -> Iterator[Iterator[tuple[int, Iterator[Line]]]]:
        """Per CTA, in the order of the file, its warps: the warp's number and its instructions.

        Warps and instructions must be consumed in order.
        """
        num_ctas = 0
        for text in self._text:
            if text == "#BEGIN_TB":
                num_ctas += 1
                if num_ctas > self.header.num_ctas:
                    raise self.fail(f"thread block {num_ctas}: the grid has {self.header.num_ctas}")
                yield self._warps()
            elif not text.startswith("#"):
                raise self.fail(
                    f"{text[:60]!r} outside of a thread block: need #BEGIN_TB (a raw trace has to "
                    "be post-processed first)"
                )
        if num_ctas != self.header.num_ctas:
            raise self.fail(
                f"the file ends after {num_ctas} thread blocks: the grid has {self.header.num_ctas}"
            )

    def _stripped(self, file: TextIO) -> Iterator[str]:
        """The lines that are not blank."""
        try:
            for line in file:
                self._line += 1
                text = line.strip()
                if text:
                    yield text
        except (OSError, EOFError, lzma.LZMAError) as error:
            raise self.fail(f"cannot be read: {error}") from None

    def _header(self) -> KernelHeader:
        fields: dict[str, Any] = {}
        for text in self._text:
            if text.startswith("#"):
                break
            try:
                found = parse_line(text)
            except ValueError as error:
                raise self.fail(error) from None
            if found:
                fields[found[0]] = found[1]
        for name, field in (("grid dim", "grid"), ("block dim", "block")):
            if field not in fields:
                raise self.fail(f"the header has no -{name}")
        header = KernelHeader(**fields)
        if header.num_ctas > MAX_INT32:
            raise self.fail(f"-grid dim = {header.grid}: allowed are up to {MAX_INT32} CTAs")
        most = MAX_WARPS_PER_CTA * WARP_SIZE
        if header.num_threads > most:
            raise self.fail(f"-block dim = {header.block}: allowed are up to {most} threads")
        return header

    def _warps(self) -> Iterator[tuple[int, Iterator[Line]]]:
        """The warps of a CTA, up to its end."""
        self._check_cta(self._value("thread block"))
        num_warps = -(-self.header.num_threads // WARP_SIZE)
        previous = -1
        for text in self._text:
            if text == "#END_TB":
                return
            warp = self._integer(self._value("warp", text), "warp")
            if not previous < warp < num_warps:
                raise self.fail(
                    f"warp = {warp}: allowed are {previous + 1} to {num_warps - 1} (in order)"
                )
            previous = warp
            yield warp, self._instructions(self._integer(self._value("insts"), "insts"))
        raise self.fail("the file ends inside a thread block")

    def _check_cta(self, value: str) -> None:
        numbers = value.split(",")
        grid = self.header.grid
        if len(numbers) != len(grid) or not all(
            number.strip().isdecimal() and int(number) < side
            for number, side in zip(numbers, grid, strict=True)
        ):
            raise self.fail(f"thread block = {value[:60]!r}: need x,y,z below {grid}")

    def _value(self, name: str, text: str | None = None) -> str:
        """The value of `name = value`, the next line unless one is given."""
        if text is None:
            text = next(self._text, "the end of the file")
        found, equals, value = text.partition("=")
        if not equals or found.strip() != name:
            raise self.fail(f"{text[:60]!r}: need {name} = ...")
        return value.strip()

    def _integer(self, value: str, name: str) -> int:
        if not value.isdecimal():
            raise self.fail(f"{name} = {value[:60]!r}: need an integer from 0 up")
        return int(value)

    def _instructions(self, num_lines: int) -> Iterator[Line]:
        num_before = int(self.header.has_line_info)
        if self.header.tracer_version < FIRST_BARE_TRACER_VERSION:
            num_before += _NUM_COORDINATES
        for number in range(num_lines):
            text = next(self._text, "#")
            if text.startswith("#") or "=" in text:
                raise self.fail(f"{number} instructions where insts = {num_lines}")
            try:
                if num_before:
                    text = " ".join(text.split(None, num_before)[num_before:])
                # Arithmetic recurs in every warp; long lines have addresses of their own.
                is_short = len(text) <= _MAX_REPEATED_CHARACTERS
                yield _parse_repeated(text) if is_short else parse_instruction(text)
            except ValueError as error:
                raise self.fail(f"{text[:100]!r}: {error}") from None


def parse_instruction(text: str) -> Line:
    """An instruction line from the program counter on.

    Raises:
        ValueError: fields that are missing or are not what they should be.
    """
    fields = text.split()
    if len(fields) < 3:
        raise ValueError("need PC, mask, number of destinations, ...")
    int(fields[0], 16)
    mask = int(fields[1], 16)
    if not 0 <= mask < 1 << WARP_SIZE:
        raise ValueError(f"mask {fields[1]}: need 8 hexadecimal digits")
    destinations, at = _registers(fields, 2)
    if at >= len(fields):
        raise ValueError("no opcode")
    opcode = fields[at]
    if not opcode[:1].isalpha():
        raise ValueError(f"opcode {opcode!r}: need a name")
    sources, at = _registers(fields, at + 1)
    if at >= len(fields) or not fields[at].isdecimal():
        raise ValueError("no memory width after the source registers")
    named = tuple(name for name in (*destinations, *sources) if name != ZERO_REGISTER)
    written = next((name for name in destinations if name != ZERO_REGISTER), "")
    return Line(mask, written, named, opcode, int(fields[at]), fields[at + 1 :])


_parse_repeated = lru_cache(maxsize=1 << 14)(parse_instruction)


def _registers(fields: list[str], at: int) -> tuple[tuple[str, ...], int]:
    """The registers whose number stands at `at`, and where the fields after them begin."""
    count = fields[at] if at < len(fields) else "nothing"
    if not count.isdecimal():
        raise ValueError(f"number of registers {count!r}: need an integer from 0 up")
    end = at + 1 + int(count)
    names = tuple(fields[at + 1 : end])
    if end > len(fields) or not all(map(_is_register, names)):
        raise ValueError(f"registers {' '.join(names)!r}: need {count} names like R8")
    return names, end


@lru_cache(maxsize=1024)
def _is_register(name: str) -> bool:
    return _REGISTER.fullmatch(name) is not None


@contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    """The text of a plain or xz-compressed file. Raises: InputError: it cannot be opened."""
    try:
        with path.open("rb") as raw:
            is_xz = raw.read(len(XZ_MAGIC)) == XZ_MAGIC
        file: TextIO
        if is_xz:
            file = lzma.open(path, "rt", encoding="utf-8", errors="replace")
        else:
            file = path.open(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    with file:
        yield file


__all__ = ["XZ_MAGIC", "KernelFile", "Line", "parse_instruction"]
