"""All of the machine's state, as the compiled loops pass it around."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.timing import records
from cachesim.timing.network import Network
from cachesim.timing.tags import Tags
from cachesim.timing.view import define


class Pool(NamedTuple):
    """Requests in flight. requests: `records.REQUEST`; free: int32 stack of unused ones; machine:
    (1,) `records.MACHINE`. waits: (stages, 3) int64, cycles spent in a stage: sum, number, least.
    """

    requests: npt.NDArray[np.void]
    free: npt.NDArray[np.int32]
    machine: npt.NDArray[np.void]
    waits: npt.NDArray[np.int64]


class Work(NamedTuple):
    """What the SMs run: rings of rows and of their requests, filled by `feed`.

    instructions, operations: the static program. rows: ring of `records.ROW`; asks: ring of
    `records.ASK`; written: with it, int64 place in `granules`, ring of uint32, one per sector of a
    stored line.
    warp_first, warp_rows: int64 per warp of the queued CTAs, -1 rows = padding; cta_left: uint8
    per queued CTA.
    """

    instructions: npt.NDArray[np.void]
    operations: npt.NDArray[np.void]
    rows: npt.NDArray[np.void]
    asks: npt.NDArray[np.void]
    written: npt.NDArray[np.int64]
    granules: npt.NDArray[np.uint32]
    warp_first: npt.NDArray[np.int64]
    warp_rows: npt.NDArray[np.int64]
    cta_left: npt.NDArray[np.uint8]


class Route(NamedTuple):
    """How addresses spread over a sliced level: `address.Partition`'s numbers as int64 [channels,
    slices per channel, run shift, kind, slices, xor, line shift], and its table. draws: int64, the
    slices drawn so far (`partition`).
    """

    numbers: npt.NDArray[np.int64]
    table: npt.NDArray[np.uint32]
    draws: npt.NDArray[np.int64]


class Memory(NamedTuple):
    """DRAM. C channels, B banks.

    channels: (C,), banks: (C * B,), groups: (C * B,). latency_ring, entry_ring, data_ring,
    return_ring: (C, room) int32; latency_time: (C, room) int64 core cycle, data_time: tick.
    bits: (3, 64) int64, which address bits make up bank, row and column, -1 = end; rest_shift in
    the machine.
    """

    channels: npt.NDArray[np.void]
    banks: npt.NDArray[np.void]
    groups: npt.NDArray[np.void]
    latency_ring: npt.NDArray[np.int32]
    latency_time: npt.NDArray[np.int64]
    entry_ring: npt.NDArray[np.int32]
    data_ring: npt.NDArray[np.int32]
    data_time: npt.NDArray[np.int64]
    return_ring: npt.NDArray[np.int32]
    bits: npt.NDArray[np.int64]


class State(NamedTuple):
    """The machine.

    latencies: (4, 2) int64 of the execution units, latency and initiation by kind.
    l1_banks: (units * banks,), banks: (units * banks, room) `records.WAITING`, the L1's delay
    lines. port_of: (units,) int32, the interconnect's port of an L1 unit. responses: (units, room)
    int32.
    ejection: (SMs, room) int32; cta_at: (SMs, places) int64; warps_left: the same.
    fifo: (units, 3, room) int32, the texture L1's reorder buffer, requests and results.
    scheduler_masks: (schedulers,) uint64. reasons: (reasons,) int64 cycles of schedulers.
    latency: (5, 2) int64, by level that gave the data: sum, number. issued: (5,) int64 by
    kind. resident: (1,) int64 warp-cycles.
    """

    pool: Pool
    work: Work
    latencies: npt.NDArray[np.int64]
    sms: npt.NDArray[np.void]
    pipes: npt.NDArray[np.void]
    warps: npt.NDArray[np.void]
    l1: Tags
    gl1: Tags
    l2: Tags
    llc: Tags
    up: Network
    down: Network
    l2_route: Route
    llc_route: Route
    memory: Memory
    l1_banks: npt.NDArray[np.void]
    banks: npt.NDArray[np.void]
    port_of: npt.NDArray[np.int32]
    responses: npt.NDArray[np.int32]
    ejection: npt.NDArray[np.int32]
    cta_at: npt.NDArray[np.int64]
    warps_left: npt.NDArray[np.int64]
    fifo: npt.NDArray[np.int32]
    scheduler_masks: npt.NDArray[np.uint64]
    reasons: npt.NDArray[np.int64]
    latency: npt.NDArray[np.int64]
    issued: npt.NDArray[np.int64]
    resident: npt.NDArray[np.int64]


_I64, _I32, _U32, _U8 = np.int64, np.int32, np.uint32, np.uint8

define(
    "Pool",
    {
        "requests": (records.REQUEST, 1),
        "free": (_I32, 1),
        "machine": (records.MACHINE, 1),
        "waits": (_I64, 2),
    },
)
define(
    "Work",
    {
        "instructions": (records.INSTRUCTION, 1),
        "operations": (records.OPERATION, 1),
        "rows": (records.ROW, 1),
        "asks": (records.ASK, 1),
        "written": (_I64, 1),
        "granules": (_U32, 1),
        "warp_first": (_I64, 1),
        "warp_rows": (_I64, 1),
        "cta_left": (_U8, 1),
    },
)
define("Route", {"numbers": (_I64, 1), "table": (_U32, 2), "draws": (_I64, 1)})
define(
    "Memory",
    {
        "channels": (records.CHANNEL, 1),
        "banks": (records.BANK, 1),
        "groups": (records.BANK_GROUP, 1),
        "latency_ring": (_I32, 2),
        "latency_time": (_I64, 2),
        "entry_ring": (_I32, 2),
        "data_ring": (_I32, 2),
        "data_time": (_I64, 2),
        "return_ring": (_I32, 2),
        "bits": (_I64, 2),
    },
)
define(
    "Tags",
    {
        "level": (records.LEVEL, 1),
        "nodes": (records.NODE, 1),
        "lines": (records.LINE, 1),
        "held": (_U32, 1),
        "owner": (_I32, 1),
        "sets": (records.SET, 1),
        "buckets": (_I32, 1),
        "mshrs": (records.MSHR, 1),
        "mshr_buckets": (_I32, 1),
        "set_table": (_U32, 2),
        "counters": (_I64, 2),
        "outcomes": (_I64, 2),
        "queues": (_I32, 3),
        "delay": (records.WAITING, 2),
    },
)
define(
    "Network",
    {
        "inputs": (records.PORT, 1),
        "in_ring": (records.PACKET, 2),
        "outputs": (records.OUTLET, 1),
        "out_ring": (records.WAITING, 2),
        "arrivals": (_I64, 1),
        "unready": (np.uint64, 1),
        "wanted": (np.uint64, 2),
        "contested": (np.uint64, 1),
        "scalars": (_I64, 1),
    },
)
define(
    "State",
    {
        "pool": "Pool",
        "work": "Work",
        "latencies": (_I64, 2),
        "sms": (records.SM, 1),
        "pipes": (records.PIPE, 1),
        "warps": (records.WARP, 1),
        "l1": "Tags",
        "gl1": "Tags",
        "l2": "Tags",
        "llc": "Tags",
        "up": "Network",
        "down": "Network",
        "l2_route": "Route",
        "llc_route": "Route",
        "memory": "Memory",
        "l1_banks": (records.L1_BANK, 1),
        "banks": (records.WAITING, 2),
        "port_of": (_I32, 1),
        "responses": (_I32, 2),
        "ejection": (_I32, 2),
        "cta_at": (_I64, 2),
        "warps_left": (_I64, 2),
        "fifo": (_I32, 3),
        "scheduler_masks": (np.uint64, 1),
        "reasons": (_I64, 1),
        "latency": (_I64, 2),
        "issued": (_I64, 1),
        "resident": (_I64, 1),
    },
)
