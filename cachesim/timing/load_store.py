"""A memory instruction's accesses: sector by sector to the banks of its L1 unit, or around them, as
the tag, data and filter laws allow.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.counts import REQUESTS
from cachesim.stream import ATOMIC, LOAD, STORE
from cachesim.timing import fifo
from cachesim.timing.access import (
    count_bypass,
    drop_request,
    take_request,
)
from cachesim.timing.bits import highest
from cachesim.timing.network import has_room
from cachesim.timing.partition import is_drawn, locate
from cachesim.timing.records import (
    DEMANDED,
    MAX_WARPS,
    NEVER,
    PATH_BYPASS,
    PATH_FIFO,
    R_INTERCONNECT,
    R_L1_BANDWIDTH,
    R_L1_RESERVATION,
)
from cachesim.timing.tags import bucket_of
from cachesim.timing.uplink import send_up
from cachesim.timing.view import prefetch
from cachesim.timing.warp import sector_back, store_done

U64 = np.uint64
#: How far ahead of the pipe the host fetches what it asks for.
_ASKS_AHEAD = 4
MAX_ADDRESS = (1 << 63) - 1


@small
def _new_request(state, unit, address, at, sector):  # type: ignore[no-untyped-def]
    """A request for one sector of the instruction the pipe works on."""
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    index = take_request(state.pool)
    one = state.pool.requests[index]
    instruction = state.work.instructions[pipe.code]
    one.address = address
    one.warp = pipe.warp
    one.load = pipe.load
    one.unit = unit
    one.group = state.work.asks[at].group
    one.operation = instruction.operation
    one.write = 1 if instruction.operation == STORE else 0
    one.kind = DEMANDED
    one.path = pipe.path
    one.born = machine.now
    one.mark = machine.now
    one.slice = pipe.slice
    one.number = pipe.number
    if one.write:
        where = state.work.written[at] + sector
        one.bytes = state.work.granules[where & (len(state.work.granules) - 1)]
    return index


@small
def _out_of_bandwidth(pipe):  # type: ignore[no-untyped-def]
    """Note why the instruction is not done, and that it is not."""
    if pipe.blocked == 0:
        pipe.blocked = R_L1_BANDWIDTH
    return False


@compiled
def issue_accesses(state, unit):  # type: ignore[no-untyped-def]
    """Hand sectors of the instruction at hand to the L1's banks, or around it, from the highest
    address down; a bank clash ends the cycle, or the next line where `lines_per_cycle` have been
    looked up. Returns whether the instruction is done.
    """
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    work = state.work
    room = state.banks.shape[1] - 1
    level = state.l1.level[0]
    now = machine.now
    moves = machine.sectors_per_cycle if pipe.path != 0 else machine.num_banks
    lines = 0 if pipe.mask == 0 else 1
    for k in range(moves):
        while pipe.mask == 0 and pipe.at > pipe.first:
            if pipe.path == 0 and machine.lines_per_cycle > 0:
                if lines == machine.lines_per_cycle:
                    return _out_of_bandwidth(pipe)
                lines += 1
            pipe.at -= 1
            prefetch(work.asks, (pipe.at - _ASKS_AHEAD) & machine.request_mask)  # type: ignore[call-arg]
            pipe.mask = work.asks[pipe.at & machine.request_mask].mask
            if pipe.path != PATH_BYPASS:
                state.l1.counters[work.asks[pipe.at & machine.request_mask].group, REQUESTS] += 1
        if pipe.mask == 0:
            break
        at = pipe.at & machine.request_mask
        sector = highest(U64(pipe.mask))
        # The highest address bit is dropped: the engine's addresses are signed.
        address = (work.asks[at].line << level.line_shift) + (sector << level.sector_shift)
        address &= MAX_ADDRESS
        if not pipe.is_located:
            # What goes around the L1 asks where at once; a random slice is drawn at first touch.
            pipe.is_located = 1
            pipe.slice = -1
            if pipe.path == PATH_BYPASS or (pipe.path == 0 and is_drawn(state.l2_route)):
                pipe.slice, pipe.number = locate(state.l2_route, address)
        if pipe.path == PATH_BYPASS:
            port = state.port_of[unit]
            if not machine.has_gl1 and not has_room(machine, state.up, port, pipe.slice):
                pipe.blocked = R_INTERCONNECT
                return False
            index = _new_request(state, unit, address, at, sector)
            if not send_up(state, index):
                drop_request(state.pool, index)
                pipe.blocked = R_INTERCONNECT
                return False
            count_bypass(
                state.l1, work.asks[at].group, state.pool.requests[index].operation != LOAD
            )
        elif pipe.path == PATH_FIFO:
            if not fifo.accepts(state, unit):
                pipe.blocked = R_L1_RESERVATION
                return False
            index = _new_request(state, unit, address, at, sector)
            fifo.access(state, unit, index)
        else:
            which = (address >> machine.bank_shift) & (machine.num_banks - 1)
            if machine.lines_per_cycle > 0:
                which = k
            which += unit * machine.num_banks
            bank = state.l1_banks[which]
            if bank.count >= machine.l1_latency or bank.entered == now:
                machine.bank_conflicts += 1
                pipe.clashes = 1
                return _out_of_bandwidth(pipe)
            index = _new_request(state, unit, address, at, sector)
            place = (bank.head + bank.count) & room
            waiting = state.banks[which, place]
            waiting.request = index
            waiting.time = now + machine.l1_latency
            waiting.entered = bucket_of(state.l1, unit, work.asks[at].line)
            if bank.count == 0:
                bank.ready = now + machine.l1_latency
            bank.count += 1
            bank.entered = now
            pipe.in_banks += 1
        pipe.mask &= ~(1 << sector)
        pipe.is_located = 0
        pipe.left -= 1
    return pipe.left <= 0 or _out_of_bandwidth(pipe)


@compiled
def _law_cycles(state, row, instruction):  # type: ignore[no-untyped-def]
    """Cycles that tags, data port and filters need for one instruction (facts sheet 1.6, 2.5)."""
    machine = state.pool.machine[0]
    cycles = 1
    if machine.lines_per_cycle > 0:
        cycles = max(cycles, -(-row.count // machine.lines_per_cycle))
    if machine.bytes_per_cycle > 0:
        moved = row.lanes * instruction.access_bytes
        cycles = max(cycles, -(-moved // machine.bytes_per_cycle))
    if machine.quads_per_cycle > 0 and instruction.quad_cost > 0:
        # The filters are the SM's; each of its units has an equal share.
        quads = -(-row.lanes // 4) * instruction.quad_cost * machine.units
        cycles = max(cycles, -(-quads // machine.quads_per_cycle))
    return cycles


@compiled
def take_instruction(state, index, unit):  # type: ignore[no-untyped-def]
    """Take the memory instruction that issued first among the schedulers' queue heads. Returns
    whether there was one.
    """
    machine = state.pool.machine[0]
    sm = state.sms[index]
    pipe = state.pipes[unit]
    now = machine.now
    if pipe.free_at > now:
        if pipe.blocked == 0:
            pipe.blocked = R_L1_BANDWIDTH
        pipe.until = min(pipe.until, pipe.free_at)
        return False
    # With collectors this is the order of issue, and what is there may be taken.
    best, oldest = -1, NEVER if machine.collector_units > 0 else now + 1
    for s in range(machine.num_schedulers):
        if sm.queue_count[s] == 0:
            continue
        at = sm.queue_head[s]
        if (
            machine.units > 1
            and (sm.queue_warp[at, s] // 2) % machine.units != unit % machine.units
        ):
            continue
        time = sm.queue_time[at, s]
        if time < oldest:
            best, oldest = s, time
        elif best < 0:
            pipe.until = min(pipe.until, time)
    if best < 0:
        return False
    at = sm.queue_head[best]
    slot = sm.queue_warp[at, best]
    sm.queue_head[best] = at + 1 if at + 1 < machine.memory_queue else 0
    sm.queue_count[best] -= 1
    sm.collect_from = 0
    sm.is_stuck = 0
    pipe.warp = index * MAX_WARPS + slot
    # The queue keeps the row beside the slot: the warp itself has moved on.
    row = state.work.rows[sm.queue_row[at, best] & machine.row_mask]
    instruction = state.work.instructions[row.code]
    pipe.code = row.code
    pipe.first = row.first
    pipe.at = row.first + row.count
    pipe.mask = 0
    pipe.left = row.sectors
    pipe.load = sm.queue_load[at, best]
    pipe.path = instruction.path
    if instruction.operation == ATOMIC:
        pipe.path = PATH_BYPASS
    pipe.free_at = now + _law_cycles(state, row, instruction)
    if row.sectors == 0 and instruction.operation == STORE:
        store_done(state, pipe.warp)
        pipe.warp = -1
    elif row.sectors == 0:
        # A fully masked access asks for nothing; `issue` left one sector pending for it.
        sector_back(state, pipe.warp, pipe.load)
        pipe.warp = -1
    return True
