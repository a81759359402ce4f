"""Fitted cost models as JSON files. What is read was written by others: every field is checked."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cachesim.cost.model import COEFFICIENTS, Coefficient, CostModel
from traces.errors import InputError
from traces.files import replacing, writing

FORMAT, VERSION = "cachesim-cost-model", 1
_LEVELS = ("l2", "llc")
MAX_FILE_BYTES = 1 << 20

_Number = Annotated[float, Field(ge=0.0, le=1e9, allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Coefficient(_Strict):
    value: _Number
    low: _Number
    high: _Number


class _Model(_Strict):
    gpu: Annotated[str, Field(min_length=1, max_length=200)]
    frames: Annotated[int, Field(ge=2, le=1_000_000)]
    coefficients: dict[str, _Coefficient]


class _File(_Strict):
    format: Literal["cachesim-cost-model"]
    version: Literal[1]
    models: Annotated[list[_Model], Field(min_length=1, max_length=100)]


def write_models(models: Sequence[CostModel], path: str | Path) -> None:
    """Write fitted models, whole or not at all.

    Raises:
        InputError: the folder does not exist or cannot be written.
        WorkError: writing failed.
    """
    held = {
        "format": FORMAT,
        "version": VERSION,
        "models": [
            {
                "gpu": model.gpu,
                "frames": model.frames,
                "coefficients": {
                    name: {"value": c.value, "low": c.low, "high": c.high}
                    for name, c in model.coefficients.items()
                },
            }
            for model in models
        ],
    }
    with replacing(path) as part, writing(path):
        part.write_text(json.dumps(held, indent=1) + "\n", encoding="utf-8")


def read_models(path: str | Path) -> dict[str, CostModel]:
    """Read a file of fitted models, by GPU.

    Raises:
        InputError: no such file, no JSON, or a field that is missing, unknown or out of range.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    if len(data) > MAX_FILE_BYTES:
        raise InputError(f"{path}: longer than {MAX_FILE_BYTES} bytes: not a cost model")
    try:
        read = _File.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "file"
        raise InputError(f"{path}: {place}: {first['msg']}") from None
    models: dict[str, CostModel] = {}
    for model in read.models:
        if model.gpu in models:
            raise InputError(f"{path}: models: {model.gpu!r} stands there twice")
        for name, c in model.coefficients.items():
            _check(name, c, f"{path}: {model.gpu}: coefficients")
        found = {n: Coefficient(c.value, c.low, c.high) for n, c in model.coefficients.items()}
        if "l2.passed" not in found:
            raise InputError(f"{path}: {model.gpu}: coefficients: 'l2.passed' is missing")
        models[model.gpu] = CostModel(model.gpu, found, model.frames)
    return models


def _check(name: str, c: _Coefficient, where: str) -> None:
    level, _, what = name.partition(".")
    if name not in COEFFICIENTS and (level not in _LEVELS or what != "passed"):
        raise InputError(f"{where}: unknown coefficient {name!r}")
    if not c.low <= c.value <= c.high:
        raise InputError(f"{where}: {name}: value {c.value:g} is not in {c.low:g} to {c.high:g}")
    if not name.startswith("cycles.") and c.value == 0.0:
        raise InputError(f"{where}: {name}: value 0: allowed are numbers above 0")
