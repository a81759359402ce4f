"""The report: its laws catch what is broken, its numbers add up, its JSON is the design's."""

from __future__ import annotations

import dataclasses
import json

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cachesim import Report, simulate
from cachesim.report import ConservationError, DramCounters, LevelCounters, Part, sum_parts
from traces.synthetic import scatter, stream

COUNTS = [f.name for f in dataclasses.fields(LevelCounters) if f.name != "sector_bytes"]


@pytest.fixture(scope="module")
def report() -> Report:
    return simulate(scatter(96, 64, 12.0, 4, frames=2), "rx-5700-xt")


def with_level(report: Report, level: str, **changes: int) -> Report:
    """The report with some counters of one level changed by so much."""
    old = report.counters[level]
    new = {name: getattr(old, name) + change for name, change in changes.items()}
    counters = report.counters | {level: dataclasses.replace(old, **new)}
    return dataclasses.replace(report, counters=counters)


def test_a_whole_report_passes_its_check(report: Report) -> None:
    report.check()


@pytest.mark.parametrize("level", ["l1", "gl1", "l2"])
@pytest.mark.parametrize("counter", sorted(set(COUNTS) - {"dirty_at_end", "requests", "writes"}))
def test_no_counter_that_moves_data_can_be_off_by_one(report, level, counter) -> None:
    without_parts = dataclasses.replace(report, parts=None)
    with pytest.raises(ConservationError, match="law broken"):
        with_level(without_parts, level, **{counter: 1}).check()


@pytest.mark.parametrize("counter", COUNTS)
def test_parts_that_do_not_sum_to_the_total_are_caught(report: Report, counter: str) -> None:
    part = report.parts[0]
    level = dataclasses.replace(
        part.counters["l1"], **{counter: getattr(part.counters["l1"], counter) + 1}
    )
    broken = dataclasses.replace(part, counters=part.counters | {"l1": level})
    with pytest.raises(ConservationError, match="parts sum to the total"):
        dataclasses.replace(report, parts=(broken, *report.parts[1:])).check()


def test_misses_turned_into_hits_on_both_sides_are_caught(report: Report) -> None:
    """accesses = hits + misses still holds; what the next level was presented does not."""
    without_parts = dataclasses.replace(report, parts=None)
    with pytest.raises(ConservationError, match="l1 passes down what gl1 is presented"):
        with_level(without_parts, "l1", hits=1, line_misses=-1).check()


def test_lane_fetches_and_dram_are_held_to_their_parts(report: Report) -> None:
    with pytest.raises(ConservationError, match="lane fetches"):
        dataclasses.replace(report, lane_fetches=report.lane_fetches + 1).check()
    moved = dataclasses.replace(report.dram, sectors_read=report.dram.sectors_read + 1)
    with pytest.raises(ConservationError, match="DRAM"):
        dataclasses.replace(report, dram=moved).check()


counters = st.builds(
    LevelCounters, st.just(32), **{name: st.integers(0, 10**12) for name in COUNTS}
)


@given(counters, counters)
def test_counters_add_field_by_field(a: LevelCounters, b: LevelCounters) -> None:
    total = a + b
    for name in (*COUNTS, "misses", "presented", "reads_down", "writes_down", "demand_bytes"):
        assert getattr(total, name) == getattr(a, name) + getattr(b, name), name
    parts = [Part("p", "t", k, 0, {"l1": c}, DramCounters(32)) for k, c in enumerate((a, b))]
    assert sum_parts(parts, "l1") == total


def test_counters_of_other_sectors_do_not_add() -> None:
    with pytest.raises(ValueError, match="sector_bytes 32 and 128"):
        LevelCounters(32) + LevelCounters(128)
    with pytest.raises(ValueError, match="no parts"):
        sum_parts([], "l1")


def test_json_is_that_of_the_design(report: Report) -> None:
    told = json.loads(json.dumps(report.to_json()))
    assert {"gpu", "trace", "levels", "dram", "demand", "cycles", "time_ms", "by"} <= set(told)
    assert told["gpu"] == "rx-5700-xt"
    assert told["levels"] == ["l1", "gl1", "l2"]
    keys = {"requests", "accesses", "hits", "misses", "line_misses", "sector_misses", "merged"}
    keys |= {"writes", "bypasses", "writebacks", "dirty_at_end", "miss_rate", "sector_bytes"}
    for level in told["levels"]:
        found = told[level]
        assert keys <= set(found)
        assert found["accesses"] == found["hits"] + found["misses"]
        assert found["misses"] == found["line_misses"] + found["sector_misses"]
        assert found["miss_rate"] == found["misses"] / found["accesses"]
        assert told["demand"][f"{level}_bytes"] == found["accesses"] * found["sector_bytes"]
        assert sum(part[level]["accesses"] for part in told["by"]) == found["accesses"]
    assert set(told["dram"]) >= {"sectors_read", "sectors_written", "bytes"}
    assert told["demand"]["dram_bytes"] == told["dram"]["bytes"]
    assert told["cycles"] is None and told["time_ms"] is None
    assert "llc" not in told


def test_a_lane_address_trace_has_no_provenance() -> None:
    report = simulate(stream(64, 2), "titan-x-pascal")
    assert report.parts is None
    assert report.to_json()["by"] is None
    assert report.by_frame().empty


def test_an_absent_miss_rate_is_null_not_zero() -> None:
    assert LevelCounters(32).miss_rate is None
    assert LevelCounters(32).to_json()["miss_rate"] is None


def test_frames_say_what_the_json_says(report: Report) -> None:
    frame = report.frame().set_index("level")
    told = report.to_json()
    for level in report.levels:
        for key, value in told[level].items():
            told_as = frame.loc[level, key]
            assert (told_as is pd.NA) if value is None else told_as == value
        assert frame.loc[level, "demand_bytes"] == told["demand"][f"{level}_bytes"]
    by = report.by_frame()
    assert set(by["level"]) == {*report.levels, "dram"}
    assert set(zip(by["pass"], by["texture"], by["mip"], strict=True)) == {
        (part["pass"], part["texture"], part["mip"]) for part in told["by"]
    }
    assert by[by["level"] == "dram"]["bytes"].sum() == report.dram.bytes
