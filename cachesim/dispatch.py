"""CTA dispatch: which warp's access issues when, on which SM, without a clock (`Order when
counting`).

Time is turns: in each turn every SM, in index order, issues the next access of its next resident
    warp, round robin. A CTA leaves after its last access, and the next CTA in order takes its
    place. At a launch's start CTAs are placed one per SM in turn. The order depends on the numbers
    of accesses alone, never on hits, nor on how the trace was cut into chunks.

Where an SM has several L1 units, pairs of warp slots take them in turn: warps go to the four
schedulers in turn, and a pair of schedulers shares a unit (Maxwell and Pascal).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.compiled import compiled, inlined
from cachesim.config import SM
from traces.errors import InputError
from traces.trace import Chunk, Launch

I64 = np.int64


class IssuedRows(NamedTuple):
    """A batch of rows in issue order.

    slot: (n,) int64, where each row lies in `lanes` and `instruction`. instance: (n,) uint32, the
        L1 unit it goes to.
    lanes: (capacity, warp_size), instruction: (capacity,) uint16, the dispatcher's store; valid
        until its next `issue`.
    """

    slot: npt.NDArray[np.int64]
    instance: npt.NDArray[np.uint32]
    lanes: npt.NDArray[np.uint32] | npt.NDArray[np.uint64]
    instruction: npt.NDArray[np.uint16]


def resident_ctas(sm: SM, launch: Launch) -> int:
    """How many CTAs of a launch one SM holds at a time: the least of its CTA, warp, register and
    shared-memory limits.

    Raises:
        InputError: a single CTA does not fit.
    """
    warps = -(-launch.warps_per_cta * 32 // sm.warp_size)
    limits = [sm.max_ctas, sm.max_warps // warps]
    if launch.registers_per_thread:
        limits.append(sm.registers // (launch.registers_per_thread * sm.warp_size * warps))
    if launch.shared_bytes_per_cta:
        limits.append(sm.shared // launch.shared_bytes_per_cta)
    if min(limits) < 1:
        raise InputError(
            f"launch {launch.pass_name!r}: a CTA of {warps} warps, "
            f"{launch.registers_per_thread} registers per thread and "
            f"{launch.shared_bytes_per_cta} B of shared memory does not fit an SM of "
            f"{sm.max_warps} warps, {sm.registers} registers and {sm.shared} B"
        )
    return min(limits)


@inlined
def _place(  # type: ignore[no-untyped-def]
    sm, place, warps_per_cta, queue, warp_first, warp_rows, next_row, rows_left, warps_left, cta_at
):
    """Put the next CTA of the queue on place `place` of an SM."""
    cta = queue[0]
    queue[0] = cta + 1
    live = 0
    for w in range(warps_per_cta):
        slot = place * warps_per_cta + w
        next_row[sm, slot] = warp_first[cta * warps_per_cta + w]
        rows_left[sm, slot] = warp_rows[cta * warps_per_cta + w]
        live += rows_left[sm, slot] > 0
    warps_left[sm, place] = live
    cta_at[sm, place] = cta


@compiled
def _fill_first(  # type: ignore[no-untyped-def]
    warps_per_cta,
    num_places,
    queue,
    num_queued,
    warp_first,
    warp_rows,
    next_row,
    rows_left,
    warps_left,
    cta_at,
):
    """Place CTAs one per SM in turn until all SMs are full."""
    for place in range(num_places):
        for sm in range(next_row.shape[0]):
            if queue[0] < num_queued:
                _place(
                    sm,
                    place,
                    warps_per_cta,
                    queue,
                    warp_first,
                    warp_rows,
                    next_row,
                    rows_left,
                    warps_left,
                    cta_at,
                )


@compiled
def _issue(  # type: ignore[no-untyped-def]
    warps_per_cta,
    units,
    complete,
    mask,
    queue,
    num_queued,
    warp_first,
    warp_rows,
    next_row,
    rows_left,
    warps_left,
    cta_at,
    pointer,
    left,
    out_slot,
    out_instance,
):
    """Run whole turns until the output is full, the queue could run dry within a turn, or all is
    issued. Returns rows issued.
    """
    num_sms, num_slots = next_row.shape
    n = 0
    idle = False
    while (
        not idle and n + num_sms <= len(out_slot) and (complete or num_queued - queue[0] >= num_sms)
    ):
        idle = True
        for sm in range(num_sms):
            slot = pointer[sm]
            for _ in range(num_slots):
                if rows_left[sm, slot]:
                    break
                slot += 1
                if slot == num_slots:
                    slot = 0
            if not rows_left[sm, slot]:
                continue
            idle = False
            out_slot[n] = next_row[sm, slot] & mask
            out_instance[n] = sm * units + (slot // 2) % units
            n += 1
            next_row[sm, slot] += 1
            rows_left[sm, slot] -= 1
            pointer[sm] = slot + 1 if slot + 1 < num_slots else 0
            if rows_left[sm, slot] == 0:
                place = slot // warps_per_cta
                warps_left[sm, place] -= 1
                if warps_left[sm, place] == 0:
                    left[cta_at[sm, place]] = 1
                    if queue[0] < num_queued:
                        _place(
                            sm,
                            place,
                            warps_per_cta,
                            queue,
                            warp_first,
                            warp_rows,
                            next_row,
                            rows_left,
                            warps_left,
                            cta_at,
                        )
    return n


class Dispatcher:
    """Holds the rows of resident and waiting CTAs of one launch at a time, and hands them out in
    issue order.

    The store is a ring of rows; it grows to what the resident CTAs need and is reused by every
    launch.
    """

    def __init__(
        self, sm: SM, units_per_sm: int, lanes_dtype: npt.DTypeLike, batch_rows: int
    ) -> None:
        self._sm = sm
        self._units = units_per_sm
        self._batch_rows = max(batch_rows, sm.count)
        self._lanes = np.empty((1 << 12, sm.warp_size), lanes_dtype)
        self._instruction = np.empty(1 << 12, np.uint16)
        self._launch: Launch | None = None

    def begin(self, launch: Launch) -> None:
        """Start a launch; the last one must be drained."""
        self._launch = launch
        self._places = resident_ctas(self._sm, launch)
        self._warps = -(-launch.warps_per_cta * 32 // self._sm.warp_size)
        num_slots = self._places * self._warps
        self._head = self._tail = 0
        self._queue = np.zeros(1, I64)
        self._complete = self._filled = False
        self._warp_first = np.zeros(0, I64)
        self._warp_rows = np.zeros(0, I64)
        self._left = np.zeros(0, np.uint8)
        self._next_row = np.zeros((self._sm.count, num_slots), I64)
        self._rows_left = np.zeros((self._sm.count, num_slots), I64)
        self._warps_left = np.zeros((self._sm.count, self._places), I64)
        self._cta_at = np.zeros((self._sm.count, self._places), I64)
        self._pointer = np.zeros(self._sm.count, I64)

    def add(self, chunk: Chunk) -> None:
        """Queue the CTAs of a chunk. CTAs without accesses take no room."""
        offsets, lanes, instruction = chunk.warp_offsets, chunk.lanes, chunk.instruction
        assert self._launch is not None
        if self._sm.warp_size == 64:
            offsets, lanes, instruction = join_warps(
                offsets, lanes, instruction, self._launch.warps_per_cta
            )
        self._drop_left()
        rows = len(instruction)
        self._reserve(rows)
        capacity = len(self._instruction)
        at = self._head % capacity
        first = min(rows, capacity - at)
        self._lanes[at : at + first], self._instruction[at : at + first] = (
            lanes[:first],
            instruction[:first],
        )
        self._lanes[: rows - first], self._instruction[: rows - first] = (
            lanes[first:],
            instruction[first:],
        )
        counts = np.diff(offsets).reshape(-1, self._warps)
        some = counts.any(axis=1)
        starts = (self._head + offsets[:-1]).reshape(counts.shape)
        self._warp_first = np.concatenate([self._warp_first, starts[some].ravel()])
        self._warp_rows = np.concatenate([self._warp_rows, counts[some].ravel()])
        self._left = np.concatenate([self._left, np.zeros(int(some.sum()), np.uint8)])
        self._head += rows

    def finish(self) -> None:
        """Say that the launch's last chunk was added."""
        self._complete = True

    def issue(self) -> IssuedRows | None:
        """The next batch of rows, or None when more chunks are needed or the launch is drained."""
        num_queued = len(self._left)
        if not self._filled:
            if not self._complete and num_queued < self._sm.count * (self._places + 1):
                return None
            _fill_first(
                self._warps,
                self._places,
                self._queue,
                num_queued,
                self._warp_first,
                self._warp_rows,
                self._next_row,
                self._rows_left,
                self._warps_left,
                self._cta_at,
            )
            self._filled = True
        slot = np.empty(self._batch_rows, I64)
        instance = np.empty(self._batch_rows, np.uint32)
        n = _issue(
            self._warps,
            self._units,
            self._complete,
            len(self._instruction) - 1,
            self._queue,
            num_queued,
            self._warp_first,
            self._warp_rows,
            self._next_row,
            self._rows_left,
            self._warps_left,
            self._cta_at,
            self._pointer,
            self._left,
            slot,
            instance,
        )
        return IssuedRows(slot[:n], instance[:n], self._lanes, self._instruction) if n else None

    def _drop_left(self) -> None:
        """Forget the oldest CTAs that have left, and free their rows."""
        gone = int(np.argmin(self._left)) if not self._left.all() else len(self._left)
        gone = min(gone, int(self._queue[0]))
        if gone == 0:
            return
        self._left = self._left[gone:]
        self._warp_first = self._warp_first[gone * self._warps :]
        self._warp_rows = self._warp_rows[gone * self._warps :]
        self._queue -= gone
        self._cta_at -= gone
        self._tail = int(self._warp_first[0]) if len(self._warp_first) else self._head

    def _reserve(self, rows: int) -> None:
        """Make room for `rows` more rows; the capacity stays a power of two."""
        capacity = len(self._instruction)
        needed = self._head - self._tail + rows
        if needed <= capacity:
            return
        larger = 1 << (needed - 1).bit_length()
        lanes = np.empty((larger, self._lanes.shape[1]), self._lanes.dtype)
        instruction = np.empty(larger, np.uint16)
        kept = np.arange(self._tail, self._head)
        lanes[kept % larger], instruction[kept % larger] = (
            self._lanes[kept % capacity],
            self._instruction[kept % capacity],
        )
        self._lanes, self._instruction = lanes, instruction


@compiled
def _join(  # type: ignore[no-untyped-def]
    offsets, lanes, instruction, warps_per_cta, inactive, out_offsets, out_lanes, out_instruction
):
    n, out_warp = 0, 0
    for first in range(0, len(offsets) - 1, warps_per_cta):
        for w in range(0, warps_per_cta, 2):
            a, a_end = offsets[first + w], offsets[first + w + 1]
            b, b_end = a_end, a_end
            if w + 1 < warps_per_cta:
                b_end = offsets[first + w + 2]
            while a < a_end or b < b_end:
                take_a = a < a_end and (b == b_end or instruction[a] <= instruction[b])
                take_b = b < b_end and (a == a_end or instruction[b] <= instruction[a])
                out_instruction[n] = instruction[a] if take_a else instruction[b]
                for lane in range(32):
                    out_lanes[n, lane] = lanes[a, lane] if take_a else inactive
                    out_lanes[n, 32 + lane] = lanes[b, lane] if take_b else inactive
                a += take_a
                b += take_b
                n += 1
            out_warp += 1
            out_offsets[out_warp] = n
    return n


def join_warps(
    offsets: npt.NDArray[np.int64],
    lanes: npt.NDArray[np.uint32],
    instruction: npt.NDArray[np.uint16],
    warps_per_cta: int,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32], npt.NDArray[np.uint16]]:
    """Two 32-lane warps of a CTA as one 64-lane wave: rows of the same instruction issue together.

    Where the halves differ (one has more samples), the half that is earlier in the program issues
    alone, as after a divergent loop.
    """
    waves = -(-warps_per_cta // 2)
    ctas = (len(offsets) - 1) // warps_per_cta
    out_offsets = np.zeros(ctas * waves + 1, I64)
    out_lanes = np.empty((len(instruction), 64), lanes.dtype)
    out_instruction = np.empty(len(instruction), np.uint16)
    inactive = lanes.dtype.type(np.iinfo(lanes.dtype).max)
    n = _join(
        offsets,
        lanes,
        instruction,
        warps_per_cta,
        inactive,
        out_offsets,
        out_lanes,
        out_instruction,
    )
    return out_offsets, out_lanes[:n], out_instruction[:n]
