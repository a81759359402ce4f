"""Sweeps: each row is what `simulate` says of that point, in grid order, however worked off."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pandas as pd
import pytest

from cachesim import presets, simulate, sweep
from traces.errors import InputError
from traces.parquet import write_parquet
from traces.synthetic import scatter
from traces.trace import Trace

GPU = "titan-x-pascal"
AXES = {"l1.capacity": [24576, 49152, 98304], "l2.replacement": ["lru", "random"]}


@pytest.fixture(scope="module")
def trace() -> Trace:
    return scatter(96, 64, 12.0, 6)


@pytest.fixture(scope="module")
def trace_file(trace: Trace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sweep") / "trace.parquet"
    write_parquet(trace, path)
    return path


@pytest.fixture(scope="module")
def frame(trace: Trace) -> pd.DataFrame:
    return sweep(trace, GPU, AXES)


def test_every_row_is_what_simulate_says_of_its_point(trace: Trace, frame: pd.DataFrame) -> None:
    grid = [(a, b) for a in AXES["l1.capacity"] for b in AXES["l2.replacement"]]
    assert list(zip(frame["l1.capacity"], frame["l2.replacement"], strict=True)) == grid
    for row, (capacity, policy) in enumerate(grid):
        fields = {"l1.capacity": capacity, "l2.replacement": policy}
        report = simulate(trace, presets.with_fields(presets.load(GPU), fields))
        told = report.to_json()
        for section in ("l1", "l2", "dram", "demand"):
            for key, value in told[section].items():
                assert frame.loc[row, f"{section}.{key}"] == value, (row, section, key)
    assert frame["l1.misses"].nunique() == 3


def test_axes_come_first_and_then_the_counters(frame: pd.DataFrame) -> None:
    columns = list(frame.columns)
    assert columns[:2] == list(AXES)
    assert {"l1.accesses", "l1.miss_rate", "l2.misses", "dram.bytes", "demand.l1_bytes"} <= set(
        columns
    )


@pytest.mark.parametrize("workers", [1, 2])
def test_processes_and_files_change_nothing(
    trace_file: Path, frame: pd.DataFrame, workers: int
) -> None:
    """Six points: two processes take three each; rows and progress come as they are done."""
    rows: list[dict[str, object]] = []
    told: list[int] = []
    found = sweep(
        trace_file, GPU, AXES, num_workers=workers, progress=told.append, on_row=rows.append
    )
    pd.testing.assert_frame_equal(found, frame)
    assert told[-1] == len(rows) == 6
    assert told == sorted(told)
    by_point = pd.DataFrame(rows).sort_values(list(AXES), ignore_index=True)
    pd.testing.assert_frame_equal(by_point, frame.sort_values(list(AXES), ignore_index=True))


def test_no_axis_is_one_point(trace: Trace) -> None:
    frame = sweep(trace, GPU, {})
    assert len(frame) == 1
    assert frame.loc[0, "l1.misses"] == simulate(trace, GPU).counters["l1"].misses


def test_a_level_that_a_point_lacks_is_empty_there(trace: Trace) -> None:
    gpu = presets.with_fields(presets.load("rx-6900-xt"), {"llc.capacity": 1 << 20})
    with_llc = sweep(trace, gpu, {"sm.count": [8]})
    without = sweep(trace, presets.with_fields(gpu, {"llc": None}), {"sm.count": [8]})
    assert with_llc.loc[0, "llc.accesses"] > 0
    assert "llc.accesses" not in without.columns


@pytest.mark.parametrize(
    ("axes", "told"),
    [
        ({"l1.capacity": [24576, 1000]}, r"l1\.capacity=1000.*1000"),
        ({"l1.capcity": [24576]}, "capcity"),
        ({"l1.sector_bytes": [16]}, r"l1\.sector_bytes=16.*l2\.sector_bytes = 32 does not divide"),
        ({"l1.ways": []}, r"axis 'l1\.ways': no values"),
        ({"sm.max_warps": [64, 1]}, r"sm\.max_warps=1.*does not fit an SM"),
    ],
)
def test_impossible_points_are_named_before_any_work(
    trace: Trace, axes: dict[str, list[int]], told: str
) -> None:
    def no_row(_: object) -> None:
        pytest.fail("a point was counted before all were checked")

    with pytest.raises(InputError, match=told):
        sweep(trace, GPU, axes, on_row=no_row)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"fetch_path": "textur"}, "did you mean 'texture'"),
        ({"layout": "mortn"}, "did you mean 'morton'"),
        ({"num_workers": 0}, "num_workers = 0"),
    ],
)
def test_wrong_arguments_are_bad_input(trace: Trace, wrong: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told):
        sweep(trace, GPU, AXES, **wrong)


def test_an_error_of_a_worker_is_raised_here(tmp_path: Path, trace_file: Path) -> None:
    """A file that is cut short shows itself only where its rows are read."""
    cut = tmp_path / "cut.parquet"
    whole = bytearray(trace_file.read_bytes())
    middle = len(whole) // 3
    whole[middle : middle + 64] = bytes(64)
    cut.write_bytes(whole)
    with pytest.raises(InputError, match=r"cut\.parquet"):
        sweep(cut, GPU, AXES, num_workers=2)


def test_an_interrupt_stops_the_workers_and_keeps_the_rows_so_far(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(scatter(320, 256, 12.0, 24), path)
    script = tmp_path / "sweeping.py"
    script.write_text(
        textwrap.dedent(
            f"""
            from cachesim import sweep

            if __name__ == "__main__":
                rows = []
                def on_row(row):
                    rows.append(row)
                    print("row", flush=True)
                axes = {{"l1.capacity": [24576 * k for k in range(1, 200)]}}
                try:
                    sweep({str(path)!r}, {GPU!r}, axes, num_workers=2, on_row=on_row)
                except KeyboardInterrupt:
                    print("stopped with", len(rows), flush=True)
            """
        )
    )
    command = [sys.executable, str(script)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "row\n"
        start = time.monotonic()
        # Ctrl-C reaches every process of the terminal's group.
        os.killpg(process.pid, signal.SIGINT)
        out, error = process.communicate(timeout=60)
    last = out.splitlines()[-1]
    assert last.startswith("stopped with ")
    assert 1 <= int(last.split()[-1]) < 199
    assert error == ""
    assert process.returncode == 0
    assert time.monotonic() - start < 30
