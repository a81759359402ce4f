"""Every mechanism of the timing model by name, each on a trace that shows nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from timing_machines import (
    BASE,
    cycles_of,
    held_in,
    in_turn,
    load,
    one_sm,
    program,
    sectors,
    single_lane,
    stepped,
    taken,
    timed,
)

from cachesim import presets, simulate
from cachesim.config import Gpu
from cachesim.counts import ACCESSES
from cachesim.timing.clock import Clock
from cachesim.timing.machine import build
from cachesim.timing.network import has_room, new_network, push
from traces.errors import InputError, WorkError
from traces.synthetic import gather
from traces.texture import Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

LINE = 128


def outcomes(trace: Trace, gpu: Gpu, level: str = "l1", path: str = "readonly") -> dict[str, int]:
    """GPGPU-Sim's outcome words of one level that were counted at all."""
    return {name: n for name, n in timed(trace, gpu, path).raw()[level].items() if n}


def together(*offsets: int) -> Trace:
    """One warp's loads, all in flight at once."""
    return single_lane([offsets], loads_in_flight=len(offsets))


# Outcomes of an access ------------------------------------------------------------------------


def test_a_load_of_a_sector_on_its_way_is_hit_reserved_and_merges() -> None:
    gpu = one_sm("l1_timing.allocation=on-miss")
    assert outcomes(together(0, 4), gpu) == {"MISS": 1, "HIT_RESERVED": 1, "MSHR_HIT": 1}
    assert outcomes(together(0, 4), gpu, "l2") == {"MISS": 1}


def test_a_streaming_l1_calls_it_a_miss_and_merges_as_well() -> None:
    for allocation in ("streaming", "on-fill"):
        gpu = one_sm(f"l1_timing.allocation={allocation}")
        assert outcomes(together(0, 4), gpu) == {"MISS": 2, "MSHR_HIT": 1}
        assert outcomes(together(0, 4), gpu, "l2") == {"MISS": 1}


def test_another_sector_of_a_line_is_a_sector_miss_once_the_line_is_there() -> None:
    on_miss, streaming = one_sm("l1_timing.allocation=on-miss"), one_sm()
    assert outcomes(together(0, 32), on_miss) == {"MISS": 1, "SECTOR_MISS": 1}
    # A line is taken when its data arrives: until then the other sector finds no line.
    assert outcomes(together(0, 32), streaming) == {"MISS": 2}
    for gpu in (on_miss, streaming):
        in_order = single_lane([[0, 32, 4, 36]])
        assert outcomes(in_order, gpu) == {"MISS": 1, "SECTOR_MISS": 1, "HIT": 2}


@pytest.mark.parametrize("merge", [1, 2, 3, 8])
def test_more_requests_than_an_mshr_merges_fail_and_are_tried_again(merge: int) -> None:
    gpu = one_sm("l1_timing.allocation=on-miss", f"l1_timing.mshr_merge={merge}")
    found = outcomes(together(0, 4, 8, 12), gpu)
    merged = min(merge, 4) - 1
    assert found["MISS"] == 1 and found.get("HIT_RESERVED", 0) == found.get("MSHR_HIT", 0) == merged
    # What could not merge hits once the data is there.
    assert found.get("HIT", 0) == 3 - merged
    assert (found.get("RESERVATION_FAIL", 0) > 0) == (merge < 4)


def test_without_a_free_mshr_a_miss_fails_every_cycle_until_one_is_free() -> None:
    gpu = one_sm("l1_timing.num_mshrs=1")
    found = outcomes(together(0, 32), gpu)
    assert found["MISS"] + found.get("SECTOR_MISS", 0) == 2
    # The second waits for the whole flight of the first, which is a cold miss.
    assert found["RESERVATION_FAIL"] > 200
    one, two = (cycles_of(together(*at), gpu) for at in ((0,), (0, 32)))
    free = cycles_of(together(0, 32), one_sm())
    assert two > free + 200 and two > 1.5 * (one - 100)


def test_a_full_miss_queue_fails_and_reads_leave_a_place_for_write_backs() -> None:
    # Sixteen lines of both banks, two look-ups a cycle; one miss a cycle leaves.
    trace = sectors(np.arange(16).reshape(1, 8, 2) * 32, loads_in_flight=8)
    assert "RESERVATION_FAIL" not in outcomes(trace, one_sm("l1_timing.miss_queue=32"))
    assert outcomes(trace, one_sm("l1_timing.miss_queue=3"))["RESERVATION_FAIL"] > 0


def test_a_reserved_line_is_not_evicted() -> None:
    """One set of two ways, three lines on their way: the third waits for a line, not for data."""
    tiny = ("l1.capacity=256B", "l1.ways=2")
    on_miss = one_sm(*tiny, "l1_timing.allocation=on-miss")
    found = outcomes(together(0, LINE, 2 * LINE), on_miss)
    assert found["MISS"] == 3 and found["RESERVATION_FAIL"] > 100
    # Where lines are taken at the fill there is none to wait for.
    assert outcomes(together(0, LINE, 2 * LINE), one_sm(*tiny)) == {"MISS": 3}


def test_lru_keeps_what_was_touched_and_fifo_what_came_last() -> None:
    trace = single_lane([[0, LINE, 0, 2 * LINE, 0]])
    for replacement, hits in (("lru", 2), ("fifo", 1)):
        gpu = one_sm("l1.capacity=256B", "l1.ways=2", f"l1.replacement={replacement}")
        assert outcomes(trace, gpu)["HIT"] == hits


def test_dirty_lines_are_spared_below_the_dirty_limit() -> None:
    """Of one set of two ways a stored line is the oldest, but spared while few lines are dirty."""
    steps: list[tuple[Instruction, int]] = [(load(operation="store"), 0)]
    steps += [(load(num_outstanding=0), LINE * k) for k in (1, 2, 0)]
    trace = program(steps)
    for limit, hits in ((0, 0), (100, 1)):
        gpu = one_sm(
            "l1.capacity=256B", "l1.ways=2", "l1.write_policy=write-through",
            "l1.write_allocate=lazy-fetch-on-read", "l1_timing.allocation=on-miss",
            f"l1_timing.dirty_limit_percent={limit}",
        )  # fmt: skip
        lanes = np.zeros((4, 32), np.uint64)
        lanes[0] = BASE + np.arange(32) * 4
        lanes[1:] = next(iter(trace.chunks())).lanes[1:]
        chunk = Chunk(0, 0, np.array([0, 4]), next(iter(trace.chunks())).instruction, lanes)
        whole = from_chunks([chunk], [], trace.instructions, trace.launches)
        assert outcomes(whole, gpu).get("HIT", 0) == hits, limit


# Banks, ports, laws of the load/store unit ----------------------------------------------------


def test_sectors_of_one_bank_conflict_and_of_two_do_not() -> None:
    gpu = one_sm("l1_timing.num_banks=2", "l1_timing.bank_bytes=32")
    same = sectors(np.array([[[0, 64]]]))
    other = sectors(np.array([[[0, 96]]]))
    assert timed(same, gpu, "readonly").raw()["sm"]["l1_bank_conflicts"] == 1
    assert timed(other, gpu, "readonly").raw()["sm"]["l1_bank_conflicts"] == 0


def hits_rate(gpu: Gpu, offsets: list[int], path: str = "readonly") -> float:
    """Cycles per load of four sectors that hit the L1, with many warps."""

    def took(loads: int) -> int:
        one = np.tile(np.array(offsets), (16, loads, 1))
        return cycles_of(sectors(one, warps_per_cta=4, loads_in_flight=8), gpu, path)

    return (took(96) - took(32)) / (16 * 64)


_LAWS = ("l1_timing.num_banks=64", "sm_timing.collector_units=0", "sm_timing.memory_queue=16")


@pytest.mark.parametrize(("limit", "expected"), [(1, 4), (2, 2), (3, 2), (4, 1), (0, 1)])
def test_the_tag_law_looks_up_so_many_lines_a_cycle(limit: int, expected: int) -> None:
    # Four lines, of four banks.
    gpu = one_sm(*_LAWS, f"l1_timing.lines_per_cycle={limit}")
    lines = [0, LINE + 32, 2 * LINE + 64, 3 * LINE + 96]
    assert hits_rate(gpu, lines) == pytest.approx(expected, rel=0.05)
    assert hits_rate(gpu, [0, 32, 64, 96]) == pytest.approx(1, rel=0.05)


@pytest.mark.parametrize(("limit", "expected"), [(32, 4), (64, 2), (128, 1), (0, 1)])
def test_the_data_law_returns_so_many_bytes_a_cycle(limit: int, expected: int) -> None:
    gpu = one_sm(*_LAWS, f"l1_timing.bytes_per_cycle={limit}")
    assert hits_rate(gpu, [0, 32, 64, 96]) == pytest.approx(expected, rel=0.05)


def texels(texture: Texture, num_loads: int, num_warps: int = 16) -> Trace:
    """Warps that load the same 8 x 4 texels again and again."""
    lane = np.arange(32)
    row = pack_texel(0, lane // 8, lane % 8).astype(np.uint32)
    rows = num_warps * num_loads
    chunk = Chunk(
        0,
        0,
        np.arange(num_warps + 1, dtype=np.int64) * num_loads,
        np.zeros(rows, np.uint16),
        np.tile(row, (rows, 1)),
    )
    return from_chunks(
        [chunk], [texture], [Instruction("pass", 0)], [Launch(0, "pass", num_warps // 4, 4)]
    )


@pytest.mark.parametrize(
    ("format", "quads", "expected"),
    # Eight quads; 128-bit texels take four times as long.
    [("RGBA8", 1, 8), ("RGBA8", 2, 4), ("RGBA16F", 2, 4), ("RGBA32F", 2, 16), ("RGBA8", 8, 1)],
)
def test_the_filters_take_so_many_quads_a_cycle(format: str, quads: int, expected: int) -> None:
    gpu = presets.load(
        "titan-x-pascal",
        ["sm.count=1", "l1.units_per_sm=1", "l1.capacity=48KiB", "l1_timing.lines_per_cycle=0",
         "l1_timing.bytes_per_cycle=0", "l1_timing.num_banks=64",
         f"sm_timing.texture_quads_per_cycle={quads}"],
    )  # fmt: skip
    texture = Texture("t", format, 8, 8)

    def rate(path: str) -> float:
        long, short = (cycles_of(texels(texture, n), gpu, path) for n in (48, 16))
        return (long - short) / (16 * 32)

    assert rate("texture") == pytest.approx(expected, rel=0.06)
    # Loads past the filters are not filtered: their sixteen sectors or fewer are a cycle's work.
    assert rate("readonly") < 1.06


# Interconnect ---------------------------------------------------------------------------------


def crossbar(queueing: str, inputs: int, outputs: int) -> tuple[Any, Any]:
    gpu = one_sm(f"icnt.queueing={queueing}")
    machine = build(gpu, "readonly", 1).pool.machine
    return machine[0], new_network(inputs, outputs, 128, 128, 0)


def test_the_crossbar_serves_its_inputs_in_turn() -> None:
    """Four inputs, all for output 0: each is served once before any is served again."""
    machine, net = crossbar("input-fifo", 4, 2)
    for packet in range(5):
        for source in range(4):
            push(machine, net, source, 0, source * 10 + packet, 0, 0)
    order = [packet // 10 for _, packet in taken(machine, net, 30)[0]]
    assert order == [0, 1, 2, 3] * 5


def test_a_blocked_head_blocks_what_is_behind_it_only_in_input_fifos() -> None:
    """Input 1's packet for the idle output 1 stands behind one for the contended output 0."""
    for queueing, latest in (("input-fifo", 4), ("output-queued", 2)):
        machine, net = crossbar(queueing, 2, 2)
        for packet in (1, 2):
            push(machine, net, 0, 0, packet, 0, 0)
        push(machine, net, 1, 0, 11, 0, 0)
        push(machine, net, 1, 1, 12, 0, 0)
        [(cycle, packet)] = taken(machine, net, 20)[1]
        assert packet == 12
        assert (cycle >= 3) == (queueing == "input-fifo") and cycle <= latest


def test_a_full_port_takes_no_packet() -> None:
    machine, net = crossbar("input-fifo", 1, 1)
    packets = 0
    while has_room(machine, net, 0, 0):
        push(machine, net, 0, 0, packets, 0, 0)
        packets += 1
    assert packets == machine["input_packets"]


def test_head_of_line_blocking_costs_bandwidth() -> None:
    """Eight SMs, eight slices, random lines: the heads of FIFOs collide."""
    random = np.random.default_rng(3)
    lines = random.integers(0, 2048, (256, 24, 1)) * 32
    trace = sectors(lines, warps_per_cta=8, loads_in_flight=8)

    def took(queueing: str) -> int:
        gpu = one_sm(
            "sm.count=8", "l1.bypass_loads=true", "l2.num_channels=8", "l2.capacity=1MiB",
            "l2_timing.queue_in=512", f"icnt.queueing={queueing}", "icnt.input_packets=64",
        )  # fmt: skip
        return cycles_of(in_turn(trace, trace), gpu, "global")

    assert took("input-fifo") > 1.15 * took("output-queued")


# Memory ---------------------------------------------------------------------------------------


def dram_of(gpu: Gpu, *offsets: int) -> dict[str, int]:
    return timed(together(*offsets), gpu, "readonly").raw()["dram"]


def test_fr_fcfs_prefers_the_open_row_and_fifo_does_not() -> None:
    row = 1 << 15
    order = (0, row, 32, row + 32)
    assert dram_of(one_sm(), *order) == {
        "reads": 4, "writes": 0, "row_hits": 2, "activates": 2, "precharges": 1,
    }  # fmt: skip
    found = dram_of(one_sm("dram_timing.scheduler=fifo"), *order)
    assert (found["activates"], found["precharges"]) == (4, 3)


def test_banks_work_side_by_side() -> None:
    gpu = one_sm()
    row, bank = 1 << 15, 1 << 12
    same, apart = together(*(row * k for k in range(8))), together(*(bank * k for k in range(8)))
    assert gpu.dram_timing is not None
    least = 6 * (gpu.dram_timing.rc - gpu.dram_timing.rrd)
    assert cycles_of(same, gpu) > cycles_of(apart, gpu) + least


@pytest.mark.parametrize(("queue", "returns"), [(1, 1), (2, 3), (8, 4)])
def test_credits_bound_what_a_channel_has_in_flight(queue: int, returns: int) -> None:
    gpu = one_sm(f"dram_timing.queue={queue}", f"dram_timing.return_queue={returns}")
    most = 0
    for state in stepped(sectors(np.arange(64).reshape(1, 16, 4) * 32, loads_in_flight=16), gpu):
        channel = state.memory.channels[0]
        held = int(channel["shared_credit"]) + int(channel["private_credit"].sum())
        most = max(most, held)
        assert held <= queue + returns + 1
    # One credit of the slice's own, the others shared.
    assert most == queue + returns + 1


def test_a_write_back_belongs_to_the_pass_that_wrote() -> None:
    """Pass `writes` stores a texture; `reads` sweeps it out of a small L2."""
    written, read = Texture("written", "RGBA8", 64, 8), Texture("read", "RGBA8", 256, 256)
    gpu = one_sm("l2.capacity=2KiB", "l2.ways=4", "l2.set_hash=linear")
    instructions = [Instruction("writes", 0, "store"), Instruction("reads", 1)]
    chunks = []
    for number, texture in enumerate((written, read)):
        at = np.arange(texture.width * texture.height, dtype=np.int64)
        lanes = pack_texel(0, at // texture.width, at % texture.width).astype(np.uint32)
        rows = len(at) // 32
        offsets = np.arange(rows + 1, dtype=np.int64)
        chunks.append(
            Chunk(number, 0, offsets, np.full(rows, number, np.uint16), lanes.reshape(-1, 32))
        )
    launches = [
        Launch(0, name, chunk.num_warps, 1)
        for name, chunk in zip(("writes", "reads"), chunks, strict=True)
    ]
    trace = from_chunks(chunks, [written, read], instructions, launches)
    report = simulate(trace, gpu, fetch_path="readonly", layout="row-major", timing=True)
    parts = {part.pass_name: part for part in report.parts or ()}
    assert parts["writes"].counters["l2"].writebacks == 64 * 8 * 4 // 32
    assert parts["reads"].counters["l2"].writebacks == 0
    assert parts["writes"].dram.sectors_written == 64 and parts["reads"].dram.sectors_written == 0
    assert parts["reads"].dram.sectors_read == 256 * 256 * 4 // 32


# Schedulers, units, residency -----------------------------------------------------------------

#: One scheduler without operand collectors, so that a test sees each issue.
_PLAIN = (
    "sm.count=1", "sm_timing.num_schedulers=1", "sm_timing.launch_cycles=0",
    "sm_timing.issue_per_warp=1",
)  # fmt: skip


def issue_order(gpu: Gpu, trace: Trace) -> list[int]:
    """Warp slot of every issue, in order."""
    order, before = [], 0
    for state in stepped(trace, gpu):
        issued = int(state.issued.sum())
        assert issued - before <= 1
        if issued > before:
            order.append(int(state.sms[0]["last_issued"][0]))
        before = issued
    return order


def test_gto_stays_with_a_warp_and_lrr_goes_round() -> None:
    trace = program([], 3, 3, trailing=(("fp32", 6),))
    gto = issue_order(presets.load("titan-x-pascal", [*_PLAIN, "sm_timing.scheduler=gto"]), trace)
    lrr = issue_order(presets.load("titan-x-pascal", [*_PLAIN, "sm_timing.scheduler=lrr"]), trace)
    # Three independent chains a warp: greedy until the fourth must wait.
    assert gto[:6] == [0, 0, 0, 1, 1, 1]
    assert lrr[:9] == [0, 1, 2] * 3
    # Six instructions and the exit of each.
    assert sorted(gto) == sorted(lrr) == [0] * 7 + [1] * 7 + [2] * 7


def most_issued(trace: Trace, *overrides: str) -> int:
    """The most instructions issued in one cycle."""
    gpu = presets.load("titan-x-pascal", [*_PLAIN, *overrides])
    most = before = 0
    for state in stepped(trace, gpu):
        issued = int(state.issued.sum())
        most, before = max(most, issued - before), issued
    return most


def test_dual_issue_takes_two_instructions_of_different_units() -> None:
    # A load needs its address, not the sum before it.
    pairs = program([(load(("fp32", 1)), 32 * k) for k in range(8)], 4, 4)
    assert most_issued(pairs, "sm_timing.issue_per_warp=1") == 1
    assert most_issued(pairs, "sm_timing.issue_per_warp=2") == 2
    # Of one unit only one, although neighbours of a run are independent.
    one_unit = program([], 4, 4, trailing=(("fp32", 16),))
    assert most_issued(one_unit, "sm_timing.issue_per_warp=2") == 1


def resident(trace: Trace, gpu: Gpu) -> int:
    """The most warps an SM held at once."""
    return max(int(state.sms["num_resident"].max()) for state in stepped(trace, gpu))


@pytest.mark.parametrize(
    ("launch", "expected"),
    [
        ({}, 64),
        # 65536 registers: 128 of each of 32 threads x 4 warps are 16384 a CTA.
        ({"registers_per_thread": 128}, 16),
        ({"registers_per_thread": 32}, 64),
        # 96 KiB of shared memory.
        ({"shared_bytes_per_cta": 32 << 10}, 12),
        ({"registers_per_thread": 128, "shared_bytes_per_cta": 48 << 10}, 8),
    ],
)
def test_registers_and_shared_memory_bound_the_ctas_of_an_sm(
    launch: dict[str, int], expected: int
) -> None:
    trace = program([(load(), 0)], 96, 4, trailing=(("wait", 0), ("fp32", 4)), **launch)
    assert resident(trace, one_sm()) == expected


def test_max_ctas_and_max_warps_bound_the_ctas_of_an_sm() -> None:
    trace = program([(load(), 0)], 96, 4, trailing=(("wait", 0),))
    assert resident(trace, one_sm("sm.max_ctas=3")) == 12
    assert resident(trace, one_sm("sm.max_warps=20")) == 20


def test_each_cta_pays_its_launch() -> None:
    trace = program([], 4, 1)
    base = cycles_of(trace, one_sm("sm.max_ctas=1"))
    slow = cycles_of(trace, one_sm("sm.max_ctas=1", "sm_timing.cta_launch_cycles=100"))
    assert slow - base == 400


# Stalls and their detector --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("where", "field", "told"),
    [
        ("l2", "queue_down", r"l2\.in \d+ \(instance 0\)"),
        ("l2", "queue_out", r"l2\.in \d+"),
        ("l2", "queue_fill", r"dram \d+ \(channel 0\)"),
        ("machine", "dram_queue", r"l2\.down \d+"),
        ("machine", "ejection", r"reply network out \d+"),
        ("machine", "response", r"replies at SMs \d+"),
        ("l1", "num_mshrs", r"l1 banks \d+"),
        ("l1", "miss_queue", r"l1 banks \d+"),
    ],
)
def test_a_machine_that_cannot_move_names_the_queue(where: str, field: str, told: str) -> None:
    clock = Clock(single_lane([[0, 64]]), one_sm(), "readonly")
    if where == "machine":
        clock.state.pool.machine[0][field] = 0
    else:
        getattr(clock.state, where).level[0][field] = 0
    with pytest.raises(WorkError, match=rf"the timing model is stuck: cycle \d+, .*{told}"):
        for chunk in single_lane([[0, 64]]).chunks():
            clock.add(chunk)
        clock.finish()


def test_a_long_computation_is_not_a_deadlock() -> None:
    clock = timed(program([], trailing=(("fp32", 400_000),)), one_sm())
    assert clock.launches[0].warp_instructions["fp32"] == 400_000
    assert clock.cycles > 400_000


def test_a_gpu_without_timing_tables_is_refused_by_name() -> None:
    gpu = one_sm().model_copy(update={"icnt": None, "l2_timing": None})
    with pytest.raises(InputError, match="timing needs the tables icnt, l2_timing"):
        Clock(single_lane([[0]]), gpu)


# Reports --------------------------------------------------------------------------------------


class FakeTimeline:
    def __init__(self) -> None:
        self.events: list[tuple[str, str, int, int, str]] = []
        self.counters: list[tuple[str, int, float]] = []

    def event(self, name: str, category: str, start: int, duration: int, track: str) -> None:
        self.events.append((name, category, start, duration, track))

    def counter(self, name: str, cycle: int, value: float) -> None:
        self.counters.append((name, cycle, value))


def test_a_timeline_is_told_every_launch_and_what_went_on() -> None:
    timeline = FakeTimeline()
    gpu = one_sm("sm_timing.launch_cycles=700")
    part = single_lane(np.arange(64).reshape(16, 4) * 64)
    clock = timed(in_turn(part, part), gpu, "readonly", timeline=timeline)
    first, second = clock.launches
    kernels = [event for event in timeline.events if event[4] == "kernels"]
    assert [event[2:4] for event in kernels] == [
        (0, 700),
        (700, first.cycles - 700),
        (first.cycles, 700),
        (first.cycles + 700, second.cycles - 700),
    ]
    names = {name for name, _, _ in timeline.counters}
    assert {"instructions per cycle", "L1 sectors per cycle", "resident warps"} <= names
    cycles = [cycle for name, cycle, _ in timeline.counters if name == "resident warps"]
    assert cycles == sorted(cycles) and max(cycles) <= clock.cycles
    # The timeline changes nothing.
    assert clock.launches == timed(in_turn(part, part), gpu, "readonly").launches


def test_gpgpusims_outcomes_add_up_to_the_reports_accesses() -> None:
    trace = single_lane(np.random.default_rng(2).integers(0, 256, (32, 8)) * 16, loads_in_flight=4)
    report = simulate(trace, one_sm(), fetch_path="readonly", timing=True)
    assert report.gpgpusim is not None
    for level in ("l1", "l2"):
        raw, counted = report.gpgpusim[level], report.counters[level]
        misses = raw["MISS"] + raw["SECTOR_MISS"]
        assert raw["HIT"] + raw["HIT_RESERVED"] + misses == counted.accesses
        # Facts sheet 4: what an L1 sends down.
        assert counted.reads_down == misses + raw["HIT_RESERVED"] - raw["MSHR_HIT"]
    assert report.gpgpusim["sm"]["gpu_sim_cycle"] == report.cycles["total"]  # type: ignore[index]
    assert not any(held_in(timed(trace, one_sm(), "readonly")).values())


# ---- packets of several sectors


def test_a_slice_that_gets_sectors_faster_than_it_looks_them_up_loses_none() -> None:
    """A texture line is four sectors of the L2: each packet is four look-ups, one a cycle."""
    gpu = one_sm("sm.count=8")
    trace = gather(Texture("t", "RGBA8", 128, 128), 256, 4, seed=1)
    clock = Clock(trace, gpu, "texture")
    before = clock.state.l2.delay.shape[1]
    for chunk in trace.chunks():
        clock.add(chunk)
    clock.finish()
    state = clock.state
    assert state.l2.delay.shape[1] > before  # else the test shows nothing
    misses = outcomes(trace, gpu, "l1", "texture")["MISS"]
    assert state.l2.counters[:, ACCESSES].sum() == 4 * misses
    assert state.pool.machine[0]["in_flight"] == 0
    # Every cycle looks up one sector: the slice is the bound, and nothing waits for long.
    cycles = clock.cycles - state.pool.machine[0]["launch_cycles"]
    assert 4 * misses < cycles < 1.2 * 4 * misses + 2000
