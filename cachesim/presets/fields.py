"""The fields of a GPU by path ("l1.capacity"): types, parsing of text, and errors in one line.

Everything is read off the pydantic models of `cachesim.config`: a field added there is known here.
"""

from __future__ import annotations

import difflib
import types
from collections.abc import Mapping
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic import BaseModel, TypeAdapter, ValidationError

from cachesim.config import Bytes, Gpu
from cachesim.units import format_size
from traces.errors import InputError, unknown
from traces.layout import LAYOUTS

NO_LEVEL = "none"


def _read_models() -> tuple[dict[str, type[BaseModel]], frozenset[str], dict[str, Any]]:
    """Table name -> its model, the tables that may be absent, and field path -> annotated type."""
    sections: dict[str, type[BaseModel]] = {}
    optional = set()
    leaves: dict[str, Any] = {}
    for name, hint in get_type_hints(Gpu, include_extras=True).items():
        if name not in Gpu.model_fields:
            continue
        choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        if not (isinstance(choices[0], type) and issubclass(choices[0], BaseModel)):
            leaves[name] = hint
            continue
        model = sections[name] = choices[0]
        if type(None) in choices:
            optional.add(name)
        hints = get_type_hints(model, include_extras=True)
        leaves.update({f"{name}.{field}": hints[field] for field in model.model_fields})
    return sections, frozenset(optional), leaves


SECTIONS, OPTIONAL_SECTIONS, FIELDS = _read_models()


def check_path(path: str, where: str) -> None:
    """Refuse a field path that no GPU has.

    Raises:
        InputError: unknown table or field, with the nearest match; or a table, not a field.
    """
    if path in FIELDS:
        return
    section, _, field = path.partition(".")
    if path in SECTIONS:
        fields = ", ".join(SECTIONS[path].model_fields)
        raise InputError(f"{where}: {path!r} is a table; choose one of its fields: {fields}")
    if section in SECTIONS:
        raise unknown(f"field in [{section}]", field, SECTIONS[section].model_fields, where)
    top_level = [known for known in FIELDS if "." not in known]
    raise InputError(
        f"{where}: unknown field {path!r}; {_did_you_mean(path, [*FIELDS, *SECTIONS])}choose from "
        f"{', '.join(top_level)} and the fields of {', '.join(SECTIONS)}"
    )


def _did_you_mean(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}? " if near else ""


def parse_field(path: str, text: str, where: str) -> Any:
    """The typed value of a known field written as text: "64KiB" -> 65536, "true" -> True.

    Raises:
        InputError: the text is not a value of that field.
    """
    hint = FIELDS[path]
    value: Any = text
    if get_origin(hint) is Literal:
        value = {str(choice): choice for choice in get_args(hint)}.get(text, text)
    try:
        parsed = TypeAdapter(hint).validate_python(value)
    except ValidationError as error:
        raise InputError(f"{where}: {_explain(error.errors()[0], path)}") from None
    check_layout({path: parsed}, where)
    return parsed


def check_layout(values: Mapping[str, Any], where: str) -> None:
    """Refuse an unknown `texture_layout`, which `Gpu` itself leaves open."""
    layout = values.get("texture_layout")
    if layout is not None and layout not in LAYOUTS:
        raise unknown("texture_layout", str(layout), LAYOUTS, where)


def build_gpu(values: Mapping[str, Any], where: str) -> Gpu:
    """The validated GPU of a flat map, field path -> value; a level without fields is absent.

    Raises:
        InputError: one line with `where`, the first wrong field, its value and what is allowed.
    """
    nested: dict[str, Any] = {}
    for path, value in values.items():
        section, _, field = path.partition(".")
        if field:
            nested.setdefault(section, {})[field] = value
        else:
            nested[path] = value
    try:
        gpu = Gpu.model_validate(nested)
    except ValidationError as error:
        raise InputError(f"{where}: {explain(error)}") from None
    check_layout({"texture_layout": gpu.texture_layout}, where)
    return gpu


def flatten_gpu(gpu: Gpu) -> dict[str, Any]:
    """Field path -> value of a GPU, in the models' order, without the fields of absent levels."""
    flat = {}
    for path in FIELDS:
        section, _, field = path.partition(".")
        holder = getattr(gpu, section)
        if holder is not None:
            flat[path] = getattr(holder, field) if field else holder
    return flat


def format_value(path: str, value: Any) -> str:
    """A field's value as people write it: sizes with their unit, booleans as TOML has them."""
    if FIELDS[path] == Bytes:
        return format_size(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def explain(error: ValidationError) -> str:
    """One line for a validation error: its first wrong value, or all that is missing."""
    problems = error.errors()
    missing = [_path(problem) for problem in problems if problem["type"] == "missing"]
    wrong = [problem for problem in problems if problem["type"] != "missing"]
    if not wrong:
        return f"missing {', '.join(missing)}"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return _explain(wrong[0], _path(wrong[0])) + more


def _path(problem: Any) -> str:
    return ".".join(str(part) for part in problem["loc"])


def _explain(problem: Any, path: str) -> str:
    """One problem of pydantic's in our words: field path, value, what is allowed."""
    kind, value = problem["type"], _clip(problem["input"])
    if kind == "value_error":
        reason = str(problem["ctx"]["error"])
        if path in FIELDS:
            return f"{path}: {reason}"
        return f"{path}.{reason}" if path else reason
    allowed = _allowed(kind, problem, FIELDS.get(path))
    return f"{path} = {value}; {allowed}"


def _allowed(kind: str, problem: Any, hint: Any) -> str:
    if kind == "literal_error":
        choices = get_args(hint)
        near = _did_you_mean(str(problem["input"]), [c for c in choices if isinstance(c, str)])
        return f"{near}allowed are {', '.join(map(str, choices))}"
    if kind.startswith("int_") or kind == "finite_number":
        return "allowed are whole numbers"
    if kind in ("greater_than", "less_than_equal"):
        limit = next(iter(problem["ctx"].values()))
        return f"allowed are numbers {'above' if kind == 'greater_than' else 'up to'} {limit}"
    if kind.startswith("bool_"):
        return "allowed are true, false"
    return "allowed is text" if kind == "string_type" else cast(str, problem["msg"])


def _clip(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
