"""Where commands read and write: paths checked before the work, results whole or not at all."""

from __future__ import annotations

import os
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from traces.errors import InputError
from traces.files import replacing, writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all."""
    with replacing(path) as part, writing(path):
        part.write_text(text, encoding="utf-8")


def write_figure(path: Path, figure: Figure, dpi: int = 150) -> None:
    """Write a figure in the format that the suffix names, whole or not at all."""
    # Drawn before the file is opened: matplotlib's PDF writer fails badly on a full disk.
    drawn = BytesIO()
    figure.savefig(drawn, dpi=dpi, format=path.suffix.removeprefix("."))
    with replacing(path) as part, writing(path):
        part.write_bytes(drawn.getbuffer())


def output_file(path: Path, *suffixes: str) -> Path:
    """`path` as an output that can be written: checked before the work starts, not after.

    Raises:
        InputError: its folder does not exist, it is a folder, or its suffix is none of `suffixes`.
    """
    if suffixes and path.suffix not in suffixes:
        raise InputError(f"{path}: suffix {path.suffix!r}: allowed are {', '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"{path}: is a folder: name a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: folder {str(path.parent)!r} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: folder {str(path.parent)!r} cannot be written")
    return path


def output_folder(path: Path) -> Path:
    """`path` as a folder for results; made, with its parents, where it does not exist.

    Raises:
        InputError: it exists and is no folder, or cannot be made or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path}: exists and is not a folder") from error
    except PermissionError as error:
        raise InputError(f"{path}: cannot be made: permission denied") from error
    if not os.access(path, os.W_OK):
        raise InputError(f"{path}: folder cannot be written")
    return path


def input_file(path: Path, *suffixes: str) -> Path:
    """`path` as an input that exists.

    Raises:
        InputError: no such file, or its suffix is none of `suffixes`.
    """
    if not path.is_file():
        raise InputError(f"{path}: is a folder" if path.is_dir() else f"{path}: no such file")
    if suffixes and path.suffix not in suffixes:
        raise InputError(f"{path}: suffix {path.suffix!r}: allowed are {', '.join(suffixes)}")
    return path
