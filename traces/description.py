"""The description of a trace (all but its rows) as JSON texts in a file's metadata, and back with
every field checked.

One JSON text per key: `version`, `manifest`, `textures`, `instructions`, `launches`, and `chunks`,
which lists [launch, first CTA, CTAs, rows] for each piece of the file in order; a piece without
rows has no row group.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from pydantic import TypeAdapter, ValidationError

from traces.errors import InputError
from traces.texture import Texture
from traces.trace import Instruction, Launch, Trace

VERSION = 1
PREFIX = "sss-cachesim."


class Piece(NamedTuple):
    """CTAs [first_cta, first_cta + num_ctas) of a launch, in num_rows rows."""

    launch: int
    first_cta: int
    num_ctas: int
    num_rows: int


class Description(NamedTuple):
    """What the metadata holds, checked."""

    manifest: dict[str, Any]
    textures: list[Texture]
    instructions: list[Instruction]
    launches: list[Launch]
    chunks: list[Piece]


_ADAPTERS: dict[str, TypeAdapter[Any]] = {
    "manifest": TypeAdapter(dict[str, Any]),
    "textures": TypeAdapter(list[Texture]),
    "instructions": TypeAdapter(list[Instruction]),
    "launches": TypeAdapter(list[Launch]),
    "chunks": TypeAdapter(list[Piece]),
}


def to_metadata(trace: Trace, chunks: list[Piece]) -> dict[str, str]:
    """The metadata of a trace. Raises: ValueError, TypeError: the manifest is not JSON-able."""
    values = {
        "version": VERSION,
        "manifest": trace.manifest,
        "textures": [asdict(t) for t in trace.textures],
        "instructions": [asdict(i) for i in trace.instructions],
        "launches": [asdict(launch) for launch in trace.launches],
        "chunks": chunks,
    }
    return {
        PREFIX + key: json.dumps(value, allow_nan=False, separators=(",", ":"))
        for key, value in values.items()
    }


def from_metadata(metadata: Mapping[bytes, bytes], where: str) -> Description:
    """The description in a file's metadata. Raises: InputError, naming the key and the field."""
    version = _text(metadata, "version", where)
    if version != str(VERSION).encode():
        raise InputError(
            f"{where}: metadata 'version': {version.decode(errors='replace')[:20]!r}: "
            f"this program reads version {VERSION}"
        )
    values = {}
    for key, adapter in _ADAPTERS.items():
        try:
            values[key] = adapter.validate_json(_text(metadata, key, where), strict=True)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = ".".join(str(part) for part in first["loc"])
            shown = repr(first["input"])[:60]
            at = f" at {place}" if place else ""
            raise InputError(f"{where}: metadata {key!r}{at}: {shown}: {first['msg']}") from None
    return Description(**values)


def _text(metadata: Mapping[bytes, bytes], key: str, where: str) -> bytes:
    text = metadata.get((PREFIX + key).encode())
    if text is None:
        raise InputError(
            f"{where}: metadata {PREFIX + key!r} is missing: not a trace of this program"
        )
    return text
