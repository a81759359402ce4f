"""GPGPU-Sim's operand collectors of one SM: issued instructions wait here for their operands, then
for their unit.
"""

from __future__ import annotations

from cachesim.compiled import compiled
from cachesim.timing.records import (
    FP32,
    INT,
    MAX_WARPS,
    MEMORY,
    NEVER,
    SFU,
)
from cachesim.timing.units import AHEAD, note_access, unit_of
from cachesim.timing.warp import is_exit, schedule

#: The order in which a port looks for instructions.
_PORT_ORDER = (FP32, SFU, MEMORY, INT)


@compiled
def _dispatch(state, index, s, c):  # type: ignore[no-untyped-def]
    """Move a collected instruction to its unit, if that has room. Returns whether it did."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    now = machine.now
    kind = sm.collector_kind[c, s]
    if kind == MEMORY:
        if sm.queue_count[s] > 0:
            return False
        sm.queue_head[s] = 0
        sm.queue_count[s] = 1
        sm.queue_warp[0, s] = sm.collector_slot[c, s]
        # The load/store unit takes the oldest of those that are there.
        sm.queue_time[0, s] = sm.collector_order[c, s]
        sm.queue_row[0, s] = sm.collector_row[c, s]
        sm.queue_load[0, s] = sm.collector_load[c, s]
    else:
        unit = unit_of(machine, kind)
        # One instruction may wait between collector and unit.
        if sm.unit_free[unit, s] - state.latencies[kind, 1] > now:
            return False
        slot = sm.collector_slot[c, s]
        warp = state.warps[index * MAX_WARPS + slot]
        is_last = sm.collector_chain[c, s] < 0
        start = max(now + 1, sm.unit_free[unit, s])
        sm.unit_free[unit, s] = start + (1 if is_last else state.latencies[kind, 1])
        done = start + state.latencies[kind, 0] + machine.result_cycles - AHEAD
        if is_last:
            warp.exit_ready = start + machine.result_cycles - AHEAD + 1
        else:
            warp.chains_ready[sm.collector_chain[c, s]] = done
        if kind == INT:
            warp.int_ready = done
        if warp.waits_chain >= 0:
            warp.waits_chain = -1
            schedule(state, index, slot, now + 1)
    sm.collector_slot[c, s] = -1
    sm.num_collecting -= 1
    return True


@compiled
def _allocate(state, index, kind):  # type: ignore[no-untyped-def]
    """Give the oldest issued instruction of a kind a collector of its scheduler, if one is free."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    if sm.num_issued[kind] == 0:
        return False
    oldest, order = -1, NEVER
    for s in range(machine.num_schedulers):
        if sm.issued_slot[kind, s] >= 0 and sm.issued_order[kind, s] < order:
            oldest, order = s, sm.issued_order[kind, s]
    if oldest < 0:
        return False
    for c in range(machine.collector_units):
        if sm.collector_slot[c, oldest] >= 0:
            continue
        sm.collector_slot[c, oldest] = sm.issued_slot[kind, oldest]
        sm.collector_kind[c, oldest] = sm.issued_kind[kind, oldest]
        # One operand is read a step: arithmetic has two, a memory instruction its address, an exit
        # none.
        exits = sm.issued_chain[kind, oldest] < 0
        sm.collector_ready[c, oldest] = 1 if exits else 0 if kind == MEMORY else -1
        sm.collector_order[c, oldest] = order
        sm.collector_chain[c, oldest] = sm.issued_chain[kind, oldest]
        if kind == MEMORY:
            sm.collector_row[c, oldest] = sm.issued_row[oldest]
            sm.collector_load[c, oldest] = sm.issued_load[oldest]
        sm.issued_slot[kind, oldest] = -1
        sm.num_issued[kind] -= 1
        sm.is_stuck = 0
        return True
    return False


@compiled
def collect(state, index):  # type: ignore[no-untyped-def]
    """One cycle of GPGPU-Sim's operand collectors: two steps of dispatch, reads, allocation.

    A scheduler's collectors are tried in their order, so that under pressure a later one waits.
    """
    machine = state.pool.machine[0]
    sm = state.sms[index]
    now = machine.now
    changed = False
    later = NEVER
    for _ in range(2):
        for s in range(machine.num_schedulers):
            for c in range(machine.collector_units):
                if sm.collector_slot[c, s] < 0:
                    continue
                if sm.collector_ready[c, s] <= 0:
                    sm.collector_ready[c, s] += 1
                    changed = True
                elif _dispatch(state, index, s, c):
                    changed = True
                elif sm.collector_kind[c, s] != MEMORY:
                    later = now + 1
        # Each of the ports takes the oldest of every kind in turn; one that finds no collector of
        # its scheduler free blocks its kind.
        moved = True
        while moved:
            moved = False
            for place in range(4):
                moved |= _allocate(state, index, _PORT_ORDER[place])
            changed |= moved
    sm.collect_from = now + 1 if changed else later


@compiled
def enter_collectors(state, index, s, slot, warp, kind):  # type: ignore[no-untyped-def]
    """Issue to the collectors' entry."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    place = kind if kind == MEMORY else unit_of(machine, kind)
    sm.order += 1
    sm.num_collecting += 1
    sm.collect_from = 0
    sm.issued_slot[place, s] = slot
    sm.num_issued[place] += 1
    sm.issued_order[place, s] = sm.order
    sm.issued_chain[place, s] = warp.chain
    sm.issued_kind[place, s] = kind
    if kind == MEMORY:
        row = state.work.rows[warp.row & machine.row_mask]
        sm.issued_row[s] = warp.row
        sm.issued_load[s] = note_access(state, warp, row)
    elif is_exit(warp):
        sm.issued_chain[place, s] = -1
        warp.exit_ready = NEVER
    else:
        warp.chains_ready[warp.chain] = NEVER
        if kind == INT:
            warp.int_ready = NEVER
