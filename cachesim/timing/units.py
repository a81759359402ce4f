"""What issue and the operand collectors share: an instruction's unit, a warp's loads in flight."""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, small
from cachesim.stream import STORE
from cachesim.timing.bits import bit_at
from cachesim.timing.records import (
    CONTROL,
    FP32,
    INT,
    MAX_LOADS,
    MAX_REGISTER_BANKS,
    PATH_BYPASS,
)

U64 = np.uint64
#: Registers: of addresses, of a group's first load, of the first sum (`traces.lane_address`).
ADDRESS, LOADED, SUM = 2, 8, 28
#: An instruction may issue this many cycles before its unit is free: it is collected meanwhile.
AHEAD = 3


@small
def unit_of(machine, kind):  # type: ignore[no-untyped-def]
    """The unit that executes a kind; GPGPU-Sim's control instructions take the fp32 one."""
    if kind == CONTROL and machine.collector_units > 0:
        kind = INT
    return FP32 if kind == INT and machine.int_on_fp32 else kind


@small
def registers_written(sm, now):  # type: ignore[no-untyped-def]
    """The register banks that loaded data enters in this cycle, a mask over the schedulers'."""
    return sm.written if sm.written_at == now else U64(0)


@small
def write_register(sm, scheduler, bank, now):  # type: ignore[no-untyped-def]
    """Note that loaded data enters a scheduler's register bank in this cycle."""
    sm.written = registers_written(sm, now) | bit_at(scheduler * MAX_REGISTER_BANKS + bank)
    sm.written_at = now


@compiled
def note_access(state, warp, row):  # type: ignore[no-untyped-def]
    """What the warp will wait for: a load's sectors, or a store's acknowledgements. Returns the
    load's number.
    """
    machine = state.pool.machine[0]
    instruction = state.work.instructions[row.code]
    if instruction.operation == STORE:
        parts = machine.line_parts if instruction.path == PATH_BYPASS else 1
        warp.stores += max(1, row.sectors * parts)
        return 0
    load = warp.next_load
    if instruction.waits:
        warp.group = load
    warp.pending[load & (MAX_LOADS - 1)] = max(1, row.sectors)
    warp.next_load += 1
    return load
