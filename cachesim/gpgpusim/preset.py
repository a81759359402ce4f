"""Option files in, a preset with the source of every field out, and its TOML text."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cachesim.config import Bytes, Gpu
from cachesim.gpgpusim.geometry import geometry
from cachesim.gpgpusim.network import network_remarks
from cachesim.gpgpusim.options import Options, Remark, label
from cachesim.gpgpusim.syntax import read_option_files
from cachesim.gpgpusim.timing import timing
from cachesim.presets.fields import FIELDS, build_gpu
from cachesim.presets.files import Sourced
from cachesim.units import format_size
from traces.errors import InputError

#: Longer values stand outside their column.
_MAX_COLUMN = 40
_LEGEND = (
    "# Confidence: S source, M measured, P paper or vendor's staff, R recalled specification, "
    "D derived, ? assumed."
)


@dataclass(frozen=True)
class Imported:
    """A preset made of option files.

    fields: field path -> value, source and confidence, in the order of `Gpu`.
    ignored: settings that nothing was made of. differing: settings under which GPGPU-Sim does
        something else than the timing model, and what that does.
    origin: what sources call the first file.
    """

    gpu: Gpu
    fields: dict[str, Sourced]
    ignored: tuple[Remark, ...]
    differing: tuple[Remark, ...]
    origin: str

    def to_toml(self, header: str | None = None) -> str:
        """The text of a preset file. header: its leading comment lines; made up where None."""
        if header is None:
            made = f"# {self.gpu.name}: read from {self.origin} by `cachesim import-config`."
            header = f"{made}\n{_LEGEND}"
        return f"{header}\n\n{format_fields(self.fields)}"


def import_config(files: Sequence[Path], name: str) -> Imported:
    """The preset of GPGPU-Sim's and Accel-Sim's option files, in which later settings win.

    name: of the preset. A BookSim file that `-inter_config_file` names is read where it stands
        beside the file that names it.

    Raises:
        InputError: one line with file, option, value and what is allowed.
    """
    if not files:
        raise InputError("no option file given")
    where = ", ".join(map(str, files))
    settings = read_option_files(files)
    if not settings:
        raise InputError(f"{where}: no option in it; allowed is -option value")
    options = Options(settings, where)
    made = {**geometry(options, name), **timing(options)}
    fields = {path: made[path] for path in FIELDS if path in made}
    gpu = build_gpu({path: entry.value for path, entry in fields.items()}, where)
    differing = (*options.differing(), *network_remarks(options))
    origin = label(next(iter(settings.values())))
    return Imported(gpu, fields, tuple(options.ignored()), differing, origin)


def leading_comments(text: str) -> str | None:
    """The comment lines a file begins with; None where it begins otherwise."""
    lines: list[str] = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line)
    return "\n".join(lines) or None


def format_fields(fields: dict[str, Sourced]) -> str:
    """Fields as TOML, one inline table each, one table per section, columns aligned."""
    sections: dict[str, list[tuple[str, str, Sourced]]] = {}
    for path, entry in fields.items():
        section, _, field = path.rpartition(".")
        sections.setdefault(section, []).append((field, _toml_value(path, entry.value), entry))
    blocks = []
    for section, rows in sections.items():
        keys = max(len(field) for field, _, _ in rows)
        values = 1 + max(
            (len(value) for _, value, _ in rows if len(value) <= _MAX_COLUMN), default=0
        )
        lines = [f"[{section}]"] if section else []
        lines += [
            f"{field:<{keys}} = {{ value = {value + ',':<{values}} source = "
            f"{_quote(entry.source)}, confidence = {_quote(entry.confidence)} }}"
            for field, value, entry in rows
        ]
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def _toml_value(path: str, value: Any) -> str:
    """As the shipped files write it: capacities with their unit, large numbers in groups."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _quote(value)
    if FIELDS[path] == Bytes and not format_size(value).endswith(" B") and value > 1024:
        return _quote(format_size(value))
    return f"{value:_}" if value >= 10**6 else str(value)


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def group_remarks(remarks: Iterable[Remark]) -> dict[str, list[str]]:
    """Reason -> its settings as "option value", in order."""
    groups: dict[str, list[str]] = {}
    for remark in remarks:
        text = f"{remark.setting.option} {remark.setting.text}".strip()
        groups.setdefault(remark.reason, []).append(text)
    return groups
