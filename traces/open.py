"""Open a trace file of any known format; the format is told by the file's first bytes, not by its
name.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from traces.errors import InputError
from traces.lane_address import read_lane_address
from traces.parquet import read_parquet
from traces.trace import Trace

#: First bytes of a file -> its reader. A new format is one file and one line here.
READERS: dict[bytes, Callable[[Path], Trace]] = {
    b"PAR1": read_parquet,
    b"PK\x03\x04": read_lane_address,
}


def open_trace(path: str | Path) -> Trace:
    """The trace of a recording (`.parquet`) or of a lane-address file (`.npz`).

    Raises:
        InputError: no such file, or not one of the formats; and what the reader raises.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if start not in READERS:
        raise InputError(
            f"{path}: starts with {start!r}: is neither a Parquet trace nor a lane-address .npz"
        )
    return READERS[start](path)
