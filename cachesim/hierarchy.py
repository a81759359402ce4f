"""The counting hierarchy: issued rows in, counters of every level out.

    issued rows ──► coalesce ──► L1 units ──► (GL1 arrays) ──► L2 slices ──► (LLC slices) ──► DRAM

Stages work on bounded batches and run side by side in threads: one coalesces, one runs the L1s, one
all that is below.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any

import numpy as np

from cachesim import cache
from cachesim.coalesce import Placement, Program, coalesce, new_scratch
from cachesim.compiled import compiled
from cachesim.dispatch import IssuedRows
from cachesim.level import Buffer, Level
from cachesim.route import pass_down
from cachesim.stream import GROUP_BITS, STORE, Requests
from traces.errors import InputError
from traces.texture import unpack_texel

#: Rows of a batch: long enough that each L1 unit's state is fetched into the host's cache once for
#: many rows.
BATCH_ROWS = 8192
_NUM_BATCHES = 3
_U64 = np.uint64


@compiled
def _segments_of_positions(position, count, instance_of, out_segments, out_instance):  # type: ignore[no-untyped-def]
    """Runs of requests from the same upper segment, and the lower instance of each. Returns how
    many runs.
    """
    runs = 0
    for i in range(count):
        if i == 0 or position[i] != position[i - 1]:
            out_segments[runs] = i
            out_instance[runs] = instance_of[position[i]]
            runs += 1
    out_segments[runs] = count
    return runs


@dataclass
class _Batch:
    """One batch on its way: a buffer per level."""

    buffers: list[Buffer]
    requests: Requests | None = field(default=None)


class Hierarchy:
    """The levels of one GPU, and the stages between them.

    levels: from the L1 down. units_per_instance: L1 units behind each instance of each level (1 for
        the L1, all for a sliced level).
    """

    def __init__(
        self,
        levels: list[Level],
        units_per_instance: list[int],
        program: Program,
        placement: Placement,
        *,
        warp_size: int,
        texel_range: tuple[int, int] | None,
        num_groups: int,
        threaded: bool,
    ) -> None:
        """texel_range: (first byte, bytes) that texels lie in, or None for a lane-address trace."""
        self.levels = levels
        self.timings: dict[str, float] = {}
        self.lane_fetches = np.zeros(num_groups, np.int64)
        self.num_rows = 0
        self._units = units_per_instance
        self._program, self._placement = program, placement
        self._sector_shift = _U64(levels[0].config.sector_bytes.bit_length() - 1)
        self._line_shift = _U64(levels[0].config.line_bytes.bit_length() - 1)
        narrow = texel_range is not None and texel_range[1] >> int(self._sector_shift) < 1 << 32
        self._first_sector = _U64(
            texel_range[0] >> int(self._sector_shift) if narrow and texel_range else 0
        )
        self._scratch = new_scratch(warp_size, np.uint32 if narrow else np.uint64)
        keys = warp_size * (4 if program.bilinear.any() else 2 if texel_range is None else 1)
        self._free: SimpleQueue[_Batch] = SimpleQueue()
        for _ in range(_NUM_BATCHES if threaded else 1):
            self._free.put(self._new_batch(BATCH_ROWS * keys))
        self._pools = [ThreadPoolExecutor(1), ThreadPoolExecutor(1)] if threaded else []
        self._futures: list[Future[Any]] = []

    def _new_batch(self, num_requests: int) -> _Batch:
        buffers = [Buffer(self.levels[0], num_requests, BATCH_ROWS)]
        for upper, lower in zip(self.levels, self.levels[1:], strict=False):
            num_requests = upper.bound_passed_down(num_requests, lower.config)
            buffers.append(
                Buffer(lower, num_requests, num_requests if lower.partition is None else 1)
            )
        return _Batch(buffers)

    def process(self, rows: IssuedRows) -> None:
        """Send a batch of issued rows through all levels; returns when its lanes are coalesced."""
        batch = self._free.get()
        try:
            self._timed("coalesce", self._coalesce, rows, batch)
        except BaseException:
            self._free.put(batch)
            raise
        self._start(0, self._first_level, batch)

    def drain(self) -> None:
        """Wait until every batch has passed every level.

        Raises:
            Whatever a stage raised.
        """
        while self._futures:
            self._futures.pop(0).result()

    def close(self) -> None:
        """End the stages' threads."""
        for pool in self._pools:
            pool.shutdown(wait=True, cancel_futures=True)

    def end_launch(self) -> None:
        """L1s (and GL1s) start empty at each launch: write back what is dirty, forget the rest;
        sliced levels are kept.
        """
        self.drain()
        top = self.levels[0]
        if top.rules.can_be_dirty and top.state.flags[cache.DIRTY :: 4].any():
            self._write_back_all(0)
        for level in self.levels:
            if level.partition is None:
                cache.reset(level.state, level.rules)

    def _timed(self, stage: str, work: Callable[..., None], *arguments: Any) -> None:
        start = time.thread_time()
        work(*arguments)
        self.timings[stage] = self.timings.get(stage, 0.0) + time.thread_time() - start

    def _start(self, pool: int, work: Callable[[_Batch], None], batch: _Batch) -> None:
        if not self._pools:
            work(batch)
            return
        if pool == 0:
            while self._futures and self._futures[0].done():
                self._futures.pop(0).result()
        self._futures.append(self._pools[pool].submit(work, batch))

    def _coalesce(self, rows: IssuedRows, batch: _Batch) -> None:
        """Requests of the rows, those of one L1 unit together, with the issue order kept beside."""
        by_unit = np.argsort(rows.instance, kind="stable")
        buffer = batch.buffers[0]
        requests = buffer.requests
        num = len(by_unit)
        bad_slot = coalesce(
            rows.slot[by_unit],
            rows.lanes,
            rows.instruction,
            self._program,
            self._placement,
            self._sector_shift,
            self._line_shift,
            self._first_sector,
            self._scratch,
            requests,
            self.lane_fetches,
        )
        if bad_slot >= 0:
            raise InputError(self._describe_bad_row(rows, bad_slot))
        requests.instance[:num] = rows.instance[by_unit]
        requests.order[by_unit] = np.arange(num)
        self.num_rows += num
        batch.requests = requests._replace(
            segments=requests.segments[: num + 1],
            instance=requests.instance[:num],
            order=requests.order[:num],
        )

    def _describe_bad_row(self, rows: IssuedRows, slot: int) -> str:
        texture = int(self._program.texture[rows.instruction[slot]])
        width, height = self._placement.width[texture], self._placement.height[texture]
        mip, y, x = (v.astype(np.int64) for v in unpack_texel(rows.lanes[slot].astype(np.uint32)))
        outside = (x >= width[mip % len(width)]) | (y >= height[mip % len(width)])
        lane = int(np.argmax(outside & (rows.lanes[slot] != np.uint32(0xFFFFFFFF))))
        return (
            f"trace: a fetch of texture {texture} asks for texel (mip {mip[lane]}, y {y[lane]}, "
            f"x {x[lane]}); it has {int((width > 0).sum())} mips, mip 0 of "
            f"{width[0]}x{height[0]} texels"
        )

    def _first_level(self, batch: _Batch) -> None:
        try:
            assert batch.requests is not None
            self._timed(self.levels[0].name, self._access, 0, batch.requests, batch.buffers[0])
        except BaseException:
            self._free.put(batch)
            raise
        self._start(1, self._lower_levels, batch)

    def _lower_levels(self, batch: _Batch) -> None:
        try:
            assert batch.requests is not None
            self._descend(0, batch.requests, batch.buffers)
        finally:
            self._free.put(batch)

    def _access(self, index: int, requests: Requests, buffer: Buffer) -> None:
        level = self.levels[index]
        arranged, sets = level.arrange(requests, buffer)
        level.access(arranged, sets, buffer.outcome)

    def _descend(self, index: int, requests: Requests, buffers: list[Buffer]) -> None:
        """Pass what a level sends down to the next ones."""
        for upper in range(index, len(self.levels) - 1):
            lower = upper + 1
            passed: list[Requests] = []
            self._timed(
                "route",
                lambda u=upper, r=requests, p=passed: p.append(self._pass_down(u, r, buffers)),
            )
            requests = passed[0]
            self._timed(self.levels[lower].name, self._access, lower, requests, buffers[lower])

    def _pass_down(self, index: int, requests: Requests, buffers: list[Buffer]) -> Requests:
        upper, lower, buffer = self.levels[index], self.levels[index + 1], buffers[index + 1]
        out = buffer.requests
        num, _ = pass_down(
            requests,
            buffers[index].outcome,
            upper.config.line_bytes,
            upper.config.sector_bytes,
            lower.config.line_bytes,
            lower.config.sector_bytes,
            out.line,
            out.mask,
            out.meta,
            out.written,
            out.bytes_written,
            buffer.position,
        )
        if lower.partition is None:
            ratio = self._units[index + 1] // self._units[index]
            runs = _segments_of_positions(
                buffer.position,
                num,
                requests.instance // np.uint32(ratio),
                out.segments,
                out.instance,
            )
        else:
            runs, out.segments[1], out.segments[0] = 1, num, 0
            out.instance[0] = 0
        out.order[:runs] = np.arange(runs)
        return out._replace(
            segments=out.segments[: runs + 1], instance=out.instance[:runs], order=out.order[:runs]
        )

    def _write_back_all(self, index: int) -> None:
        """Write back every dirty line of a level, in line order, as stores to the next one."""
        level = self.levels[index]
        state, rules = level.state, level.rules
        lines = np.flatnonzero(state.flags[cache.DIRTY :: 4])
        upper = Requests(
            line=cache.line_numbers(state, rules)[lines],
            mask=np.zeros(len(lines), np.uint8),
            meta=np.full(len(lines), STORE << GROUP_BITS, np.uint32),
            written=np.zeros(len(lines), np.int32),
            bytes_written=np.zeros((1, 8), np.uint32),
            segments=np.arange(len(lines) + 1),
            instance=(lines * rules.num_instances // (len(state.flags) // 4)).astype(np.uint32),
            order=np.arange(len(lines)),
        )
        buffer = Buffer(level, len(lines), 1)
        for s in range(rules.sectors_per_line):
            dirty = (state.flags[cache.DIRTY :: 4][lines] >> s) & 1 == 1
            owner = state.owner[lines[dirty], s]
            np.add.at(level.counters[:, cache.WRITEBACKS], owner, 1)
            buffer.outcome.evicted_owner[dirty, s] = owner + 1
            full = (state.flags[cache.VALID :: 4][lines] >> s) & 1 == 1
            buffer.outcome.evicted_bytes[:, s] = np.where(
                full, rules.all_bytes, state.bytes_held[lines, s]
            )
        buffer.outcome.evicted_line[:] = upper.line
        buffers = self._new_batch(len(lines)).buffers
        buffers[index] = buffer
        self._descend(index, upper, buffers)


__all__ = ["BATCH_ROWS", "Hierarchy"]
