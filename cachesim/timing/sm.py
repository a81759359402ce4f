"""One SM: its schedulers, execution units, and the pipes of its L1 units."""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.stream import STORE
from cachesim.timing.bits import bit_at, lowest, without_lowest
from cachesim.timing.pipe import book_sleep, step_pipe
from cachesim.timing.records import (
    CONTROL,
    FP32,
    INT,
    MAX_LOADS,
    MAX_WARPS,
    MEMORY,
    NEVER,
    PATH_BYPASS,
    R_ARITHMETIC,
    R_IDLE,
    R_INTERCONNECT,
    R_ISSUE,
    R_L1_BANDWIDTH,
    R_MEMORY,
    SFU,
    WHEEL,
)
from cachesim.timing.warp import advance, is_exit, schedule, start_warp, wake_timed

U64 = np.uint64
#: An instruction may issue this many cycles before its unit is free: it is collected meanwhile.
_AHEAD = 3
#: The order in which a port of GPGPU-Sim's operand collectors looks for instructions.
_PORT_ORDER = (FP32, SFU, MEMORY, INT)


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
def _note_access(state, warp, row):  # type: ignore[no-untyped-def]
    """What the warp will wait for: a load's sectors, or a store's acknowledgements. Returns the
    load's number.
    """
    machine = state.pool.machine[0]
    instruction = state.work.instructions[row.code]
    if instruction.operation == STORE:
        parts = machine.line_parts if instruction.path == PATH_BYPASS else 1
        warp.stores += max(1, row.sectors * parts)
        return 0
    load = warp.next_load
    warp.pending[load & (MAX_LOADS - 1)] = max(1, row.sectors)
    warp.next_load += 1
    return load


@small
def _unit_of(machine, kind):  # type: ignore[no-untyped-def]
    """The unit that executes a kind; GPGPU-Sim's control instructions take the fp32 one."""
    if kind == CONTROL and machine.collector_units > 0:
        kind = INT
    return FP32 if kind == INT and machine.int_on_fp32 else kind


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
        unit = _unit_of(machine, kind)
        # One instruction may wait between collector and unit.
        if sm.unit_free[unit, s] - state.latencies[kind, 1] > now:
            return False
        slot = sm.collector_slot[c, s]
        warp = state.warps[index * MAX_WARPS + slot]
        is_last = sm.collector_chain[c, s] < 0
        start = max(now + 1, sm.unit_free[unit, s])
        sm.unit_free[unit, s] = start + (1 if is_last else state.latencies[kind, 1])
        done = start + state.latencies[kind, 0] + machine.result_cycles - _AHEAD
        if is_last:
            warp.exit_ready = start + machine.result_cycles - _AHEAD + 1
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
def _collect(state, index):  # type: ignore[no-untyped-def]
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
def _enter_collectors(state, index, s, slot, warp, kind):  # type: ignore[no-untyped-def]
    """Issue to the collectors' entry."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    place = kind if kind == MEMORY else _unit_of(machine, kind)
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
        sm.issued_load[s] = _note_access(state, warp, row)
    elif is_exit(warp):
        sm.issued_chain[place, s] = -1
        warp.exit_ready = NEVER
    else:
        warp.chains_ready[warp.chain] = NEVER
        if kind == INT:
            warp.int_ready = NEVER


@compiled
def _start_arithmetic(state, index, scheduler, warp, kind, now):  # type: ignore[no-untyped-def]
    """Send an instruction to its unit, and note when its result is there."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    unit = _unit_of(machine, kind)
    start = max(now + _AHEAD, sm.unit_free[unit, scheduler])
    sm.unit_free[unit, scheduler] = start + state.latencies[kind, 1]
    done = start + state.latencies[kind, 0] + machine.result_cycles - _AHEAD
    if is_exit(warp):
        warp.exit_ready = start + machine.result_cycles - _AHEAD + 1
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
    sm.queue_load[at, scheduler] = _note_access(state, warp, row)


@small
def _has_room(state, index, scheduler, kind, now):  # type: ignore[no-untyped-def]
    """Whether a scheduler may issue an instruction of a kind."""
    machine = state.pool.machine[0]
    sm = state.sms[index]
    if machine.collector_units > 0:
        return sm.issued_slot[_unit_of(machine, kind), scheduler] < 0
    if kind == MEMORY:
        return sm.queue_count[scheduler] < machine.memory_queue
    return sm.unit_free[_unit_of(machine, kind), scheduler] <= now + _AHEAD


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
        unit = _unit_of(machine, kind)
        if issued > 0 and (
            (machine.different_units and unit == previous)
            or not _has_room(state, index, scheduler, kind, now)
        ):
            break
        sm.ready[kind] &= ~bit
        if machine.collector_units > 0:
            _enter_collectors(state, index, scheduler, slot, warp, kind)
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
        again = issued < machine.issue_per_warp and warp.parity == 0
        warp.parity ^= 1
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
    """Why a scheduler whose warps are `mine` does not issue. blocked: 0, or why an access of the SM
    did not leave its pipe.
    """
    if sm.resident & mine == 0:
        return R_IDLE
    if sm.ready[MEMORY] & mine:
        return blocked if blocked > 0 else R_L1_BANDWIDTH
    if sm.resident & ~sm.blocked & mine:
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
        _collect(state, index)
        has_moved |= sm.collect_from <= now + 1
    issued = 0
    issuers = 0
    if sm.num_resident > 0 and not sm.is_stuck:
        ready = sm.ready[0] | sm.ready[1] | sm.ready[2] | sm.ready[3] | sm.ready[4]
        scheduler = now % machine.num_schedulers
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
        sm.stall[s] = _find_stall(sm, state.scheduler_masks[s], blocked)
        if (issuers >> s) & 1:
            state.reasons[R_ISSUE] += 1
        else:
            state.reasons[sm.stall[s]] += 1
    sm.wake = _next_event(state, index)
    sm.waits_for_room = 0
    if sm.wake == now + 1 and issued == 0 and not has_moved:
        _sleep(state, index)


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
