"""GPUs by name: one TOML file each, every field with its source and its confidence.

    shipped name | file.toml ──► read (extends) ──► fields with sources ──► overrides ──► Gpu

`from cachesim import presets`, then `presets.load("titan-x-pascal", ["l1.capacity=64KiB"])`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from cachesim.config import Gpu
from cachesim.presets import files
from cachesim.presets.fields import FIELDS, NO_LEVEL, build_gpu, flatten_gpu, format_value
from cachesim.presets.files import CONFIDENCES as CONFIDENCES
from cachesim.presets.files import Sourced as Sourced
from cachesim.presets.files import names as names
from cachesim.presets.overrides import apply_overrides as apply_overrides
from cachesim.presets.overrides import parse_axis as parse_axis
from cachesim.presets.overrides import parse_overrides
from cachesim.presets.overrides import with_fields as with_fields


def load(name_or_path: str | Path, overrides: Iterable[str] = ()) -> Gpu:
    """The GPU of a shipped preset or of a user's own .toml file.

    overrides: changes such as "l1.capacity=64KiB" or "llc=none", checked together.

    Raises:
        InputError: one line with the file, the field, its value and what is allowed.
    """
    fields = files.read(name_or_path)
    gpu = build_gpu({path: entry.value for path, entry in fields.items()}, str(name_or_path))
    return apply_overrides(gpu, overrides)


def sources(name_or_path: str | Path, overrides: Iterable[str] = ()) -> dict[str, Sourced]:
    """Field path -> value, source and confidence of every field, in the order of `Gpu`.

    Raises:
        InputError: as `load`.
    """
    overrides = list(overrides)
    gpu, given, changed = (
        load(name_or_path, overrides),
        files.read(name_or_path),
        parse_overrides(overrides),
    )
    result = {}
    for path, value in flatten_gpu(gpu).items():
        source, confidence = "assumed: the model's default", "?"
        if path in changed:
            source = "assumed: set by an override"
        elif path in given:
            source, confidence = given[path].source, given[path].confidence
        result[path] = Sourced(value, source, confidence)
    return result


def describe(name_or_path: str | Path, overrides: Iterable[str] = ()) -> pd.DataFrame:
    """A preset as a table, one row per field.

    Columns: `field`, `value` (text, sizes with units), `source`, `confidence`.

    Raises:
        InputError: as `load`.
    """
    rows = [
        (path, format_value(path, entry.value), entry.source, entry.confidence)
        for path, entry in sources(name_or_path, overrides).items()
    ]
    return pd.DataFrame(rows, columns=["field", "value", "source", "confidence"])


def diff(a: str | Path, b: str | Path) -> pd.DataFrame:
    """The fields in which two presets differ.

    Columns: `field`, and the value in each preset under its name; "none" where a level is absent.

    Raises:
        InputError: as `load`.
    """
    left, right = flatten_gpu(load(a)), flatten_gpu(load(b))
    rows = []
    for path in (path for path in FIELDS if path in left or path in right):
        values = [
            format_value(path, gpu[path]) if path in gpu else NO_LEVEL for gpu in (left, right)
        ]
        if values[0] != values[1]:
            rows.append((path, *values))
    return pd.DataFrame(rows, columns=["field", str(a), str(b)])
