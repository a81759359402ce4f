"""`cachesim microbench`: its traces touch what they say, and its table is that of the GPU."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.cli import run_command
from traces.microbench import STEP_BYTES, chase, stream
from traces.texture import INACTIVE_ADDRESS
from traces.trace import Trace

KIB = 1 << 10


def lines_of(trace: Trace) -> dict[str, np.ndarray]:
    """Pass -> the 128 B lines that its lanes touch, in order; the first address is line 0."""
    found = {}
    for chunk in trace.chunks():
        lanes = chunk.lanes[chunk.lanes != INACTIVE_ADDRESS]
        found[trace.launches[chunk.launch].pass_name] = lanes // STEP_BYTES
    base = min(int(lines.min()) for lines in found.values() if len(lines))
    return {name: lines.astype(np.int64) - base for name, lines in found.items()}


def test_a_chase_goes_round_all_of_a_footprint_before_it_counts() -> None:
    lines = lines_of(chase(8 * KIB, 100, "self"))
    for name, counted in (("once", 100), ("twice", 200)):
        walk = lines[name]
        assert len(walk) == 64 + counted
        assert sorted(walk[:64]) == list(range(64))
        assert (walk[64:] == walk[:-64]).all()  # cyclic, so a lower level's LRU never hits
    assert list(lines["twice"][:164]) == list(lines["once"])


@pytest.mark.parametrize("warm", ["whole", "rest"])
def test_a_chase_below_the_l1s_touches_no_line_twice(warm: str) -> None:
    lines = lines_of(chase(1024 * KIB, 300, warm))  # type: ignore[arg-type]
    walked = np.concatenate([lines["once"], lines["twice"]])
    assert len(lines["once"]) == 300 and len(lines["twice"]) == 600
    assert len(np.unique(walked)) == 900
    assert walked.max() < 4096  # the first half
    touched = set(lines["warm"])
    assert set(walked) <= touched if warm == "whole" else not set(walked) & touched


def test_every_load_of_a_chase_waits_for_the_one_before() -> None:
    trace = chase(8 * KIB, 10, "self")
    for chunk in trace.chunks():
        launch = trace.launches[chunk.launch]
        outstanding = {trace.instructions[k].num_outstanding for k in chunk.instruction}
        assert outstanding == ({-1} if launch.pass_name == "warm" else {0})
        assert launch.pass_name == "warm" or chunk.num_warps == 1


def test_a_stream_goes_on_where_the_last_wave_ended() -> None:
    trace = stream(1024 * KIB, 64, 4, 8)
    lines = lines_of(trace)
    assert sorted(lines["warm"][::32]) == list(range(8192))
    # Each warp takes a whole line; the first 2048 loads are 2048 lines side by side.
    assert sorted(lines["stream"][::32]) == list(range(64 * 4 * 8))
    assert trace.launches[1].num_ctas * trace.launches[1].warps_per_cta == 64 * 8


def test_the_command_prints_every_level_beside_what_is_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "levels.csv"
    assert run_command(["microbench", "--gpu", "rtx-2060", "-o", str(output)]) == 0
    said = capsys.readouterr().out
    frame = pd.read_csv(output).set_index("level")
    assert list(frame.index) == ["l1", "l2", "dram"]
    assert frame.latency_cycles["l1"] == 32 and "32.0" in said
    assert frame.latency_error_percent["l1"] == 0
    for level in frame.index:
        known, found = frame.known_bandwidth[level], frame.bandwidth[level]
        assert frame.bandwidth_error_percent[level] == pytest.approx(100 * (found / known - 1))
        assert f"{found:,.1f}" in said
        assert f"{level}: bandwidth from {frame.bandwidth_source[level]}." in said


def test_a_gpu_of_ones_own_has_nothing_to_stand_beside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes = ["--set", "name=mine", "--set", "sm.count=2"]
    assert run_command(["microbench", "--gpu", "rtx-2060", *changes]) == 0
    said = capsys.readouterr().out
    assert "of mine's levels" in said and " from " not in said


def test_a_gpu_without_timing_tables_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["microbench", "--gpu", "rtx-2060", "--set", "dram_timing=none"]) == 2
    assert "dram_timing" in capsys.readouterr().err
