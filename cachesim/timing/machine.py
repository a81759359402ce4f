"""Build the machine's state from a GPU's configuration.

Gpu ──► rules and sizes (`records.MACHINE`, `records.LEVEL`) ──► empty arrays (`state.State`)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cachesim.address import RANDOM, partition_of, set_hash
from cachesim.config import L2, CacheLevel, Gpu
from cachesim.counts import (
    NUM_COUNTERS,
    ON_HIT,
    ON_MISS,
)
from cachesim.timing import records
from cachesim.timing.bits import power_of_two
from cachesim.timing.network import new_network
from cachesim.timing.partition import new_draws
from cachesim.timing.records import (
    MAX_DRAM_BANKS,
    MAX_SUBSLICES,
    MAX_WARPS,
    NEVER,
    NUM_REASONS,
)
from cachesim.timing.refusals import check_timing
from cachesim.timing.state import Memory, Pool, Route, State, Work
from cachesim.timing.tags import Tags
from cachesim.timing_config import CacheTiming, L1Timing

_FIRST_POOL = 1 << 14
_FIRST_DRAWS = 1 << 15


def _log2(number: int) -> int:
    return number.bit_length() - 1


def _level_rules(
    index: int,
    level: CacheLevel,
    instances: int,
    timing: L1Timing | CacheTiming,
    core_hz: int,
) -> npt.NDArray[np.void]:
    """The `records.LEVEL` of one level."""
    rules = np.zeros(1, records.LEVEL)
    one = rules[0]
    one["index"] = index
    one["num_instances"] = instances
    one["line_shift"] = _log2(level.line_bytes)
    one["sector_shift"] = _log2(level.sector_bytes)
    one["sectors_per_line"] = level.sectors_per_line
    one["sector_mask"] = level.sectors_per_line - 1
    one["num_sets"], one["ways"] = level.num_sets, level.ways
    one["touch_on_hit"] = level.replacement == "lru"
    one["on_miss_allocation"] = timing.allocation == "on-miss"
    one["on_hit"], one["on_store_miss"] = (
        ON_HIT[level.write_policy],
        ON_MISS[level.write_allocate],
    )
    one["is_read_only"] = level.write_policy == "read-only"
    one["all_bytes"] = (1 << min(32, level.sector_bytes)) - 1
    one["num_mshrs"], one["merge"] = timing.num_mshrs, timing.mshr_merge
    one["miss_queue"] = timing.miss_queue
    one["bucket_mask"] = power_of_two(2 * level.num_sets * level.ways) - 1
    one["mshr_mask"] = power_of_two(2 * timing.num_mshrs) - 1
    one["dirty_limit"] = timing.dirty_limit_percent
    one["set_kind"] = set_hash(level).kind
    one["width"] = 1
    one["reserve_in"] = level.sectors_per_line
    if isinstance(timing, CacheTiming):
        cost = 256 * level.sector_bytes * core_hz // (timing.port_bytes * timing.clock_hz)
        one["port_cost"] = one["fill_cost"] = max(1, cost)
        one["width"] = -(-256 // max(1, cost))
        one["latency"] = timing.latency_cycles
        one["texture_latency"] = getattr(timing, "texture_latency_cycles", timing.latency_cycles)
        one["queue_in"], one["queue_down"] = timing.queue_in, timing.queue_down
        one["queue_fill"], one["queue_out"] = timing.queue_fill, timing.queue_out
        one["delay_capacity"] = timing.queue_in + int(one["width"]) * (timing.latency_cycles + 2)
    else:
        cost = 256 * level.sector_bytes // timing.fill_bytes_per_cycle
        one["fill_cost"] = max(1, cost)
        one["latency"] = timing.latency_cycles
    return rules


def _tags(
    index: int,
    level: CacheLevel | None,
    instances: int,
    timing: Any,
    core_hz: int,
    num_groups: int,
    parts: int = 1,
) -> Tags:
    """The empty arrays of one level; of nothing where the level is absent. parts: sectors of this
    level in one packet.
    """
    if level is None:
        none = np.zeros(0, np.int32)
        return Tags(
            np.zeros(1, records.LEVEL), np.zeros(0, records.NODE), np.zeros(0, records.LINE),
            none.view(np.uint32), none, np.zeros(0, records.SET), none, np.zeros(0, records.MSHR),
            none, np.zeros((0, 256), np.uint32), np.zeros((num_groups, NUM_COUNTERS), np.int64),
            np.zeros((2, 6), np.int64), np.zeros((1, 5, 1), np.int32),
            np.zeros((1, 1), records.WAITING),
        )  # fmt: skip
    rules = _level_rules(index, level, instances, timing, core_hz)
    # Rings stay small: their places are used in turn, and would fill the host's cache.
    most, delayed = timing.miss_queue, 1
    if isinstance(timing, CacheTiming):
        queues = (timing.queue_in, timing.queue_down, timing.queue_fill, timing.queue_out)
        most = max(most, *queues)
        latency = max(int(rules[0]["latency"]), int(rules[0]["texture_latency"]))
        width = int(rules[0]["width"])
        delayed = timing.queue_in + width * parts * (latency + 4)
    room = power_of_two(most + 64)
    lines = instances * level.num_sets * level.ways
    mshrs = instances * timing.num_mshrs
    tags = Tags(
        rules,
        records.zeros(instances, records.NODE),
        np.zeros(lines, records.LINE),
        np.zeros(lines * level.sectors_per_line, np.uint32),
        np.zeros(lines * level.sectors_per_line, np.int32),
        np.zeros(instances * level.num_sets, records.SET),
        np.full(instances * (int(rules[0]["bucket_mask"]) + 1), -1, np.int32),
        np.zeros(mshrs, records.MSHR),
        np.full(instances * (int(rules[0]["mshr_mask"]) + 1), -1, np.int32),
        set_hash(level).table,
        np.zeros((num_groups, NUM_COUNTERS), np.int64),
        np.zeros((2, 6), np.int64),
        np.zeros((instances, 5, room), np.int32),
        np.zeros((instances, power_of_two(delayed)), records.WAITING),
    )
    free = np.arange(mshrs, dtype=np.int32).reshape(instances, timing.num_mshrs)
    following = free + 1
    following[:, -1] = -1
    tags.mshrs["ready_next"] = following.ravel()
    tags.nodes["mshr_free"] = free[:, 0]
    tags.nodes["ready_first"] = -1
    tags.nodes["failed"] = -1
    tags.nodes["wake"] = NEVER
    forget_lines(tags)
    return tags


def forget_lines(tags: Tags) -> None:
    """Empty every line of a level."""
    ways = int(tags.level[0]["ways"])
    line = np.arange(len(tags.lines), dtype=np.int32)
    way = line % ways
    tags.lines["key"] = -NEVER
    tags.lines["set"] = line // ways
    # Way 0 is the first to be given up.
    tags.lines["newer"] = np.where(way == ways - 1, -1, way + 1)
    tags.lines["older"] = way - 1
    for field in ("valid", "partial", "modified", "reserved"):
        tags.lines[field] = 0
    tags.sets["newest"] = np.arange(len(tags.sets)) * ways + ways - 1
    tags.sets["oldest"] = np.arange(len(tags.sets)) * ways
    tags.sets["reserved_lines"] = 0
    tags.buckets[:] = -1
    tags.nodes["dirty_lines"] = 0


def _route(level: L2 | None) -> Route:
    if level is None:
        return Route(np.zeros(7, np.int64), np.zeros((0, 256), np.uint32), new_draws(1))
    part = partition_of(level)
    numbers = [
        part.num_channels, part.slices_per_channel, part.run_shift, part.hash.kind,
        part.hash.size, part.xor, _log2(level.line_bytes),
    ]  # fmt: skip
    size = _FIRST_DRAWS if part.hash.kind == RANDOM else 1
    return Route(np.array(numbers, np.int64), part.hash.table, new_draws(size))


def _address_bits(address_map: str) -> npt.NDArray[np.int64]:
    """Positions of the bank and row bits, lowest first, each list closed by -1."""
    letters = [c for c in address_map.partition(";")[2] if c not in ".| "]
    bits = np.full((2, 65), -1, np.int64)
    for row, letter in enumerate("BR"):
        positions = [63 - k for k, c in enumerate(letters) if c == letter]
        bits[row, : len(positions)] = sorted(positions)
    return bits


def _memory(gpu: Gpu, channels: int) -> Memory:
    timing = gpu.dram_timing
    assert timing
    room = power_of_two(timing.queue + timing.return_queue + 8 * MAX_SUBSLICES)
    # While the return queue is full, the bursts of all that credits admit may wait for it.
    last = gpu.llc or gpu.l2
    bursts = power_of_two(room * (last.sector_bytes // timing.atom_bytes))
    memory = Memory(
        np.zeros(channels, records.CHANNEL),
        np.zeros(channels * MAX_DRAM_BANKS, records.BANK),
        np.zeros(channels * MAX_DRAM_BANKS, records.BANK_GROUP),
        np.zeros((channels, room), np.int32),
        np.zeros((channels, room), np.int64),
        np.zeros((channels, room), np.int32),
        np.zeros((channels, bursts), np.int32),
        np.zeros((channels, bursts), np.int64),
        np.zeros((channels, room), np.int32),
        _address_bits(timing.address_map),
    )
    for field in ("serving", "open_row", "first", "last"):
        memory.banks[field] = -1
    memory.channels["wake"] = NEVER
    return memory


def build(gpu: Gpu, fetch_path: str, num_groups: int) -> State:
    """The state of an idle machine.

    num_groups: rows of the levels' counters.

    Raises:
        InputError: as `check_timing`.
    """
    check_timing(gpu, fetch_path)
    sm, l1_timing, icnt, dram = gpu.sm_timing, gpu.l1_timing, gpu.icnt, gpu.dram_timing
    assert sm and l1_timing and icnt and dram and gpu.l2_timing
    fifo = gpu.l1_texture_timing if fetch_path == "texture" and gpu.l1_texture else None
    l1 = gpu.l1_texture if fifo and gpu.l1_texture else gpu.l1
    num_sms, units = gpu.sm.count, l1.units_per_sm
    num_gl1 = -(-num_sms // gpu.gl1.sms_per_instance) if gpu.gl1 else 0
    ports = num_gl1 or num_sms
    last = gpu.llc or gpu.l2
    latency = (
        l1_timing.texture_latency_cycles if fetch_path == "texture" else l1_timing.latency_cycles
    )
    machine = np.zeros(1, records.MACHINE)
    line_parts = max(1, l1.sector_bytes // gpu.l2.sector_bytes)
    bl = dram.burst_cycles
    rules = {
        "num_sms": num_sms, "units": units, "num_schedulers": sm.num_schedulers,
        "is_gto": sm.scheduler == "gto", "issue_per_warp": sm.issue_per_warp,
        "different_units": sm.dual_issue_different_units, "int_on_fp32": sm.int_on_fp32,
        "result_cycles": sm.result_cycles, "memory_cycles": sm.memory_cycles,
        "memory_queue": sm.memory_queue, "collector_units": sm.collector_units,
        "register_banks": sm.register_banks,
        "quads_per_cycle": sm.texture_quads_per_cycle, "lines_per_cycle": l1_timing.lines_per_cycle,
        "bytes_per_cycle": l1_timing.bytes_per_cycle, "num_banks": l1_timing.num_banks,
        "bank_shift": _log2(l1_timing.bank_bytes), "l1_latency": latency,
        "bypass": fetch_path == "global" and gpu.l1.bypass_loads, "has_fifo_l1": fifo is not None,
        "launch_cycles": sm.launch_cycles, "cta_launch_cycles": sm.cta_launch_cycles,
        "ejection": icnt.ejection_packets, "response": icnt.response_packets, "num_ports": ports,
        "num_slices": gpu.l2.num_slices, "num_gl1": num_gl1, "has_gl1": num_gl1 > 0,
        "num_llc": gpu.llc.num_slices if gpu.llc else 0, "has_llc": gpu.llc is not None,
        "num_channels": last.num_channels, "subslices": last.slices_per_channel,
        "sms_per_gl1": gpu.gl1.sms_per_instance if gpu.gl1 else 1,
        "output_queued": icnt.queueing == "output-queued", "router_steps": icnt.router_steps,
        "flit_bytes": icnt.flit_bytes, "header_bytes": icnt.header_bytes,
        "input_packets": icnt.input_packets, "output_packets": icnt.output_packets,
        "l2_sector_shift": _log2(gpu.l2.sector_bytes), "llc_sector_shift": _log2(last.sector_bytes),
        "core_hz": gpu.clock_hz, "dram_hz": dram.clock_hz,
        "fixed_latency": dram.fixed_latency_cycles, "dram_queue": dram.queue,
        "return_queue": dram.return_queue, "dual_bus": dram.command_bus == "dual",
        "in_bank_order": dram.command_bus == "bank-order",
        "fr_fcfs": dram.scheduler == "fr-fcfs", "num_dram_banks": dram.num_banks,
        "group_mask": dram.num_bank_groups - 1, "bursts": last.sector_bytes // dram.atom_bytes,
        "ccd": dram.ccd, "rrd": dram.rrd, "rcd": dram.rcd, "ras": dram.ras, "rp": dram.rp,
        "rc": dram.rc, "cl": dram.cl, "wl": dram.wl, "ccdl": dram.ccdl, "rtpl": dram.rtpl,
        # Facts sheet 3.4, derived timings.
        "rcdwr": max(0, dram.rcd - (dram.wl + 1)), "rtw": dram.cl + bl + 2 - dram.wl,
        "wtr": dram.wl + bl + dram.cdlr, "wtp": dram.wl + bl + dram.wr,
        "shared_credits": dram.queue + dram.return_queue - (last.slices_per_channel - 1),
        "channel_shift": int(dram.address_map.partition("@")[2].partition(";")[0]),
        "sector_shift": _log2(l1.sector_bytes), "line_parts": line_parts,
        "store_bytes": gpu.l1.sector_bytes, "last_sm": num_sms - 1,
        "sectors_per_cycle": 1, "returns_per_cycle": 1, "replies_per_cycle": 1,
    }  # fmt: skip
    if icnt.queueing == "output-queued":
        # Hardware moves what its ports are wide; GPGPU-Sim one sector a cycle everywhere.
        packet = gpu.l2.sector_bytes + icnt.header_bytes
        rules |= {
            "sectors_per_cycle": max(1, l1_timing.fill_bytes_per_cycle // l1.sector_bytes),
            "returns_per_cycle": max(1, l1_timing.bytes_per_cycle // l1.sector_bytes),
            "replies_per_cycle": max(1, icnt.flit_bytes // packet),
        }
    if fifo:
        rules |= {
            "fragment_fifo": fifo.fragment_fifo, "request_fifo": fifo.request_fifo,
            "rob": fifo.reorder_buffer, "result_fifo": fifo.result_fifo,
        }  # fmt: skip
    for name, value in rules.items():
        machine[0][name] = value
    tags = [
        _tags(records.L1, l1, num_sms * units, l1_timing, gpu.clock_hz, num_groups),
        _tags(records.GL1, gpu.gl1, num_gl1, gpu.gl1_timing, gpu.clock_hz, num_groups),
        _tags(
            records.L2, gpu.l2, gpu.l2.num_slices, gpu.l2_timing, gpu.clock_hz, num_groups,
            line_parts,
        ),
        _tags(
            records.LLC, gpu.llc, gpu.llc.num_slices if gpu.llc else 0, gpu.llc_timing,
            gpu.clock_hz, num_groups,
        ),
    ]  # fmt: skip
    # What one cycle can take from the pool at most.
    machine[0]["num_pool"] = (
        num_sms * units * l1_timing.num_banks
        + sum(8 * int(t.level[0]["width"]) * len(t.nodes) for t in tags)
        + gpu.l2.num_slices * line_parts * int(tags[2].level[0]["width"])
        + 8 * gpu.l2.num_slices
    )
    pool_size = power_of_two(2 * int(machine[0]["num_pool"]) + _FIRST_POOL)
    machine[0]["free_top"] = pool_size
    sms = records.zeros(num_sms, records.SM)
    sms["wake"] = NEVER
    sms["stall"] = records.R_IDLE
    sms["last_step"] = -1
    sms["last_issued"] = -1
    pipes = records.zeros(num_sms * units, records.PIPE)
    for field in ("warp", "next_writeback", "next_global"):
        pipes[field] = -1
    l1_banks = records.zeros(num_sms * units * l1_timing.num_banks, records.L1_BANK)
    l1_banks["entered"] = -1
    l1_banks["failed"] = -1
    masks = np.zeros(sm.num_schedulers, np.uint64)
    for slot in range(MAX_WARPS):
        masks[slot % sm.num_schedulers] |= np.uint64(1 << slot)
    kinds = ("int", "fp32", "sfu", "control")
    latencies = [
        [getattr(sm, f"{kind}_latency_cycles"), getattr(sm, f"{kind}_initiation_cycles")]
        for kind in kinds
    ]
    fifo_room = power_of_two(max(fifo.fragment_fifo, fifo.reorder_buffer) + 2) if fifo else 1
    slack = 8 * (num_sms + gpu.l2.num_slices) if icnt.queueing == "output-queued" else 8
    return State(
        Pool(
            records.zeros(pool_size, records.REQUEST),
            np.arange(pool_size, dtype=np.int32),
            machine,
            np.tile(np.array([0, 0, NEVER], np.int64), (4, 1)),
        ),
        empty_work(),
        np.array(latencies, np.int64),
        sms,
        pipes,
        records.zeros(num_sms * MAX_WARPS, records.WARP),
        tags[0],
        tags[1],
        tags[2],
        tags[3],
        new_network(
            ports, gpu.l2.num_slices, icnt.input_packets + slack, icnt.output_packets + slack,
            icnt.request_latency_cycles,
        ),
        new_network(
            gpu.l2.num_slices, ports, icnt.input_packets + slack, icnt.output_packets + slack,
            icnt.reply_latency_cycles,
        ),
        _route(gpu.l2),
        _route(gpu.llc),
        _memory(gpu, last.num_channels),
        l1_banks,
        np.zeros(
            (num_sms * units * l1_timing.num_banks, power_of_two(latency + 1)), records.WAITING
        ),
        (np.arange(num_sms * units) // units // int(machine[0]["sms_per_gl1"])).astype(np.int32),
        np.zeros((num_sms * units, power_of_two(icnt.response_packets + 1)), np.int32),
        np.zeros((num_sms, power_of_two(icnt.ejection_packets + 64)), np.int32),
        np.full((num_sms, 1), -1, np.int64),
        np.zeros((num_sms, 1), np.int64),
        np.zeros((num_sms * units, 3, fifo_room), np.int32),
        masks,
        np.zeros(NUM_REASONS, np.int64),
        np.zeros((5, 2), np.int64),
        np.zeros(5, np.int64),
        np.zeros(1, np.int64),
    )  # fmt: skip


def empty_work() -> Work:
    """No program, no rows."""
    return Work(
        np.zeros(0, records.INSTRUCTION), np.zeros(0, records.OPERATION),
        np.zeros(1, records.ROW), np.zeros(1, records.ASK), np.zeros(1, np.int64),
        np.zeros(1, np.uint32),
        np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint8),
    )  # fmt: skip
