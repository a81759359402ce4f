"""The load/store and texture pipe of an L1 unit: from a memory instruction's sectors to its
registers.

memory instruction ──► L1 banks (a delay, then the tags) ──► miss queue ──► interconnect
registers ◄── write-back ◄── fill ◄── responses

How many sectors each of these moves a cycle follows from the ports' widths (`machine.build`); it is
one in GPGPU-Sim.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.counts import REQUESTS
from cachesim.stream import ATOMIC, LOAD, STORE
from cachesim.timing import fifo
from cachesim.timing.access import (
    MISSES,
    access,
    count_bypass,
    drop_request,
    fill,
    since,
    take_request,
)
from cachesim.timing.network import has_room, push
from cachesim.timing.partition import is_drawn, locate
from cachesim.timing.records import (
    DEMANDED,
    FAIL,
    HIT,
    MAX_WARPS,
    NEVER,
    NO_OTHER,
    NO_QUEUE,
    PATH_BYPASS,
    PATH_FIFO,
    R_INTERCONNECT,
    R_L1_BANDWIDTH,
    R_L1_RESERVATION,
)
from cachesim.timing.slice import arrive
from cachesim.timing.tags import bucket_of, next_ready
from cachesim.timing.view import prefetch
from cachesim.timing.warp import sector_back, store_done

U64 = np.uint64
#: How far ahead of the pipe the host fetches what it asks for.
_ASKS_AHEAD = 4
MAX_ADDRESS = (1 << 63) - 1


@compiled
def send_up(state, request):  # type: ignore[no-untyped-def]
    """Give a request of an SM to the interconnect, or to its GL1; False where there is no room."""
    machine = state.pool.machine[0]
    one = state.pool.requests[request]
    if machine.has_gl1:
        port = state.port_of[one.unit]
        node = state.gl1.nodes[port]
        level = state.gl1.level[0]
        if node.delay_count + node.in_count >= level.queue_in:
            return False
        ready = machine.now + 1 + level.latency
        arrive(state.gl1, port, request, ready, machine.now)
        node.wake = min(node.wake, ready)
        return True
    return inject(state, request, machine.now + 1)


@compiled
def inject(state, request, time):  # type: ignore[no-untyped-def]
    """Put a request into the request network; False where there is no room."""
    machine = state.pool.machine[0]
    one = state.pool.requests[request]
    if one.slice < 0:
        one.slice, one.number = locate(state.l2_route, one.address)
    where, port = one.slice, state.port_of[one.unit]
    if not has_room(machine, state.up, port, where):
        return False
    payload = machine.store_bytes if one.write else 0
    push(machine, state.up, port, where, request, payload, time)
    if machine.output_queued:
        node = state.l2.nodes[where]
        node.wake = min(node.wake, time)
    return True


@small
def _returned(state, request):  # type: ignore[no-untyped-def]
    """Book a sector that reached its register, and forget its request."""
    machine = state.pool.machine[0]
    one = state.pool.requests[request]
    took = since(one.born, machine.now)
    state.latency[one.source, 0] += took
    state.latency[one.source, 1] += 1
    sector_back(state, one.warp, one.load)
    drop_request(state.pool, request)


@small
def _write_back(state, unit):  # type: ignore[no-untyped-def]
    """Write one sector to the registers, and choose the next client: texture, bypassed or L1.
    Returns whether there is one.
    """
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    if pipe.next_writeback >= 0:
        _returned(state, pipe.next_writeback)
        pipe.next_writeback = -1
    for c in range(5):
        client = (c + pipe.client) % 5
        if client == 1:
            if machine.has_fifo_l1 and pipe.result_count > 0:
                pipe.next_writeback = fifo.next_result(state, unit)
        elif client == 3:
            if pipe.next_global >= 0:
                pipe.next_writeback = pipe.next_global
                pipe.next_global = -1
        elif client == 4 and state.l1.nodes[unit].ready_first >= 0:
            pipe.next_writeback = next_ready(state.l1, state.pool.requests, unit)
        if pipe.next_writeback >= 0:
            pipe.client = (client + 1) % 5
            return True
    return False


@compiled
def _respond(state, unit):  # type: ignore[no-untyped-def]
    """Take one reply: an acknowledged store, bypassed data, or data for the L1. Returns whether it
    could.
    """
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    if pipe.response_count == 0:
        return False
    room = state.responses.shape[1] - 1
    request = state.responses[unit, pipe.response_head & room]
    one = state.pool.requests[request]
    if one.write:
        if one.warp >= 0:
            store_done(state, one.warp)
        drop_request(state.pool, request)
    elif one.path == PATH_BYPASS:
        if pipe.next_global >= 0:
            return False
        if one.is_part:
            parent = one.parent
            drop_request(state.pool, request)
            state.pool.requests[parent].pending -= 1
            request = parent if state.pool.requests[parent].pending == 0 else -1
        pipe.next_global = request
    elif one.path == PATH_FIFO:
        fifo.arrived(state, unit, request)
    else:
        node = state.l1.nodes[unit]
        if node.fill_time >= (machine.now + 1) * 256:
            return False
        node.fill_time = max(node.fill_time, machine.now * 256) + state.l1.level[0].fill_cost
        fill(state.l1, state.pool, unit, request, machine.now)
    pipe.response_count -= 1
    pipe.response_head = (pipe.response_head + 1) & room if pipe.response_count > 0 else 0
    return True


@small
def _drain_misses(state, unit):  # type: ignore[no-untyped-def]
    """Send the oldest miss on. Returns whether it could."""
    node = state.l1.nodes[unit]
    if node.miss_count == 0:
        return False
    room = state.l1.queues.shape[2] - 1
    request = state.l1.queues[unit, MISSES, node.miss_head & room]
    if not send_up(state, request):
        return False
    node.miss_head = (node.miss_head + 1) & room
    node.miss_count -= 1
    node.version += 1
    return True


@small
def _may_succeed(state, node, bank):  # type: ignore[no-untyped-def]
    """Whether something has changed that a failed look-up waits for."""
    if bank.failed == node.version:
        return False
    reason = bank.reason
    if reason == NO_OTHER or bank.filled != node.num_filled:
        return True
    level = state.l1.level[0]
    if reason == NO_QUEUE:
        return node.miss_count + 1 < level.miss_queue
    return node.mshr_used < level.num_mshrs or bank.taken != node.num_taken


@small
def _note_fail(pipe, bank):  # type: ignore[no-untyped-def]
    """The look-up of a bank has failed."""
    pipe.blocked = R_L1_RESERVATION
    if bank.write:
        pipe.write_fails += 1
    else:
        pipe.read_fails += 1


@compiled
def _look_up(state, unit):  # type: ignore[no-untyped-def]
    """Tag look-ups of the accesses whose delay is over, one per bank."""
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    node = state.l1.nodes[unit]
    room = state.banks.shape[1] - 1
    now = machine.now
    # Where `lines_per_cycle` rules, "bank" k is the k-th access that entered in a cycle.
    for k in range(machine.num_banks):
        at = unit * machine.num_banks + k
        bank = state.l1_banks[at]
        if bank.count == 0:
            continue
        if bank.ready > now:
            pipe.until = min(pipe.until, bank.ready)
            continue
        if bank.failed >= 0 and not _may_succeed(state, node, bank):
            state.l1.outcomes[bank.write, FAIL] += 1
            _note_fail(pipe, bank)
            continue
        request = state.banks[at, bank.head & room].request
        one = state.pool.requests[request]
        outcome, sent = access(state.l1, state.pool, unit, request, now)
        if outcome == FAIL:
            bank.failed = node.version
            bank.reason = node.fail_reason
            bank.filled = node.num_filled
            bank.taken = node.num_taken
            bank.write = one.write
            _note_fail(pipe, bank)
            continue
        pipe.has_moved = 1
        bank.failed = -1
        bank.head = (bank.head + 1) & room
        bank.count -= 1
        pipe.in_banks -= 1
        if bank.count > 0:
            following = state.banks[at, bank.head & room]
            bank.ready = following.time
            # It is looked up in a later cycle; until then the host fetches what that needs.
            prefetch(state.pool.requests, following.request)  # type: ignore[call-arg]
            prefetch(state.l1.buckets, following.entered)
        if one.operation == STORE:
            node.version += 1
            node.num_filled += 1
            if not sent:
                store_done(state, one.warp)
                drop_request(state.pool, request)
        elif outcome == HIT:
            _returned(state, request)
        else:
            node.version += 1


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
def _highest(mask):  # type: ignore[no-untyped-def]
    sector = 7
    while (mask >> sector) & 1 == 0:
        sector -= 1
    return sector


@small
def _out_of_bandwidth(pipe):  # type: ignore[no-untyped-def]
    """Note why the instruction is not done, and that it is not."""
    if pipe.blocked == 0:
        pipe.blocked = R_L1_BANDWIDTH
    return False


@compiled
def _issue_accesses(state, unit):  # type: ignore[no-untyped-def]
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
        sector = _highest(pipe.mask)
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
def _take_instruction(state, index, unit):  # type: ignore[no-untyped-def]
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


@small
def book_sleep(state, unit, cycles):  # type: ignore[no-untyped-def]
    """Count what failed again in cycles that the pipe slept through."""
    pipe = state.pipes[unit]
    state.l1.outcomes[0, FAIL] += cycles * pipe.read_fails
    state.l1.outcomes[1, FAIL] += cycles * pipe.write_fails
    state.pool.machine[0].bank_conflicts += cycles * pipe.clashes


@compiled
def step_pipe(state, index, unit):  # type: ignore[no-untyped-def]
    """One cycle of the pipe, from its end to its start."""
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    pipe.blocked = 0
    pipe.until = NEVER
    pipe.read_fails = 0
    pipe.write_fails = 0
    pipe.clashes = 0
    pipe.has_moved = pipe.next_writeback >= 0
    # A sector is chosen one cycle and written the next, so that a lone one takes two.
    for _ in range(machine.returns_per_cycle if pipe.next_writeback >= 0 else 1):
        if not _write_back(state, unit):
            break
        pipe.has_moved = 1
    for _ in range(machine.sectors_per_cycle):
        if not _respond(state, unit):
            break
        pipe.has_moved = 1
    if machine.has_fifo_l1:
        if pipe.request_count > 0 and send_up(state, fifo.oldest_request(state, unit)):
            fifo.request_sent(state, unit)
        fifo.step(state, unit)
        if pipe.fragment_count + pipe.request_count + pipe.result_count > 0:
            pipe.has_moved = 1
    for _ in range(machine.sectors_per_cycle):
        if not _drain_misses(state, unit):
            break
        pipe.has_moved = 1
    if pipe.in_banks > 0:
        _look_up(state, unit)
    if pipe.warp >= 0:
        at, mask, left = pipe.at, pipe.mask, pipe.left
        if _issue_accesses(state, unit):
            pipe.warp = -1
        if pipe.warp < 0 or pipe.at != at or pipe.mask != mask or pipe.left != left:
            pipe.has_moved = 1
    if pipe.warp < 0 and _take_instruction(state, index, unit):
        pipe.has_moved = 1
    if pipe.response_count > 0:
        pipe.until = machine.now + 1
