"""The interconnect: a request network from the SMs' ports to the slices, a reply network back.

"input-fifo" is a crossbar that matches the heads of its inputs to outputs once a cycle, each output
taking the next input in turn (iSLIP with one iteration); a head whose output is taken blocks what
is behind it, and a packet holds its output for whole cycles. As a router it works in steps, some a
cycle: in one an output is given to an input, in a later one that input's packet moves, if there is
room; the output is free, and the input asks again, in the step after. "output-queued" has no such
blocking: a packet waits at its output, which moves a flit's bytes a cycle, several small packets if
they fit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.compiled import compiled, small
from cachesim.timing.bits import bit_at, lowest, power_of_two, without_lowest
from cachesim.timing.records import NEVER, OUTLET, PACKET, PORT, WAITING


class Network(NamedTuple):
    """One direction. I inputs, O outputs, W and V 64-bit words with a bit each.

    inputs: (I,) `records.PORT`; in_ring: (I, room) `records.PACKET`. outputs: (O,)
    `records.OUTLET`, an output-queued one's `busy` in 1/256 cycles; out_ring: (O, room)
    `records.WAITING`. arrivals: (O,) int64 cycle from which an output's first packet may be taken,
    `NEVER` without one. unready: (W,) uint64 inputs whose head may not move yet; wanted: (O, W)
    uint64 inputs whose head may, by output; contested: (V,) uint64 outputs that an input wants.
    scalars: (2,) int64, packets held at inputs, the latency.
    """

    inputs: npt.NDArray[np.void]
    in_ring: npt.NDArray[np.void]
    outputs: npt.NDArray[np.void]
    out_ring: npt.NDArray[np.void]
    arrivals: npt.NDArray[np.int64]
    unready: npt.NDArray[np.uint64]
    wanted: npt.NDArray[np.uint64]
    contested: npt.NDArray[np.uint64]
    scalars: npt.NDArray[np.int64]


AT_INPUTS, LATENCY = range(2)
U64 = np.uint64


def new_network(
    inputs: int, outputs: int, input_packets: int, output_packets: int, latency: int
) -> Network:
    """An empty network with room for so many packets at each input and output."""
    words = (inputs + 63) // 64
    outlets = np.zeros(outputs, OUTLET)
    outlets["given"] = -1
    return Network(
        np.zeros(inputs, PORT),
        np.zeros((inputs, power_of_two(input_packets)), PACKET),
        outlets,
        np.zeros((outputs, power_of_two(output_packets)), WAITING),
        np.full(outputs, NEVER, np.int64),
        np.zeros(words, np.uint64),
        np.zeros((outputs, words), np.uint64),
        np.zeros((outputs + 63) // 64, np.uint64),
        np.array([0, latency], np.int64),
    )


@small
def has_room(machine, net, source, output):  # type: ignore[no-untyped-def]
    """Whether a packet may enter."""
    if machine.output_queued:
        return net.outputs[output].count < machine.output_packets
    return net.inputs[source].count < machine.input_packets


@small
def _arrive(net, output, request, time, entered):  # type: ignore[no-untyped-def]
    """Queue a packet at an output."""
    outlet = net.outputs[output]
    place = net.out_ring[output, (outlet.head + outlet.count) & (net.out_ring.shape[1] - 1)]
    place.request = request
    place.time = time
    place.entered = entered
    if outlet.count == 0:
        net.arrivals[output] = time
    outlet.count += 1


@compiled
def push(machine, net, source, output, request, payload_bytes, time):  # type: ignore[no-untyped-def]
    """Enter a packet that may move from cycle `time` on."""
    size = payload_bytes + machine.header_bytes
    if machine.output_queued:
        outlet = net.outputs[output]
        outlet.busy = max(time * 256, outlet.busy) + max(1, size * 256 // machine.flit_bytes)
        arrives = (outlet.busy + 255) // 256 + net.scalars[LATENCY]
        _arrive(net, output, request, arrives, machine.now)
        return
    port = net.inputs[source]
    place = net.in_ring[source, (port.head + port.count) & (net.in_ring.shape[1] - 1)]
    place.request = request
    place.time = time
    place.entered = machine.now
    place.output = output
    place.flits = (size + machine.flit_bytes - 1) // machine.flit_bytes
    if port.count == 0:
        net.unready[source >> 6] |= bit_at(source & 63)
    port.count += 1
    net.scalars[AT_INPUTS] += 1


@small
def _offer(net, source, now):  # type: ignore[no-untyped-def]
    """Let the head of an input that is not ready ask for its output, if it may move by now."""
    port = net.inputs[source]
    head = net.in_ring[source, port.head & (net.in_ring.shape[1] - 1)]
    if head.time > now or port.busy > now:
        return
    word, bit = source >> 6, bit_at(source & 63)
    net.unready[word] &= ~bit
    net.wanted[head.output, word] |= bit
    net.contested[head.output >> 6] |= bit_at(head.output & 63)


@small
def _next_in_turn(net, output, turn):  # type: ignore[no-untyped-def]
    """The first input from `turn` on, around, that wants an output which some input wants."""
    words = net.wanted.shape[1]
    word = turn >> 6
    after = net.wanted[output, word] & ~(bit_at(turn & 63) - U64(1))
    for _ in range(words):
        if after != 0:
            return (word << 6) + lowest(after)
        word = word + 1 if word + 1 < words else 0
        after = net.wanted[output, word]
    return (word << 6) + lowest(after)


@compiled
def _move(machine, net, source, output, now):  # type: ignore[no-untyped-def]
    """Move the first packet of an input to its output; the turn passes to the input after it."""
    outlet = net.outputs[output]
    port = net.inputs[source]
    head = net.in_ring[source, port.head & (net.in_ring.shape[1] - 1)]
    flits = np.int64(head.flits)
    _arrive(net, output, head.request, now + flits + net.scalars[LATENCY], head.entered)
    outlet.busy = now + flits
    outlet.turn = source + 1 if source + 1 < len(net.inputs) else 0
    word, bit = source >> 6, bit_at(source & 63)
    net.wanted[output, word] &= ~bit
    others = U64(0)
    for k in range(net.wanted.shape[1]):
        others |= net.wanted[output, k]
    if others == 0:
        net.contested[output >> 6] &= ~bit_at(output & 63)
    port.count -= 1
    port.head = (port.head + 1) & (net.in_ring.shape[1] - 1) if port.count > 0 else 0
    net.scalars[AT_INPUTS] -= 1
    if flits > 1:
        port.busy = now + flits
    if port.count > 0:
        net.unready[word] |= bit
        if flits == 1 and machine.router_steps == 0:
            _offer(net, source, now)


@small
def _offer_all(net, now):  # type: ignore[no-untyped-def]
    for word in range(len(net.unready)):
        left = net.unready[word]
        while left != 0:
            _offer(net, (word << 6) + lowest(left), now)
            left = without_lowest(left)


@compiled
def _step_router(machine, net, now):  # type: ignore[no-untyped-def]
    """One step of the router: outputs that are given move a packet, free ones are given."""
    _offer_all(net, now)
    for word in range(len(net.contested)):
        left = net.contested[word]
        while left != 0:
            output = (word << 6) + lowest(left)
            left = without_lowest(left)
            outlet = net.outputs[output]
            if outlet.given < 0:
                outlet.given = _next_in_turn(net, output, outlet.turn)
            elif outlet.count < machine.output_packets and outlet.busy <= now:
                source = outlet.given
                outlet.given = -1
                _move(machine, net, source, output, now)


@compiled
def transfer(machine, net, now):  # type: ignore[no-untyped-def]
    """One cycle of the crossbar: match heads to outputs, and move what was matched."""
    if net.scalars[AT_INPUTS] == 0:
        return
    if machine.router_steps > 0:
        for _ in range(machine.router_steps):
            _step_router(machine, net, now)
        return
    _offer_all(net, now)
    for word in range(len(net.contested)):
        # An input that has moved a packet may ask for a later output in the same cycle.
        later = ~U64(0)
        while net.contested[word] & later != 0:
            place = lowest(net.contested[word] & later)
            later = ~U64(1) << U64(place)
            output = (word << 6) + place
            outlet = net.outputs[output]
            if outlet.count < machine.output_packets and outlet.busy <= now:
                _move(machine, net, _next_in_turn(net, output, outlet.turn), output, now)


@small
def arrival(net, output):  # type: ignore[no-untyped-def]
    """The cycle from which an output's first packet may be taken; `NEVER` if there is none."""
    return net.arrivals[output]


@small
def pop(net, output):  # type: ignore[no-untyped-def]
    """Take an output's first packet. Returns (its request, when it entered modulo 2^32)."""
    outlet = net.outputs[output]
    room = net.out_ring.shape[1] - 1
    first = net.out_ring[output, outlet.head & room]
    request, entered = first.request, first.entered
    outlet.count -= 1
    # An empty ring starts over: places in use stay in the host's cache.
    outlet.head = (outlet.head + 1) & room if outlet.count > 0 else 0
    net.arrivals[output] = NEVER if outlet.count == 0 else net.out_ring[output, outlet.head].time
    return request, entered
