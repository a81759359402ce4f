"""Cycles that follow from the configuration by hand: chases, streams, compute, and what binds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from timing_machines import (
    GPGPUSIM,
    cycles_of,
    in_turn,
    load,
    one_sm,
    program,
    sectors,
    single_lane,
    timed,
)

from cachesim import presets
from cachesim.config import Gpu
from traces.oracle_traces import oracle_trace
from traces.trace import Trace

RESULTS = Path(__file__).parent / "oracles" / "accel-sim" / "results.csv"
CHASED = (GPGPUSIM, "rtx-2060-gpgpusim", "titan-x-pascal", "rx-6900-xt")
NAVI = "rx-6900-xt"

# Cycles that every request spends besides the latencies of the configuration. From the L1's look-up
# of a miss on: into the miss queue, into the network, across it, to the slice's queue, its look-up,
# into the reply network, across it, to the load/store unit, its fill, the choice of the write-back,
# and the write-back.
_L2_PIPE = 9
# A request without an L1 leaves for the network at once.
_BYPASS_PIPE = 8
# With a GL1 between: its delay is entered a cycle after the miss queue, its look-up, its miss queue
# and the network's entry; the reply is filled, chosen and handed over by the GL1 as well.
_GL1_PIPE, _GL1_L2_PIPE = 6, 13


def chase(step: int, num: int) -> Trace:
    """One lane of one warp loads every `step` bytes, each load after the one before it."""
    return single_lane([[step * k for k in range(num)]])


def per_load(gpu: Gpu, step: int, num: int, *, warm: bool, path: str = "readonly") -> float:
    """Cycles that one load more takes, over `num` loads more. warm: the lines are in the L2."""
    first = [chase(step, num + 1)] if warm else []
    long = cycles_of(in_turn(*first, chase(step, num + 1)), gpu, path)
    short = cycles_of(in_turn(*first, chase(step, 1)), gpu, path)
    return (long - short) / num


def latencies(gpu: Gpu) -> dict[str, int]:
    """What the preset says of every stage, 0 where the level is absent."""
    assert gpu.sm_timing and gpu.l1_timing and gpu.icnt and gpu.l2_timing and gpu.dram_timing
    return {
        "issue": gpu.sm_timing.memory_cycles,
        "l1": gpu.l1_timing.latency_cycles,
        "icnt": gpu.icnt.request_latency_cycles + gpu.icnt.reply_latency_cycles,
        "gl1": gpu.gl1_timing.latency_cycles if gpu.gl1_timing else 0,
        "l2": gpu.l2_timing.latency_cycles,
        "llc": gpu.llc_timing.latency_cycles if gpu.llc_timing else 0,
        "dram": gpu.dram_timing.fixed_latency_cycles,
    }


@pytest.mark.parametrize("name", CHASED)
def test_a_chase_of_l1_hits_takes_the_issue_and_the_l1s_latency(name: str) -> None:
    gpu = presets.load(name)
    of = latencies(gpu)
    assert per_load(gpu, 0, 32, warm=True) == of["issue"] + of["l1"]


@pytest.mark.parametrize("name", CHASED)
def test_a_chase_of_l2_hits_adds_the_network_and_the_l2(name: str) -> None:
    gpu = presets.load(name)
    of = latencies(gpu)
    pipe = _GL1_L2_PIPE if gpu.gl1 else _L2_PIPE
    assert per_load(gpu, 4096, 32, warm=True) == (
        of["issue"] + of["l1"] + of["gl1"] + of["icnt"] + of["l2"] + pipe
    )


@pytest.mark.parametrize("name", [GPGPUSIM, "titan-x-pascal"])
def test_a_chase_around_the_l1_pays_no_l1(name: str) -> None:
    gpu = presets.load(name)
    of = latencies(gpu)
    expected = of["issue"] + of["icnt"] + of["l2"] + _BYPASS_PIPE
    assert per_load(gpu, 4096, 32, warm=True, path="global") == expected


def test_a_chase_of_gl1_hits_takes_l1_and_gl1() -> None:
    gpu = presets.load(NAVI)
    of = latencies(gpu)
    # Twice as many lines as the L0 has, an eighth of the GL1's: the second round hits the GL1.
    lines = 2 * gpu.l1.capacity // gpu.l1.line_bytes
    once = list(range(0, lines * 128, 128))
    two = cycles_of(single_lane([once * 3]), gpu) - cycles_of(single_lane([once * 2]), gpu)
    assert two / lines == of["issue"] + of["l1"] + of["gl1"] + _GL1_PIPE


def test_a_chase_of_last_level_hits_adds_its_latency_and_both_halves_of_the_line() -> None:
    """The L2's 128 B come as two look-ups of 64 B, in two cycles of one slice."""
    gpu = presets.load(NAVI, ["l2.capacity=32KiB"])
    of = latencies(gpu)
    # 512 lines go round through 256 places of the L2.
    step, num = 128, 512
    warm = single_lane([[step * k for k in range(num)]])
    long = cycles_of(in_turn(warm, chase(step, 257)), gpu)
    short = cycles_of(in_turn(warm, chase(step, 1)), gpu)
    l2_hit = of["issue"] + of["l1"] + of["gl1"] + of["icnt"] + of["l2"] + _GL1_L2_PIPE
    # To the L2's miss queue, to the LLC, its queue, the second half, and the L2's reply.
    assert (long - short) / 256 == l2_hit + of["llc"] + 5


@pytest.mark.parametrize("name", CHASED)
def test_a_cold_load_adds_the_memorys_latency_and_a_row_to_open(name: str) -> None:
    """An activate, a read of the row, and its data, in command cycles; the rest in core cycles. A
    command cycle begins up to one core cycle late, as does its end.
    """
    gpu = presets.load(name)
    dram, last = gpu.dram_timing, gpu.llc or gpu.l2
    assert dram is not None
    of = latencies(gpu)
    cold = cycles_of(chase(0, 1), gpu, "readonly")
    warm = cycles_of(in_turn(chase(0, 1), chase(0, 1)), gpu, "readonly")
    bursts = gpu.l2.sector_bytes // dram.atom_bytes
    commands = 2 + dram.rcd + dram.cl + (bursts - 1) * max(dram.ccd, dram.ccdl)
    expected = 3 + of["dram"] + commands * gpu.clock_hz / dram.clock_hz
    if last is gpu.llc:
        # The look-up and the fill of the last cache, and its two queues.
        expected += 5 + of["llc"]
    assert cold - warm == pytest.approx(expected, abs=3)


def row_of(num: int, step: int) -> float:
    """Cycles per load of a chase through memory in step with the core."""
    gpu = one_sm()
    return (cycles_of(chase(step, num + 1), gpu) - cycles_of(chase(step, 1), gpu)) / num


def test_a_chase_through_memory_takes_exactly_the_sum_of_its_stages() -> None:
    gpu = one_sm()
    dram, of = gpu.dram_timing, latencies(gpu)
    assert dram is not None
    l2_hit = of["issue"] + of["l1"] + of["icnt"] + of["l2"] + _L2_PIPE
    # Take, enter and activate, return, fill, and the reply that an L2 hit sends a cycle earlier.
    opened = l2_hit + of["dram"] + dram.rcd + dram.cl + 5
    # Banks are at bits 12 to 14, rows from bit 15 on, columns at bits 5 and 6.
    assert row_of(7, 1 << 12) == opened
    assert row_of(7, 1 << 15) == opened + dram.rp
    assert row_of(3, 1 << 5) == opened - dram.rcd


def test_a_row_miss_costs_its_precharge_and_its_activate_more_than_a_row_hit() -> None:
    for rp, rcd in ((16, 16), (30, 16), (16, 40)):
        gpu = one_sm(f"dram_timing.rp={rp}", f"dram_timing.rcd={rcd}", "dram_timing.rc=0")
        miss = cycles_of(chase(1 << 15, 2), gpu)
        hit = cycles_of(chase(1 << 5, 2), gpu)
        assert miss - hit == rp + rcd


# Streams --------------------------------------------------------------------------------------


def reads(num_warps: int, loads: int, footprint: int, in_flight: int = 8) -> Trace:
    """Warps of 128 B loads, one line after the other of a footprint that all warps share."""
    line = np.arange(num_warps * loads).reshape(loads, num_warps).T * 128 % footprint
    return sectors(line[:, :, None] + np.arange(4) * 32, warps_per_cta=4, loads_in_flight=in_flight)


def bytes_per_cycle(
    gpu: Gpu,
    num_warps: int,
    footprint: int,
    path: str,
    loads: int = 16,
    warm: bool = True,
    in_flight: int = 8,
) -> float:
    """Bytes of loads more / cycles more: start and end of the kernel cancel out."""
    first = [reads(num_warps, max(1, footprint // (128 * num_warps)), footprint)] if warm else []

    def took(num: int) -> int:
        trace = reads(num_warps, num, footprint, in_flight)
        return cycles_of(in_turn(*first, trace), gpu, path)

    long, short = took(3 * loads), took(loads)
    return num_warps * 2 * loads * 128 / (long - short)


@pytest.mark.parametrize("banks", [1, 2, 4])
def test_a_stream_of_l1_hits_reaches_the_banks_bandwidth(banks: int) -> None:
    # A line's four sectors are one instruction a cycle, more than operand collectors let through.
    gpu = one_sm(f"l1_timing.num_banks={banks}", "sm_timing.collector_units=0")
    rate = bytes_per_cycle(gpu, 64, 1024, "readonly", loads=32)
    assert rate == pytest.approx(32 * banks, rel=0.05)


@pytest.mark.parametrize("limit", [32, 64])
def test_a_stream_of_l1_hits_reaches_the_data_ports_bandwidth(limit: int) -> None:
    gpu = one_sm("l1_timing.num_banks=16", f"l1_timing.bytes_per_cycle={limit}")
    assert bytes_per_cycle(gpu, 32, 1024, "readonly") == pytest.approx(limit, rel=0.05)


#: Four SMs ask one slice. Its queue is long: a slice takes requests by the room in the queue behind
#: its latency, so that a short queue runs dry before the next ones arrive.
_TO_L2 = ("sm.count=4", "l1.bypass_loads=true", "l2_timing.queue_in=512")


@pytest.mark.parametrize("port", [32, 16, 8])
def test_a_stream_of_l2_hits_reaches_the_slices_ports(port: int) -> None:
    gpu = one_sm(*_TO_L2, f"l2_timing.port_bytes={port}")
    assert bytes_per_cycle(gpu, 64, 4096, "global") == pytest.approx(port, rel=0.05)


def test_the_l2s_own_clock_scales_its_bandwidth() -> None:
    gpu = one_sm(*_TO_L2, "l2_timing.clock_hz=708500000")
    assert bytes_per_cycle(gpu, 64, 4096, "global") == pytest.approx(16, rel=0.05)


@pytest.mark.parametrize("queueing", ["input-fifo", "output-queued"])
@pytest.mark.parametrize("flits", [1, 2, 5])
def test_a_stream_reaches_the_networks_flit_rate(queueing: str, flits: int) -> None:
    """A reply of 32 B data and 8 B header holds its port for a cycle a flit: the slice's in a
    crossbar of FIFOs, only the SM's where packets queue at the outputs.
    """
    gpu = one_sm(*_TO_L2, f"icnt.queueing={queueing}", f"icnt.flit_bytes={40 // flits}")
    num_ports = 1 if queueing == "input-fifo" else gpu.sm.count
    expected = min(32, num_ports * 32 / flits)
    assert bytes_per_cycle(gpu, 64, 4096, "global") == pytest.approx(expected, rel=0.05)


def test_an_sm_takes_one_reply_a_cycle_however_many_slices_answer() -> None:
    gpu = one_sm("l1.bypass_loads=true", "l2.num_channels=4", "l2.capacity=512KiB")
    assert bytes_per_cycle(gpu, 64, 16384, "global") == pytest.approx(32, rel=0.05)


@pytest.mark.parametrize("port", [64, 128, 256])
def test_a_stream_of_gl1_hits_reaches_the_gl1s_port(port: int) -> None:
    gpu = presets.load(NAVI, ["sm.count=10", f"gl1_timing.port_bytes={port}"])
    # An L0 is asked for three times as many lines as it holds, the GL1 for fewer.
    rate = bytes_per_cycle(gpu, 160, 96 << 10, "readonly", loads=96, warm=False)
    assert rate == pytest.approx(port, rel=0.05)


def test_a_stream_of_last_level_hits_reaches_the_last_levels_port() -> None:
    gpu = presets.load(
        NAVI,
        ["sm.count=10", "l2.num_channels=1", "l2.capacity=32KiB", "llc.num_channels=1",
         "llc.capacity=8MiB"],
    )  # fmt: skip
    assert gpu.llc_timing is not None
    expected = gpu.llc_timing.port_bytes * gpu.llc_timing.clock_hz / gpu.clock_hz
    rate = bytes_per_cycle(gpu, 160, 1 << 20, "readonly", loads=16)
    assert rate == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("data_rate", "ccd"), [(4, 2), (2, 4)])
def test_a_stream_from_memory_reaches_the_bus(data_rate: int, ccd: int) -> None:
    """Banks and rows lifted: activates are free, groups do not matter."""
    gpu = one_sm(
        "sm.count=4", "l1.bypass_loads=true", f"dram_timing.data_rate={data_rate}",
        f"dram_timing.ccd={ccd}", f"dram_timing.ccdl={ccd}", "dram_timing.rrd=1",
        "dram_timing.command_bus=dual",
    )  # fmt: skip
    assert gpu.dram_timing is not None
    rate = bytes_per_cycle(gpu, 64, 1 << 30, "global", loads=16, warm=False)
    assert rate == pytest.approx(gpu.dram_timing.bus_bytes * data_rate, rel=0.05)


@pytest.mark.parametrize(
    ("config", "name", "overrides"),
    [
        ("SM6_TITANX", GPGPUSIM, []),
        ("SM6_TITANX_L1", GPGPUSIM, ["l1.bypass_loads=false"]),
        ("SM75_RTX2060", "rtx-2060-gpgpusim", []),
    ],
)
def test_a_stream_attains_what_accel_sim_attained(
    config: str, name: str, overrides: list[str]
) -> None:
    table = pd.read_csv(RESULTS).set_index(["config", "trace"])
    gpu = presets.load(name, overrides)
    assert gpu.sm_timing is not None
    theirs = int(table.loc[(config, "stream"), "cycles"]) - gpu.sm_timing.launch_cycles
    assert cycles_of(oracle_trace("stream"), gpu, "global") == pytest.approx(theirs, rel=0.05)


# Compute --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "per_cycle"),
    # Four schedulers, of which each issues one a cycle, or one every other cycle of its unit; two.
    [(GPGPUSIM, 4), ("rtx-2060-gpgpusim", 2), ("titan-x-pascal", 4), (NAVI, 2)],
)
def test_a_compute_bound_kernel_reaches_the_issue_limit(name: str, per_cycle: int) -> None:
    gpu = presets.load(name, ["sm.count=1"])
    # A greedy scheduler is full with three warps of three chains at a latency of nine cycles, and
    # goes through its warps by threes.
    num_warps = min(48, gpu.sm.max_warps)

    def kernel(count: int) -> Trace:
        return single_lane(
            [[128 * w] for w in range(num_warps)], warps_per_cta=4, compute_per_load=count
        )

    took = cycles_of(kernel(300), gpu) - cycles_of(kernel(100), gpu)
    assert num_warps * 200 / took == pytest.approx(per_cycle, rel=0.05)


@pytest.mark.parametrize("name", CHASED)
@pytest.mark.parametrize("kind", ["int", "fp32", "sfu"])
def test_a_single_chain_takes_three_results_a_latency(name: str, kind: str) -> None:
    """One warp, three dependent chains: three instructions in the time of one result, or one in the
    time of three initiations.
    """
    gpu = presets.load(name, ["sm.count=1"])
    sm = gpu.sm_timing
    assert sm is not None
    latency = getattr(sm, f"{kind}_latency_cycles") + sm.result_cycles
    initiation = getattr(sm, f"{kind}_initiation_cycles")

    def kernel(count: int) -> Trace:
        return program([], trailing=((kind, count),))

    took = cycles_of(kernel(330), gpu) - cycles_of(kernel(30), gpu)
    assert took / 100 == max(latency, 3 * initiation)


# What binds -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mshrs", [8, 16, 32])
def test_a_latency_bound_stream_moves_mshrs_times_a_sector_per_latency(mshrs: int) -> None:
    gpu = one_sm(f"l1_timing.num_mshrs={mshrs}", "l2.num_channels=4", "l2.capacity=512KiB")
    of = latencies(gpu)
    # An MSHR is held from the look-up to the write-back's choice, a cycle before the last one.
    held = of["icnt"] + of["l2"] + _L2_PIPE - 1
    bound = mshrs * 32 / held
    rate = bytes_per_cycle(gpu, 16, 128 << 10, "readonly", loads=16)
    assert rate <= bound * 1.001
    assert rate >= bound * 0.95


@pytest.mark.parametrize("mshrs", [8, 16])
def test_an_unsectored_l1_moves_mshrs_times_a_line_per_latency(mshrs: int) -> None:
    gpu = presets.load(
        NAVI,
        ["sm.count=1", f"l1_timing.num_mshrs={mshrs}", "l1_timing.fill_bytes_per_cycle=128"],
    )
    of = latencies(gpu)
    held = of["gl1"] + of["icnt"] + of["l2"] + _GL1_L2_PIPE - 1
    bound = mshrs * 128 / held
    # One load per warp, so that neighbours in time are neighbours in memory, on different slices.
    rate = bytes_per_cycle(gpu, 32, 1 << 20, "readonly", loads=32, in_flight=1)
    assert rate <= bound * 1.001
    assert rate >= bound * 0.95


#: A machine, and which field's doubling helps it: memory's bus, the slice's port, the MSHRs.
_BOUND = {
    "dram_timing.data_rate": ("dram_timing.data_rate=2", "dram_timing.ccd=4", "dram_timing.ccdl=4"),
    "l2_timing.port_bytes": ("l2_timing.port_bytes=8",),
    "l1_timing.num_mshrs": ("l1_timing.num_mshrs=8", "l1.bypass_loads=false"),
}
_DOUBLED = {
    "dram_timing.data_rate": (
        "dram_timing.data_rate=4", "dram_timing.ccd=2", "dram_timing.ccdl=2",
    ),
    "l2_timing.port_bytes": ("l2_timing.port_bytes=16",),
    "l1_timing.num_mshrs": ("l1_timing.num_mshrs=16",),
}  # fmt: skip
_NEVER_BINDS = (
    "l1_timing.mshr_merge=64", "l1_timing.miss_queue=64", "l2_timing.num_mshrs=512",
    "l2_timing.mshr_merge=128", "icnt.ejection_packets=64", "icnt.response_packets=4",
    "l2_timing.queue_fill=64", "sm_timing.memory_queue=8", "dram_timing.return_queue=128",
)  # fmt: skip


@pytest.mark.parametrize("binds", _BOUND)
def test_doubling_what_binds_helps_and_doubling_the_rest_does_not(binds: str) -> None:
    base = ("sm.count=2", "l1.bypass_loads=true", "dram_timing.command_bus=dual",
            "dram_timing.rrd=1", *_BOUND[binds])  # fmt: skip
    footprint = 1 << 30 if binds.startswith("dram") else 16 << 10
    path = "readonly" if binds.startswith("l1") else "global"
    # An L2 that is cold takes the same misses in every run; the L1 never holds the footprint.
    small = ("l1.capacity=2KiB", "l1.ways=4")

    def took(*overrides: str) -> int:
        trace = reads(32, 64, footprint)
        return cycles_of(in_turn(trace, trace), one_sm(*base, *small, *overrides), path)

    before = took()
    assert took(*_DOUBLED[binds]) < 0.65 * before
    for other in _NEVER_BINDS:
        assert took(other) == pytest.approx(before, rel=0.01), other
    for other in set(_BOUND) - {binds}:
        if other != "l1_timing.num_mshrs":
            field = "l2_timing.port_bytes=64" if other.startswith("l2") else None
            if field:
                assert took(field) == pytest.approx(before, rel=0.01), other


def test_a_wait_holds_the_warp_until_few_enough_loads_are_out() -> None:
    """Eight loads with at most n + 1 in flight take ceil(8 / (n + 1)) latencies, a cycle apart."""
    gpu = one_sm("l1.bypass_loads=true")
    of = latencies(gpu)
    latency = of["issue"] + of["icnt"] + of["l2"] + _BYPASS_PIPE

    def took(outstanding: int) -> int:
        one = load(num_outstanding=outstanding)
        warm = program([(load(), 32 * k) for k in range(8)])
        return cycles_of(in_turn(warm, program([(one, 32 * k) for k in range(8)])), gpu, "global")

    assert took(0) - took(1) == pytest.approx(4 * latency, abs=16)
    assert took(1) - took(3) == pytest.approx(2 * latency, abs=16)
    assert took(3) - took(7) == pytest.approx(latency, abs=16)


def test_launches_cost_their_latency_each_and_nothing_else() -> None:
    for cycles in (0, 100, 5000):
        gpu = one_sm(f"sm_timing.launch_cycles={cycles}")
        clock = timed(in_turn(chase(0, 1), chase(0, 1), chase(0, 1)), gpu)
        assert [one.launch_cycles for one in clock.launches] == [cycles] * 3
        assert clock.launches[1].cycles == clock.launches[2].cycles
        assert clock.cycles == sum(one.cycles for one in clock.launches)
