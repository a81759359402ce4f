"""The look-up of an L1 unit: what its banks hold goes to the tags, misses to the interconnect."""

from __future__ import annotations

from cachesim.compiled import compiled, small
from cachesim.stream import STORE
from cachesim.timing.access import (
    MISSES,
    access,
    drop_request,
    note_filled,
    since,
)
from cachesim.timing.records import (
    FAIL,
    HIT,
    NO_OTHER,
    NO_QUEUE,
    R_L1_RESERVATION,
)
from cachesim.timing.uplink import send_up
from cachesim.timing.view import prefetch
from cachesim.timing.warp import sector_back, store_done


@small
def returned(state, request):  # type: ignore[no-untyped-def]
    """Book a sector that reached its register, and forget its request."""
    machine = state.pool.machine[0]
    one = state.pool.requests[request]
    took = since(one.born, machine.now)
    state.latency[one.source, 0] += took
    state.latency[one.source, 1] += 1
    sector_back(state, one.warp, one.load)
    drop_request(state.pool, request)


@small
def drain_misses(state, unit):  # type: ignore[no-untyped-def]
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
def _is_new(bank, seen, count, last, shift):  # type: ignore[no-untyped-def]
    """Whether of `count` sectors those after the first `seen` may be what a bank's failed look-up
    waits for: the same above `shift` bits. Only the last one is known.
    """
    if seen == count:
        return False
    return count - seen > 1 or (bank.sector ^ last) >> shift == 0


@small
def _note_tried(node, bank):  # type: ignore[no-untyped-def]
    """A bank's look-up fails as the unit stands now."""
    bank.failed = node.version
    bank.filled = node.num_filled
    bank.taken = node.num_taken


@small
def _may_succeed(state, node, bank):  # type: ignore[no-untyped-def]
    """Whether something has changed that a failed look-up waits for."""
    if bank.failed == node.version:
        return False
    level = state.l1.level[0]
    in_line = level.line_shift - level.sector_shift
    if bank.reason == NO_OTHER or _is_new(
        bank, bank.filled, node.num_filled, node.filled_sector, in_line
    ):
        return True
    if bank.reason == NO_QUEUE:
        if node.miss_count + 1 < level.miss_queue:
            return True
    elif node.mshr_used < level.num_mshrs or _is_new(
        bank, bank.taken, node.num_taken, node.taken_sector, 0
    ):
        return True
    _note_tried(node, bank)
    return False


@small
def _note_fail(pipe, bank):  # type: ignore[no-untyped-def]
    """The look-up of a bank has failed."""
    pipe.blocked = R_L1_RESERVATION
    if bank.write:
        pipe.write_fails += 1
    else:
        pipe.read_fails += 1


@compiled
def look_up(state, unit):  # type: ignore[no-untyped-def]
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
            _note_tried(node, bank)
            bank.reason = node.fail_reason
            bank.sector = one.address >> state.l1.level[0].sector_shift
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
            note_filled(state.l1, unit, one.address >> state.l1.level[0].sector_shift)
            if not sent:
                store_done(state, one.warp)
                drop_request(state.pool, request)
        elif outcome == HIT:
            returned(state, request)
        else:
            node.version += 1
