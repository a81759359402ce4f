"""Tables of a timed run: shares that sum to one, rates at the clock, the bottleneck in one line."""

import dataclasses
import math

import pandas as pd
import pytest
from timing_samples import CLOCK_HZ, one_pass, timing_result

from cachesim import presets
from cachesim.timing.results import REASONS, LevelTiming
from experiments.adaptive_tables import demand_table, findings
from experiments.adaptive_vs_fixed import ratio_frame, timing_totals
from experiments.demo import machines_to_time
from experiments.tables import cells, print_table
from experiments.timing_tables import (
    REASON_HEADINGS,
    REASON_NAMES,
    bandwidth_table,
    bottleneck_line,
    comparison_notes,
    cycles_table,
    issue_slots_used,
    timing_refusal,
    where_table,
)

GPU = presets.load("titan-x-pascal-gpgpusim")
PASSES = ("setup", "prefilter", "sampling", "update", "combine")


def whole_frame():
    return timing_result(*(one_pass(name, scale=i + 1) for i, name in enumerate(PASSES)))


def test_every_reason_has_a_heading_and_a_name() -> None:
    assert set(REASON_HEADINGS) == set(REASON_NAMES) == set(REASONS)


def test_the_shares_of_every_row_sum_to_all_of_its_cycles() -> None:
    frame = where_table(whole_frame(), GPU).frame
    assert list(frame["pass"]) == [*PASSES, "total"]
    assert frame.drop(columns="pass").sum(axis=1).to_list() == pytest.approx([100.0] * 6)


def test_the_last_row_is_the_total() -> None:
    frame = cycles_table(whole_frame(), GPU).frame
    assert frame["cycles"].iloc[-1] == frame["cycles"].iloc[:-1].sum() == 15 * 10_000 + 5 * 1000
    assert frame["num_launches"].iloc[-1] == 5


def test_cycles_are_milliseconds_at_the_presets_clock() -> None:
    frame = cycles_table(timing_result(), GPU).frame
    assert frame["time_ms"].iloc[0] == pytest.approx(11_000 / CLOCK_HZ * 1000)


def test_a_reason_without_cycles_takes_no_column() -> None:
    columns = where_table(timing_result(), GPU).frame.columns
    assert "dram" in columns and "l1_reservation" not in columns


def test_one_pass_is_one_row_that_is_the_total() -> None:
    assert list(cycles_table(timing_result(), GPU).frame["pass"]) == ["total"]


def test_the_bottleneck_is_one_line_with_its_share_and_the_busiest_level() -> None:
    line = bottleneck_line(one_pass())
    # 4000 of 10,000 cycles without the launch; 240,000 B of 320,000 B.
    assert line == (
        "Bottleneck: DRAM, 40% of the cycles without launches; busiest DRAM at 75% of peak."
    )
    told = f"DRAM: {REASONS['dram']}. Instructions issued in 15% of the schedulers' cycles."
    assert where_table(timing_result(), GPU).notes == (line, told)


@pytest.mark.parametrize("reason", REASONS)
def test_the_bottleneck_takes_one_line_of_a_hundred_columns(reason: str) -> None:
    part = one_pass(where={reason: 11_000})
    assert len(bottleneck_line(part)) <= 100


def test_a_run_of_launches_alone_is_bound_by_them() -> None:
    empty = one_pass(cycles=1000, where={"launch": 1000}, resident_warp_cycles=0, sm_cycles=0)
    quiet = dataclasses.replace(empty, levels={"l1": LevelTiming(0, 512_000, 0, 0)})
    assert bottleneck_line(quiet).startswith("Bottleneck: launch, 100% of the cycles; busiest")
    for table in (cycles_table, where_table, bandwidth_table):
        assert len(cells(table(timing_result(quiet), GPU))) == 1


def test_passes_with_another_bottleneck_are_named() -> None:
    where = {"issue": 4000, "l2": 5000, "dram": 1000, "launch": 1000}
    result = timing_result(one_pass("setup", where=where), one_pass("sampling", scale=4))
    told = where_table(result, GPU).notes
    assert told[0].startswith("Bottleneck: DRAM")
    assert "In pass setup it is L2, 50%." in told
    assert not any("sampling" in line for line in told)


@pytest.mark.parametrize(("issued", "bound"), [(7900, "dram"), (8100, "issue")])
def test_issue_is_the_bottleneck_from_four_fifths_of_the_slots_on(issued: int, bound: str) -> None:
    where = {"issue": issued, "dram": 10_000 - issued, "launch": 1000}
    assert one_pass(where=where).bottleneck == bound


def test_issue_slots_used_counts_every_slot_of_every_scheduler() -> None:
    part = one_pass()
    # 6000 instructions in 40,000 SM-cycles of four schedulers with two slots each.
    assert issue_slots_used(part, GPU) == pytest.approx(6000 / (40_000 * 4 * 2))


def test_achieved_bandwidth_is_bytes_over_the_time_without_launches() -> None:
    frame = bandwidth_table(timing_result(), GPU).frame.set_index("level")
    # 10,000 cycles at 1 GHz are 10 us.
    assert frame["achieved_gb_per_s"].to_dict() == pytest.approx(
        {"L1": 100.0, "L2": 40.0, "DRAM": 24.0}
    )
    assert frame["peak_gb_per_s"].to_dict() == pytest.approx(
        {"L1": 512.0, "L2": 128.0, "DRAM": 32.0}
    )
    ratio = frame["achieved_gb_per_s"] / frame["peak_gb_per_s"]
    assert frame["utilisation"].to_list() == pytest.approx(ratio.to_list())
    assert frame["mean_latency_cycles"].to_list() == [40, 240, 600]


def test_levels_of_every_kind_are_shown_by_name() -> None:
    level = LevelTiming(1000, 1000, 10, 1)
    levels = dict.fromkeys(("l1", "gl1", "l2", "llc", "dram"), level)
    frame = bandwidth_table(timing_result(one_pass(levels=levels)), GPU).frame
    assert list(frame["level"]) == ["L1", "GL1", "L2", "LLC", "DRAM"]


def test_a_level_that_answered_nothing_has_no_latency() -> None:
    levels = {"l1": LevelTiming(1000, 1000, 0, 0)}
    shown = cells(bandwidth_table(timing_result(one_pass(levels=levels)), GPU))
    assert shown[0][6] == "-"


def test_the_tables_fit_a_hundred_columns(capsys: pytest.CaptureFixture[str]) -> None:
    # A frame of 1080p: hundreds of millions of cycles, every reason present.
    where = {reason: 4_000_000 for reason in REASONS}
    big = [
        one_pass(name, 10_000, cycles=40_000_000, launch_cycles=4_000_000, where=where)
        for name in PASSES
    ]
    for table in (cycles_table, where_table, bandwidth_table):
        print_table(table(timing_result(*big), GPU))
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 100 and "…" not in said
    assert "Bottleneck: " in said and "200,000,000" in said


@pytest.mark.parametrize(
    ("gpu", "path", "l1_accesses", "told"),
    [
        ("titan-x-pascal-gpgpusim", "global", 0, "skip the L1"),
        ("titan-x-pascal-gpgpusim", "texture", 10, "footprint"),
        ("titan-x-pascal-gpgpusim", "readonly", 10, None),
        ("rtx-2060-gpgpusim", "global", 10, None),
        ("titan-x-pascal", "global", 0, None),
    ],
)
def test_a_run_of_another_kind_than_gpgpusims_says_so(
    gpu: str, path: str, l1_accesses: int, told: str | None
) -> None:
    lines = comparison_notes(presets.load(gpu), path, l1_accesses)
    assert bool(lines) == (told is not None)
    assert told is None or told in lines[0]


def test_what_timing_lacks_of_a_gpu_is_one_line() -> None:
    gpu = presets.load("titan-x-pascal")
    assert timing_refusal(gpu) is None
    told = timing_refusal(gpu.model_copy(update={"icnt": None, "l2_timing": None}))
    assert told is not None and "icnt, l2_timing" in told and "\n" not in told


def test_the_demos_cycles_are_of_the_frame_or_of_its_sampling_pass() -> None:
    result = timing_result(one_pass("setup"), one_pass("sampling", 3))
    assert timing_totals(result, "all") == {"cycles": 42_000, "time_ms": pytest.approx(0.042)}
    assert timing_totals(result, "sampling")["cycles"] == 31_000
    assert all(math.isnan(n) for n in timing_totals(None, "all").values())


def demo_frame(fewer: float) -> pd.DataFrame:
    """The demo's central table for two GPUs, of which one was timed; adaptive / fixed = `fewer`."""
    numbers = ("lane_fetches", "l1_bytes", "l2_bytes", "dram_bytes", "l1_miss_rate", "l2_miss_rate")
    rows = []
    for gpu, cycles in (("a", 5e6), ("b", math.nan)):
        for passes in ("all", "sampling"):
            for method, share in (("fixed", 1.0), ("adaptive", fewer)):
                key = {"scene": "close", "gpu": gpu, "passes": passes, "method": method}
                time = {"cycles": cycles * share, "time_ms": cycles * share / 1e6}
                rows.append(key | dict.fromkeys(numbers, 0.5 * share) | time)
    return pd.DataFrame(rows)


def test_the_demos_table_has_cycles_where_a_gpu_was_timed_and_dashes_elsewhere() -> None:
    demand = demo_frame(0.2)
    table = demand_table(demand, ratio_frame(demand), "t", "96x54")
    shown = {(row[1], row[2]): row[-2:] for row in cells(table)}
    assert shown["a", "fixed"] == ["5.00", "5.00"] and shown["a", "adaptive"] == ["1.00", "1.00"]
    assert shown["a", "of sampling"] == ["0.200", "0.200"]
    assert shown["b", "fixed"] == shown["b", "ratio"] == ["-", "-"]


@pytest.mark.parametrize(("fewer", "told"), [(0.2, "as the paper shows"), (1.5, "Disagrees")])
def test_the_demo_says_in_words_whether_cycles_agree_with_the_paper(
    fewer: float, told: str
) -> None:
    lines = [line for line in findings(ratio_frame(demo_frame(fewer)), "96x54") if "Cycles" in line]
    assert len(lines) == 1 and told in lines[0] and "Timed on a." in lines[0]
    untimed = demo_frame(fewer).assign(cycles=math.nan, time_ms=math.nan)
    assert not any("Cycles" in line for line in findings(ratio_frame(untimed), "96x54"))


def test_gpus_that_cannot_be_timed_are_left_out_with_a_remark(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bare = GPU.model_copy(update={"name": "bare", "dram_timing": None})
    machines = [bare, GPU]
    assert machines_to_time(machines, "none") == []
    assert machines_to_time(machines, "all") == [GPU]
    assert "bare: timing needs the tables dram_timing" in capsys.readouterr().err
    assert machines_to_time([GPU, bare], "first") == [GPU]
    assert not capsys.readouterr().err
