"""Output files and folders that are written whole or not at all."""

from __future__ import annotations

import os
import shutil
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
def replacing_folder(folder: str | Path) -> Iterator[Path]:
    """A temporary folder beside `folder` for the block to fill.

    When the block ends, it takes the place of `folder`; when it fails or is interrupted, it is
    removed.

    Raises:
        InputError: `folder` is a file or is not empty, or cannot be made there.
        WorkError: the finished folder could not be put in place.
    """
    folder = check_new_folder(folder)
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        part.mkdir()
    except OSError as error:
        raise InputError(f"{folder}: cannot write here: {error.strerror}") from None
    try:
        yield part
        try:
            if folder.is_dir():
                folder.rmdir()
            part.rename(folder)
        except OSError as error:
            raise WorkError(f"{folder}: cannot write: {error.strerror}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def check_new_folder(folder: str | Path) -> Path:
    """`folder` as an output that replaces nothing: checked before the work starts, not after.

    Raises:
        InputError: it is a file or is not empty, or the folder it is to lie in does not exist.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; need the name of a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty; need a new or an empty folder")
    if not folder.parent.is_dir():
        raise InputError(f"{folder}: folder {str(folder.parent)!r} does not exist")
    return folder


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
