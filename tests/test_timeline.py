"""A timeline is JSON that trace viewers read: times at the clock, tracks named, whole or absent."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.timeline import timeline_file

CLOCK_HZ = 1_417_000_000


def events_of(path: Path, phase: str) -> list[dict]:
    return [e for e in json.loads(path.read_text())["traceEvents"] if e["ph"] == phase]


def track_names(path: Path) -> dict[int, str]:
    named = (e for e in events_of(path, "M") if e["name"] == "thread_name")
    return {e["tid"]: e["args"]["name"] for e in named}


def test_times_are_microseconds_at_the_clock_and_cycles_stand_beside(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    with timeline_file(path, 2_000_000_000, "run") as timeline:
        timeline.event("sampling", "pass", 5000, 3001, "passes")
    (event,) = events_of(path, "X")
    # 2 GHz: half a nanosecond per cycle; 8001 cycles end at 4000.5 ns, rounded up.
    assert (event["ts"], event["dur"]) == (2.5, 1.501)
    assert event["args"] == {"cycle": 5000, "cycles": 3001}
    assert (event["name"], event["cat"]) == ("sampling", "pass")


def test_every_event_has_what_the_format_asks_of_its_kind(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    with timeline_file(path, CLOCK_HZ, "t on titan-x-pascal") as timeline:
        for i in range(5):
            timeline.event(f"CTA {i}", "cta", 100 * i, 100, f"SM {i % 2}")
            timeline.counter("DRAM queue", 100 * i, i)
    whole = json.loads(path.read_text())
    for event in whole["traceEvents"]:
        assert {"name", "ph", "pid", "args"} <= set(event)
        if event["ph"] != "M":
            assert isinstance(event["ts"], int | float)
        if event["ph"] == "X":
            assert {"dur", "tid", "cat"} <= set(event)
    assert track_names(path) == {1: "SM 0", 2: "SM 1"}
    process = [e for e in events_of(path, "M") if e["name"] == "process_name"]
    assert [e["args"]["name"] for e in process] == ["t on titan-x-pascal"]
    assert [e["args"]["value"] for e in events_of(path, "C")] == [0, 1, 2, 3, 4]


@given(
    spans=st.lists(st.tuples(st.integers(0, 10**7), st.integers(0, 5000)), max_size=60),
    clock=st.integers(10**6, 4 * 10**9),
)
def test_events_of_one_lane_never_overlap(
    tmp_path_factory: pytest.TempPathFactory, spans: list[tuple[int, int]], clock: int
) -> None:
    path = tmp_path_factory.mktemp("timeline") / "t.json"
    with timeline_file(path, clock, "run") as timeline:
        for start, duration in spans:
            timeline.event("e", "c", start, duration, "one track")
    lanes: dict[int, list[tuple[int, int]]] = {}
    for event in events_of(path, "X"):
        # Whole nanoseconds, as the viewers keep them.
        start, dur = round(1000 * event["ts"]), round(1000 * event["dur"])
        lanes.setdefault(event["tid"], []).append((start, start + dur))
    assert sum(map(len, lanes.values())) == len(spans)
    for lane in lanes.values():
        lane.sort()
        assert all(a[1] <= b[0] for a, b in pairwise(lane))
    names = set(track_names(path).values())
    assert names <= {"one track", *(f"one track ({i})" for i in range(2, 61))}


def test_back_to_back_events_share_a_lane_and_overlapping_ones_do_not(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    with timeline_file(path, CLOCK_HZ, "run") as timeline:
        timeline.event("a", "c", 0, 10, "SM 0")
        timeline.event("b", "c", 10, 10, "SM 0")
        timeline.event("c", "c", 15, 10, "SM 0")
    names = track_names(path)
    assert [names[e["tid"]] for e in events_of(path, "X")] == ["SM 0", "SM 0", "SM 0 (2)"]


def test_lanes_of_a_track_are_sorted_beside_each_other(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    with timeline_file(path, CLOCK_HZ, "run") as timeline:
        for track in ("SM 0", "SM 1", "SM 0"):
            timeline.event("e", "c", 0, 10, track)
    order = {
        e["tid"]: e["args"]["sort_index"]
        for e in events_of(path, "M")
        if e["name"] == "thread_sort_index"
    }
    names = track_names(path)
    assert [names[t] for t in sorted(order, key=order.__getitem__)] == ["SM 0", "SM 0 (2)", "SM 1"]


def test_numbers_of_numpy_are_written_as_plain_numbers(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    with timeline_file(path, CLOCK_HZ, "run") as timeline:
        timeline.event("e", "c", np.int64(7), np.uint32(3), "SM 0")
        timeline.counter("n", np.int64(7), np.int64(4))
    assert events_of(path, "X")[0]["args"] == {"cycle": 7, "cycles": 3}
    assert events_of(path, "C")[0]["args"] == {"value": 4}


@pytest.mark.parametrize(("start", "duration"), [(-1, 5), (5, -1)])
def test_a_negative_time_is_refused(tmp_path: Path, start: int, duration: int) -> None:
    with (
        pytest.raises(ValueError, match="allowed are 0 and up"),
        timeline_file(tmp_path / "t.json", CLOCK_HZ, "run") as timeline,
    ):
        timeline.event("e", "c", start, duration, "SM 0")


def test_an_infinite_value_is_refused_as_json_has_none(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="JSON"),
        timeline_file(tmp_path / "t.json", CLOCK_HZ, "run") as timeline,
    ):
        timeline.counter("n", 0, float("inf"))


def test_an_interrupted_run_leaves_what_stood_there(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), timeline_file(path, CLOCK_HZ, "run") as timeline:
        for i in range(5000):
            timeline.event("e", "c", i, 1, "SM 0")
        raise KeyboardInterrupt
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["t.json"]


def test_events_go_to_the_file_as_they_come(tmp_path: Path) -> None:
    with timeline_file(tmp_path / "t.json", CLOCK_HZ, "run") as timeline:
        for i in range(20000):
            timeline.event("e", "c", i, 1, "SM 0")
        (part,) = tmp_path.iterdir()
        assert part.stat().st_size > 1_000_000
