"""Preset files: TOML in, field path -> value with its source and confidence out.

A leaf field is an inline table: `ways = { value = 48, source = "...", confidence = "S" }`. A user's
own file may give plain values, `extends = "rtx-2080-ti"` (a shipped preset, or a `.toml` path
relative to the file), and `llc = "none"` to drop a level.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cachesim.presets.fields import NO_LEVEL, OPTIONAL_SECTIONS, SECTIONS, check_path
from traces.errors import InputError, unknown

#: S read in source or a driver table, M measured, P stated in a paper or by the vendor's staff,
#: R recalled from a vendor's specification, D derived by arithmetic, ? assumed.
CONFIDENCES = ("S", "M", "P", "R", "D", "?")
_KEYS = ("value", "source", "confidence")
_SHIPPED = Path(__file__).parent


@dataclass(frozen=True)
class Sourced:
    """A field's value, where it comes from, and how far to trust that (one of `CONFIDENCES`)."""

    value: Any
    source: str
    confidence: str


def names() -> list[str]:
    """The shipped presets, sorted."""
    return sorted(path.stem for path in _SHIPPED.glob("*.toml"))


def locate(name_or_path: str | Path) -> Path:
    """The file of a shipped preset's name, or of a path that ends in .toml.

    Raises:
        InputError: neither, with the nearest name.
    """
    if str(name_or_path) in names():
        return _SHIPPED / f"{name_or_path}.toml"
    if Path(name_or_path).suffix != ".toml":
        error = unknown("preset", str(name_or_path), names())
        raise InputError(f"{error}, or a path that ends in .toml")
    return Path(name_or_path)


def read(name_or_path: str | Path) -> dict[str, Sourced]:
    """The fields of a preset file on top of those it extends, not yet checked as a GPU.

    Raises:
        InputError: no such preset or file, not TOML, an unknown table or field, a source or
            confidence that is missing or wrong, or a file that extends itself.
    """
    return _read_chain(locate(name_or_path), ())


def _read_chain(path: Path, heirs: tuple[Path, ...]) -> dict[str, Sourced]:
    """The fields of `path` on top of its ancestors'. `heirs`: the files that `extends` came by."""
    document = _parse(path)
    fields: dict[str, Sourced] = {}
    if "extends" in document:
        base = document["extends"]
        if not isinstance(base, str):
            raise InputError(
                f"{path}: extends = {base!r}; allowed is a preset's name or a .toml path"
            )
        try:
            base_path = path.parent / locate(base)
        except InputError as error:
            raise InputError(f"{path}: extends: {error}") from None
        chain = (*heirs, path)
        if base_path.resolve() in [heir.resolve() for heir in chain]:
            cycle = " -> ".join(file.name for file in (*chain, base_path))
            raise InputError(f"{path}: extends = {base!r}; a preset cannot extend itself: {cycle}")
        fields = _read_chain(base_path, chain)
    fields["name"] = Sourced(path.stem, "assumed: called after its file", "?")
    for key, entry in document.items():
        if key == "extends":
            continue
        if key in SECTIONS:
            _read_section(key, entry, fields, path)
        else:
            check_path(key, str(path))
            fields[key] = _sourced(key, entry, path)
    return fields


def _read_section(section: str, entry: Any, fields: dict[str, Sourced], path: Path) -> None:
    """Put one table's fields into `fields`, or take its level out."""
    if entry == NO_LEVEL and section in OPTIONAL_SECTIONS:
        for field in [field for field in fields if field.startswith(f"{section}.")]:
            del fields[field]
        return
    if not isinstance(entry, dict):
        absent = f" or {NO_LEVEL!r}" if section in OPTIONAL_SECTIONS else ""
        raise InputError(f"{path}: {section} = {entry!r}; allowed is a table [{section}]{absent}")
    for field, value in entry.items():
        check_path(f"{section}.{field}", str(path))
        fields[f"{section}.{field}"] = _sourced(f"{section}.{field}", value, path)


def _sourced(field: str, entry: Any, path: Path) -> Sourced:
    """The value and source of one leaf: an inline table, or a plain value."""
    if not isinstance(entry, dict):
        return Sourced(entry, f"assumed: given in {path.name}", "?")
    for key in entry:
        if key not in _KEYS:
            raise unknown("key", key, _KEYS, f"{path}: {field}")
    for key in _KEYS:
        if key not in entry:
            raise InputError(f"{path}: {field}: missing {key}; it needs {', '.join(_KEYS)}")
    source, confidence = entry["source"], entry["confidence"]
    if confidence not in CONFIDENCES:
        raise InputError(
            f"{path}: {field}: confidence = {confidence!r}; allowed are {', '.join(CONFIDENCES)}"
        )
    if not isinstance(source, str) or not source.strip():
        raise InputError(f"{path}: {field}: source = {source!r}; allowed is text that is not empty")
    if source.startswith("assumed") != (confidence == "?"):
        raise InputError(
            f"{path}: {field}: confidence = {confidence!r} with source = {source!r}; "
            "'?' and a source that begins with 'assumed' go together"
        )
    return Sourced(entry["value"], source, confidence)


def _parse(path: Path) -> dict[str, Any]:
    text = ""
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except tomllib.TOMLDecodeError as error:
        end = f"line {len(text.splitlines())}, the end of the file"
        reason = str(error).replace("end of document", end)
        raise InputError(f"{path}: not TOML: {reason}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None
