"""The native trace file: Parquet (zstd), one row per access instruction of a warp, streamed in both
directions.

Columns that any Parquet reader understands: launch, cta, warp (in its CTA), step (in its warp),
instruction, and mask (bit l = lane l is active). The lanes stand in byte planes as residuals of a
prediction (`traces.encoding`), which `read_parquet` undoes; the manifest, textures, instructions
and launches stand in the file's metadata as JSON (`traces.description`). Row groups hold whole
CTAs. Pages carry checksums.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from traces.check import Checker
from traces.description import Description, Piece, from_metadata, to_metadata
from traces.errors import InputError
from traces.files import replacing, writing
from traces.row_groups import CTAS_PER_GROUP, RowGroups, merged, split
from traces.trace import Chunk, Trace

#: Of zstd. Level 1 leaves passes with regular addresses seven times as large; on scattered fetches
#: all levels do alike.
COMPRESSION_LEVEL = 3
_COUNTED = ("cta", "warp", "step")
_REPEATED = ("launch", "instruction")


def write_parquet(
    trace: Trace, path: str | Path, progress: Callable[[int], None] | None = None
) -> None:
    """Write a trace, chunk by chunk; every chunk is checked on its way.

    progress: told the number of lane fetches written so far, after each chunk.

    Raises:
        InputError: a broken trace, or a folder that cannot be written to.
        WorkError: writing failed, for example for want of space. Nothing is left behind.
    """
    checker = Checker(trace, str(path))
    groups = RowGroups(trace)
    pieces: list[Piece] = []
    with replacing(path) as part_path, _open_writer(part_path, groups, path) as writer:
        for chunk in merged(_checked(trace, checker, progress)):
            warps_per_cta = trace.launches[chunk.launch].warps_per_cta
            for piece, part in split(chunk, warps_per_cta, str(path)):
                pieces.append(piece)
                if piece.num_rows:
                    table = groups.table(part)
                    with writing(path):
                        writer.write_table(table)
        writer.add_key_value_metadata(to_metadata(trace, pieces))


def read_parquet(path: str | Path) -> Trace:
    """Open a trace file. Its rows are read, and checked, a row group at a time whenever `chunks()`
    is called.

    Raises:
        InputError: not a trace file, truncated, corrupt, or with metadata that contradicts itself;
            later also from the chunks.
    """
    path = Path(path)
    with _readable(path), pq.ParquetFile(path) as file:
        schema = file.schema_arrow.remove_metadata()
        metadata = file.metadata.metadata or {}
        rows = [file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)]
    description = from_metadata(metadata, str(path))
    manifest, textures, instructions, launches, pieces = description
    trace = Trace(manifest, textures, instructions, launches, lambda: _chunks(path, trace, pieces))
    checker = Checker(trace, str(path))
    for index in range(len(launches)):
        checker.check_launch(index)
    expected = RowGroups(trace).schema
    if schema != expected:
        raise InputError(
            f"{path}: columns {', '.join(f'{f.name} {f.type}' for f in schema)}: "
            f"need {', '.join(f'{f.name} {f.type}' for f in expected)}"
        )
    _check_pieces(description, rows, path)
    return trace


@contextmanager
def _open_writer(part: Path, groups: RowGroups, path: str | Path) -> Iterator[pq.ParquetWriter]:
    """A writer to the file `part`, whose errors name `path`. The footer is written when the block
    ends well.
    """
    with writing(path):
        file = pa.OSFile(str(part), "wb")
        writer = pq.ParquetWriter(
            file,
            groups.schema,
            compression="zstd",
            compression_level=COMPRESSION_LEVEL,
            use_dictionary=list(_REPEATED),
            column_encoding={
                **dict.fromkeys(_COUNTED, "DELTA_BINARY_PACKED"),
                **dict.fromkeys(groups.planes, "DELTA_LENGTH_BYTE_ARRAY"),
            },
            write_statistics=["launch", "cta", "instruction"],
            write_page_checksum=True,
            store_schema=False,
        )
    try:
        yield writer
    except BaseException:
        # The file is going to be removed; what closing says about it is of no interest.
        with suppress(OSError):
            writer.close()
        with suppress(OSError):
            file.close()
        raise
    with writing(path):
        writer.close()
        file.close()


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turns what pyarrow raises on bad files into an `InputError` that names the file."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: not a readable Parquet file: {reason}") from None


def _checked(
    trace: Trace, checker: Checker, progress: Callable[[int], None] | None
) -> Iterator[Chunk]:
    for chunk in trace.chunks():
        checker.chunk(chunk)
        yield chunk
        if progress:
            progress(checker.num_lane_fetches)
    checker.finish()


def _check_pieces(description: Description, rows: list[int], path: Path) -> None:
    """The list of pieces agrees with the row groups, and names launches that exist."""
    if [piece.num_rows for piece in description.chunks if piece.num_rows] != rows:
        raise InputError(
            f"{path}: metadata 'chunks' lists other numbers of rows than the file's {len(rows)} "
            "row groups have"
        )
    for index, piece in enumerate(description.chunks):
        if not 0 <= piece.launch < len(description.launches):
            raise InputError(
                f"{path}: metadata 'chunks' at {index}: launch {piece.launch}: "
                f"allowed are 0 to {len(description.launches) - 1}"
            )
        if min(piece) < 0 or piece.num_ctas > CTAS_PER_GROUP:
            raise InputError(
                f"{path}: metadata 'chunks' at {index}: {piece.num_ctas} CTAs from "
                f"{piece.first_cta}: allowed are up to {CTAS_PER_GROUP} from 0 up"
            )


def _chunks(path: Path, trace: Trace, pieces: list[Piece]) -> Iterator[Chunk]:
    checker = Checker(trace, str(path))
    groups = RowGroups(trace)
    with _readable(path):
        file = pq.ParquetFile(path, page_checksum_verification=True)
    with file:
        group = 0
        for piece in pieces:
            table = None
            if piece.num_rows:
                with _readable(path):
                    table = file.read_row_group(group)
            chunk = groups.chunk(table, piece, f"{path}: row group {group}")
            checker.chunk(chunk)
            yield chunk
            group += piece.num_rows > 0
    checker.finish()
