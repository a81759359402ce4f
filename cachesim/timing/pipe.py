"""The load/store and texture pipe of an L1 unit: from a memory instruction's sectors to its
registers.

memory instruction ──► L1 banks (a delay, then the tags) ──► miss queue ──► interconnect
registers ◄── write-back ◄── fill ◄── responses

How many sectors each of these moves a cycle follows from the ports' widths (`machine.build`); it is
one in GPGPU-Sim.
"""

from __future__ import annotations

from cachesim.compiled import compiled, small
from cachesim.timing import fifo
from cachesim.timing.access import (
    drop_request,
    fill,
)
from cachesim.timing.load_store import issue_accesses, take_instruction
from cachesim.timing.lookup import drain_misses, look_up, returned
from cachesim.timing.records import (
    FAIL,
    MAX_WARPS,
    NEVER,
    PATH_BYPASS,
    PATH_FIFO,
)
from cachesim.timing.tags import next_ready
from cachesim.timing.units import LOADED, write_register
from cachesim.timing.uplink import send_up
from cachesim.timing.warp import store_done


@small
def _write_register(state, request):  # type: ignore[no-untyped-def]
    """A loaded sector enters its register bank."""
    machine = state.pool.machine[0]
    one = state.pool.requests[request]
    register = LOADED + one.load - state.warps[one.warp].group
    scheduler = (one.warp & (MAX_WARPS - 1)) % machine.num_schedulers
    sm = state.sms[one.warp // MAX_WARPS]
    write_register(sm, scheduler, register % machine.register_banks, machine.now)


@small
def _write_back(state, unit):  # type: ignore[no-untyped-def]
    """Write one sector to the registers, and choose the next client: texture, bypassed or L1.
    Returns whether there is one.
    """
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    if pipe.next_writeback >= 0:
        if machine.register_banks > 0:
            _write_register(state, pipe.next_writeback)
        returned(state, pipe.next_writeback)
        pipe.next_writeback = -1
    has_l1 = state.l1.nodes[unit].ready_first >= 0
    if not has_l1 and pipe.next_global < 0 and pipe.result_count == 0:
        return False
    client = pipe.client
    for _ in range(5):
        if client == 1:
            if machine.has_fifo_l1 and pipe.result_count > 0:
                pipe.next_writeback = fifo.next_result(state, unit)
        elif client == 3:
            if pipe.next_global >= 0:
                pipe.next_writeback = pipe.next_global
                pipe.next_global = -1
        elif client == 4 and has_l1:
            pipe.next_writeback = next_ready(state.l1, state.pool.requests, unit)
        client = client + 1 if client < 4 else 0
        if pipe.next_writeback >= 0:
            pipe.client = client
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
        if not drain_misses(state, unit):
            break
        pipe.has_moved = 1
    if pipe.in_banks > 0:
        look_up(state, unit)
    if pipe.warp >= 0:
        at, mask, left = pipe.at, pipe.mask, pipe.left
        if issue_accesses(state, unit):
            pipe.warp = -1
        if pipe.warp < 0 or pipe.at != at or pipe.mask != mask or pipe.left != left:
            pipe.has_moved = 1
    if pipe.warp < 0 and take_instruction(state, index, unit):
        pipe.has_moved = 1
    if pipe.response_count > 0:
        pipe.until = machine.now + 1
