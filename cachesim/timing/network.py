"""The interconnect: a request network from the SMs' ports to the slices, a reply network back.

"input-fifo" is a crossbar that matches the heads of its inputs to outputs once a cycle, each output
taking the next input in turn (iSLIP with one iteration); a head whose output is taken blocks what
is behind it, and a packet holds its output for whole cycles. "output-queued" has no such blocking:
a packet waits at its output, which moves a flit's bytes a cycle, several small packets if they fit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cachesim.compiled import compiled


class Network(NamedTuple):
    """One direction. I inputs, O outputs.

    inputs: (I,) `records.PORT`, in_ring: (I, room) int32, in_time: (I, room) int64 cycle from which
    a packet may move; in_out: (I, room) int32 its output, in_flits: (I, room) int32.
    outputs: (O,) `records.OUTLET`, out_ring, out_time: (O, room); an output-queued one's `busy` is
    in 1/256 cycles. scalars: (2,) int64, packets held at inputs, the latency.
    """

    inputs: npt.NDArray[np.void]
    in_ring: npt.NDArray[np.int32]
    in_time: npt.NDArray[np.int64]
    in_out: npt.NDArray[np.int32]
    in_flits: npt.NDArray[np.int32]
    outputs: npt.NDArray[np.void]
    out_ring: npt.NDArray[np.int32]
    out_time: npt.NDArray[np.int64]
    scalars: npt.NDArray[np.int64]


AT_INPUTS, LATENCY = range(2)


@compiled
def has_room(machine, net, source, output):  # type: ignore[no-untyped-def]
    """Whether a packet may enter."""
    if machine.output_queued:
        return net.outputs[output].count < machine.output_packets
    return net.inputs[source].in_count < machine.input_packets


@compiled
def push(machine, net, source, output, request, payload_bytes, time):  # type: ignore[no-untyped-def]
    """Enter a packet that may move from cycle `time` on."""
    size = payload_bytes + machine.header_bytes
    if machine.output_queued:
        outlet = net.outputs[output]
        room = net.out_ring.shape[1] - 1
        outlet.busy = max(time * 256, outlet.busy) + max(1, size * 256 // machine.flit_bytes)
        at = (outlet.head + outlet.count) & room
        net.out_ring[output, at] = request
        net.out_time[output, at] = (outlet.busy + 255) // 256 + net.scalars[LATENCY]
        outlet.count += 1
        return
    flits = (size + machine.flit_bytes - 1) // machine.flit_bytes
    port = net.inputs[source]
    room = net.in_ring.shape[1] - 1
    at = (port.in_head + port.in_count) & room
    net.in_ring[source, at] = request
    net.in_time[source, at] = time
    net.in_out[source, at] = output
    net.in_flits[source, at] = flits
    port.in_count += 1
    net.scalars[AT_INPUTS] += 1


@compiled
def _offer(net, source, now):  # type: ignore[no-untyped-def]
    """Put an input on the list of those whose head wants an output."""
    port = net.inputs[source]
    at = port.in_head & (net.in_ring.shape[1] - 1)
    if port.in_count == 0 or net.in_time[source, at] > now or port.in_busy > now:
        return -1
    output = net.in_out[source, at]
    outlet = net.outputs[output]
    if outlet.stamp != now:
        outlet.stamp = now
        outlet.first = -1
    port.candidate = outlet.first
    outlet.first = source
    return output


@compiled
def transfer(machine, net, now):  # type: ignore[no-untyped-def]
    """One cycle of the crossbar: match heads to outputs, and move what was matched."""
    if net.scalars[AT_INPUTS] == 0:
        return
    num_inputs, num_outputs = len(net.inputs), len(net.outputs)
    offered = 0
    for source in range(num_inputs):
        if net.inputs[source].in_count > 0:
            offered += _offer(net, source, now) >= 0
    if offered == 0:
        return
    in_room, out_room = net.in_ring.shape[1] - 1, net.out_ring.shape[1] - 1
    for output in range(num_outputs):
        outlet = net.outputs[output]
        if outlet.stamp != now or outlet.first < 0:
            continue
        if outlet.count >= machine.output_packets or outlet.busy > now:
            continue
        best, nearest = -1, num_inputs
        source = outlet.first
        while source >= 0:
            distance = source - outlet.turn
            if distance < 0:
                distance += num_inputs
            if distance < nearest:
                best, nearest = source, distance
            source = net.inputs[source].candidate
        port = net.inputs[best]
        at = port.in_head & in_room
        flits = net.in_flits[best, at]
        place = (outlet.head + outlet.count) & out_room
        net.out_ring[output, place] = net.in_ring[best, at]
        net.out_time[output, place] = now + flits + net.scalars[LATENCY]
        outlet.count += 1
        outlet.busy = now + flits
        outlet.turn = best + 1 if best + 1 < num_inputs else 0
        port.in_head = (port.in_head + 1) & in_room
        port.in_count -= 1
        net.scalars[AT_INPUTS] -= 1
        if flits > 1:
            port.in_busy = now + flits
        elif machine.match_again:
            _offer(net, best, now)


@compiled
def arrival(net, output):  # type: ignore[no-untyped-def]
    """The cycle from which an output's first packet may be taken; `NEVER`-like if there is none."""
    outlet = net.outputs[output]
    if outlet.count == 0:
        return np.int64(1 << 62)
    return net.out_time[output, outlet.head & (net.out_ring.shape[1] - 1)]


@compiled
def pop(net, output):  # type: ignore[no-untyped-def]
    """Take an output's first packet."""
    outlet = net.outputs[output]
    room = net.out_ring.shape[1] - 1
    request = net.out_ring[output, outlet.head & room]
    outlet.head = (outlet.head + 1) & room
    outlet.count -= 1
    return request
