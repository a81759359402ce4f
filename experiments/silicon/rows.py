"""The measurements' file: tidy rows of CSV under one line of JSON, the manifest.

    # {"device": "NVIDIA …", …}
    measurement,case,quantity,value,unit,source
    chase,path=load footprint_bytes=2048,latency,32.1,cycles,clock

A case is words KEY=VALUE with blanks between. Sources: "driver" (asked), "clock" (the SM's),
"event" (the driver's timer), "ncu" (the profiler's counters, under their own names), "host"
(compared or timed by the CPU).
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

from traces.errors import InputError
from traces.files import replacing

COLUMNS = ("measurement", "case", "quantity", "value", "unit", "source")
SOURCES = ("driver", "clock", "event", "ncu", "host")
_CASE = re.compile(r"([A-Za-z_0-9]+=[^\s=,]+( [A-Za-z_0-9]+=[^\s=,]+)*)?")
_NAME = re.compile(r"[A-Za-z0-9_.\-]+")


@dataclass(frozen=True)
class Row:
    """One measured number."""

    measurement: str
    case: str
    quantity: str
    value: float
    unit: str
    source: str

    @property
    def words(self) -> dict[str, str]:
        """The case's words."""
        return dict(word.split("=", 1) for word in self.case.split())

    def cells(self) -> tuple[str, ...]:
        number = f"{self.value:.0f}" if self.value == int(self.value) else repr(self.value)
        return (self.measurement, self.case, self.quantity, number, self.unit, self.source)


def case_of(**words: Any) -> str:
    """The case of these words, in their order."""
    return " ".join(f"{name}={value}" for name, value in words.items())


@dataclass(frozen=True)
class Measurements:
    """A measurements' file. manifest: device, clocks, driver, compiler, date, commit, failures."""

    manifest: Mapping[str, Any]
    rows: tuple[Row, ...]


class RowWriter:
    """Writes rows one by one into an open file, so that a process that dies loses none of them."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def add(
        self, measurement: str, case: str, quantity: str, value: float, unit: str, source: str
    ) -> None:
        row = Row(measurement, case, quantity, float(value), unit, source)
        if not math.isfinite(row.value):
            return
        self._file.write(_line(row.cells()))
        self._file.flush()


def _line(cells: Iterable[str]) -> str:
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def read_parts(text: str) -> list[Row]:
    """The rows of a process's file, whose last line may be cut off."""
    whole = text[: text.rfind("\n") + 1]
    return [_parse(cells, "part", k + 1) for k, cells in enumerate(csv.reader(StringIO(whole)))]


def write_measurements(path: Path, measurements: Measurements) -> None:
    """Write the file, whole or not at all."""
    lines = ["# " + json.dumps(measurements.manifest, sort_keys=True) + "\n", _line(COLUMNS)]
    lines += [_line(row.cells()) for row in measurements.rows]
    with replacing(path) as part:
        part.write_text("".join(lines), encoding="utf-8")


def is_measurements(text: str) -> bool:
    """Whether a text begins as a measurements' file does."""
    return text.startswith("# {")


def read_measurements(path: Path, text: str | None = None) -> Measurements:
    """Read such a file. text: its content, where it has been read.

    Raises:
        InputError: it is no measurements' file; the message names the line and what is wrong.
    """
    if text is None:
        text = path.read_text(encoding="utf-8", errors="replace")
    first, _, rest = text.partition("\n")
    if not is_measurements(first):
        raise InputError(
            f"{path}: line 1: no manifest: need '# {{…}}', as `silicon measure` writes"
        )
    try:
        manifest = json.loads(first[2:])
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: line 1: the manifest is no JSON: {error}") from error
    lines = list(csv.reader(StringIO(rest)))
    if not lines or tuple(lines[0]) != COLUMNS:
        raise InputError(f"{path}: line 2: need the columns {','.join(COLUMNS)}")
    rows = [_parse(cells, str(path), number + 3) for number, cells in enumerate(lines[1:])]
    seen: dict[tuple[str, str, str, str], int] = {}
    for number, row in enumerate(rows):
        key = (row.measurement, row.case, row.quantity, row.source)
        if key in seen:
            raise InputError(f"{path}: line {number + 3}: the same as line {seen[key]}: {key}")
        seen[key] = number + 3
    if "device" not in manifest:
        raise InputError(f"{path}: line 1: the manifest names no device")
    return Measurements(manifest, tuple(rows))


def _parse(cells: list[str], where: str, line: int) -> Row:
    if len(cells) != len(COLUMNS):
        raise InputError(f"{where}: line {line}: {len(cells)} cells: need {len(COLUMNS)}")
    measurement, case, quantity, number, unit, source = cells
    for field, text, pattern in (
        ("measurement", measurement, _NAME),
        ("case", case, _CASE),
        ("quantity", quantity, _NAME),
    ):
        if not pattern.fullmatch(text):
            raise InputError(f"{where}: line {line}: {field} {text!r}: not as written by measure")
    try:
        value = float(number)
    except ValueError as error:
        raise InputError(f"{where}: line {line}: value {number!r}: no number") from error
    if not math.isfinite(value):
        raise InputError(f"{where}: line {line}: value {number!r}: not finite")
    if source not in SOURCES:
        raise InputError(
            f"{where}: line {line}: source {source!r}: allowed are {', '.join(SOURCES)}"
        )
    return Row(measurement, case, quantity, value, unit, source)
