"""GPGPU-Sim's texture L1: tags are updated at once, data comes back in order (facts sheet 3.5, 9).

An access enters where the fragment FIFO, the request FIFO and the reorder buffer have room. Its tag
is looked up and, on a miss, replaced at once; a hit waits behind the misses before it. One result a
cycle leaves in the order of entry. Hits are counted HIT_RESERVED, as the tool prints them.
"""

from __future__ import annotations

from cachesim.compiled import compiled
from cachesim.counts import ACCESSES, HITS, LINE_MISSES
from cachesim.timing.access import drop_request
from cachesim.timing.records import HIT_RESERVED, MISS
from cachesim.timing.tags import find_line, install, set_of, touch, victim_of

#: Rings of `State.fifo`: entries in order of entry, requests for the interconnect, results.
FRAGMENTS, REQUESTS, RESULTS = range(3)


@compiled
def accepts(state, unit):  # type: ignore[no-untyped-def]
    """Whether an access may enter."""
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    return (
        pipe.fragment_count < machine.fragment_fifo
        and pipe.request_count < machine.request_fifo
        and pipe.rob_count < machine.rob
    )


@compiled
def access(state, unit, request):  # type: ignore[no-untyped-def]
    """Look up the tag, replace it on a miss, and queue the fragment behind those before it."""
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    one = state.pool.requests[request]
    tags = state.l1
    key = one.address >> tags.level[0].line_shift
    line = find_line(tags, unit, key)
    counters = tags.counters
    counters[one.group, ACCESSES] += 1
    room = state.fifo.shape[2] - 1
    if line >= 0:
        touch(tags, line)
        tags.outcomes[0, HIT_RESERVED] += 1
        counters[one.group, HITS] += 1
        one.pending = 0
        one.sectors = 0
    else:
        line = victim_of(tags, unit, set_of(tags, unit, key))
        install(tags, unit, line, key)
        tags.lines[line].valid = 1
        tags.outcomes[0, MISS] += 1
        counters[one.group, LINE_MISSES] += 1
        # Until its sectors are back; they count it down.
        one.pending = machine.line_parts
        one.sectors = machine.line_parts
        at = (pipe.request_head + pipe.request_count) & room
        state.fifo[unit, REQUESTS, at] = request
        pipe.request_count += 1
        pipe.rob_count += 1
    at = (pipe.fragment_head + pipe.fragment_count) & room
    state.fifo[unit, FRAGMENTS, at] = request
    pipe.fragment_count += 1


@compiled
def arrived(state, unit, request):  # type: ignore[no-untyped-def]
    """One part of a line has come back."""
    one = state.pool.requests[request]
    if not one.is_part:
        one.pending = 0
        return
    parent = one.parent
    state.pool.requests[parent].pending -= 1
    state.pool.requests[parent].source = one.source
    drop_request(state.pool, request)


@compiled
def oldest_request(state, unit):  # type: ignore[no-untyped-def]
    """The request that goes to the interconnect next."""
    room = state.fifo.shape[2] - 1
    return state.fifo[unit, REQUESTS, state.pipes[unit].request_head & room]


@compiled
def request_sent(state, unit):  # type: ignore[no-untyped-def]
    """The interconnect took the oldest request."""
    pipe = state.pipes[unit]
    pipe.request_head = (pipe.request_head + 1) & (state.fifo.shape[2] - 1)
    pipe.request_count -= 1


@compiled
def step(state, unit):  # type: ignore[no-untyped-def]
    """Let the oldest fragment leave if its data is there."""
    machine = state.pool.machine[0]
    pipe = state.pipes[unit]
    room = state.fifo.shape[2] - 1
    if pipe.fragment_count > 0 and pipe.result_count < machine.result_fifo:
        request = state.fifo[unit, FRAGMENTS, pipe.fragment_head & room]
        one = state.pool.requests[request]
        if one.pending == 0:
            pipe.fragment_head = (pipe.fragment_head + 1) & room
            pipe.fragment_count -= 1
            if one.sectors > 0:
                pipe.rob_count -= 1
            at = (pipe.result_head + pipe.result_count) & room
            state.fifo[unit, RESULTS, at] = request
            pipe.result_count += 1


@compiled
def next_result(state, unit):  # type: ignore[no-untyped-def]
    """Take the oldest result."""
    pipe = state.pipes[unit]
    room = state.fifo.shape[2] - 1
    request = state.fifo[unit, RESULTS, pipe.result_head & room]
    pipe.result_head = (pipe.result_head + 1) & room
    pipe.result_count -= 1
    return request
