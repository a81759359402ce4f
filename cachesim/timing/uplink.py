"""The way out of an SM: a request into the interconnect, or to the SM's GL1."""

from __future__ import annotations

from cachesim.compiled import compiled
from cachesim.timing.network import has_room, push
from cachesim.timing.partition import locate
from cachesim.timing.slice import arrive


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
