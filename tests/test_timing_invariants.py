"""What holds for any trace on any machine: the counting model's accesses, nothing lost, the same
result again, and time that only grows with latencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import strategies
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from timing_machines import BASE, GPGPUSIM, held_in, in_turn, load, program, single_lane, timed

from cachesim import presets, simulate, simulate_all
from cachesim.config import Gpu
from cachesim.report import Report
from cachesim.timing.clock import Clock
from traces.errors import InputError
from traces.oracle_traces import oracle_trace
from traces.texture import INACTIVE_ADDRESS, Texture
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

EXAMPLES = settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)

_SMALL_L2 = ("l2.num_channels=2", "l2.capacity=64KiB")
#: Machines of every kind, cut down so that their caches overflow: (preset, overrides).
MACHINES: dict[str, tuple[str, tuple[str, ...]]] = {
    "gpgpusim": (GPGPUSIM, ("sm.count=3", "l2.num_channels=2", "l2.capacity=512KiB")),
    "gpgpusim with an L1": (
        GPGPUSIM,
        ("sm.count=2", "l2.num_channels=2", "l2.capacity=512KiB", "l1.bypass_loads=false",
         "l1.capacity=2KiB", "l1.ways=4", "l1_timing.num_mshrs=4", "l1_timing.mshr_merge=2",
         "l1_timing.miss_queue=4"),
    ),
    "rtx 2060": (
        "rtx-2060-gpgpusim",
        ("sm.count=2", "l2.num_channels=2", "l2.capacity=512KiB", "l1.capacity=4KiB", "l1.ways=8",
         "l1_timing.num_mshrs=8"),
    ),
    "titan x": ("titan-x-pascal", ("sm.count=2", "l2.num_channels=3", "l2.capacity=768KiB")),
    "wave64": (
        "rx-5700-xt",
        ("sm.count=11", "l2.capacity=64KiB", "sm.warp_size=64", "gl1.capacity=4KiB", "gl1.ways=4",
         "gl1.set_hash=linear"),
    ),
    "last-level cache": (
        "rx-6900-xt",
        ("sm.count=11", "l2.capacity=32KiB", "llc.capacity=64KiB", "l2_timing.num_mshrs=8"),
    ),
    "fifo replacement": (
        "titan-x-pascal",
        ("sm.count=2", "l2.num_channels=2", "l2.capacity=512KiB", "l1.replacement=fifo",
         "l2.replacement=fifo", "l1.capacity=1KiB", "l1.ways=4"),
    ),
    "slow memory": (
        GPGPUSIM,
        ("sm.count=4", "l2.num_channels=1", "l2.capacity=256KiB", "dram_timing.queue=2",
         "dram_timing.return_queue=1", "dram_timing.scheduler=fifo", "l2_timing.queue_in=8",
         "l2_timing.queue_fill=1", "l2_timing.queue_out=1", "l2_timing.queue_down=1",
         "icnt.input_packets=1", "icnt.output_packets=1", "icnt.ejection_packets=1",
         "icnt.response_packets=1", "l2_timing.num_mshrs=2", "l2_timing.mshr_merge=1",
         "l2_timing.port_bytes=4"),
    ),
}  # fmt: skip


def machine_of(name: str) -> Gpu:
    preset, overrides = MACHINES[name]
    return presets.load(preset, list(overrides))


def accesses(report: Report) -> Any:
    """What both models must agree on: of the whole trace, and of every pass, texture and mip."""
    first = report.levels[0]

    def of(counters: Any) -> tuple[int, ...]:
        one = counters[first]
        return one.accesses, one.requests, one.writes, one.bypasses, one.bypassed_writes

    parts = {
        (part.pass_name, part.texture, part.mip): (part.lane_fetches, *of(part.counters))
        for part in report.parts or ()
        if any((part.lane_fetches, *of(part.counters)))
    }
    return report.num_rows, report.lane_fetches, of(report.counters), parts


def assert_idle(clock: Clock) -> None:
    """Nothing is held anywhere, and every request of the pool is free exactly once."""
    assert clock.drain() == 0
    assert {name: held for name, held in held_in(clock).items() if held} == {}
    pool = clock.state.pool
    assert int(pool.machine[0]["free_top"]) == len(pool.free) == len(pool.requests)
    assert np.array_equal(np.sort(pool.free), np.arange(len(pool.free)))


def assert_agrees(trace: Trace, gpu: Gpu, path: str | None) -> None:
    counted, with_clock = simulate_all(
        trace, [gpu, gpu], fetch_path=path, timing=[False, True], threaded=False
    )
    with_clock.check()
    assert accesses(with_clock) == accesses(counted)


@pytest.mark.parametrize("name", MACHINES)
@given(data=st.data())
@EXAMPLES
def test_the_clock_sees_the_counting_models_accesses_and_ends_empty(name: str, data: Any) -> None:
    gpu = machine_of(name)
    trace = data.draw(strategies.traces(6))
    paths = ["readonly", "global"] + ([] if trace.is_lane_address else ["texture"])
    path = data.draw(st.sampled_from(paths))
    assert_agrees(trace, gpu, path)
    clock = timed(trace, gpu, path)
    assert_idle(clock)
    for one in clock.launches:
        assert sum(one.where.values()) == one.cycles
        assert min(one.where.values()) >= 0
        # A slot issues an instruction, or several of one warp; a share is rounded to a cycle.
        assert gpu.sm_timing is not None
        schedulers = gpu.sm.count * gpu.sm_timing.num_schedulers
        num_issued = sum(one.warp_instructions.values())
        used = one.where["issue"] * schedulers
        fewest = num_issued / gpu.sm_timing.issue_per_warp
        assert fewest - schedulers <= used <= num_issued + schedulers


def cut(trace: Trace, ctas_per_chunk: int) -> Trace:
    """The same trace in chunks of other sizes."""
    chunks = []
    for chunk in trace.chunks():
        warps = trace.launches[chunk.launch].warps_per_cta
        for first in range(0, chunk.num_warps, ctas_per_chunk * warps):
            last = min(first + ctas_per_chunk * warps, chunk.num_warps)
            begin, end = chunk.warp_offsets[first], chunk.warp_offsets[last]
            chunks.append(
                Chunk(
                    chunk.launch,
                    chunk.first_cta + first // warps,
                    chunk.warp_offsets[first : last + 1] - begin,
                    chunk.instruction[begin:end],
                    chunk.lanes[begin:end],
                )
            )
    return from_chunks(
        chunks, trace.textures, trace.instructions, trace.launches, dict(trace.manifest)
    )


def outcome(trace: Trace, gpu: Gpu) -> tuple[Any, ...]:
    report = simulate(trace, gpu, timing=True)
    return report.cycles, report.gpgpusim, {n: c.to_json() for n, c in report.counters.items()}


@pytest.mark.parametrize("name", ["gpgpusim", "gpgpusim with an L1", "wave64"])
@given(data=st.data())
@EXAMPLES
def test_the_result_is_the_same_again_and_for_any_chunks(name: str, data: Any) -> None:
    gpu = machine_of(name)
    trace = data.draw(strategies.traces(5))
    if not any(launch.num_ctas for launch in trace.launches):
        return
    whole = outcome(trace, gpu)
    assert outcome(trace, gpu) == whole
    assert outcome(cut(trace, data.draw(st.integers(1, 3))), gpu) == whole


def test_a_long_launch_in_small_chunks_is_the_launch_in_one() -> None:
    """More CTAs than the machine holds, whose places are taken in the same order."""
    random = np.random.default_rng(5)
    trace = single_lane(random.integers(0, 1 << 14, (400, 3)) * 4, warps_per_cta=4)
    gpu = machine_of("gpgpusim with an L1")
    whole = outcome(trace, gpu)
    for size in (1, 7, 99):
        assert outcome(cut(trace, size), gpu) == whole


#: Fields that are latencies, in core or command cycles.
LATENCIES = (
    "sm_timing.int_latency_cycles", "sm_timing.fp32_latency_cycles", "l1_timing.latency_cycles",
    "icnt.request_latency_cycles", "icnt.reply_latency_cycles", "l2_timing.latency_cycles",
    "dram_timing.fixed_latency_cycles", "dram_timing.rcd", "dram_timing.rp", "dram_timing.cl",
    "sm_timing.cta_launch_cycles", "sm_timing.launch_cycles", "sm_timing.result_cycles",
    "sm_timing.memory_cycles",
)  # fmt: skip
#: Nothing to wait for but latencies: wide ports, long queues, caches that hold everything.
UNLIMITED = (
    "sm.count=2", "l1_timing.num_banks=64", "l1_timing.num_mshrs=4096", "l1_timing.mshr_merge=4096",
    "l1_timing.miss_queue=4096", "l1_timing.bytes_per_cycle=0", "l1_timing.lines_per_cycle=0",
    "l1_timing.fill_bytes_per_cycle=4096", "sm_timing.memory_queue=64",
    "sm_timing.issue_per_warp=1", "sm_timing.texture_quads_per_cycle=0",
    "l2_timing.port_bytes=4096", "l2_timing.num_mshrs=4096", "l2_timing.mshr_merge=4096",
    "l2_timing.miss_queue=4096", "l2_timing.queue_in=4096", "l2_timing.queue_down=4096",
    "l2_timing.queue_fill=4096", "l2_timing.queue_out=4096", "icnt.flit_bytes=4096",
    "icnt.output_packets=4096", "icnt.ejection_packets=4096", "icnt.response_packets=4096",
    "dram_timing.queue=4096", "dram_timing.return_queue=4096",
)  # fmt: skip


@pytest.mark.parametrize("field", LATENCIES)
@given(data=st.data())
@settings(parent=EXAMPLES, max_examples=5)
def test_cycles_never_fall_when_a_latency_is_raised(field: str, data: Any) -> None:
    """One warp per scheduler: two that compete may swap places for the better."""
    sectors = data.draw(
        st.lists(st.lists(st.integers(0, 4095), min_size=4, max_size=4), min_size=1, max_size=4)
    )
    trace = single_lane(
        np.array(sectors) * 32,
        warps_per_cta=len(sectors),
        loads_in_flight=data.draw(st.integers(1, 4)),
        compute_per_load=data.draw(st.integers(0, 7)),
    )
    gpu = presets.load("titan-x-pascal", list(UNLIMITED))
    table, _, name = field.partition(".")
    took = -1
    for more in (0, 1, 7, 40):
        value = getattr(getattr(gpu, table), name) + more
        if name in ("result_cycles", "memory_cycles") and value > 64:
            break
        cycles = timed(trace, presets.with_fields(gpu, {field: value}), "readonly").cycles
        assert cycles >= took, more
        took = cycles


# Write policies -------------------------------------------------------------------------------

_ALLOCATES = ("none", "write-allocate", "fetch-on-write", "lazy-fetch-on-read")
#: (write_policy, write_allocate, allocation) of an L1 and of an L2 that the machine accepts.
L1_POLICIES = [
    (policy, allocate, allocation)
    for policy in ("write-through", "write-evict", "local-write-back")
    for allocate in ("none", "lazy-fetch-on-read")
    for allocation in ("on-miss", "on-fill", "streaming")
    if allocation == "on-miss" or allocate == "none"
]
L2_POLICIES = [("write-back", allocate) for allocate in _ALLOCATES]


def mixed(seed: int, operations: Sequence[str], access_bytes: int, masked: float) -> Trace:
    """Two launches of random accesses to a few KiB, some lanes or whole accesses masked."""
    random = np.random.default_rng(seed)
    instructions = [
        Instruction(name, -1, operation, access_bytes=access_bytes)
        for name in ("first", "second")
        for operation in operations
    ]
    chunks = []
    for number in range(2):
        warps, rows = 12, 6
        base = random.integers(0, 1 << 13, (warps * rows, 1)) & ~31
        lanes = BASE + (base + random.integers(0, 256, (warps * rows, 32))) // access_bytes * (
            access_bytes
        )
        lanes = lanes.astype(np.uint64)
        lanes[random.random(lanes.shape) < masked] = INACTIVE_ADDRESS
        lanes[random.random(warps * rows) < masked / 4] = INACTIVE_ADDRESS
        index = number * len(operations) + random.integers(0, len(operations), warps * rows)
        chunks.append(
            Chunk(
                number, 0, np.arange(warps + 1, dtype=np.int64) * rows, index.astype(np.uint16),
                lanes,
            )
        )  # fmt: skip
    launches = [Launch(0, name, 6, 2) for name in ("first", "second")]
    return from_chunks(chunks, [], instructions, launches)


@pytest.mark.parametrize(("policy", "allocate", "allocation"), L1_POLICIES)
def test_every_write_policy_of_the_l1_keeps_the_laws(
    policy: str, allocate: str, allocation: str
) -> None:
    gpu = presets.load(
        GPGPUSIM,
        ["sm.count=2", "l2.num_channels=2", "l2.capacity=512KiB", "l1.bypass_loads=false",
         "l1.capacity=1KiB", "l1.ways=4", f"l1.write_policy={policy}",
         f"l1.write_allocate={allocate}", f"l1_timing.allocation={allocation}",
         "l1_timing.num_mshrs=6"],
    )  # fmt: skip
    for seed, size in ((1, 1), (2, 4), (3, 8)):
        trace = mixed(seed, ("load", "store"), size, 0.3)
        assert_agrees(trace, gpu, "readonly")
        assert_idle(timed(trace, gpu, "readonly"))


@pytest.mark.parametrize(("policy", "allocate"), L2_POLICIES)
def test_every_write_policy_of_the_l2_keeps_the_laws(policy: str, allocate: str) -> None:
    for path in ("readonly", "global"):
        gpu = presets.load(
            GPGPUSIM,
            ["sm.count=2", "l2.num_channels=2", "l2.slices_per_channel=1", "l2.capacity=2KiB",
             "l2.ways=4", "l2.set_hash=linear", f"l2.write_policy={policy}",
             f"l2.write_allocate={allocate}", "l2_timing.num_mshrs=6"],
        )  # fmt: skip
        for seed, size in ((1, 1), (2, 4), (3, 16)):
            trace = mixed(seed, ("load", "store", "atomic"), size, 0.3)
            assert_agrees(trace, gpu, path)
            assert_idle(timed(trace, gpu, path))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("l1.write_allocate=fetch-on-write", "l1.write_allocate = 'fetch-on-write'"),
        ("l1.write_allocate=write-allocate", "l1.write_allocate = 'write-allocate'"),
        ("l2.write_policy=write-through", "l2.write_policy = 'write-through'"),
        ("l1.replacement=srrip", "l1.replacement = 'srrip'"),
        ("l2_timing.miss_queue=1", "l2_timing.miss_queue = 1"),
    ],
)
def test_what_the_clock_cannot_run_is_refused_in_one_line(override: str, message: str) -> None:
    gpu = presets.load(GPGPUSIM, ["l1_timing.allocation=on-miss", override])
    with pytest.raises(InputError, match=message) as error:
        simulate(oracle_trace("chase"), gpu, timing=True)
    assert "\n" not in str(error.value)


def test_stores_of_single_bytes_keep_the_laws_on_every_machine() -> None:
    for name in MACHINES:
        trace = mixed(7, ("store", "load"), 1, 0.9)
        assert_agrees(trace, machine_of(name), "readonly")
        assert_idle(timed(trace, machine_of(name), "readonly"))


# Odd launches ---------------------------------------------------------------------------------


def test_fully_masked_accesses_end_without_traffic() -> None:
    steps = [(load(num_outstanding=0), -1), (load(operation="store"), -1), (load(), -1)]
    for name in MACHINES:
        gpu = machine_of(name)
        report = simulate(program(steps, 4, 2), gpu, fetch_path="readonly", timing=True)
        assert report.counters["l1"].presented == 0 and report.dram.bytes == 0
        assert report.cycles is not None
        issued = report.cycles["warp_instructions"]
        # A wave of 64 lanes takes two warps' rows at once.
        assert issued["memory"] == report.num_rows == (12 if gpu.sm.warp_size == 32 else 6)


def test_warps_without_accesses_exit() -> None:
    gpu = machine_of("gpgpusim")
    clock = timed(program([], 64, 4), gpu)
    assert_idle(clock)
    assert clock.launches[0].warp_instructions["control"] == 64
    assert clock.launches[0].warp_instructions["memory"] == 0


def test_launches_without_ctas_take_nothing() -> None:
    gpu = machine_of("gpgpusim")
    one = single_lane([[0, 64]])
    empty = Launch(0, "none", 0, 4)
    chunks = [replace(chunk, launch=1) for chunk in one.chunks()]
    trace = from_chunks(chunks, [], one.instructions, [empty, one.launches[0], empty])
    assert timed(trace, gpu).cycles == timed(one, gpu).cycles
    nothing = from_chunks([], [], one.instructions, [empty])
    report = simulate(nothing, gpu, timing=True)
    assert report.cycles is not None and report.cycles["total"] == 0 and report.time_ms == 0


def test_launches_in_a_row_wait_for_each_other() -> None:
    gpu = machine_of("gpgpusim with an L1")
    part = single_lane([[0, 64, 128], [32, 96, 4096]], warps_per_cta=2)
    clock = timed(in_turn(part, part, part), gpu)
    assert_idle(clock)
    first, second, third = (one.cycles for one in clock.launches)
    # The second finds its lines in the L2, but not in the L1, which a launch leaves empty.
    assert third == second < first
    l1 = clock.raw()["l1"]
    assert l1["HIT"] == 0


def test_padding_warps_are_not_charged() -> None:
    """Five warps in CTAs of four: three warps of the second CTA are not there."""
    gpu = machine_of("gpgpusim")
    trace = single_lane(np.arange(5)[:, None] * 128, warps_per_cta=4, compute_per_load=2)
    assert trace.manifest["padding_warps"] == 3
    issued = timed(trace, gpu).launches[0].warp_instructions
    assert issued == {"int": 5, "fp32": 10, "sfu": 0, "control": 5, "memory": 5}


def test_addresses_at_the_end_of_the_space_are_like_any_others() -> None:
    """The line numbers of the highest addresses must not be mistaken for marks."""
    top = (1 << 64) - (1 << 16)
    for base in (0, BASE, top):
        lanes = np.full((64, 32), INACTIVE_ADDRESS, np.uint64)
        lanes[:, 0] = np.uint64(base) + np.arange(64, dtype=np.uint64) * np.uint64(1024 - 32)
        lanes[63, 0] = np.uint64(base) + np.uint64((1 << 16) - 8)
        chunk = Chunk(0, 0, np.arange(65, dtype=np.int64), np.zeros(64, np.uint16), lanes)
        twice = [chunk, replace(chunk, launch=1)]
        trace = from_chunks(twice, [], [load()], [Launch(0, "pass", 64, 1)] * 2)
        gpu = presets.load(GPGPUSIM, ["sm.count=2", "l1.bypass_loads=false"])
        clock = timed(trace, gpu)
        assert_idle(clock)
        assert clock.raw()["l2"]["HIT"] == 64
        assert clock.raw()["dram"]["reads"] == 64


def test_textures_go_through_every_path() -> None:
    texture = Texture("t", "RGBA16F", 64, 32, 2)
    from traces.synthetic import gather, pixel_pass

    for name in MACHINES:
        gpu = machine_of(name)
        for path in ("texture", "readonly", "global"):
            for trace in (pixel_pass(texture), pixel_pass(texture, "store"), gather(texture, 4, 3)):
                assert_agrees(trace, gpu, path)
