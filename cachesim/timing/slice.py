"""A cache below the L1 (a GL1, an L2 slice, a slice of the last-level cache), one cycle at a time.

arrival ──► delay ──► queue ──► look-up ──► miss queue ──► down
reply ◄── ready MSHRs ◄── fill ◄── from below
"""

from __future__ import annotations

from cachesim.compiled import compiled, small
from cachesim.counts import HIT_BACK
from cachesim.stream import ATOMIC, LOAD, STORE
from cachesim.timing.access import (
    DOWN,
    FILLS,
    IN,
    MISSES,
    OUT,
    access,
    count_bypass,
    drop_request,
    fill,
    note,
    push_miss,
)
from cachesim.timing.records import (
    DEMANDED,
    FAIL,
    HIT,
    L2,
    NEVER,
    S_BELOW,
    S_L2,
    WRITE_FILL,
    WRITEBACK,
)
from cachesim.timing.tags import next_ready


@small
def _push(tags, node, which, head, count, request):  # type: ignore[no-untyped-def]
    room = tags.queues.shape[2] - 1
    tags.queues[node, which, (head + count) & room] = request


@small
def _front(tags, node, which, head):  # type: ignore[no-untyped-def]
    return tags.queues[node, which, head & (tags.queues.shape[2] - 1)]


@small
def _answer(tags, pool, node, request):  # type: ignore[no-untyped-def]
    """Queue a reply towards the SMs."""
    home = tags.nodes[node]
    _push(tags, node, OUT, home.out_head, home.out_count, request)
    home.out_count += 1


@small
def _take_ready(tags, pool, node, now):  # type: ignore[no-untyped-def]
    """Answer one request whose data is there."""
    home = tags.nodes[node]
    level = tags.level[0]
    if home.ready_first < 0 or home.out_count >= level.queue_out:
        return False
    request = next_ready(tags, pool.requests, node)
    one = pool.requests[request]
    if one.kind == WRITE_FILL and one.load == level.index:
        drop_request(pool, request)
    else:
        _answer(tags, pool, node, request)
    return True


@compiled
def _take_fill(tags, pool, node, now):  # type: ignore[no-untyped-def]
    """Put one sector that came from below into the array, or pass an acknowledgement on."""
    home = tags.nodes[node]
    level = tags.level[0]
    if home.fill_count == 0:
        return False
    request = _front(tags, node, FILLS, home.fill_head)
    one = pool.requests[request]
    went_around = one.operation == ATOMIC and level.on_hit != HIT_BACK
    passes = one.write or went_around or (level.is_read_only and one.path == 1)
    if passes:
        if home.out_count >= level.queue_out:
            return False
        _answer(tags, pool, node, request)
    else:
        if home.fill_time > now * 256:
            return False
        if level.index == L2 and one.kind == DEMANDED:
            note(pool, S_BELOW, request, now)
        home.fill_time = max(home.fill_time, (now - 1) * 256) + level.fill_cost
        fill(tags, pool, node, request, now)
    home.fill_head += 1
    home.fill_count -= 1
    return True


@small
def _drain_miss(tags, node):  # type: ignore[no-untyped-def]
    home = tags.nodes[node]
    if home.miss_count == 0 or home.down_count >= tags.level[0].queue_down:
        return False
    request = _front(tags, node, MISSES, home.miss_head)
    _push(tags, node, DOWN, home.down_head, home.down_count, request)
    home.down_count += 1
    home.miss_head += 1
    home.miss_count -= 1
    home.version += 1
    return True


@compiled
def _look_up(tags, pool, node, now):  # type: ignore[no-untyped-def]
    """Look up the oldest request, if the data port is free and its outcome has somewhere to go."""
    home = tags.nodes[node]
    level = tags.level[0]
    if (
        home.in_count == 0
        or home.down_count >= level.queue_down
        or home.out_count >= level.queue_out
        or home.port_time > now * 256
    ):
        return False
    if home.failed == home.version:
        tags.outcomes[home.failed_write, FAIL] += 1
        home.is_stalled = 1
        return False
    request = _front(tags, node, IN, home.in_head)
    one = pool.requests[request]
    # A read-only level and what may not be looked up: stores, atomics and bypassing loads pass.
    goes_around = level.is_read_only and (one.operation != LOAD or one.path == 1)
    if goes_around or (one.operation == ATOMIC and level.on_hit != HIT_BACK):
        if home.miss_count >= level.miss_queue:
            return False
        count_bypass(tags, one.group, one.operation != LOAD)
        push_miss(tags, node, request)
    else:
        outcome, sent = access(tags, pool, node, request, now)
        if outcome == FAIL:
            home.failed = home.version
            home.failed_write = one.write
            home.is_stalled = 1
            return False
        if outcome == HIT or one.operation == STORE:
            home.port_time = max(home.port_time, (now - 1) * 256 + 1) + level.port_cost
        if one.operation == STORE:
            if not sent:
                if one.kind == WRITEBACK:
                    drop_request(pool, request)
                else:
                    one.source = level.index
                    _answer(tags, pool, node, request)
        elif outcome == HIT:
            one.source = level.index
            _answer(tags, pool, node, request)
        if outcome != HIT:
            home.version += 1
    home.in_head += 1
    home.in_count -= 1
    home.failed = -1
    if level.index == L2 and one.kind == DEMANDED:
        note(pool, S_L2, request, now)
    return True


@small
def _leave_delay(tags, pool, node, now):  # type: ignore[no-untyped-def]
    home = tags.nodes[node]
    if home.delay_count == 0 or home.in_count >= tags.level[0].queue_in:
        return False
    if home.delay_ready > now:
        return False
    room = tags.delay.shape[1] - 1
    first = tags.delay[node, home.delay_head & room]
    request = first.request
    if tags.level[0].index == L2:
        # It is looked up in a later cycle; until then the host fetches its record.
        pool.requests[request].mark = first.entered
    _push(tags, node, IN, home.in_head, home.in_count, request)
    home.in_count += 1
    home.delay_head += 1
    home.delay_count -= 1
    if home.delay_count > 0:
        home.delay_ready = tags.delay[node, home.delay_head & room].time
    return True


@small
def arrive(tags, node, request, ready, now):  # type: ignore[no-untyped-def]
    """A request reaches the level; it may be looked up after cycle `ready`."""
    home = tags.nodes[node]
    place = tags.delay[node, (home.delay_head + home.delay_count) & (tags.delay.shape[1] - 1)]
    place.time = ready
    place.request = request
    place.entered = now
    if home.delay_count == 0:
        home.delay_ready = ready
    home.delay_count += 1


@small
def come_back(tags, pool, node, request):  # type: ignore[no-untyped-def]
    """Data or an acknowledgement reaches the level from below."""
    home = tags.nodes[node]
    _push(tags, node, FILLS, home.fill_head, home.fill_count, request)
    home.fill_count += 1


@compiled
def step_cache(tags, pool, node, now):  # type: ignore[no-untyped-def]
    """One cycle of one instance, its end first; sets the cycle in which it wants to be stepped
    again, arrivals and room in the queues it fills apart.
    """
    home = tags.nodes[node]
    width = tags.level[0].width
    if home.is_stalled:
        # It slept through cycles in which its look-up would have failed again.
        tags.outcomes[home.failed_write, FAIL] += now - home.last_step - 1
        home.is_stalled = 0
    home.last_step = now
    has_moved = False
    for _ in range(width):
        if not _take_ready(tags, pool, node, now):
            break
        has_moved = True
    for _ in range(width):
        if not _take_fill(tags, pool, node, now):
            break
        has_moved = True
    for _ in range(width):
        if not _drain_miss(tags, node):
            break
        has_moved = True
    for _ in range(width):
        if not _look_up(tags, pool, node, now):
            break
        has_moved = True
    for _ in range(width):
        if not _leave_delay(tags, pool, node, now):
            break
        has_moved = True
    home.wake = NEVER
    if has_moved:
        if home.in_count > 0 or home.fill_count > 0 or home.miss_count > 0 or home.ready_first >= 0:
            home.wake = now + 1
        elif home.delay_count > 0:
            home.wake = max(now + 1, home.delay_ready)
        return
    # Nothing can move until a port is free, a delay is over, or somebody else wakes it.
    if home.in_count > 0 and home.port_time > now * 256:
        home.wake = (home.port_time + 255) // 256
    if home.fill_count > 0 and home.fill_time > now * 256:
        home.wake = min(home.wake, (home.fill_time + 255) // 256)
    if home.delay_count > 0 and home.in_count < tags.level[0].queue_in:
        home.wake = min(home.wake, max(now + 1, home.delay_ready))


@small
def took_down(tags, node, cycle):  # type: ignore[no-untyped-def]
    """A miss has left the instance; if that was full, it is stepped in `cycle`."""
    home = tags.nodes[node]
    if home.down_count >= tags.level[0].queue_down:
        home.wake = min(home.wake, cycle)
    home.down_head += 1
    home.down_count -= 1


@small
def took_out(tags, node, cycle):  # type: ignore[no-untyped-def]
    """A reply has left the instance; if that was full, it is stepped in `cycle`."""
    home = tags.nodes[node]
    if home.out_count >= tags.level[0].queue_out:
        home.wake = min(home.wake, cycle)
    home.out_head += 1
    home.out_count -= 1
