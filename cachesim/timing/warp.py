"""One warp's way through its program: what it does next, and what it waits for.

A warp issues in order. A load waits for the warp's last integer result (its address), a store for
all results; arithmetic instruction c of a run waits for c - 3, as three chains run side by side; a
"wait" holds the warp until all but its last n loads are back.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.stream import STORE
from cachesim.timing.bits import bit_at, lowest, without_lowest
from cachesim.timing.partition import draw_code, is_drawn
from cachesim.timing.records import MAX_LOADS, MAX_WARPS, MEMORY, NEVER, WAIT, WHEEL


@small
def _block(sm, warp, slot, until):  # type: ignore[no-untyped-def]
    warp.waits_for = until
    sm.blocked |= bit_at(slot)


@compiled
def _finish(state, index, slot):  # type: ignore[no-untyped-def]
    """The warp has exited; its CTA leaves with its last warp."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    warp = state.warps[index * MAX_WARPS + slot]
    warp.alive = 0
    state.resident[0] += sm.num_resident * (machine.now - sm.resident_since)
    sm.resident_since = machine.now
    sm.num_resident -= 1
    sm.resident &= ~bit_at(slot)
    place = warp.cta
    state.warps_left[index, place] -= 1
    if state.warps_left[index, place] == 0:
        state.work.cta_left[state.cta_at[index, place]] = 1
        state.cta_at[index, place] = -1
        sm.free_places += 1
        machine.live_ctas -= 1
        machine.ctas_done += 1


@small
def is_exit(warp):  # type: ignore[no-untyped-def]
    """Whether the warp's next instruction is its exit, which depends on nothing."""
    return warp.in_trailer and warp.operation == warp.last_operation - 1


@small
def has_exited(warp):  # type: ignore[no-untyped-def]
    """Whether the warp has issued all its instructions."""
    return warp.in_trailer and warp.operation >= warp.last_operation


@compiled
def schedule(state, index, slot, earliest):  # type: ignore[no-untyped-def]
    """Find what a warp issues next, and put it where the issue logic sees it no sooner than cycle
    `earliest`: on a ready mask, on the wheel, or blocked until loads are back.
    """
    machine = state.pool.machine[0]
    sm = state.sms[index]
    warp = state.warps[index * MAX_WARPS + slot]
    work = state.work
    ready = earliest
    kind = MEMORY
    while True:
        if warp.operation < warp.last_operation:
            step = work.operations[warp.operation]
            if step.kind == WAIT:
                until = warp.next_load - step.count
                if warp.oldest_load < until:
                    _block(sm, warp, slot, until)
                    return
                warp.operation += 1
                continue
            if warp.left < 0:
                warp.left = step.count
                warp.chain = 0
            if warp.left == 0:
                warp.operation += 1
                warp.left = -1
                continue
            kind = step.kind
            if not is_exit(warp):
                ready = max(ready, warp.chains_ready[warp.chain])
            break
        if warp.in_trailer:
            if warp.oldest_load < warp.next_load or warp.stores > 0:
                _block(sm, warp, slot, warp.next_load)
                return
            # A warp leaves when its last instructions have left the pipeline.
            ready = warp.exit_ready
            for chain in range(3):
                ready = max(ready, warp.chains_ready[chain])
            if ready <= machine.now:
                _finish(state, index, slot)
                return
            break
        row = work.rows[warp.row & machine.row_mask]
        instruction = work.instructions[row.code]
        until = warp.next_load - (MAX_LOADS - 2)
        if instruction.num_outstanding >= 0:
            until = max(until, warp.next_load - instruction.num_outstanding)
        if warp.oldest_load < until:
            _block(sm, warp, slot, until)
            return
        ready = max(ready, warp.int_ready)
        if instruction.operation == STORE:
            for chain in range(3):
                ready = max(ready, warp.chains_ready[chain])
        break
    if ready >= NEVER:
        # Its last result is still being collected; `collect` will say when it is there.
        warp.waits_chain = 0
        return
    bit = bit_at(slot)
    if ready <= machine.now:
        sm.ready[kind] |= bit
        sm.is_stuck = 0
    else:
        sm.wheel[ready & (WHEEL - 1)] |= bit
        sm.num_timed += 1


@compiled
def wake_timed(state, index):  # type: ignore[no-untyped-def]
    """Move the warps whose time has come from the wheel to the ready masks."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    due = sm.wheel[machine.now & (WHEEL - 1)]
    if due == 0:
        return
    sm.wheel[machine.now & (WHEEL - 1)] = np.uint64(0)
    while due != 0:
        slot = lowest(due)
        due = without_lowest(due)
        sm.num_timed -= 1
        warp = state.warps[index * MAX_WARPS + slot]
        kind = MEMORY
        if warp.operation < warp.last_operation:
            kind = state.work.operations[warp.operation].kind
        if has_exited(warp):
            schedule(state, index, slot, machine.now)
        else:
            sm.ready[kind] |= bit_at(slot)
            sm.is_stuck = 0


@compiled
def _unblock(state, warp_index):  # type: ignore[no-untyped-def]
    warp = state.warps[warp_index]
    if warp.waits_for < 0 or warp.oldest_load < warp.waits_for:
        return
    if has_exited(warp) and warp.stores > 0:
        return
    warp.waits_for = -1
    index = warp_index // MAX_WARPS
    slot = warp_index % MAX_WARPS
    sm = state.sms[index]
    sm.blocked &= ~bit_at(slot)
    schedule(state, index, slot, state.pool.machine[0].now)


@compiled
def sector_back(state, warp_index, load):  # type: ignore[no-untyped-def]
    """One sector of a load has reached its register."""
    warp = state.warps[warp_index]
    at = load & (MAX_LOADS - 1)
    warp.pending[at] -= 1
    if warp.pending[at] > 0 or load != warp.oldest_load:
        return
    while (
        warp.oldest_load < warp.next_load and warp.pending[warp.oldest_load & (MAX_LOADS - 1)] == 0
    ):
        warp.oldest_load += 1
    _unblock(state, warp_index)


@compiled
def store_done(state, warp_index):  # type: ignore[no-untyped-def]
    """One sector of a store was acknowledged."""
    state.warps[warp_index].stores -= 1
    _unblock(state, warp_index)


@small
def _fetch_code(state, warp):  # type: ignore[no-untyped-def]
    """Where slices are drawn, the warp's next instruction may be the first touch of its code."""
    if state.pool.machine[0].collector_units > 0 and is_drawn(state.l2_route):
        draw_code(state.l2_route, warp.num_issued)


@compiled
def advance(state, index, slot, now, again):  # type: ignore[no-untyped-def]
    """The warp has issued its next instruction; find the one after it. again: it may issue once
    more in this cycle.
    """
    machine = state.pool.machine[0]
    warp = state.warps[index * MAX_WARPS + slot]
    work = state.work
    if warp.operation < warp.last_operation:
        warp.left -= 1
        warp.chain = warp.chain + 1 if warp.chain < 2 else 0
        if warp.left == 0:
            warp.operation += 1
            warp.left = -1
    else:
        warp.row += 1
        warp.rows_left -= 1
        if warp.rows_left > 0:
            instruction = work.instructions[work.rows[warp.row & machine.row_mask].code]
            warp.operation = instruction.first
            warp.last_operation = instruction.last
        else:
            warp.operation = machine.trailer_first
            warp.last_operation = machine.trailer_last
            warp.in_trailer = 1
        warp.left = -1
    if not has_exited(warp):
        _fetch_code(state, warp)
    schedule(state, index, slot, now if again else now + 1)


@compiled
def start_warp(state, index, slot, place, first, rows, age):  # type: ignore[no-untyped-def]
    """Put a warp into a slot of an SM. It may issue in two cycles, when it is fetched."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    work = state.work
    warp = state.warps[index * MAX_WARPS + slot]
    warp.row = first
    warp.rows_left = rows
    warp.left = -1
    warp.chain = 0
    warp.waits_for = -1
    warp.waits_chain = -1
    warp.num_issued = 0
    _fetch_code(state, warp)
    warp.group = 0
    warp.next_load = 0
    warp.oldest_load = 0
    warp.stores = 0
    warp.cta = place
    warp.alive = 1
    sm.age[slot] = age
    warp.int_ready = 0
    warp.exit_ready = 0
    for chain in range(3):
        warp.chains_ready[chain] = 0
    if rows > 0:
        instruction = work.instructions[work.rows[first & machine.row_mask].code]
        warp.operation = instruction.first
        warp.last_operation = instruction.last
        warp.in_trailer = 0
    else:
        warp.operation = machine.trailer_first
        warp.last_operation = machine.trailer_last
        warp.in_trailer = 1
    state.resident[0] += sm.num_resident * (machine.now - sm.resident_since)
    sm.resident_since = machine.now
    sm.num_resident += 1
    sm.resident |= bit_at(slot)
    schedule(state, index, slot, machine.now + 2 + machine.cta_launch_cycles)
