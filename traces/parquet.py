"""The native trace file: Parquet (zstd), one row per access instruction of a warp, streamed in both directions.

Columns that any Parquet reader understands: launch, cta, warp (in its CTA), step (in its warp), instruction, and mask (bit l = lane l
is active). The lanes stand in byte planes as residuals of a prediction (`traces.encoding`), which `read_parquet` undoes; the manifest,
textures, instructions and launches stand in the file's metadata as JSON (`traces.description`). Row groups hold whole CTAs. Pages
carry checksums.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from traces.check import Checker, level_sizes
from traces.description import Description, Piece, from_metadata, to_metadata
from traces.encoding import NUM_ADDRESS_PLANES, Planes, decode, encode
from traces.errors import InputError
from traces.files import replacing, writing
from traces.trace import Chunk, Trace

#: Rows of a row group, unless one CTA has more: 8 MiB of lanes, which bounds the memory of a reader.
ROWS_PER_GROUP = 1 << 16
#: CTAs of a row group: bounds the memory of a piece whose warps have few rows or none.
CTAS_PER_GROUP = 1 << 16
#: A row group's planes are addressed with 32-bit offsets, at 64 bytes a row.
MAX_ROWS_PER_CTA = 1 << 24
#: Of zstd. Higher levels gain under 2 % on residuals that are noise, and cost several times as much.
COMPRESSION_LEVEL = 1
_TEXEL_PLANES = ("mip", "xy_low", "xy_high")
_ADDRESS_PLANES = tuple(f"address_{byte}" for byte in range(NUM_ADDRESS_PLANES))
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
    sizes = level_sizes(trace)
    names = _plane_names(trace)
    pieces: list[Piece] = []
    with replacing(path) as part_path, _open_writer(part_path, names, path) as writer:
        for chunk in trace.chunks():
            checker.chunk(chunk)
            for piece, part in _split(chunk, trace.launches[chunk.launch].warps_per_cta, path):
                pieces.append(piece)
                if piece.num_rows:
                    warps_per_cta = trace.launches[piece.launch].warps_per_cta
                    planes = encode(part.lanes, part.warp_offsets, part.instruction, sizes)
                    with writing(path):
                        writer.write_table(_table(part, planes, warps_per_cta, names))
            if progress:
                progress(checker.num_lane_fetches)
        checker.finish()
        writer.add_key_value_metadata(to_metadata(trace, pieces))


def read_parquet(path: str | Path) -> Trace:
    """Open a trace file. Its rows are read, and checked, a row group at a time whenever `chunks()` is called.

    Raises:
        InputError: not a trace file, truncated, corrupt, or with metadata that contradicts itself; later also from the chunks.
    """
    path = Path(path)
    with _readable(path), pq.ParquetFile(path) as file:
        schema = file.schema_arrow.remove_metadata()
        metadata = file.metadata.metadata or {}
        rows = [file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)]
    description = from_metadata(metadata, str(path))
    manifest, textures, instructions, launches, pieces = description
    trace = Trace(manifest, textures, instructions, launches, lambda: _chunks(path, trace, pieces))
    expected = _schema(_plane_names(trace))
    if schema != expected:
        raise InputError(
            f"{path}: columns {', '.join(f'{f.name} {f.type}' for f in schema)}: "
            f"need {', '.join(f'{f.name} {f.type}' for f in expected)}"
        )
    checker = Checker(trace, str(path))
    for index in range(len(launches)):
        checker.check_launch(index)
    _check_pieces(description, rows, path)
    return trace


def _plane_names(trace: Trace) -> tuple[str, ...]:
    return _ADDRESS_PLANES if trace.is_lane_address else _TEXEL_PLANES


def _schema(planes: tuple[str, ...]) -> pa.Schema:
    fixed = {
        "launch": pa.int32(),
        "cta": pa.int32(),
        "warp": pa.int32(),
        "step": pa.int32(),
        "instruction": pa.uint16(),
        "mask": pa.uint32(),
        "predictor": pa.uint8(),
    }
    fields = [pa.field(name, kind, nullable=False) for name, kind in fixed.items()]
    return pa.schema(fields + [pa.field(name, pa.binary()) for name in planes])


@contextmanager
def _open_writer(
    part: Path, planes: tuple[str, ...], path: str | Path
) -> Iterator[pq.ParquetWriter]:
    """A writer to the file `part`, whose errors name `path`. The footer is written when the block ends well."""
    with writing(path):
        file = pa.OSFile(str(part), "wb")
        writer = pq.ParquetWriter(
            file,
            _schema(planes),
            compression="zstd",
            compression_level=COMPRESSION_LEVEL,
            use_dictionary=list(_REPEATED),
            column_encoding={
                **dict.fromkeys(_COUNTED, "DELTA_BINARY_PACKED"),
                **dict.fromkeys(planes, "DELTA_LENGTH_BYTE_ARRAY"),
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


def _split(chunk: Chunk, warps_per_cta: int, path: str | Path) -> Iterator[tuple[Piece, Chunk]]:
    """The chunk in pieces of whole CTAs with at most `ROWS_PER_GROUP` rows where CTAs allow."""
    starts = chunk.warp_offsets[::warps_per_cta]
    num_ctas = len(starts) - 1
    if num_ctas and int(np.diff(starts).max()) > MAX_ROWS_PER_CTA:
        raise InputError(f"{path}: a CTA of more than {MAX_ROWS_PER_CTA} accesses cannot be stored")
    begin = 0
    while begin < num_ctas:
        end = int(np.searchsorted(starts, starts[begin] + ROWS_PER_GROUP, side="right")) - 1
        end = min(max(end, begin + 1), begin + CTAS_PER_GROUP, num_ctas)
        low, high = int(starts[begin]), int(starts[end])
        offsets = chunk.warp_offsets[begin * warps_per_cta : end * warps_per_cta + 1]
        first = chunk.first_cta + begin
        yield (
            Piece(chunk.launch, first, end - begin, high - low),
            Chunk(chunk.launch, first, offsets - low, chunk.instruction[low:high], chunk.lanes[low:high]),
        )
        begin = end


def _table(chunk: Chunk, planes: Planes, warps_per_cta: int, names: tuple[str, ...]) -> pa.Table:
    num_rows = chunk.num_rows
    lengths = np.diff(chunk.warp_offsets)
    warp = np.repeat(np.arange(chunk.num_warps, dtype=np.int32), lengths)
    step = np.arange(num_rows) - np.repeat(chunk.warp_offsets[:-1], lengths)
    columns = [
        pa.array(np.full(num_rows, chunk.launch, np.int32)),
        pa.array(warp // np.int32(warps_per_cta) + np.int32(chunk.first_cta)),
        pa.array(warp % np.int32(warps_per_cta)),
        pa.array(step.astype(np.int32)),
        pa.array(chunk.instruction),
        pa.array(planes.mask),
        pa.array(planes.predictor),
    ]
    for plane, data in enumerate(planes.data):
        valid = np.packbits(planes.present[plane], bitorder="little")
        buffers = [pa.py_buffer(valid), pa.py_buffer(planes.offsets[plane]), pa.py_buffer(data)]
        columns.append(pa.Array.from_buffers(pa.binary(), num_rows, buffers))
    return pa.table(columns, schema=_schema(names))


def _check_pieces(description: Description, rows: list[int], path: Path) -> None:
    """The list of pieces agrees with the row groups, and its CTAs with the launches' size."""
    if [piece.num_rows for piece in description.chunks if piece.num_rows] != rows:
        raise InputError(
            f"{path}: metadata 'chunks' lists other numbers of rows than the file's {len(rows)} row groups have"
        )
    for index, piece in enumerate(description.chunks):
        if not 0 <= piece.launch < len(description.launches):
            raise InputError(
                f"{path}: metadata 'chunks' at {index}: launch {piece.launch}: "
                f"allowed are 0 to {len(description.launches) - 1}"
            )
        if min(piece) < 0 or piece.num_ctas > CTAS_PER_GROUP:
            raise InputError(
                f"{path}: metadata 'chunks' at {index}: {piece.num_ctas} CTAs from {piece.first_cta}: "
                f"allowed are up to {CTAS_PER_GROUP} from 0 up"
            )


def _chunks(path: Path, trace: Trace, pieces: list[Piece]) -> Iterator[Chunk]:
    checker = Checker(trace, str(path))
    sizes = level_sizes(trace)
    with _readable(path):
        file = pq.ParquetFile(path, page_checksum_verification=True)
    with file:
        group = 0
        for piece in pieces:
            warps_per_cta = trace.launches[piece.launch].warps_per_cta
            if piece.num_rows:
                with _readable(path):
                    table = file.read_row_group(group)
                chunk = _chunk(table, piece, warps_per_cta, trace, sizes, f"{path}: row group {group}")
                group += 1
            else:
                offsets = np.zeros(piece.num_ctas * warps_per_cta + 1, np.int64)
                lanes = np.empty((0, 32), np.uint64 if trace.is_lane_address else np.uint32)
                chunk = Chunk(piece.launch, piece.first_cta, offsets, np.empty(0, np.uint16), lanes)
            checker.chunk(chunk)
            yield chunk
    checker.finish()


def _chunk(
    table: pa.Table,
    piece: Piece,
    warps_per_cta: int,
    trace: Trace,
    sizes: tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32]],
    where: str,
) -> Chunk:
    """The rows of one row group, decoded. Raises: InputError: columns that contradict each other or the piece."""
    column = {name: table.column(name).combine_chunks() for name in table.column_names}
    numbers = {name: column[name].to_numpy() for name in column if name not in _plane_names(trace)}
    launch, cta, warp, step = (numbers[name].astype(np.int64) for name in ("launch", *_COUNTED))
    num_warps = piece.num_ctas * warps_per_cta
    warp_in_piece = (cta - piece.first_cta) * warps_per_cta + warp
    bad = (launch != piece.launch) | (warp < 0) | (warp >= warps_per_cta)
    bad |= (warp_in_piece < 0) | (warp_in_piece >= num_warps)
    bad[1:] |= warp_in_piece[1:] < warp_in_piece[:-1]
    offsets = np.zeros(num_warps + 1, np.int64)
    if not bad.any():
        offsets[1:] = np.cumsum(np.bincount(warp_in_piece, minlength=num_warps))
        bad |= step != np.arange(len(step)) - offsets[warp_in_piece]
    if bad.any():
        row = int(bad.argmax())
        raise InputError(
            f"{where}, row {row}: launch {launch[row]}, cta {cta[row]}, warp {warp[row]}, step {step[row]}: must be of launch "
            f"{piece.launch}, CTAs {piece.first_cta} to {piece.first_cta + piece.num_ctas - 1} of {warps_per_cta} warps, "
            "in order, steps from 0"
        )
    instruction = numbers["instruction"]
    if int(instruction.max()) >= len(trace.instructions):
        raise InputError(
            f"{where}: instruction {instruction.max()}: allowed are 0 to {len(trace.instructions) - 1}"
        )
    planes = _planes([column[name] for name in _plane_names(trace)], numbers)
    try:
        lanes = decode(planes, offsets, instruction, sizes)
    except ValueError as error:
        raise InputError(f"{where}, {error}") from None
    return Chunk(piece.launch, piece.first_cta, offsets, instruction, lanes)


def _planes(columns: list[pa.BinaryArray], numbers: dict[str, npt.NDArray[np.uint32]]) -> Planes:
    """The buffers of the planes' columns, without copies of the data."""
    num_rows = len(columns[0])
    present = np.ones((len(columns), num_rows), np.bool_)
    offsets = np.zeros((len(columns), num_rows + 1), np.int32)
    data = []
    for plane, column in enumerate(columns):
        valid, ends, held = column.buffers()
        if valid is not None:
            bits = np.frombuffer(valid, np.uint8)
            bits = np.unpackbits(bits, count=column.offset + num_rows, bitorder="little")
            present[plane] = bits[column.offset :]
        offsets[plane] = np.frombuffer(ends, np.int32)[column.offset : column.offset + num_rows + 1]
        data.append(np.frombuffer(held, np.uint8) if held is not None else np.empty(0, np.uint8))
    mask, predictor = numbers["mask"], numbers["predictor"].astype(np.uint8)
    return Planes(mask, predictor, present, offsets, tuple(data))
