"""The cycle loop: every part of the machine steps once a core cycle, in GPGPU-Sim's order (facts
sheet 3.5, 10), and cycles in which nothing can happen are skipped.

replies to SMs ──► slices to the reply network ──► DRAM ──► request network to slices, slices ──►
networks ──► SMs ──► CTAs
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.timing.access import DOWN, OUT, book, drop_request, take_request
from cachesim.timing.dram import is_idle, next_delay, step_channel
from cachesim.timing.network import AT_INPUTS, arrival, has_room, pop, push, transfer
from cachesim.timing.partition import is_filling_table, locate
from cachesim.timing.records import NEVER, PATH_FIFO, S_REPLY, S_REQUEST, WRITEBACK
from cachesim.timing.slice import arrive, come_back, step_cache, took_down, took_out
from cachesim.timing.sm import place_ctas, step_sm
from cachesim.timing.state import State
from cachesim.timing.uplink import inject
from cachesim.timing.view import opener, prefetch, table_of

_open_state = opener("State")

#: Why the loop stopped.
DONE, NEEDS_CTAS, NEEDS_ROOM, STUCK, PAUSED = range(5)
#: Cycles without any progress after which the machine counts as stuck.
PATIENCE = 100_000


@small
def _give_to_sm(state, index, request):  # type: ignore[no-untyped-def]
    sm = state.sms[index]
    room = state.ejection.shape[1] - 1
    state.ejection[index, (sm.eject_head + sm.eject_count) & room] = request
    sm.eject_count += 1


@compiled
def _receive_replies(state):  # type: ignore[no-untyped-def]
    """Each SM passes replies to its load/store units and takes some from the network: one a cycle
    in GPGPU-Sim, what its port moves on hardware.
    """
    machine = state.pool.machine[0]
    now = machine.now
    for index in range(machine.num_sms):
        sm = state.sms[index]
        for _ in range(machine.replies_per_cycle):
            if sm.eject_count == 0:
                break
            room = state.ejection.shape[1] - 1
            request = state.ejection[index, sm.eject_head & room]
            unit = state.pool.requests[request].unit
            pipe = state.pipes[unit]
            if pipe.response_count >= machine.response:
                break
            sm.eject_count -= 1
            sm.eject_head = (sm.eject_head + 1) & room if sm.eject_count > 0 else 0
            to = state.responses.shape[1] - 1
            state.responses[unit, (pipe.response_head + pipe.response_count) & to] = request
            pipe.response_count += 1
            sm.wake = min(sm.wake, now)
        for _ in range(0 if machine.has_gl1 else machine.replies_per_cycle):
            if sm.eject_count >= machine.ejection or arrival(state.down, index) > now:
                break
            request, entered = pop(state.down, index)
            book(state.pool, S_REPLY, entered, now)
            prefetch(state.pool.requests, request)  # type: ignore[call-arg]
            _give_to_sm(state, index, request)
            machine.progress = now


@compiled
def _join(state, tags, request):  # type: ignore[no-untyped-def]
    """A part has come back; returns the request it is a part of once all parts have, itself if it
    is not a part, and -1 otherwise.
    """
    one = state.pool.requests[request]
    if not one.is_part:
        return request
    parent = one.parent
    state.pool.requests[parent].pending -= 1
    state.pool.requests[parent].source = max(state.pool.requests[parent].source, one.source)
    drop_request(state.pool, request)
    return parent if state.pool.requests[parent].pending == 0 else -1


@compiled
def _step_gl1s(state):  # type: ignore[no-untyped-def]
    """The caches between SMs and network: replies in, one cycle, requests and replies out."""
    machine = state.pool.machine[0]
    now = machine.now
    tags = state.gl1
    room = tags.queues.shape[2] - 1
    for node in range(machine.num_gl1):
        home = tags.nodes[node]
        width = tags.level[0].width
        for _ in range(width):
            if home.fill_count < tags.level[0].queue_fill and arrival(state.down, node) <= now:
                request, entered = pop(state.down, node)
                book(state.pool, S_REPLY, entered, now)
                come_back(tags, state.pool, node, request)
                home.wake = min(home.wake, now)
        if home.wake <= now:
            step_cache(tags, state.pool, node, now)
        for _ in range(width):
            if home.down_count > 0:
                request = tags.queues[node, DOWN, home.down_head & room]
                if inject(state, request, now + 1):
                    took_down(tags, node, now + 1)
        for _ in range(width):
            if home.out_count > 0:
                request = tags.queues[node, OUT, home.out_head & room]
                index = state.pool.requests[request].unit // machine.units
                if state.sms[index].eject_count < machine.ejection:
                    took_out(tags, node, now + 1)
                    _give_to_sm(state, index, request)
                    machine.progress = now


@compiled
def _send_replies(state):  # type: ignore[no-untyped-def]
    """Each slice gives one reply to the network."""
    machine = state.pool.machine[0]
    tags = state.l2
    room = tags.queues.shape[2] - 1
    width = tags.level[0].width
    for node in range(machine.num_slices):
        home = tags.nodes[node]
        for _ in range(width):
            if home.out_count == 0:
                break
            request = tags.queues[node, OUT, home.out_head & room]
            one = state.pool.requests[request]
            port = state.port_of[one.unit]
            if not has_room(machine, state.down, node, port):
                break
            took_out(tags, node, machine.now)
            payload = 0 if one.write else 1 << machine.l2_sector_shift
            push(machine, state.down, node, port, request, payload, machine.now)


@compiled
def _split(state, request, parts, shift):  # type: ignore[no-untyped-def]
    """Part `parts` of a request that asks for several sectors of the level below."""
    index = take_request(state.pool)
    source, one = state.pool.requests[request], state.pool.requests[index]
    one.address = source.address + (parts << shift)
    one.number = source.number
    one.warp = source.warp
    one.load = source.load
    one.unit = source.unit
    one.slice = source.slice
    one.lower = source.lower
    one.group = source.group
    one.operation = source.operation
    one.path = source.path
    one.kind = source.kind
    one.write = source.write
    if source.write:
        one.bytes = source.bytes
    one.born = source.born
    one.mark = source.mark
    one.parent = request
    one.is_part = 1
    return index


@compiled
def _part_of_bytes(state, granules, part):  # type: ignore[no-untyped-def]
    """The granules of one L2 sector of a store to a larger sector: one bit of the larger stands for
    as many bytes as there are parts.
    """
    parts = state.pool.machine[0].line_parts
    each = 32 // parts
    covered = np.uint32(0)
    for bit in range(32):
        if (granules >> np.uint32(part * each + bit // parts)) & np.uint32(1):
            covered |= np.uint32(1) << np.uint32(bit)
    return covered


@compiled
def _receive_requests(state, node):  # type: ignore[no-untyped-def]
    """A slice takes a request from the network into its delay."""
    machine = state.pool.machine[0]
    now = machine.now
    tags = state.l2
    home = tags.nodes[node]
    level = tags.level[0]
    for _ in range(level.width):
        if home.in_count + level.reserve_in > level.queue_in or arrival(state.up, node) > now:
            break
        if machine.output_queued and home.delay_count >= level.delay_capacity:
            break
        request, entered = pop(state.up, node)
        machine.progress = now
        book(state.pool, S_REQUEST, entered, now)
        one = state.pool.requests[request]
        delay = level.latency
        if machine.has_fifo_l1 and one.path == PATH_FIFO:
            delay = level.texture_latency
        if machine.line_parts > 1:
            one.pending = machine.line_parts
            for part in range(machine.line_parts):
                piece = _split(state, request, part, machine.l2_sector_shift)
                if one.write:
                    # Each part of a store is acknowledged by itself.
                    state.pool.requests[piece].is_part = 0
                    state.pool.requests[piece].bytes = _part_of_bytes(state, one.bytes, part)
                arrive(tags, node, piece, now + delay, now)
            if one.write:
                drop_request(state.pool, request)
        else:
            arrive(tags, node, request, now + delay, now)
        home.wake = min(home.wake, home.delay_ready)
    # Packets of several sectors can come faster than one a cycle leaves: the delay has no bound.
    if home.delay_count + level.width * machine.line_parts > state.l2.delay.shape[1]:
        machine.lacks_room = 1


@compiled
def _step_slices(state):  # type: ignore[no-untyped-def]
    machine = state.pool.machine[0]
    now = machine.now
    for node in range(machine.num_slices):
        if state.up.outputs[node].count > 0:
            _receive_requests(state, node)
        if state.l2.nodes[node].wake <= now:
            step_cache(state.l2, state.pool, node, now)


@compiled
def _step_llc(state):  # type: ignore[no-untyped-def]
    """L2 misses to the last-level cache, one cycle of it, and its replies back."""
    machine = state.pool.machine[0]
    now = machine.now
    l2, llc = state.l2, state.llc
    down_room, out_room = l2.queues.shape[2] - 1, llc.queues.shape[2] - 1
    parts = 1 << (machine.l2_sector_shift - machine.llc_sector_shift)
    for node in range(machine.num_slices):
        home = l2.nodes[node]
        if home.down_count == 0:
            continue
        request = l2.queues[node, DOWN, home.down_head & down_room]
        where, _ = locate(state.llc_route, state.pool.requests[request].address)
        target = llc.nodes[where]
        if target.delay_count + target.in_count + parts > llc.level[0].delay_capacity:
            continue
        took_down(l2, node, now)
        one = state.pool.requests[request]
        one.pending = parts
        for part in range(parts):
            piece = request
            if parts > 1:
                piece = _split(state, request, part, machine.llc_sector_shift)
                if one.write and one.kind == WRITEBACK:
                    state.pool.requests[piece].is_part = 0
            _, number = locate(state.llc_route, state.pool.requests[piece].address)
            state.pool.requests[piece].number = number
            arrive(llc, where, piece, now + llc.level[0].latency, now)
        target.wake = min(target.wake, now + 1)
        if parts > 1 and one.write and one.kind == WRITEBACK:
            drop_request(state.pool, request)
    for node in range(machine.num_llc):
        target = llc.nodes[node]
        if target.wake <= now:
            step_cache(llc, state.pool, node, now)
        for _ in range(llc.level[0].width):
            if target.out_count == 0:
                break
            request = llc.queues[node, OUT, target.out_head & out_room]
            home = l2.nodes[state.pool.requests[request].slice]
            if home.fill_count >= l2.level[0].queue_fill:
                break
            took_out(llc, node, now + 1)
            whole = _join(state, llc, request)
            if whole >= 0:
                where, number = locate(state.l2_route, state.pool.requests[whole].address)
                state.pool.requests[whole].number = number
                come_back(l2, state.pool, where, whole)
                home.wake = min(home.wake, now)


@compiled
def _tick_memory(state, ticks):  # type: ignore[no-untyped-def]
    machine = state.pool.machine[0]
    tags = state.llc if machine.has_llc else state.l2
    for _ in range(ticks):
        machine.tick += 1
        for index in range(machine.num_channels):
            channel = state.memory.channels[index]
            if channel.wake <= machine.now or not is_idle(state, tags, index):
                step_channel(state, tags, index)
                channel.wake = next_delay(state, index)


@compiled
def _next_cycle(state):  # type: ignore[no-untyped-def]
    """The next cycle in which something can happen."""
    machine = state.pool.machine[0]
    now = machine.now
    if state.up.scalars[AT_INPUTS] + state.down.scalars[AT_INPUTS] > 0:
        return now + 1
    soonest = NEVER
    for index in range(machine.num_sms):
        sm = state.sms[index]
        if sm.eject_count > 0:
            return now + 1
        if sm.free_places > 0 and machine.taken < machine.queued:
            soonest = min(soonest, max(now + 1, machine.place_from))
        soonest = min(soonest, sm.wake)
    for port in range(machine.num_ports):
        soonest = min(soonest, arrival(state.down, port))
    for node in range(machine.num_slices):
        soonest = min(soonest, min(arrival(state.up, node), state.l2.nodes[node].wake))
        if state.l2.nodes[node].out_count + state.l2.nodes[node].down_count > 0:
            return now + 1
    for node in range(machine.num_gl1):
        if state.gl1.nodes[node].out_count + state.gl1.nodes[node].down_count > 0:
            return now + 1
        soonest = min(soonest, state.gl1.nodes[node].wake)
    for node in range(machine.num_llc):
        if state.llc.nodes[node].out_count > 0:
            return now + 1
        soonest = min(soonest, state.llc.nodes[node].wake)
    tags = state.llc if machine.has_llc else state.l2
    for index in range(machine.num_channels):
        if not is_idle(state, tags, index):
            return now + 1
        soonest = min(soonest, next_delay(state, index))
    return max(now + 1, soonest)


@compiled
def _run(address, pause):  # type: ignore[no-untyped-def]
    """Run until the launch is done, more CTAs are needed, nothing moves any more, or cycle `pause`.

    Returns why. The machine's `now` is the cycle to go on with.
    """
    state = _open_state(address)
    machine = state.pool.machine[0]
    while True:
        if not machine.complete and machine.queued - machine.taken < machine.num_sms:
            return NEEDS_CTAS
        if (
            machine.free_top < machine.num_pool
            or machine.lacks_room
            or is_filling_table(state.l2_route.draws)
            or is_filling_table(state.llc_route.draws)
        ):
            return NEEDS_ROOM
        if machine.now >= pause:
            return PAUSED
        now = machine.now
        _receive_replies(state)
        _send_replies(state)
        if machine.has_gl1:
            _step_gl1s(state)
        total = machine.tick_remainder + machine.dram_hz
        ticks = total // machine.core_hz
        machine.tick_remainder = total - ticks * machine.core_hz
        _tick_memory(state, ticks)
        if machine.has_llc:
            _step_llc(state)
        _step_slices(state)
        transfer(machine, state.up, now)
        transfer(machine, state.down, now)
        start = now % machine.num_sms if machine.output_queued else 0
        for k in range(machine.num_sms):
            index = k + start
            if index >= machine.num_sms:
                index -= machine.num_sms
            sm = state.sms[index]
            if sm.wake <= now or (
                sm.waits_for_room
                and has_room(machine, state.up, state.port_of[index * machine.units], 0)
            ):
                step_sm(state, index)
        if machine.taken < machine.queued and now >= machine.place_from:
            place_ctas(state)
            machine.progress = now
        if machine.complete and machine.live_ctas == 0 and machine.taken >= machine.queued:
            machine.now = now + 1
            return DONE
        following = min(_next_cycle(state), max(now + 1, pause))
        if following >= NEVER or following - machine.progress > PATIENCE:
            return STUCK
        if following > now + 1:
            # Memory ticks on while the rest sleeps; its channels are idle.
            skipped = following - now - 1
            total = machine.tick_remainder + skipped * machine.dram_hz
            ticks = total // machine.core_hz
            machine.tick_remainder = total - ticks * machine.core_hz
            machine.tick += ticks
        machine.now = following


def run(state: State, pause: int) -> int:
    """Run the machine until one of the reasons above, or cycle `pause`; returns the reason."""
    table = table_of("State", state)
    return int(_run(table.address, pause))


__all__ = ["DONE", "NEEDS_CTAS", "NEEDS_ROOM", "PAUSED", "STUCK", "run"]
