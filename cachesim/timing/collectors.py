"""GPGPU-Sim's operand collectors of one SM: issued instructions wait here for their operands, then
for their unit.

issued, one of each unit and scheduler ──► collector: reads its register banks ──► unit

A bank gives one operand a step, and none in the first step of a cycle in which loaded data enters.
Registers are those of `traces.lane_address`: loads of a group fill R8, R9, … in their order, an
instruction that takes a load's data adds it to R28, R29 or R30 in turn, addresses are in R2, a
store's data in R28.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.stream import STORE
from cachesim.timing.bits import bit_at, lowest, num_set, without_lowest
from cachesim.timing.records import (
    CONTROL,
    FP32,
    INT,
    MAX_COLLECTORS,
    MAX_REGISTER_BANKS,
    MAX_WARPS,
    MEMORY,
    NEVER,
    SFU,
)
from cachesim.timing.units import (
    ADDRESS,
    AHEAD,
    LOADED,
    SUM,
    note_access,
    registers_written,
    unit_of,
)
from cachesim.timing.warp import is_exit, schedule

U64 = np.uint64
_PLACES = U64((1 << MAX_COLLECTORS) - 1)


@small
def _to_load_store(sm, place):  # type: ignore[no-untyped-def]
    """Hand an access to the load/store unit's queue, which is empty."""
    one = sm.collector[place]
    s = place // MAX_COLLECTORS
    sm.queue_head[s] = 0
    sm.queue_count[s] = 1
    sm.queue_warp[0, s] = one.slot
    # The load/store unit takes the oldest of those that are there.
    sm.queue_time[0, s] = one.order
    sm.queue_row[0, s] = one.row
    sm.queue_load[0, s] = one.load


@small
def _to_unit(state, index, place):  # type: ignore[no-untyped-def]
    """Start an arithmetic instruction, if its unit has room. Returns whether it has."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    one = sm.collector[place]
    s = place // MAX_COLLECTORS
    kind = one.kind
    unit = unit_of(machine, kind)
    # One instruction may wait between collector and unit.
    if sm.unit_free[unit, s] - state.latencies[kind, 1] > machine.now:
        return False
    warp = state.warps[index * MAX_WARPS + one.slot]
    start = max(machine.now + 1, sm.unit_free[unit, s])
    if one.chain < 0:
        sm.unit_free[unit, s] = start + 1
        warp.exit_ready = start + machine.result_cycles - AHEAD + 1
    else:
        sm.unit_free[unit, s] = start + state.latencies[kind, 1]
        done = start + state.latencies[kind, 0] + machine.result_cycles - AHEAD
        warp.chains_ready[one.chain] = done
        if kind == INT:
            warp.int_ready = done
    if warp.waits_chain >= 0:
        warp.waits_chain = -1
        schedule(state, index, one.slot, machine.now + 1)
    return True


@small
def _read_operands(sm, num_schedulers, written):  # type: ignore[no-untyped-def]
    """Each bank that is not written gives one operand to the collector that has asked first."""
    for s in range(num_schedulers):
        left = (sm.reading >> U64(s * MAX_COLLECTORS)) & _PLACES
        free = ~np.int64(written >> U64(s * MAX_REGISTER_BANKS))
        while left != 0:
            place = s * MAX_COLLECTORS + lowest(left)
            rest = without_lowest(left)
            while rest != 0:
                other = s * MAX_COLLECTORS + lowest(rest)
                rest = without_lowest(rest)
                if sm.collector[other].since < sm.collector[place].since:
                    place = other
            left &= ~bit_at(place - s * MAX_COLLECTORS)
            one = sm.collector[place]
            taken = one.banks & free
            free &= ~taken
            # The second operand of a bank waits for the next step.
            one.banks = (one.banks & ~taken) | (one.again & taken)
            one.again &= ~taken
            if one.banks == 0:
                sm.reading &= ~bit_at(place)


@small
def _allocate(sm, unit, units_mask):  # type: ignore[no-untyped-def]
    """Give the oldest issued instruction of a unit a collector of its scheduler. Returns whether
    one is free; if not, it blocks the younger ones of other schedulers.
    """
    turn = sm.turn[unit]
    if turn == 0:
        return False
    s = np.int64(turn & 15) - 1
    free = ~(sm.collecting >> U64(s * MAX_COLLECTORS)) & units_mask
    if free == 0:
        return False
    place = s * MAX_COLLECTORS + lowest(free)
    source, one = sm.issued[unit, s], sm.collector[place]
    sm.order += 1
    one.since = sm.order
    one.order = source.order
    one.slot = source.slot
    one.kind = source.kind
    one.chain = source.chain
    one.banks = source.banks
    one.again = source.again
    bit = bit_at(place)
    sm.collecting |= bit
    if source.banks != 0:
        sm.reading |= bit
    if unit == MEMORY:
        one.row = source.row
        one.load = source.load
    sm.turn[unit] = turn >> 4
    sm.waiting[unit] &= ~(1 << s)
    sm.is_stuck = 0
    return True


@compiled
def collect(state, index):  # type: ignore[no-untyped-def]
    """One cycle of GPGPU-Sim's operand collectors: two steps of dispatch, reads, allocation.

    A scheduler's collectors are tried in their order, so that under pressure a later one waits.
    """
    machine = state.pool.machine[0]
    sm = state.sms[index]
    units_mask = bit_at(machine.collector_units) - U64(1)
    changed = False
    later = NEVER
    for step in range(2):
        left = sm.collecting & ~sm.reading
        while left != 0:
            place = lowest(left)
            left = without_lowest(left)
            if sm.collector[place].kind == MEMORY:
                if sm.queue_count[place // MAX_COLLECTORS] > 0:
                    continue
                _to_load_store(sm, place)
            elif not _to_unit(state, index, place):
                later = machine.now + 1
                continue
            sm.collecting &= ~bit_at(place)
            sm.num_collecting -= 1
            changed = True
        if sm.reading != 0:
            # Loaded data is written in the first step.
            written = registers_written(sm, machine.now) if step == 0 else U64(0)
            _read_operands(sm, machine.num_schedulers, written)
            changed = True
        # Each of the ports takes the oldest of every unit in turn.
        moved = sm.num_collecting > num_set(sm.collecting)
        while moved:
            moved = _allocate(sm, FP32, units_mask)
            moved |= _allocate(sm, SFU, units_mask)
            moved |= _allocate(sm, MEMORY, units_mask)
            moved |= _allocate(sm, INT, units_mask)
            changed |= moved
    sm.collect_from = machine.now + 1 if changed else later


@small
def _note_banks(one, num_banks, first, second):  # type: ignore[no-untyped-def]
    """The banks of an instruction's one or two operands; second: -1 where there is none."""
    one.banks = 1 << (first % num_banks)
    if second >= 0:
        other = 1 << (second % num_banks)
        one.again = one.banks & other
        one.banks |= other


@compiled
def enter_collectors(state, index, s, slot, warp, kind):  # type: ignore[no-untyped-def]
    """Issue to the collectors' entry."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    unit = unit_of(machine, kind)
    sm.order += 1
    sm.num_collecting += 1
    sm.collect_from = 0
    ahead = 0
    while sm.turn[unit] >> (4 * ahead) != 0:
        ahead += 1
    sm.turn[unit] |= (s + 1) << (4 * ahead)
    sm.waiting[unit] |= 1 << s
    one = sm.issued[unit, s]
    one.order = sm.order
    one.slot = slot
    one.kind = kind
    one.chain = warp.chain
    one.banks = 0
    one.again = 0
    if kind == MEMORY:
        row = state.work.rows[warp.row & machine.row_mask]
        one.row = warp.row
        one.load = note_access(state, warp, row)
        if machine.register_banks > 0:
            stores = state.work.instructions[row.code].operation == STORE
            _note_banks(one, machine.register_banks, ADDRESS, SUM if stores else -1)
    elif is_exit(warp):
        one.chain = -1
        warp.exit_ready = NEVER
    else:
        if machine.register_banks > 0 and kind != CONTROL:
            load = state.work.operations[warp.operation].load
            loaded = LOADED + load if load >= 0 else -1
            _note_banks(one, machine.register_banks, SUM + warp.chain, loaded)
        warp.chains_ready[warp.chain] = NEVER
        if kind == INT:
            warp.int_ready = NEVER
