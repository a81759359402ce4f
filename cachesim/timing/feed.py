"""From chunks of a trace to the rows and CTAs that the SMs run: coalesced once, held until their
CTA has left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cachesim.coalesce import Placement, Program, coalesce, new_scratch
from cachesim.config import Gpu
from cachesim.counts import POPCOUNT
from cachesim.dispatch import join_warps, resident_ctas
from cachesim.stream import LOAD, STORE, Requests
from cachesim.timing import records
from cachesim.timing.records import CONTROL, KINDS, PATH_BYPASS, PATH_FIFO, PATH_L1
from cachesim.timing.state import State, Work
from traces.errors import InputError
from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL
from traces.trace import Chunk, Launch, Trace

_BLOCK_ROWS = 4096
I64 = np.int64


def _operations(arithmetic: Sequence[tuple[str, int]], where: str) -> list[tuple[int, int, int]]:
    """Micro-operations of (kind, count) pairs, with the load whose data they take."""
    operations = []
    # Loads of a group return in order: what waits for all but n takes the data of the last but n.
    group = max([count for kind, count in arithmetic if kind == "wait"], default=-1) + 1
    load = -1
    for kind, count in arithmetic:
        if kind not in KINDS or kind == "memory":
            allowed = ", ".join(k for k in KINDS if k != "memory")
            raise InputError(f"{where}: arithmetic kind {kind!r}: timing knows {allowed}")
        if kind == "wait":
            load = group - 1 - count
        operations.append((KINDS.index(kind), count, load))
    return operations


class Feed:
    """Fills the `Work` of a state from chunks, and empties it as CTAs leave."""

    def __init__(
        self,
        trace: Trace,
        gpu: Gpu,
        program: Program,
        placement: Placement,
        first_sector: int,
        narrow: bool,
        num_groups: int,
        fetch_path: str,
        line_bytes: int,
        sector_bytes: int,
    ) -> None:
        """first_sector, narrow: see `coalesce`. line_bytes, sector_bytes: of the L1."""
        self._trace, self._gpu = trace, gpu
        self._program, self._placement = program, placement
        self._first = np.uint64(first_sector)
        self._line_shift = np.uint64(line_bytes.bit_length() - 1)
        self._sector_shift = np.uint64(sector_bytes.bit_length() - 1)
        self._sectors = line_bytes // sector_bytes
        self._scratch = new_scratch(gpu.sm.warp_size, np.uint32 if narrow else np.uint64)
        keys = gpu.sm.warp_size * (4 if program.bilinear.any() else 1 if trace.textures else 2)
        room = _BLOCK_ROWS * keys
        self._requests = Requests(
            np.zeros(room, np.uint64), np.zeros(room, np.uint8), np.zeros(room, np.uint32),
            np.zeros(room, np.int32), np.zeros((room, 8), np.uint32),
            np.zeros(_BLOCK_ROWS + 1, I64), np.zeros(0, np.uint32), np.zeros(0, I64),
        )  # fmt: skip
        self.lane_fetches = np.zeros(num_groups, I64)
        self.num_rows = 0
        self._row_head = self._row_tail = self._ask_head = self._ask_tail = 0
        self._granule_head = 0
        self._static(fetch_path)

    def _static(self, fetch_path: str) -> None:
        """The instruction and micro-operation tables; launches append their trailers."""
        trace, gpu = self._trace, self._gpu
        path = PATH_L1
        if fetch_path == "global" and gpu.l1.bypass_loads:
            path = PATH_BYPASS
        table = np.zeros(len(trace.instructions), records.INSTRUCTION)
        self._ops: list[tuple[int, int, int]] = []
        for k, one in enumerate(trace.instructions):
            code = int(self._program.operation[k])
            own_path = path
            if fetch_path == "texture" and gpu.l1_texture is not None:
                # The texture L1 serves texture fetches alone; stores go around it.
                own_path = PATH_FIFO if code == LOAD else PATH_BYPASS
            first = len(self._ops)
            self._ops += _operations(one.arithmetic, f"instruction {k}")
            quad = 0
            if fetch_path == "texture" and code == LOAD:
                quad = 4 if self._program.access_bytes[k] > 8 else 1
            table[k] = (
                first, len(self._ops), code, own_path, quad,
                int(self._program.access_bytes[k]), one.num_outstanding,
                any(kind == "wait" for kind, _ in one.arithmetic) or one.num_outstanding >= 0,
            )  # fmt: skip
        self._instructions = table

    def begin(self, state: State, launch: Launch, padding_warps: int) -> State:
        """Start a launch on a machine without CTAs."""
        machine = state.pool.machine[0]
        sm = self._gpu.sm
        self._wave = sm.warp_size // 32
        warps = -(-launch.warps_per_cta // self._wave)
        places = resident_ctas(sm, launch)
        self._warps = warps
        self._launch = launch
        self._next_warp = 0
        self._granule_head = 0
        self._num_warps = launch.num_ctas * launch.warps_per_cta - padding_warps
        trailer = _operations(launch.trailing_arithmetic, f"launch {launch.pass_name!r}")
        operations = [*self._ops, *trailer, (CONTROL, 1, -1)]
        values: dict[str, Any] = {
            "warps_per_cta": warps, "num_places": places, "trailer_first": len(self._ops),
            "trailer_last": len(operations), "queued": 0, "taken": 0, "complete": 0,
            "place_from": machine["now"] + machine["launch_cycles"], "age": 0,
            "last_sm": sm.count - 1, "progress": machine["now"] + machine["launch_cycles"],
        }  # fmt: skip
        if machine["collector_units"] > 0:
            # GPGPU-Sim's schedulers start their turns with an SM's first CTA.
            values["first_turn"] = -(values["place_from"] + 1) % machine["num_schedulers"]
        for name, value in values.items():
            machine[name] = value
        state.sms["free_places"] = places
        state.sms["last_issued"] = -1
        work = state.work._replace(
            instructions=self._instructions,
            operations=np.array(operations, records.OPERATION),
            warp_first=np.zeros(0, I64),
            warp_rows=np.zeros(0, I64),
            cta_left=np.zeros(0, np.uint8),
        )
        return state._replace(
            work=work,
            cta_at=np.full((sm.count, places), -1, I64),
            warps_left=np.zeros((sm.count, places), I64),
        )

    def add(self, state: State, chunk: Chunk) -> State:
        """Queue a chunk's CTAs.

        Raises:
            InputError: a fetch outside its texture.
        """
        offsets, lanes, instruction = chunk.warp_offsets, chunk.lanes, chunk.instruction
        num_warps = len(offsets) - 1
        real = np.clip(self._num_warps - self._next_warp - np.arange(num_warps), 0, 1)
        self._next_warp += num_warps
        if self._wave == 2:
            offsets, lanes, instruction = join_warps(
                offsets, lanes, instruction, self._launch.warps_per_cta
            )
            per_cta = self._launch.warps_per_cta
            real = real.reshape(-1, per_cta)[:, ::2].ravel()
        state = self._drop_left(state)
        work = self._room(state.work, len(instruction))
        first_row = self._row_head
        for begin in range(0, len(instruction), _BLOCK_ROWS):
            end = min(begin + _BLOCK_ROWS, len(instruction))
            work = self._coalesce(work, lanes[begin:end], instruction[begin:end])
        counts = np.where(real == 1, np.diff(offsets), -1)
        work = work._replace(
            warp_first=np.concatenate([work.warp_first, first_row + offsets[:-1]]),
            warp_rows=np.concatenate([work.warp_rows, counts]),
            cta_left=np.concatenate(
                [work.cta_left, np.zeros(len(counts) // self._warps, np.uint8)]
            ),
        )
        state.pool.machine[0]["queued"] = len(work.cta_left)
        state.pool.machine[0]["row_mask"] = len(work.rows) - 1
        state.pool.machine[0]["request_mask"] = len(work.asks) - 1
        return state._replace(work=work)

    def _coalesce(self, work: Work, lanes: Any, instruction: npt.NDArray[np.uint16]) -> Work:
        requests = self._requests
        num = len(instruction)
        bad = coalesce(
            np.arange(num), np.ascontiguousarray(lanes), np.ascontiguousarray(instruction),
            self._program, self._placement, self._sector_shift, self._line_shift, self._first,
            self._scratch, requests, self.lane_fetches,
        )  # fmt: skip
        if bad >= 0:
            raise InputError(f"trace: row {bad} of a chunk asks for a texel outside its texture")
        segments = requests.segments[: num + 1]
        total = int(segments[num])
        work = self._ask_room(work, total)
        at = (self._ask_head + np.arange(total)) & (len(work.asks) - 1)
        work.asks["line"][at] = requests.line[:total].astype(I64)
        work.asks["mask"][at] = requests.mask[:total]
        work.asks["group"][at] = (requests.meta[:total] & 0xFFFFFF).astype(np.int32)
        stores = np.flatnonzero(requests.meta[:total] >> 24 == STORE)
        if len(stores):
            work = self._granule_room(work, len(stores) * self._sectors)
            place = self._granule_head + np.arange(len(stores)) * self._sectors
            work.written[at[stores]] = place
            bits = requests.bytes_written[requests.written[stores], : self._sectors]
            work.granules[
                (place[:, None] + np.arange(self._sectors)) & (len(work.granules) - 1)
            ] = bits
            self._granule_head += len(stores) * self._sectors
        sectors = np.concatenate([[0], np.cumsum(POPCOUNT[requests.mask[:total]])])
        inactive = INACTIVE_ADDRESS if lanes.dtype == np.uint64 else INACTIVE_TEXEL
        rows = np.zeros(num, records.ROW)
        rows["first"] = self._ask_head + segments[:-1]
        rows["count"] = np.diff(segments)
        rows["lanes"] = (lanes != inactive).sum(axis=1)
        rows["code"] = instruction
        rows["sectors"] = np.diff(sectors[segments])
        work.rows[(self._row_head + np.arange(num)) & (len(work.rows) - 1)] = rows
        self._row_head += num
        self._ask_head += total
        self.num_rows += num
        return work

    def _drop_left(self, state: State) -> State:
        """Forget the oldest CTAs that have left, and free what they held."""
        work = state.work
        machine = state.pool.machine[0]
        left = work.cta_left
        gone = int(np.argmin(left)) if not left.all() else len(left)
        gone = min(gone, int(machine["taken"]))
        if gone == 0:
            return state
        machine["taken"] -= gone
        state.cta_at[state.cta_at >= 0] -= gone
        work = work._replace(
            cta_left=left[gone:],
            warp_first=work.warp_first[gone * self._warps :],
            warp_rows=work.warp_rows[gone * self._warps :],
        )
        self._row_tail = int(work.warp_first[0]) if len(work.warp_first) else self._row_head
        if self._row_tail < self._row_head:
            row = work.rows[self._row_tail & (len(work.rows) - 1)]
            self._ask_tail = int(row["first"])
        else:
            self._ask_tail = self._ask_head
        machine["queued"] = len(work.cta_left)
        return state._replace(work=work)

    def _room(self, work: Work, rows: int) -> Work:
        return work._replace(rows=_grown(work.rows, self._row_tail, self._row_head, rows))

    def _ask_room(self, work: Work, requests: int) -> Work:
        arrays = {
            name: _grown(getattr(work, name), self._ask_tail, self._ask_head, requests)
            for name in ("asks", "written")
        }
        return work._replace(**arrays)

    def _granule_room(self, work: Work, granules: int) -> Work:
        # What a launch stores is kept to its end: stores are few beside fetches.
        return work._replace(granules=_grown(work.granules, 0, self._granule_head, granules))


def _grown(ring: npt.NDArray[Any], tail: int, head: int, more: int) -> npt.NDArray[Any]:
    """A ring with room for `more` entries after `head`; entries keep their numbers."""
    needed = head - tail + more
    if needed <= len(ring):
        return ring
    size = 1 << (needed - 1).bit_length()
    larger = np.zeros(size, ring.dtype)
    kept = np.arange(tail, head)
    larger[kept & (size - 1)] = ring[kept & (len(ring) - 1)]
    return larger
