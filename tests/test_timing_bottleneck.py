"""The bottleneck that a run names is the resource that makes it faster when there is more of it."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from timing_machines import sectors, timed

from cachesim import presets
from cachesim.timing.results import PassTiming, TimingResult
from experiments.timing_tables import notes

KIB = 1 << 10
GPU = "quadro-p4000"
#: Bottleneck: the bytes that random reads go to, the field that binds, and twice as much of it.
CASES = {
    # One 32 B sector of a row: what memory does is open rows, a fifth of its bus is used.
    "dram": (32 << 20, "dram_timing.rrd=10", "dram_timing.rrd=5"),
    "l1_reservation": (96 * KIB, "l1_timing.num_mshrs=4", "l1_timing.num_mshrs=8"),
    "interconnect": (96 * KIB, "icnt.flit_bytes=8", "icnt.flit_bytes=16"),
    "l2": (96 * KIB, "l2_timing.clock_hz=185000000", "l2_timing.clock_hz=370000000"),
}


@functools.cache
def reads(footprint_bytes: int, *overrides: str) -> PassTiming:
    """Every warp reads eight times four random sectors at once."""
    numbers = np.random.default_rng(1).integers(0, footprint_bytes // 32, size=(14 * 32, 8, 4))
    trace = sectors(numbers * 32, warps_per_cta=8, loads_in_flight=8)
    return timed(trace, presets.load(GPU, overrides), "readonly").timing_result().total


def running(part: PassTiming) -> int:
    return part.cycles - part.launch_cycles


@pytest.mark.parametrize("named", CASES)
def test_what_is_named_is_what_binds(named: str) -> None:
    footprint, scarce, twice = CASES[named]
    before = reads(footprint, scarce)
    assert before.bottleneck == named
    assert running(reads(footprint, twice)) < 0.62 * running(before)


@pytest.mark.parametrize("named", ["dram", "interconnect"])
def test_full_mshrs_are_not_the_bottleneck_where_requests_queue_behind_them(named: str) -> None:
    """Twice as many fill up, too: accesses are refused as before, and nothing is faster."""
    footprint, scarce, _ = CASES[named]
    before = reads(footprint, scarce)
    more = reads(footprint, scarce, "l1_timing.num_mshrs=256")
    assert abs(running(more) / running(before) - 1) < 0.02
    assert more.bottleneck == before.bottleneck == named


def test_memory_that_opens_a_row_for_each_sector_says_so() -> None:
    part = reads(*CASES["dram"][:2])
    opened = part.levels["dram"].bytes / part.rows_opened
    assert 32 <= opened < 36 and (part.utilisation("dram") or 1) < 0.25
    told = " ".join(notes(TimingResult(1_480_000_000, (part,)), presets.load(GPU)))
    assert f"A row was opened for every {opened:.0f} B." in told
