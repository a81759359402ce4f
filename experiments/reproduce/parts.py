"""Finished cells of long experiments, kept so that an interrupted run goes on where it stopped.

A cell is one file, JSON or NumPy arrays, with a fingerprint of its inputs and of the sources that
made it; a cell with another fingerprint is computed again and replaced.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from experiments.output import output_folder, write_text
from traces.files import replacing, writing

Arrays = dict[str, npt.NDArray[Any]]

#: What, besides Python, decides a result: OpenCL sources, presets, counted instructions.
_SUFFIXES = (".py", ".cl", ".h", ".toml", ".json", ".cu")
_ROOT = Path(__file__).resolve().parents[2]


def cell_name(words: str) -> str:
    """Words as the name of a cell's file: "AFIS, fixed, 64" is "AFIS-fixed-64"."""
    return words.replace(", ", "-").replace(" ", "-")


class Parts:
    """The cells of one experiment.

    folder: where they lie; made when the first is written. sources: dotted names of packages and
    modules, such as "kernels" or "experiments.reproduce.cv_toy".
    """

    def __init__(self, folder: Path, sources: Sequence[str] = ()) -> None:
        self._folder = folder
        self._sources = tuple(sources)

    def json(self, name: str, inputs: Mapping[str, Any], compute: Callable[[], Any]) -> Any:
        """The cell `name` as JSON holds it: read where it is finished, computed and kept otherwise.

        inputs: all that decides the value besides the sources; JSON.
        """
        path, wanted = self._folder / f"{name}.json", self.fingerprint(inputs)
        kept = _read_json(path)
        if isinstance(kept, dict) and kept.get("fingerprint") == wanted:
            return kept["value"]
        value = compute()
        text = json.dumps({"fingerprint": wanted, "value": value}, indent=1)
        output_folder(self._folder)
        write_text(path, text + "\n")
        # What a later run will read: tuples are lists by then.
        return json.loads(text)["value"]

    def arrays(self, name: str, inputs: Mapping[str, Any], compute: Callable[[], Arrays]) -> Arrays:
        """The same of named arrays of numbers, such as pictures."""
        path, wanted = self._folder / f"{name}.npz", self.fingerprint(inputs)
        kept = _read_arrays(path)
        if kept is not None and str(kept.pop("fingerprint", "")) == wanted:
            return kept
        value = {key: np.asarray(array) for key, array in compute().items()}
        held = BytesIO()
        if any(array.dtype.hasobject for array in value.values()):
            raise TypeError(f"{name}: arrays of objects cannot be kept")
        save: Any = np.savez_compressed
        save(held, fingerprint=np.array(wanted), **value)
        output_folder(self._folder)
        with replacing(path) as part, writing(path):
            part.write_bytes(held.getbuffer())
        return value

    def fingerprint(self, inputs: Mapping[str, Any]) -> str:
        """SHA-256 of the inputs and of the sources' text."""
        hashed = hashlib.sha256(json.dumps(dict(inputs), sort_keys=True).encode())
        for name in self._sources:
            hashed.update(f"{name}\0{_source_hash(name)}\0".encode())
        return hashed.hexdigest()


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None


def _read_arrays(path: Path) -> Arrays | None:
    try:
        # From memory: NumPy leaves the file of a damaged archive open.
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as held:
            return {key: held[key] for key in held.files}
    except (FileNotFoundError, ValueError, EOFError, BadZipFile):
        return None


@cache
def _source_hash(name: str) -> str:
    hashed = hashlib.sha256()
    for path in _source_files(name):
        hashed.update(f"{path.name}\0".encode() + path.read_bytes())
    return hashed.hexdigest()


def _source_files(name: str) -> Iterator[Path]:
    """The files of a package, or the one of a module.

    Raises:
        ValueError: the repository has no such package or module.
    """
    place = _ROOT.joinpath(*name.split("."))
    if place.is_dir():
        yield from sorted(p for p in place.rglob("*") if p.suffix in _SUFFIXES)
    elif place.with_suffix(".py").is_file():
        yield place.with_suffix(".py")
    else:
        raise ValueError(f"no package or module {name!r}")
