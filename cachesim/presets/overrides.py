"""Changing fields of a GPU by name: `--set l1.capacity=64KiB`, the axes of a sweep."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from cachesim.config import Gpu
from cachesim.presets.fields import (
    NO_LEVEL,
    OPTIONAL_SECTIONS,
    build_gpu,
    check_path,
    flatten_gpu,
    parse_field,
)
from traces.errors import InputError


def parse_overrides(overrides: Iterable[str]) -> dict[str, Any]:
    """Field path -> typed value of "l1.capacity=64KiB"; `None` for "llc=none". Later ones win.

    Raises:
        InputError: not FIELD=VALUE, an unknown field (with the nearest match), or not a value of
            that field.
    """
    changes: dict[str, Any] = {}
    for override in overrides:
        where = f"override {override!r}"
        field, equals, text = (part.strip() for part in override.partition("="))
        if not (field and equals and text):
            raise InputError(f"{where}: allowed is FIELD=VALUE, for example l1.capacity=64KiB")
        changes.pop(field, None)  # so that a later override also comes later in the order
        if field in OPTIONAL_SECTIONS and text == NO_LEVEL:
            changes[field] = None
            continue
        check_path(field, where)
        changes[field] = parse_field(field, text, where)
    return changes


def with_fields(gpu: Gpu, changes: Mapping[str, Any]) -> Gpu:
    """A GPU with some fields changed, checked once after all of them.

    changes: field path -> value; `None` takes a level out.

    Raises:
        InputError: an unknown field, or values that do not fit together.
    """
    told = [f"{path}={NO_LEVEL if value is None else value}" for path, value in changes.items()]
    where = f"{gpu.name} with {', '.join(told)}"
    fields = flatten_gpu(gpu)
    for changed, value in changes.items():
        if value is None and changed in OPTIONAL_SECTIONS:
            fields = {f: v for f, v in fields.items() if not f.startswith(f"{changed}.")}
        else:
            check_path(changed, where)
            fields[changed] = value
    return build_gpu(fields, where)


def apply_overrides(gpu: Gpu, overrides: Iterable[str]) -> Gpu:
    """A GPU with overrides as the command line gives them: "l1.capacity=64KiB", "l1.ways=128".

    Raises:
        InputError: as `parse_overrides` and `with_fields`.
    """
    changes = parse_overrides(overrides)
    return with_fields(gpu, changes) if changes else gpu


def parse_axis(axis: str) -> tuple[str, list[Any]]:
    """The field and the typed values of a sweep's axis, "l1.capacity=16KiB,32KiB,64KiB".

    Raises:
        InputError: not FIELD=VALUE,VALUE,..., an unknown field, a wrong value, or one value twice.
    """
    where = f"axis {axis!r}"
    field, equals, text = (part.strip() for part in axis.partition("="))
    texts = [part.strip() for part in text.split(",")]
    if not (field and equals and all(texts)):
        raise InputError(
            f"{where}: allowed is FIELD=VALUE,VALUE, for example l1.capacity=16KiB,32KiB"
        )
    check_path(field, where)
    values = [parse_field(field, part, where) for part in texts]
    for index, value in enumerate(values):
        if value in values[:index]:
            raise InputError(f"{where}: {texts[index]} stands there twice")
    return field, values
