"""The counting model once more, one request at a time: the slow dispatch and coalescing of their
tests, `ReferenceCache`s, and between two levels nothing but arithmetic on bytes.

Only the set and partition hashes are the engine's own; `test_reach` holds those to the facts sheet.
"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass

import numpy as np
from reference_cache import ReferenceCache
from test_coalesce import expected_requests
from test_dispatch import expected_issue

from cachesim.address import index_of, partition_of, set_hash, slice_and_line
from cachesim.config import L2, CacheLevel, Gpu
from cachesim.dispatch import resident_ctas
from cachesim.stream import LOAD, OPERATION_CODES, STORE
from traces.placement import place
from traces.trace import Trace


@dataclass
class Access:
    """One request to one line of a level; bytes: sector -> the bits that a store covers."""

    unit: int
    line: int
    sectors: set[int]
    operation: int
    group: int
    bytes: dict[int, int]


class SlowLevel:
    """One level: its caches, and where a request finds its own."""

    def __init__(self, config: CacheLevel, units_per_instance: int, *, skips: bool = False) -> None:
        self.config, self.units_per_instance = config, units_per_instance
        self.hash = set_hash(config)
        self.partition = partition_of(config) if isinstance(config, L2) else None
        self.bypasses = {
            "bypass_loads": skips,
            "bypass_stores": skips or config.write_policy == "read-only",
        }
        self.counters: Counter[tuple[int, str]] = Counter()
        self.flush()

    def flush(self) -> None:
        self.caches = ReferenceCache(self.config, **self.bypasses)
        self.caches.counters = self.counters

    def access(self, request: Access) -> list[Access]:
        """What the next level is asked: the request's own sectors, its fetch, the write-back."""
        instance, number = request.unit // self.units_per_instance, np.uint64(request.line)
        if self.partition is not None:
            p, shift = self.partition, self.config.line_bytes.bit_length() - 1
            where, number = slice_and_line(
                np.uint64(request.line << shift),
                np.uint64(p.num_channels),
                np.uint64(p.slices_per_channel),
                np.uint64(p.run_shift),
                p.hash.kind,
                p.hash.size,
                p.hash.table,
                p.xor,
                np.uint64(shift),
            )
            instance = int(where)
        answer = self.caches.access(
            instance,
            int(index_of(number, self.hash.kind, self.hash.size, self.hash.table)),
            request.line,
            request.sectors,
            request.operation,
            request.group,
            request.bytes,
        )
        own = Access(
            request.unit, request.line, answer.down, request.operation, request.group, request.bytes
        )
        fetch = Access(request.unit, request.line, answer.fill, LOAD, request.group, {})
        below = [a for a in (own, fetch) if a.sectors]
        if answer.written_back:
            below += self.write_back(request.unit, answer.evicted, answer.written_back)
        return below

    def write_back(
        self, unit: int, line: int | None, sectors: dict[int, tuple[int, int]]
    ) -> list[Access]:
        """Stores of a dirty line's sectors, one for each run of one group."""
        assert line is not None
        runs = itertools.groupby(sorted(sectors), key=lambda s: sectors[s][0])
        return [
            Access(unit, line, run := set(found), STORE, group, {s: sectors[s][1] for s in run})
            for group, found in runs
        ]

    def write_back_all(self) -> list[Access]:
        """Everything dirty, instance by instance."""
        accesses = []
        for number, cache_set in sorted(self.caches.sets.items()):
            unit = number // self.config.num_sets * self.units_per_instance
            for tag, line in cache_set.lines.items():
                if line.dirty:
                    all_bytes = self.caches.every_byte
                    held = {
                        s: (group, all_bytes if s in line.readable else line.held[s])
                        for s, group in line.dirty.items()
                    }
                    self.counters.update((group, "writebacks") for group in line.dirty.values())
                    accesses += self.write_back(unit, tag, held)
        return accesses


def converted(request: Access, upper: CacheLevel, lower: CacheLevel) -> list[Access]:
    """A request in the lines, sectors and byte bits of the level below."""
    parts: dict[int, Access] = {}
    upper_granule, lower_granule = (max(1, c.sector_bytes // 32) for c in (upper, lower))
    for s in sorted(request.sectors):
        for start in range(0, upper.sector_bytes, lower.sector_bytes):
            address = request.line * upper.line_bytes + s * upper.sector_bytes + start
            line, offset = divmod(address, lower.line_bytes)
            part = parts.setdefault(
                line, Access(request.unit, line, set(), request.operation, request.group, {})
            )
            part.sectors.add(offset // lower.sector_bytes)
            if request.operation == STORE:
                bits = range(min(32, lower.sector_bytes))
                part.bytes[offset // lower.sector_bytes] = sum(
                    1 << bit
                    for bit in bits
                    if request.bytes[s] >> ((start + bit * lower_granule) // upper_granule) & 1
                )
    return list(parts.values())


def slow_simulate(
    trace: Trace, gpu: Gpu, fetch_path: str
) -> tuple[dict[str, SlowLevel], Counter[int]]:
    """The levels after the trace, with their counters by group, and lane fetches by group."""
    l1 = gpu.l1_texture if fetch_path == "texture" and gpu.l1_texture else gpu.l1
    skips = fetch_path == "global" and gpu.l1.bypass_loads
    levels = {"l1": SlowLevel(l1, 1, skips=skips)}
    if gpu.gl1 is not None:
        levels["gl1"] = SlowLevel(gpu.gl1, gpu.gl1.sms_per_instance * l1.units_per_sm)
    levels |= {n: SlowLevel(c, 1) for n, c in (("l2", gpu.l2), ("llc", gpu.llc)) if c is not None}
    chain = list(levels.values())

    def descend(accesses: list[Access], depth: int) -> None:
        for access in accesses:
            below = chain[depth].access(access)
            if depth + 1 < len(chain):
                upper, lower = chain[depth].config, chain[depth + 1].config
                for request in below:
                    descend(converted(request, upper, lower), depth + 1)

    address_map = None
    if not trace.is_lane_address:
        address_map = place(trace.textures, gpu.texture_layout)
    granule = max(1, l1.sector_bytes // 32)
    fetches: Counter[int] = Counter()
    for number, launch in enumerate(trace.launches):
        rows, counts = [], np.zeros((launch.num_ctas, launch.warps_per_cta), np.int64)
        for chunk in trace.chunks():
            if chunk.launch == number:
                requests, found = expected_requests(
                    trace, chunk, address_map, (l1.line_bytes, l1.sector_bytes)
                )
                fetches.update(found)
                operations = [trace.instructions[i].operation for i in chunk.instruction]
                rows += list(zip(requests, operations, strict=True))
                num = chunk.num_warps // launch.warps_per_cta
                lengths = np.diff(chunk.warp_offsets).reshape(num, -1)
                counts[chunk.first_cta : chunk.first_cta + num] = lengths
        first = np.concatenate([[0], np.cumsum(counts)])
        places = resident_ctas(gpu.sm, launch)
        for cta, warp, step, unit in expected_issue(counts, gpu.sm.count, places, l1.units_per_sm):
            row, operation = rows[first[cta * launch.warps_per_cta + warp] + step]
            for request in row:
                covered = dict.fromkeys(request.sectors, 0)
                for byte in request.written:
                    bit = byte % l1.sector_bytes // granule
                    covered[byte // l1.sector_bytes] |= 1 << bit
                code = OPERATION_CODES[operation]
                descend(
                    [Access(unit, request.line, request.sectors, code, request.group, covered)], 0
                )
        for access in chain[0].write_back_all():
            for request in converted(access, chain[0].config, chain[1].config):
                descend([request], 1)
        for level in chain:
            if level.partition is None:
                level.flush()
    return levels, fetches
