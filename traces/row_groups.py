"""Row groups of the native file: chunks cut and merged to a good size, as tables, and back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from traces import address_coding
from traces.description import Piece
from traces.encoding import Planes, decode, encode
from traces.errors import InputError
from traces.trace import Chunk, Trace

#: Rows of a row group, unless one CTA has more: 8 MiB of lanes, which bounds a reader's memory.
ROWS_PER_GROUP = 1 << 16
#: CTAs of a row group: bounds the memory of a piece whose warps have few rows or none.
CTAS_PER_GROUP = 1 << 16
#: A row group's planes are addressed with 32-bit offsets, at 64 bytes a row.
MAX_ROWS_PER_CTA = 1 << 24
_COLUMNS = {
    "launch": pa.int32(),
    "cta": pa.int32(),
    "warp": pa.int32(),
    "step": pa.int32(),
    "instruction": pa.uint16(),
    "mask": pa.uint32(),
    "predictor": pa.uint8(),
}
_TEXEL_PLANES = ("mip", "xy_low", "xy_high")
_ADDRESS_PLANES = tuple(f"address_{byte}" for byte in range(address_coding.NUM_PLANES))


class RowGroups:
    """Turns chunks of one trace, whose instructions have been checked, into tables and back.

    planes: names of the columns that hold the lanes. schema: of every table.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.planes = _ADDRESS_PLANES if trace.is_lane_address else _TEXEL_PLANES
        fields = [pa.field(name, kind, nullable=False) for name, kind in _COLUMNS.items()]
        self.schema = pa.schema(fields + [pa.field(name, pa.binary()) for name in self.planes])
        # Width and height of mip 0 of each instruction's texture, by which the lanes are predicted.
        held = (
            [] if trace.is_lane_address else [trace.textures[i.texture] for i in trace.instructions]
        )
        sizes = [(texture.width, texture.height) for texture in held]
        self._sizes = np.array(sizes, np.uint32).reshape(-1, 2)

    def table(self, chunk: Chunk) -> Any:
        """The `pa.Table` of a chunk."""
        warps_per_cta = np.int32(self.trace.launches[chunk.launch].warps_per_cta)
        lengths = np.diff(chunk.warp_offsets)
        warp = np.repeat(np.arange(chunk.num_warps, dtype=np.int32), lengths)
        step = np.arange(chunk.num_rows) - np.repeat(chunk.warp_offsets[:-1], lengths)
        planes = encode(chunk.lanes, chunk.warp_offsets, chunk.instruction, self._sizes)
        columns = [
            pa.array(np.full(chunk.num_rows, chunk.launch, np.int32)),
            pa.array(warp // warps_per_cta + np.int32(chunk.first_cta)),
            pa.array(warp % warps_per_cta),
            pa.array(step.astype(np.int32)),
            pa.array(chunk.instruction),
            pa.array(planes.mask),
            pa.array(planes.predictor),
        ]
        for plane, data in enumerate(planes.data):
            valid = np.packbits(planes.present[plane], bitorder="little")
            buffers = [pa.py_buffer(valid), pa.py_buffer(planes.offsets[plane]), pa.py_buffer(data)]
            columns.append(pa.Array.from_buffers(pa.binary(), chunk.num_rows, buffers))
        return pa.table(columns, schema=self.schema)

    def chunk(self, table: Any, piece: Piece, where: str) -> Chunk:
        """The chunk of a `pa.Table`, which may also be empty or None where the piece has no rows.

        where: what messages call the row group.

        Raises:
            InputError: columns that contradict each other or the piece.
        """
        if not piece.num_rows:
            num_warps = piece.num_ctas * self.trace.launches[piece.launch].warps_per_cta
            lanes = np.empty((0, 32), np.uint64 if self.trace.is_lane_address else np.uint32)
            offsets = np.zeros(num_warps + 1, np.int64)
            return Chunk(piece.launch, piece.first_cta, offsets, np.empty(0, np.uint16), lanes)
        column = {name: table.column(name).combine_chunks() for name in table.column_names}
        # Copies: what pyarrow hands out is read-only, for which every compiled loop of the readers
        # of this chunk would be compiled a second time.
        numbers = {name: column[name].to_numpy().copy() for name in _COLUMNS}
        offsets = self._warp_offsets(numbers, piece, where)
        instruction = numbers["instruction"]
        if int(instruction.max()) >= len(self.trace.instructions):
            raise InputError(
                f"{where}: instruction {instruction.max()}: "
                f"allowed are 0 to {len(self.trace.instructions) - 1}"
            )
        planes = _planes([column[name] for name in self.planes], numbers)
        try:
            lanes = decode(planes, offsets, instruction, self._sizes)
        except ValueError as error:
            raise InputError(f"{where}, {error}") from None
        return Chunk(piece.launch, piece.first_cta, offsets, instruction, lanes)

    def _warp_offsets(
        self, numbers: dict[str, npt.NDArray[Any]], piece: Piece, where: str
    ) -> npt.NDArray[np.int64]:
        """(warps + 1,) int64 as in `Chunk`, from the columns that say which warp a row is of."""
        places = (numbers[name].astype(np.int64) for name in ("launch", "cta", "warp", "step"))
        launch, cta, warp, step = places
        warps_per_cta = self.trace.launches[piece.launch].warps_per_cta
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
                f"{where}, row {row}: launch {launch[row]}, cta {cta[row]}, warp {warp[row]}, "
                f"step {step[row]}: must be of launch {piece.launch}, CTAs {piece.first_cta} to "
                f"{piece.first_cta + piece.num_ctas - 1} of {warps_per_cta} warps, in order, "
                "steps from 0"
            )
        return offsets


def _planes(columns: list[Any], numbers: dict[str, npt.NDArray[Any]]) -> Planes:
    """The buffers of the planes' columns (`pa.BinaryArray`), without copies of the data."""
    num_rows = len(columns[0])
    present = np.ones((len(columns), num_rows), np.bool_)
    offsets = np.zeros((len(columns), num_rows + 1), np.int32)
    data = []
    for plane, column in enumerate(columns):
        valid, ends, held = column.buffers()
        rows = slice(column.offset, column.offset + num_rows)
        if valid is not None:
            bits = np.unpackbits(np.frombuffer(valid, np.uint8), bitorder="little")
            present[plane] = bits[rows]
        offsets[plane] = np.frombuffer(ends, np.int32)[rows.start : rows.stop + 1]
        data.append(np.frombuffer(held, np.uint8) if held else np.empty(0, np.uint8))
    return Planes(numbers["mask"], numbers["predictor"], present, offsets, tuple(data))


def merged(chunks: Iterable[Chunk]) -> Iterator[Chunk]:
    """The chunks with runs of small ones of a launch made into one, so that row groups are worth
    their overhead.
    """
    held: list[Chunk] = []
    num_rows = 0
    for chunk in chunks:
        if held and (chunk.launch != held[0].launch or num_rows + chunk.num_rows > ROWS_PER_GROUP):
            yield _concatenate(held)
            held, num_rows = [], 0
        if chunk.num_rows > ROWS_PER_GROUP:
            yield chunk
        else:
            held.append(chunk)
            num_rows += chunk.num_rows
    if held:
        yield _concatenate(held)


def _concatenate(chunks: list[Chunk]) -> Chunk:
    """Consecutive chunks of one launch as one."""
    if len(chunks) == 1:
        return chunks[0]
    starts = np.cumsum([0] + [chunk.num_rows for chunk in chunks])
    ends = [chunk.warp_offsets[1:] + start for chunk, start in zip(chunks, starts, strict=False)]
    return Chunk(
        chunks[0].launch,
        chunks[0].first_cta,
        np.concatenate([chunks[0].warp_offsets[:1], *ends]),
        np.concatenate([chunk.instruction for chunk in chunks]),
        np.concatenate([chunk.lanes for chunk in chunks]),
    )


def split(chunk: Chunk, warps_per_cta: int, where: str) -> Iterator[tuple[Piece, Chunk]]:
    """The chunk in pieces of whole CTAs with at most `ROWS_PER_GROUP` rows where CTAs allow.

    Raises:
        InputError: a CTA with more than `MAX_ROWS_PER_CTA` rows.
    """
    starts = chunk.warp_offsets[::warps_per_cta]
    num_ctas = len(starts) - 1
    if num_ctas and int(np.diff(starts).max()) > MAX_ROWS_PER_CTA:
        raise InputError(
            f"{where}: a CTA of more than {MAX_ROWS_PER_CTA} accesses cannot be stored"
        )
    begin = 0
    while begin < num_ctas:
        end = int(np.searchsorted(starts, starts[begin] + ROWS_PER_GROUP, side="right")) - 1
        end = min(max(end, begin + 1), begin + CTAS_PER_GROUP, num_ctas)
        low, high = int(starts[begin]), int(starts[end])
        offsets = chunk.warp_offsets[begin * warps_per_cta : end * warps_per_cta + 1]
        first = chunk.first_cta + begin
        yield (
            Piece(chunk.launch, first, end - begin, high - low),
            Chunk(
                chunk.launch,
                first,
                offsets - low,
                chunk.instruction[low:high],
                chunk.lanes[low:high],
            ),
        )
        begin = end
