"""One SM: its schedulers, execution units, and the pipes of its L1 units."""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.timing.bits import bit_at, lowest, num_set, without_lowest
from cachesim.timing.collectors import collect, enter_collectors
from cachesim.timing.pipe import book_sleep, step_pipe
from cachesim.timing.records import (
    INT,
    MAX_WARPS,
    MEMORY,
    NEVER,
    R_ARITHMETIC,
    R_IDLE,
    R_INTERCONNECT,
    R_ISSUE,
    R_L1_BANDWIDTH,
    R_MEMORY,
    WHEEL,
)
from cachesim.timing.units import AHEAD, note_access, unit_of
from cachesim.timing.warp import advance, is_exit, start_warp, wake_timed

U64 = np.uint64


@small
def _pick(state, index, scheduler, candidates):  # type: ignore[no-untyped-def]
    """The warp slot a scheduler chooses among the candidates (a mask)."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    last = sm.last_issued[scheduler]
    if machine.is_gto:
        if last >= 0 and (candidates >> U64(last)) & U64(1):
            return last
        best, age = -1, NEVER
        while candidates != 0:
            slot = lowest(candidates)
            candidates = without_lowest(candidates)
            if sm.age[slot] < age:
                best, age = slot, sm.age[slot]
        return best
    # The next after the last one, or the first.
    after = candidates & ~(bit_at(last + 1) - U64(1)) if 0 <= last < 63 else candidates
    if last == 63 or after == 0:
        after = candidates
    return lowest(after)


@compiled
def _start_arithmetic(state, index, scheduler, warp, kind, now):  # type: ignore[no-untyped-def]
    """Send an instruction to its unit, and note when its result is there."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    unit = unit_of(machine, kind)
    start = max(now + AHEAD, sm.unit_free[unit, scheduler])
    sm.unit_free[unit, scheduler] = start + state.latencies[kind, 1]
    done = start + state.latencies[kind, 0] + machine.result_cycles - AHEAD
    if is_exit(warp):
        warp.exit_ready = start + machine.result_cycles - AHEAD + 1
        return
    warp.chains_ready[warp.chain] = done
    if kind == INT:
        warp.int_ready = done


@compiled
def _start_memory(state, index, scheduler, slot, warp, now):  # type: ignore[no-untyped-def]
    """Queue an access for the load/store unit."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    work = state.work
    row = work.rows[warp.row & machine.row_mask]
    at = sm.queue_head[scheduler] + sm.queue_count[scheduler]
    if at >= machine.memory_queue:
        at -= machine.memory_queue
    sm.queue_warp[at, scheduler] = slot
    sm.queue_time[at, scheduler] = now + machine.memory_cycles - 1
    sm.queue_row[at, scheduler] = warp.row
    sm.queue_count[scheduler] += 1
    sm.queue_load[at, scheduler] = note_access(state, warp, row)


@small
def _has_room(state, index, scheduler, kind, now):  # type: ignore[no-untyped-def]
    """Whether a scheduler may issue an instruction of a kind."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    if machine.collector_units > 0:
        return (sm.waiting[unit_of(machine, kind)] >> scheduler) & 1 == 0
    if kind == MEMORY:
        return sm.queue_count[scheduler] < machine.memory_queue
    return sm.unit_free[unit_of(machine, kind), scheduler] <= now + AHEAD


@compiled
def _issue(state, index, scheduler):  # type: ignore[no-untyped-def]
    """Issue up to `issue_per_warp` instructions of one warp. Returns how many."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    now = machine.now
    mine = state.scheduler_masks[scheduler]
    candidates = U64(0)
    for kind in range(5):
        if sm.ready[kind] & mine and _has_room(state, index, scheduler, kind, now):
            candidates |= sm.ready[kind] & mine
    if candidates == 0:
        return 0
    slot = _pick(state, index, scheduler, candidates)
    bit = bit_at(slot)
    warp = state.warps[index * MAX_WARPS + slot]
    issued = 0
    previous = -1
    while True:
        kind = 0
        while (sm.ready[kind] & bit) == 0:
            kind += 1
        unit = unit_of(machine, kind)
        if issued > 0 and (
            (machine.different_units and unit == previous)
            or not _has_room(state, index, scheduler, kind, now)
        ):
            break
        sm.ready[kind] &= ~bit
        if machine.collector_units > 0:
            enter_collectors(state, index, scheduler, slot, warp, kind)
        elif kind == MEMORY:
            _start_memory(state, index, scheduler, slot, warp, now)
        else:
            _start_arithmetic(state, index, scheduler, warp, kind, now)
        state.issued[kind] += 1
        lanes = 32
        if kind == MEMORY:
            lanes = state.work.rows[warp.row & machine.row_mask].lanes
        machine.instruction_threads += lanes
        issued += 1
        previous = unit
        # Instructions are fetched in pairs; only the two of a pair can issue together.
        again = issued < machine.issue_per_warp and warp.num_issued & 1 == 0
        warp.num_issued += 1
        advance(state, index, slot, now, again)
        if not again or not warp.alive:
            break
        ready = False
        for kind in range(5):
            if sm.ready[kind] & bit:
                ready = True
        if not ready:
            break
    sm.last_issued[scheduler] = slot
    return issued


@small
def _next_timed(sm, now, soonest):  # type: ignore[no-untyped-def]
    """The next cycle in which a warp on the wheel wakes, or `soonest` if that comes first."""
    if sm.num_timed > 0:
        for ahead in range(1, WHEEL):
            if now + ahead >= soonest:
                break
            if sm.wheel[(now + ahead) & (WHEEL - 1)] != 0:
                return now + ahead
    return soonest


@compiled
def _next_event(state, index):  # type: ignore[no-untyped-def]
    """The next cycle in which the SM has something to do, replies from outside apart."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    now = machine.now
    for kind in range(5):
        if sm.ready[kind] != 0:
            return now + 1
    if sm.num_collecting > 0:
        return now + 1
    soonest = NEVER
    for s in range(machine.num_schedulers):
        if sm.queue_count[s] > 0:
            return now + 1
    for unit in range(index * machine.units, (index + 1) * machine.units):
        pipe = state.pipes[unit]
        node = state.l1.nodes[unit]
        if (
            pipe.warp >= 0
            or pipe.next_writeback >= 0
            or pipe.next_global >= 0
            or pipe.response_count > 0
            or node.miss_count > 0
            or node.ready_first >= 0
            or pipe.request_count > 0
            or pipe.result_count > 0
        ):
            return now + 1
        if pipe.fragment_count > 0:
            room = state.fifo.shape[2] - 1
            if state.pool.requests[state.fifo[unit, 0, pipe.fragment_head & room]].pending == 0:
                return now + 1
        if pipe.in_banks > 0:
            for bank in range(machine.num_banks):
                one = state.l1_banks[unit * machine.num_banks + bank]
                if one.count > 0:
                    soonest = min(soonest, max(now + 1, one.ready))
    return _next_timed(sm, now, soonest)


@small
def _find_stall(sm, mine, blocked):  # type: ignore[no-untyped-def]
    """Why a scheduler whose warps are `mine` does not issue: what most of them wait for. blocked:
    0, or why an access of the SM did not leave its pipe.
    """
    resident = sm.resident & mine
    if resident == 0:
        return R_IDLE
    if sm.ready[MEMORY] & mine:
        return blocked if blocked > 0 else R_L1_BANDWIDTH
    if 2 * num_set(sm.blocked & mine) < num_set(resident):
        return R_ARITHMETIC
    return blocked if blocked > 0 else R_MEMORY


@compiled
def step_sm(state, index):  # type: ignore[no-untyped-def]
    """One cycle of an SM; sets the cycle in which it wants to be stepped again."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    now = machine.now
    # The slots it slept through went where its last ones did.
    slept = now - sm.last_step - 1
    if slept > 0:
        for s in range(machine.num_schedulers):
            state.reasons[sm.stall[s]] += slept
    sm.last_step = now
    blocked = 0
    has_moved = False
    for unit in range(index * machine.units, (index + 1) * machine.units):
        if slept > 0:
            book_sleep(state, unit, slept)
        step_pipe(state, index, unit)
        blocked = max(blocked, state.pipes[unit].blocked)
        has_moved |= state.pipes[unit].has_moved != 0
    if sm.num_timed > 0:
        has_moved |= sm.wheel[now & (WHEEL - 1)] != 0
        wake_timed(state, index)
    if sm.num_collecting > 0 and sm.collect_from <= now:
        collect(state, index)
        has_moved |= sm.collect_from <= now + 1
    issued = 0
    issuers = 0
    if sm.num_resident > 0 and not sm.is_stuck:
        ready = sm.ready[0] | sm.ready[1] | sm.ready[2] | sm.ready[3] | sm.ready[4]
        scheduler = (now + machine.first_turn) % machine.num_schedulers
        for _ in range(machine.num_schedulers):
            if ready & state.scheduler_masks[scheduler]:
                found = _issue(state, index, scheduler)
                issued += found
                if found > 0:
                    issuers |= 1 << scheduler
            scheduler += 1
            if scheduler == machine.num_schedulers:
                scheduler = 0
        # Without collectors, room for arithmetic comes with time.
        arithmetic = sm.ready[0] | sm.ready[1] | sm.ready[2] | sm.ready[3]
        sm.is_stuck = issued == 0 and (machine.collector_units > 0 or arithmetic == 0)
    if issued > 0:
        machine.progress = now
    for s in range(machine.num_schedulers):
        if (issuers >> s) & 1:
            state.reasons[R_ISSUE] += 1
        else:
            sm.stall[s] = _find_stall(sm, state.scheduler_masks[s], blocked)
            state.reasons[sm.stall[s]] += 1
    sm.wake = _next_event(state, index)
    sm.waits_for_room = 0
    if sm.wake == now + 1 and issued == 0 and not has_moved:
        _sleep(state, index)
    if sm.wake > now + 1:
        # What those that issued wait for while the SM sleeps.
        for s in range(machine.num_schedulers):
            if (issuers >> s) & 1:
                sm.stall[s] = _find_stall(sm, state.scheduler_masks[s], blocked)


@compiled
def _sleep(state, index):  # type: ignore[no-untyped-def]
    """After a cycle that changed nothing: set the one in which that may change by itself."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    now = machine.now
    if sm.num_resident > 0 and not sm.is_stuck:
        return
    soonest = NEVER
    if sm.num_collecting > 0:
        soonest = sm.collect_from
    for unit in range(index * machine.units, (index + 1) * machine.units):
        pipe = state.pipes[unit]
        soonest = min(soonest, pipe.until)
        if pipe.blocked == R_INTERCONNECT or state.l1.nodes[unit].miss_count > 0:
            if machine.output_queued or machine.has_gl1:
                return
            sm.waits_for_room = 1
    sm.wake = max(now + 1, _next_timed(sm, now, soonest))


@compiled
def place_ctas(state):  # type: ignore[no-untyped-def]
    """Give each SM with room the next CTA, one per SM and cycle, in turn."""
    machine = state.pool.machine[0]
    work = state.work
    last = machine.last_sm
    for k in range(machine.num_sms):
        if machine.taken >= machine.queued:
            break
        index = last + 1 + k
        if index >= machine.num_sms:
            index -= machine.num_sms
            if index >= machine.num_sms:
                index -= machine.num_sms
        sm = state.sms[index]
        if sm.free_places == 0:
            continue
        place = 0
        while state.cta_at[index, place] >= 0:
            place += 1
        cta = machine.taken
        machine.taken += 1
        sm.free_places -= 1
        machine.live_ctas += 1
        state.cta_at[index, place] = cta
        live = 0
        for w in range(machine.warps_per_cta):
            live += work.warp_rows[cta * machine.warps_per_cta + w] >= 0
        state.warps_left[index, place] = live
        for w in range(machine.warps_per_cta):
            at = cta * machine.warps_per_cta + w
            rows = work.warp_rows[at]
            if rows >= 0:
                machine.age += 1
                slot = place * machine.warps_per_cta + w
                start_warp(state, index, slot, place, work.warp_first[at], rows, machine.age)
        sm.wake = min(sm.wake, machine.now + 1)
        machine.last_sm = index
