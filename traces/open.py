"""Open a trace of any known format; the format is told by the file's first bytes, not by its name.
A folder is opened by the list of kernels in it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from traces.accel_sim.lines import XZ_MAGIC
from traces.accel_sim.reader import read_accel_sim
from traces.accel_sim.writer import LIST_NAME
from traces.errors import InputError
from traces.lane_address import read_lane_address
from traces.parquet import read_parquet
from traces.trace import Trace

#: First bytes of a file -> its reader. A new format is one file and one line here. Accel-Sim's
#: lists of kernels begin with a kernel or a copy, its kernels with their names or compressed.
READERS: dict[bytes, Callable[[Path], Trace]] = {
    b"PAR1": read_parquet,
    b"PK\x03\x04": read_lane_address,
    b"kern": read_accel_sim,
    b"Memc": read_accel_sim,
    b"-ker": read_accel_sim,
    XZ_MAGIC[:4]: read_accel_sim,
}


def open_trace(path: str | Path) -> Trace:
    """The trace of a recording (`.parquet`), a lane-address file (`.npz`) or Accel-Sim's files: a
    folder with `kernelslist.g`, that list, a `.traceg` or `.traceg.xz`.

    Raises:
        InputError: no such file, or not one of the formats; and what the reader raises.
    """
    path = Path(path)
    if path.name == LIST_NAME or (path / LIST_NAME).is_file():
        return read_accel_sim(path)
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if start not in READERS:
        raise InputError(
            f"{path}: starts with {start!r}: is no Parquet trace, lane-address .npz or "
            "Accel-Sim trace"
        )
    return READERS[start](path)
