"""Memory channels: a fixed delay, then first-ready first-come first-served over banks and rows.

The rules are those of facts sheet sections 3.3 to 3.5: open pages; one row or one column command a
command cycle, both with a dual bus, and with GPGPU-Sim's single one if their banks come in that
order; credits bound what a slice may have in flight.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.timing.access import DOWN, drop_request
from cachesim.timing.bits import bit_at, lowest
from cachesim.timing.records import MAX_DRAM_BANKS, NEVER, WRITEBACK
from cachesim.timing.slice import come_back, took_down

_LINK = 4
U64 = np.uint64


@compiled
def _bits(address, positions, which):  # type: ignore[no-untyped-def]
    """The number that an address's bits at row `which` of `positions` make up, the lowest first."""
    value, k = 0, 0
    while positions[which, k] >= 0:
        value |= ((address >> positions[which, k]) & 1) << k
        k += 1
    return value


@compiled
def place(state, request):  # type: ignore[no-untyped-def]
    """Bank and row of a request (facts sheet 3.4)."""
    machine = state.pool.machine[0]
    one = state.pool.requests[request]
    address = one.address
    shift = machine.channel_shift
    rest = ((address >> shift) // machine.num_channels) << shift | (address & ((1 << shift) - 1))
    bank = _bits(rest, state.memory.bits, 0)
    one.bank = bank
    one.row = _bits(rest, state.memory.bits, 1)


@small
def _has_credit(machine, channel, sub):  # type: ignore[no-untyped-def]
    return channel.private_credit[sub] < 1 or channel.shared_credit < machine.shared_credits


@small
def _borrow(channel, sub):  # type: ignore[no-untyped-def]
    if channel.private_credit[sub] < 1:
        channel.private_credit[sub] += 1
    else:
        channel.shared_credit += 1


@small
def _give_back(channel, sub):  # type: ignore[no-untyped-def]
    if channel.private_credit[sub] > 0:
        channel.private_credit[sub] -= 1
    else:
        channel.shared_credit -= 1


@small
def _return_oldest(state, tags, index):  # type: ignore[no-untyped-def]
    """Pass one finished read to its slice."""
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    if channel.return_count == 0:
        return
    room = memory.return_ring.shape[1] - 1
    request = memory.return_ring[index, channel.return_head & room]
    node = state.pool.requests[request].lower
    if tags.nodes[node].fill_count >= tags.level[0].queue_fill:
        return
    come_back(tags, state.pool, node, request)
    tags.nodes[node].wake = min(tags.nodes[node].wake, machine.now)
    _give_back(channel, node % machine.subslices)
    channel.return_head += 1
    channel.return_count -= 1


@small
def _finish_data(state, index):  # type: ignore[no-untyped-def]
    """The oldest column command's data is there."""
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    if channel.data_count == 0 or channel.return_count >= machine.return_queue:
        return
    room = memory.data_ring.shape[1] - 1
    at = channel.data_head & room
    if memory.data_time[index, at] > machine.tick:
        return
    request = memory.data_ring[index, at]
    channel.data_head += 1
    channel.data_count -= 1
    one = state.pool.requests[request]
    one.pending -= 1
    if one.pending > 0:
        return
    if one.kind == WRITEBACK:
        _give_back(channel, one.lower % machine.subslices)
        machine.queued_dram -= 1
        drop_request(state.pool, request)
        return
    machine.queued_dram -= 1
    if one.source < 4:
        one.source = 4
    to = memory.return_ring.shape[1] - 1
    memory.return_ring[index, (channel.return_head + channel.return_count) & to] = request
    channel.return_count += 1


@small
def _first_from(banks, priority):  # type: ignore[no-untyped-def]
    """The first bank of a mask that is not empty, from `priority` on, around."""
    after = banks & ~(bit_at(priority) - U64(1))
    return lowest(after if after != 0 else banks)


@compiled
def _serve_bank(state, index):  # type: ignore[no-untyped-def]
    """Give one idle bank its next request: the oldest of its open row, or the oldest."""
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    requests = state.pool.requests
    num_banks = machine.num_dram_banks
    free = channel.waiting & ~channel.serving
    if free != 0:
        b = _first_from(free, channel.priority)
        bank = memory.banks[index * MAX_DRAM_BANKS + b]
        chosen, before = bank.first, -1
        if machine.fr_fcfs and bank.open_row >= 0:
            at, previous = bank.first, -1
            while at >= 0 and requests[at].row != bank.open_row:
                previous = at
                at = requests[at].next[_LINK]
            if at >= 0:
                chosen, before = at, previous
                machine.row_hits += 1
        following = requests[chosen].next[_LINK]
        if before < 0:
            bank.first = following
        else:
            requests[before].next[_LINK] = following
        if bank.last == chosen:
            bank.last = before
        if bank.first < 0:
            channel.waiting &= ~bit_at(b)
        channel.serving |= bit_at(b)
        bank.serving = chosen
        bank.row = requests[chosen].row
        bank.write = requests[chosen].write
        bank.left = requests[chosen].pending
        channel.pending -= 1
        channel.num_serving += 1
        channel.column_from = 0
        channel.row_from = 0
        channel.priority = channel.priority + 1 if channel.priority + 1 < num_banks else 0
        return True
    return False


@small
def _column_time(channel, bank, group):  # type: ignore[no-untyped-def]
    """The tick from which a bank's open row may be read or written."""
    if bank.write:
        return max(channel.ccd, group.ccdl, bank.rcdwr, channel.rtw)
    return max(channel.ccd, group.ccdl, bank.rcd, channel.wtr)


@compiled
def _issue_column(state, index, b):  # type: ignore[no-untyped-def]
    """Read or write a burst of a bank's open row."""
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    bank = memory.banks[index * MAX_DRAM_BANKS + b]
    group = memory.groups[index * MAX_DRAM_BANKS + (b & machine.group_mask)]
    tick = machine.tick
    if bank.write:
        channel.is_writing = 1
        channel.wtr = tick + machine.wtr
        bank.wtp = tick + machine.wtp
        delay = machine.wl
        machine.dram_writes += 1
    else:
        channel.is_writing = 0
        channel.rtw = tick + machine.rtw
        bank.rtp = tick + machine.rtpl
        group.rtpl = tick + machine.rtpl
        delay = machine.cl
        machine.dram_reads += 1
    channel.ccd = tick + machine.ccd
    group.ccdl = tick + machine.ccdl
    room = memory.data_ring.shape[1] - 1
    at = (channel.data_head + channel.data_count) & room
    memory.data_ring[index, at] = bank.serving
    memory.data_time[index, at] = tick + delay
    channel.data_count += 1
    bank.left -= 1
    if bank.left == 0:
        bank.serving = -1
        channel.serving &= ~bit_at(b)
        channel.num_serving -= 1


@small
def _row_time(channel, bank, group):  # type: ignore[no-untyped-def]
    """The tick from which the row a bank needs may be opened, or the open one closed."""
    if bank.open_row < 0:
        return max(channel.rrd, bank.rp, bank.rc)
    return max(bank.ras, bank.wtp, bank.rtp, group.rtpl)


@small
def _issue_row(machine, channel, bank, b):  # type: ignore[no-untyped-def]
    """Open the row that a bank needs, or close the one that is open."""
    tick = machine.tick
    if bank.open_row < 0:
        bank.open_row = bank.row
        channel.rrd = tick + machine.rrd
        bank.rcd = tick + machine.rcd
        bank.rcdwr = tick + machine.rcdwr
        bank.ras = tick + machine.ras
        bank.rc = tick + machine.rc
        machine.activates += 1
        channel.column_from = 0
    else:
        bank.open_row = -1
        bank.rp = tick + machine.rp
        machine.precharges += 1
    channel.priority = b + 1 if b + 1 < machine.num_dram_banks else 0


@small
def _around(start, count, num_banks):  # type: ignore[no-untyped-def]
    """The mask of `count` banks from `start` on, around."""
    mask = (bit_at(count) - U64(1)) << U64(start)
    return mask | ((bit_at(count) - U64(1)) >> U64(num_banks - start))


@compiled
def _command(state, index, columns, rows):  # type: ignore[no-untyped-def]
    """Try the banks in turn for a column command and a row command, where those are asked for.
    Returns whether a column command issued; nothing is tried after it.

    A row command passes the turn on, so that the pass goes on one bank further, over as many banks
    as were left, for a column command alone. That is GPGPU-Sim's single bus.
    """
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    tick = machine.tick
    columns &= channel.ccd <= tick and channel.column_from <= tick
    rows &= channel.row_from <= tick
    if not columns and not rows:
        return False
    num_banks = machine.num_dram_banks
    first = channel.priority
    left = channel.serving
    next_column, next_row = NEVER, NEVER
    while left != 0:
        b = _first_from(left, first)
        left &= ~bit_at(b)
        bank = memory.banks[index * MAX_DRAM_BANKS + b]
        group = memory.groups[index * MAX_DRAM_BANKS + (b & machine.group_mask)]
        if bank.open_row == bank.row:
            if columns:
                may = _column_time(channel, bank, group)
                if may <= tick:
                    _issue_column(state, index, b)
                    return True
                next_column = min(next_column, may)
        elif rows:
            may = _row_time(channel, bank, group)
            if may <= tick:
                _issue_row(machine, channel, bank, b)
                passed = b - first if b >= first else b - first + num_banks
                if not columns or passed + 1 == num_banks:
                    return False
                rows = False
                first = b + passed + 2
                while first >= num_banks:
                    first -= num_banks
                left = channel.serving & _around(first, num_banks - 1 - passed, num_banks)
                next_column = 0
                next_row = 0
            else:
                next_row = min(next_row, may)
    if columns:
        channel.column_from = next_column
    if rows:
        channel.row_from = next_row
    return False


@compiled
def _enter(state, index):  # type: ignore[no-untyped-def]
    """Move what waits at the controller's door into the banks' lists."""
    memory = state.memory
    channel = memory.channels[index]
    requests = state.pool.requests
    room = memory.entry_ring.shape[1] - 1
    while channel.entry_count > 0:
        request = memory.entry_ring[index, channel.entry_head & room]
        channel.entry_head += 1
        channel.entry_count -= 1
        one = requests[request]
        one.next[_LINK] = -1
        bank = memory.banks[index * MAX_DRAM_BANKS + one.bank]
        if bank.first < 0:
            bank.first = request
        else:
            requests[bank.last].next[_LINK] = request
        bank.last = request
        channel.waiting |= bit_at(one.bank)
        channel.pending += 1


@compiled
def _take_from_slices(state, tags, index):  # type: ignore[no-untyped-def]
    """Take one request of the channel's slices into the fixed delay, slices in turn."""
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    sub = channel.last_borrower
    for _ in range(machine.subslices):
        sub = sub + 1 if sub + 1 < machine.subslices else 0
        node = index * machine.subslices + sub
        home = tags.nodes[node]
        if home.down_count == 0 or not _has_credit(machine, channel, sub):
            continue
        if channel.pending >= machine.dram_queue:
            return
        request = tags.queues[node, DOWN, home.down_head & (tags.queues.shape[2] - 1)]
        took_down(tags, node, machine.now)
        one = state.pool.requests[request]
        one.lower = node
        one.pending = machine.bursts
        place(state, request)
        _borrow(channel, sub)
        channel.last_borrower = sub
        room = memory.latency_ring.shape[1] - 1
        at = (channel.latency_head + channel.latency_count) & room
        memory.latency_ring[index, at] = request
        memory.latency_time[index, at] = machine.now + machine.fixed_latency
        channel.latency_count += 1
        machine.queued_dram += 1
        return


@small
def _leave_delay(state, index):  # type: ignore[no-untyped-def]
    machine = state.pool.machine[0]
    memory = state.memory
    channel = memory.channels[index]
    if channel.latency_count == 0 or channel.pending >= machine.dram_queue:
        return
    room = memory.latency_ring.shape[1] - 1
    at = channel.latency_head & room
    if memory.latency_time[index, at] > machine.now:
        return
    request = memory.latency_ring[index, at]
    channel.latency_head += 1
    channel.latency_count -= 1
    to = memory.entry_ring.shape[1] - 1
    memory.entry_ring[index, (channel.entry_head + channel.entry_count) & to] = request
    channel.entry_count += 1


@compiled
def step_channel(state, tags, index):  # type: ignore[no-untyped-def]
    """One command cycle of one channel. `tags`: the level above it."""
    machine = state.pool.machine[0]
    channel = state.memory.channels[index]
    _return_oldest(state, tags, index)
    _finish_data(state, index)
    if channel.entry_count > 0:
        _enter(state, index)
    if channel.pending > 0:
        _serve_bank(state, index)
    if channel.num_serving > 0:
        if machine.in_bank_order:
            _command(state, index, True, True)
        elif not _command(state, index, True, False) or machine.dual_bus:
            _command(state, index, False, True)
    _take_from_slices(state, tags, index)
    _leave_delay(state, index)


@compiled
def is_idle(state, tags, index):  # type: ignore[no-untyped-def]
    """Whether a channel has nothing to do until a slice asks."""
    machine = state.pool.machine[0]
    channel = state.memory.channels[index]
    if (
        channel.entry_count
        + channel.pending
        + channel.num_serving
        + channel.data_count
        + channel.return_count
        > 0
    ):
        return False
    for sub in range(machine.subslices):
        if tags.nodes[index * machine.subslices + sub].down_count > 0:
            return False
    return True


@compiled
def next_delay(state, index):  # type: ignore[no-untyped-def]
    """The core cycle in which the oldest delayed request may enter; `NEVER` if there is none."""
    channel = state.memory.channels[index]
    if channel.latency_count == 0:
        return NEVER
    room = state.memory.latency_ring.shape[1] - 1
    return state.memory.latency_time[index, channel.latency_head & room]
