"""Output files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from traces.errors import InputError, WorkError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix, for the block to write to.

    When the block ends, the temporary file takes the place of `path`; when it fails or is
    interrupted, the file is removed and whatever stood at `path` stays.

    Raises:
        InputError: the folder does not exist or may not be written to, or `path` is a folder.
        WorkError: the finished file could not be put in place.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; need the name of a file")
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        part.touch()
    except OSError as error:
        raise InputError(f"{path}: cannot write here: {error.strerror}") from None
    try:
        yield part
        try:
            part.replace(path)
        except OSError as error:
            raise WorkError(f"{path}: cannot write: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Turns an OSError of the block into a `WorkError` that names the file.

    Raises:
        WorkError: the block failed to write, for example for want of space.
    """
    try:
        yield
    except OSError as error:
        raise WorkError(f"{path}: cannot write: {error.strerror or error}") from None
