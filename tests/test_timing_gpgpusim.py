"""What GPGPU-Sim does and hardware need not: operand collectors over register banks, BookSim's
router, its single DRAM bus, slices drawn for code.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from timing_machines import cycles_of, one_sm, sectors, single_lane, taken, timed

from cachesim.timing.machine import build
from cachesim.timing.network import new_network, push
from cachesim.timing.partition import DRAWN
from cachesim.timing.units import registers_written, write_register

# Operand collectors ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("banks", "steps"),
    # R8 and one of R28 to R30. Four banks: R8 and R28 share one; two: R8, R28 and R30; one: all.
    [(0, 4), (4, 3 + 2 + 2), (2, 3 + 2 + 3), (1, 3 + 3 + 3)],
)
def test_two_operands_of_a_bank_hold_a_collector_a_step_longer(banks: int, steps: int) -> None:
    """One collector: an instruction enters in a step, reads in the next or the next two, and leaves
    in the one after, in which the following one enters; two steps a cycle. Without banks nothing is
    read, and it stays one step.
    """
    gpu = one_sm(
        "sm_timing.num_schedulers=1", "sm_timing.collector_units=1",
        f"sm_timing.register_banks={banks}",
    )  # fmt: skip

    def cycles(fmas: int) -> int:
        trace = single_lane(np.zeros((32, 1), np.int64), warps_per_cta=32, compute_per_load=fmas)
        return cycles_of(trace, gpu)

    rate = (cycles(360) - cycles(60)) / (32 * 100)
    # A scheduler issues one instruction of a kind in a cycle.
    assert rate == pytest.approx(max(3, steps / 2), rel=0.03)


def test_loaded_data_takes_its_bank_for_a_cycle() -> None:
    sm = build(one_sm(), "readonly", 1).sms[0]
    write_register(sm, 1, 2, 7)
    write_register(sm, 3, 0, 7)
    assert registers_written(sm, 7) == 1 << (8 + 2) | 1 << 24
    assert registers_written(sm, 8) == 0
    write_register(sm, 0, 1, 8)
    assert registers_written(sm, 8) == 1 << 1


def test_loads_that_come_back_delay_arithmetic_of_their_bank() -> None:
    """With one bank for all registers every returning sector costs the collectors a step."""
    offsets = np.arange(16 * 32 * 4).reshape(16, 32, 4) * 32

    def cycles(*overrides: str) -> int:
        trace = sectors(offsets, warps_per_cta=16, loads_in_flight=4, compute_per_load=12)
        gpu = one_sm("sm_timing.num_schedulers=1", "sm_timing.collector_units=1", *overrides)
        return cycles_of(trace, gpu, "global")

    assert cycles("sm_timing.register_banks=1") > cycles("sm_timing.register_banks=0") + 16 * 32


def test_the_schedulers_turns_start_with_the_first_cta() -> None:
    """The first cycle in which an SM steps is scheduler 0's."""
    for launch_cycles in range(5):
        gpu = one_sm(f"sm_timing.launch_cycles={launch_cycles}")
        state = timed(single_lane(np.zeros((1, 1), np.int64)), gpu, "global").state
        machine = state.pool.machine[0]
        first = int(machine["place_from"]) + 1
        assert (first + int(machine["first_turn"])) % int(machine["num_schedulers"]) == 0


# BookSim's router -----------------------------------------------------------------------------


def routed(steps: int, wanted: list[list[int]]) -> list[list[tuple[int, int]]]:
    """Per output, (cycle, input) of the packets in their order. wanted: outputs, by input."""
    machine: Any = build(one_sm(f"icnt.router_steps={steps}"), "readonly", 1).pool.machine[0]
    outputs = 1 + max(output for packets in wanted for output in packets)
    net = new_network(len(wanted), outputs, 64, 64, 0)
    for source, packets in enumerate(wanted):
        for output in packets:
            push(machine, net, source, output, source, 0, 0)
    return taken(machine, net, 40)


@pytest.mark.parametrize(("steps", "cycles_a_packet"), [(1, 2), (2, 1), (4, 1)])
def test_a_router_gives_an_output_in_one_step_and_uses_it_in_the_next(
    steps: int, cycles_a_packet: int
) -> None:
    """Three inputs for one output are served in turn; its channel moves one packet a cycle."""
    [found] = routed(steps, [[0] * 4] * 3)
    assert [source for _, source in found] == [0, 1, 2] * 4
    assert np.unique(np.diff([cycle for cycle, _ in found])).tolist() == [cycles_a_packet]


def test_a_router_frees_an_input_within_a_cycle() -> None:
    """Input 1 waits for output 0; what it has for output 1 asks in the next step, half a cycle on,
    and a crossbar that works once a cycle is no faster.
    """
    wanted = [[0], [0, 1]]
    (_, (second, _)), [(behind, _)] = routed(2, wanted)
    assert behind <= second + 1
    (_, (second, _)), [(behind, _)] = routed(1, wanted)
    assert behind >= second + 2


# Memory ---------------------------------------------------------------------------------------


def test_a_row_command_may_go_beside_a_column_command_in_bank_order() -> None:
    """Random sectors, so that row and column commands compete: GPGPU-Sim's single bus is faster
    than one command a cycle, and slower than two buses.
    """
    random = np.random.default_rng(5)
    offsets = random.permutation(1 << 16)[:4096].reshape(64, 64, 1) * 32
    trace = sectors(offsets, warps_per_cta=8, loads_in_flight=16)

    def cycles(bus: str) -> int:
        gpu = one_sm(
            f"dram_timing.command_bus={bus}", "dram_timing.clock_hz=400000000",
            "dram_timing.rrd=1", "l2.capacity=128KiB",
        )  # fmt: skip
        return cycles_of(trace, gpu, "global")

    single, ordered, dual = (cycles(bus) for bus in ("single", "bank-order", "dual"))
    assert single > 1.01 * ordered and ordered >= dual


@pytest.mark.parametrize(("fmas", "chunks"), [(0, 1), (5, 1), (6, 2), (30, 5)])
def test_code_draws_slices_as_data_does(fmas: int, chunks: int) -> None:
    """16 bytes an instruction: a slice is drawn for each 128 B of code that a warp comes to, and
    one for its datum. Two more instructions lead to the access, an exit ends it.
    """
    gpu = one_sm("l2.partition_hash=random", "l2.num_channels=12", "l2.slices_per_channel=2",
                 "l2.capacity=3MiB", "l2.channel_interleave=256")  # fmt: skip
    trace = single_lane(np.zeros((4, 1), np.int64), warps_per_cta=4, compute_per_load=fmas)
    assert timed(trace, gpu, "global").state.l2_route.draws[DRAWN] == chunks + 1
