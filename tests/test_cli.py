"""The command line: exit codes, one line for bad input, JSON as designed, whole outputs."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from experiments import console
from experiments.cli import run_command
from traces.parquet import write_parquet
from traces.synthetic import scatter, stream
from traces.trace import Trace

GPU = ["--gpu", "titan-x-pascal"]


def small_trace() -> Trace:
    return scatter(64, 32, 6.0, 4)


@pytest.fixture(scope="session")
def trace_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("traces") / "t.parquet"
    write_parquet(small_trace(), path)
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trace_file: Path) -> Path:
    """An empty folder to run in, with bad files of every kind beside it in `bad`."""
    bad = tmp_path / "bad"
    bad.mkdir()
    whole = trace_file.read_bytes()
    (bad / "whole.parquet").write_bytes(whole)
    (bad / "cut.parquet").write_bytes(whole[: len(whole) // 2])
    (bad / "empty.parquet").write_bytes(b"")
    (bad / "text.parquet").write_text("not a trace")
    pd.DataFrame({"a": [1]}).to_parquet(bad / "other.parquet")
    scalars = {
        "warps_per_cta": 2,
        "loads_in_flight": 1,
        "compute_per_load": 0,
        "bytes_per_lane": 4,
    }
    np.savez(bad / "pickled.npz", addresses=np.array([[None]], dtype=object), **scalars)
    np.savez(bad / "shape.npz", addresses=np.zeros((2, 3), np.uint64), **scalars)
    np.savez(bad / "missing.npz", addresses=np.zeros((2, 3, 32), np.uint64))
    (bad / "bad.toml").write_text('extends = "rtx-2080-ti"\n[l1]\nline_bytes = 96\n')
    run = tmp_path / "run"
    run.mkdir()
    monkeypatch.chdir(run)
    return run


BAD_TRACE_COMMANDS = [
    # command, what the message must name: the bad value, and what is allowed
    (["run", "T"], ["--gpu"]),
    (["run", "T", "--gpu", "titan-x-pascl"], ["'titan-x-pascl'", "'titan-x-pascal'", "h100-sxm"]),
    (["run", "T", "--gpu", "nowhere.toml"], ["nowhere.toml"]),
    (["run", "T", "--gpu", "../bad/bad.toml"], ["bad.toml", "line_bytes", "96", "powers of two"]),
    (["run", "T", *GPU, "--set", "l1.capcity=64KiB"], ["capcity", "capacity"]),
    (["run", "T", *GPU, "--set", "l1.capacity=64KB"], ["64KB", "KiB"]),
    (["run", "T", *GPU, "--set", "l1.capacity=-1"], ["l1.capacity", "-1"]),
    (["run", "T", *GPU, "--set", "l1.capacity=0"], ["l1.capacity", "0"]),
    (["run", "T", *GPU, "--set", "l1.sector_bytes=48"], ["sector_bytes", "48"]),
    (["run", "T", *GPU, "--set", "l1.replacement=mru"], ["mru", "lru"]),
    (["run", "T", *GPU, "--set", "l1.capacity"], ["l1.capacity"]),
    (["run", "T", *GPU, "--fetch-path", "textur"], ["'textur'", "'texture'", "readonly"]),
    (["run", "T", *GPU, "--layout", "mortn"], ["'mortn'", "'morton'", "row-major"]),
    (["run", "T", *GPU, "--json", "no/dir.json"], ["no/dir.json", "'no'"]),
    (["run", "T", *GPU, "--csv", "no/dir.csv"], ["no/dir.csv", "'no'"]),
    (["run", "missing.parquet", *GPU], ["missing.parquet", "no such file"]),
    (["run", ".", *GPU], [".:"]),
    (["run", "../bad/cut.parquet", *GPU], ["cut.parquet"]),
    (["run", "../bad/empty.parquet", *GPU], ["empty.parquet"]),
    (["run", "../bad/text.parquet", *GPU], ["text.parquet"]),
    (["run", "../bad/other.parquet", *GPU], ["other.parquet"]),
    (["run", "../bad/pickled.npz", *GPU], ["pickled.npz"]),
    (["run", "../bad/shape.npz", *GPU], ["shape.npz", "(2, 3)"]),
    (["run", "../bad/missing.npz", *GPU], ["missing.npz", "warps_per_cta"]),
    (["check", "../bad/cut.parquet"], ["cut.parquet"]),
    (["info", "../bad/pickled.npz"], ["pickled.npz"]),
    (["bound", "T", *GPU, "--level", "l3"], ["'l3'", "l1, l2"]),
    (["sweep", "T", *GPU], ["--axis"]),
    (["sweep", "T", *GPU, "--axis", "l1.capacity"], ["l1.capacity"]),
    (["sweep", "T", *GPU, "--axis", "l1.capcity=16KiB"], ["capcity", "capacity"]),
    (["sweep", "T", *GPU, "--axis", "l1.capacity=16KiB,16KiB"], ["16KiB"]),
    (["sweep", "T", *GPU, "--axis", "l1.capacity=1000"], ["1000"]),
    (["sweep", "T", *GPU, "--axis", "l1.ways=1", "--axis", "l1.ways=2"], ["l1.ways"]),
    (["sweep", "T", *GPU, "--axis", "l1.capacity=48KiB", "-o", "s.txt"], [".txt", ".csv"]),
    (["sweep", "T", *GPU, "--axis", "l1.capacity=48KiB", "--workers", "0"], ["--workers", "0"]),
    (["presets", "shwo"], ["'shwo'", "'show'", "list"]),
    (["presets", "show"], ["show", "1"]),
    (["presets", "show", "rtx-2080t"], ["'rtx-2080t'", "'rtx-2080-ti'"]),
    (["presets", "diff", "rtx-2060"], ["diff", "2"]),
    (["presets", "list", "--set", "l1.ways=1"], ["--set", "list"]),
    (["layouts", "-o", "../bad/text.parquet"], ["text.parquet", "not a folder"]),
    (["demo", "--full", "--size", "96x54"], ["--full", "96x54"]),
    (["demo", "--size", "96"], ["'96'", "WIDTHxHEIGHT"]),
    (["demo", "--scenes", "close,,ear"], ["close,,ear"]),
    (["demo", "--scenes", "close,close"], ["'close'", "repeated"]),
    (["demo", "--gpus", "rtx"], ["'rtx'", "rtx-2060"]),
    (["demo", "--frames", "1"], ["--frames", "1"]),
    (["demo", "--mesh", "none.glb"], ["none.glb", "no such file"]),
    (["demo", "--albedo-map", "x.png"], ["--albedo-map", "mesh"]),
    (["prefilter", "--counts", "8,none"], ["'none'", "1 to 2048"]),
    (["record", "-o", "t.txt"], [".txt", ".parquet"]),
    (["record"], ["--output"]),
    (["record", "-o", "no/t.parquet"], ["no/t.parquet", "'no'"]),
    (["record", "-o", "t.parquet", "--size", "0x540"], ["width 0", "1 to 16384"]),
    (["record", "-o", "t.parquet", "--size", "960x-1"], ["height -1", "1 to 16384"]),
    (["record", "-o", "t.parquet", "--size", "20000x10"], ["20000", "16384"]),
    (["record", "-o", "t.parquet", "--size", "big"], ["'big'", "WIDTHxHEIGHT"]),
    (["record", "-o", "t.parquet", "--frames", "0"], ["--frames", "0"]),
    (["record", "-o", "t.parquet", "--traced-frames", "1"], ["'1'", "last, all"]),
    (["record", "-o", "t.parquet", "--method", "adaptve"], ["'adaptve'", "'adaptive'", "fixed"]),
    (["record", "-o", "t.parquet", "--samples", "0"], ["num_samples 0", "2048"]),
    (["record", "-o", "t.parquet", "--rule", "papr"], ["'papr'", "'paper'", "engine"]),
    (["record", "-o", "t.parquet", "--kappa", "2"], ["kappa 2", "0 to 1"]),
    (["record", "-o", "t.parquet", "--kappa", "much"], ["--kappa", "much"]),
    (["record", "-o", "t.parquet", "--planes", "colr"], ["'colr'", "'colour'", "normal"]),
    (["record", "-o", "t.parquet", "--passes", "setup,smpling"], ["'smpling'", "'sampling'"]),
    (["record", "-o", "t.parquet", "--mip-rule", "eq"], ["'eq'", "eq-5.12", "mip0"]),
    (["record", "-o", "t.parquet", "--camera", "ear"], ["--camera", "mesh"]),
    (["record", "-o", "t.parquet", "--instructions", "sm_6"], ["sm_6", "sm_61-native"]),
    (["record", "-o", "t.parquet", "--nonsense"], ["--nonsense"]),
    (["rnu", "T"], ["'rnu'", "'run'"]),
]


@pytest.mark.parametrize(
    ("arguments", "named"), BAD_TRACE_COMMANDS, ids=lambda v: " ".join(v)[:60] if v else ""
)
def test_bad_input_is_one_line_and_leaves_nothing(
    arguments: list[str],
    named: list[str],
    folder: Path,
    trace_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = run_command([str(trace_file) if a == "T" else a for a in arguments])
    said = capsys.readouterr()
    assert code == 2, said.err
    lines = [line for line in said.err.splitlines() if line]
    assert len(lines) == 1, said.err
    assert lines[0].startswith("cachesim: error: ")
    for words in named:
        assert words in lines[0]
    assert list(folder.iterdir()) == []


@pytest.mark.opencl
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--scene", "eear"], ["'eear'", "'ear'", "front"]),
        (["--scene", "none.glb"], ["none.glb"]),
        (["--scene", "none.npz"], ["none.npz"]),
        (["--scene", "close", "--device", "warp drive"], ["warp drive"]),
    ],
    ids=lambda v: " ".join(v)[:60],
)
def test_bad_scenes_and_devices_are_one_line(
    arguments: list[str], named: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_command(["record", "-o", "t.parquet", "--size", "16x8", *arguments])
    error = capsys.readouterr().err
    assert code == 2, error
    assert len(error.strip().splitlines()) == 1
    for words in named:
        assert words in error
    assert list(folder.iterdir()) == []


def test_json_is_the_designed_report_and_nothing_else_on_stdout(
    trace_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["run", str(trace_file), "--gpu", "rx-6900-xt", "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["levels"] == ["l1", "gl1", "l2", "llc"]
    assert report["gpu"] == "rx-6900-xt"
    keys = {"requests", "accesses", "hits", "misses", "line_misses", "sector_misses", "merged"}
    keys |= {"writes", "bypasses", "writebacks", "dirty_at_end", "miss_rate", "sector_bytes"}
    for level in report["levels"]:
        counts = report[level]
        assert keys <= set(counts)
        assert counts["accesses"] == counts["hits"] + counts["misses"]
        assert counts["misses"] == counts["line_misses"] + counts["sector_misses"]
    assert {"sectors_read", "sectors_written", "bytes"} <= set(report["dram"])
    assert {"lane_fetches", "l1_bytes", "l2_bytes", "dram_bytes"} <= set(report["demand"])
    assert report["cycles"] is None and report["time_ms"] is None
    assert sum(part["lane_fetches"] for part in report["by"]) == report["demand"]["lane_fetches"]
    assert {"pass", "texture", "mip", "l1", "dram"} <= set(report["by"][0])


def test_an_absent_level_is_an_absent_key(
    trace_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["run", str(trace_file), *GPU, "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["levels"] == ["l1", "l2"]
    assert "gl1" not in report and "llc" not in report


def test_run_takes_overrides_and_writes_json_and_csv(folder: Path, trace_file: Path) -> None:
    common = ["run", str(trace_file), *GPU, "--json"]
    assert run_command([*common, "real.json", "--csv", "by.csv"]) == 0
    assert run_command([*common, "small.json", "--set", "l1.capacity=6KiB"]) == 0
    real, small = (json.loads((folder / n).read_text()) for n in ("real.json", "small.json"))
    assert small["l1"]["misses"] > real["l1"]["misses"]
    by = pd.read_csv(folder / "by.csv")
    assert by[by["level"] == "l1"]["accesses"].sum() == real["l1"]["accesses"]
    assert sorted(p.name for p in folder.iterdir()) == ["by.csv", "real.json", "small.json"]


def test_run_counts_a_lane_address_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    addresses = np.arange(4 * 3 * 32, dtype=np.uint64).reshape(4, 3, 32) * np.uint64(4) + 4096
    np.savez(
        "lanes.npz",
        addresses=addresses,
        warps_per_cta=2,
        loads_in_flight=1,
        compute_per_load=0,
        bytes_per_lane=4,
    )
    assert run_command(["run", "lanes.npz", *GPU, "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["by"] is None
    assert report["l1"]["accesses"] == addresses.size * 4 // 32


def test_the_printed_report_fits_a_hundred_columns(
    trace_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["run", str(trace_file), "--gpu", "rx-6900-xt"]) == 0
    said = capsys.readouterr()
    assert max(map(len, said.out.splitlines())) <= 100
    assert "prof" in said.out and "miss rate" in said.out
    assert "time per stage" in said.err


def test_sweep_writes_the_grid_and_its_picture(folder: Path, trace_file: Path) -> None:
    axes = ["--axis", "l1.capacity=12KiB,24KiB,48KiB", "--axis", "l2.capacity=1536KiB,3MiB"]
    assert run_command(["sweep", str(trace_file), *GPU, *axes, "-o", "grid.csv"]) == 0
    grid = pd.read_csv(folder / "grid.csv")
    assert len(grid) == 6
    assert set(grid["l1.capacity"]) == {12 << 10, 24 << 10, 48 << 10}
    assert (folder / "grid.png").stat().st_size > 1000
    assert sorted(p.name for p in folder.iterdir()) == ["grid.csv", "grid.png"]


def test_sweep_agrees_with_run(folder: Path, trace_file: Path) -> None:
    arguments = [str(trace_file), *GPU]
    assert run_command(["sweep", *arguments, "--axis", "l1.capacity=24KiB", "-o", "s.csv"]) == 0
    assert run_command(["run", *arguments, "--set", "l1.capacity=24KiB", "--json", "r.json"]) == 0
    report = json.loads((folder / "r.json").read_text())
    row = pd.read_csv(folder / "s.csv").iloc[0]
    assert row["l1.misses"] == report["l1"]["misses"]
    assert row["dram.bytes"] == report["dram"]["bytes"]


@pytest.mark.parametrize("level", ["l1", "l2"])
def test_no_policy_beats_the_bound(
    level: str, trace_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["bound", str(trace_file), *GPU, "--level", level]) == 0
    said = capsys.readouterr().out
    misses = {
        policy: int(count.replace(",", ""))
        for policy, count in re.findall(r"^ (lru|OPT) +([\d,]+) ", said, re.MULTILINE)
    }
    assert set(misses) == {"lru", "OPT"}
    assert 0 < misses["OPT"] <= misses["lru"]


def test_check_and_info_state_what_the_trace_holds(
    trace_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fetches = f"{sum(c.num_lane_fetches for c in small_trace().chunks()):,} lane fetches"
    assert run_command(["check", str(trace_file)]) == 0
    assert fetches in capsys.readouterr().out
    assert run_command(["info", str(trace_file)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert fetches in said and "sampling" in said and "B per lane fetch" in said


def test_presets_list_show_and_diff(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["presets"]) == 0
    listed = capsys.readouterr().out
    assert "titan-x-pascal-gpgpusim" in listed and "amd-64k-rx-navi21" in listed
    assert run_command(["presets", "show", "rtx-2080-ti", "--set", "l1.capacity=32KiB"]) == 0
    shown = capsys.readouterr().out
    assert "32 KiB" in shown and "l2.partition_hash" in shown
    assert "Against silicon (`cachesim validate silicon`): not measured" in shown
    assert run_command(["presets", "diff", "rtx-2060", "rtx-2080-ti"]) == 0
    differences = capsys.readouterr().out
    assert "5.5 MiB" in differences and "l1.capacity" not in differences
    assert max(map(len, (listed + shown + differences).splitlines())) <= 100


def test_layouts_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["layouts"]) == 0
    said = capsys.readouterr().out
    assert "block-linear-turing" in said and "RGBA16F" in said
    assert max(map(len, said.splitlines())) <= 100


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | environment,
    )


def test_the_command_line_loads_nothing_heavy_for_its_help() -> None:
    heavy = ["numba", "numpy", "pandas", "pyopencl", "matplotlib", "pyarrow", "pydantic"]
    done = python(
        "import sys; from experiments.cli import run_command; code = run_command(['--help']);"
        f"print(sorted(set({heavy}) & set(sys.modules)), code, file=sys.stderr)"
    )
    assert done.stderr.strip() == "[] 0"
    assert "record" in done.stdout and "doctor" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "T", *GPU, "--json", "-"],
        ["sweep", "T", *GPU, "--axis", "l1.capacity=24KiB", "-o", "s.csv"],
        ["bound", "T", *GPU],
        ["presets"],
        ["layouts"],
        ["info", "T"],
        ["check", "T"],
    ],
    ids=lambda a: a[0],
)
def test_saved_traces_need_no_opencl(arguments: list[str], folder: Path, trace_file: Path) -> None:
    arguments = [str(trace_file) if a == "T" else a for a in arguments]
    done = python(
        "import sys; sys.modules['pyopencl'] = None;"  # any import of it now fails
        "from experiments.cli import main;"
        f"main({arguments!r})"
    )
    assert done.returncode == 0, done.stderr


def interrupt(arguments: list[str], ready: Path | None = None) -> tuple[int, str]:
    """Start a command, send it SIGINT once it works (`ready` holds a file), and wait for it."""
    child = subprocess.Popen(
        [sys.executable, "-m", "experiments.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while ready is not None and not any(ready.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.0 if ready is not None else 5.0)
    assert child.poll() is None, child.communicate()[1]
    child.send_signal(signal.SIGINT)
    _, error = child.communicate(timeout=60)
    return child.returncode, error


def test_an_interrupted_sweep_leaves_nothing_half_written(folder: Path, tmp_path: Path) -> None:
    trace = tmp_path / "big.parquet"
    write_parquet(stream(20000), trace)
    axis = "l1.capacity=" + ",".join(f"{24 * k}KiB" for k in range(1, 400))
    code, error = interrupt(["sweep", str(trace), *GPU, "--axis", axis, "-o", "s.csv"])
    assert code == 130, error
    assert error.strip().splitlines()[-1] == "cachesim: error: interrupted"
    assert "Traceback" not in error
    # What was finished is kept, whole, under a name of its own.
    assert {path.name for path in folder.iterdir()} <= {"s.partial.csv"}
    for path in folder.iterdir():
        kept = pd.read_csv(path)
        assert 0 < len(kept) < 399
        assert kept["l1.accesses"].notna().all()


@pytest.mark.opencl
def test_an_interrupted_recording_leaves_nothing_half_written(folder: Path) -> None:
    arguments = ["record", "--scene", "close", "--frames", "200", "--traced-frames", "all"]
    code, error = interrupt([*arguments, "--size", "960x540", "-o", "t.parquet"], ready=folder)
    assert code == 130, error
    assert error.strip().splitlines()[-1] == "cachesim: error: interrupted"
    assert "Traceback" not in error
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(("seconds", "is_shown"), [(0.4, True), (0.0, False)])
def test_a_progress_bar_shows_itself_only_for_long_work(
    seconds: float, is_shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(
        console, "console", lambda stderr: Console(file=terminal, force_terminal=True)
    )
    monkeypatch.setattr(console.Progress, "SHOW_AFTER_S", 0.1)
    with console.progress("counting sheep", 10) as bar:
        time.sleep(seconds)
        bar.update(5)
    assert ("counting sheep" in terminal.getvalue()) is is_shown


def test_no_device_is_one_line_and_exit_code_1(
    folder: Path, without_opencl: dict[str, str]
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "experiments.cli", "record", "--size", "16x8", "-o", "t.parquet"],
        capture_output=True,
        text=True,
        check=False,
        env=without_opencl,
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("cachesim: error: ")
    assert "OpenCL" in done.stderr
    assert list(folder.iterdir()) == []


def test_no_space_on_the_disk_is_one_line_and_exit_code_1(
    folder: Path,
    trace_file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    assert run_command(["run", str(trace_file), *GPU, "--json", "r.json"]) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert error[-1].startswith("cachesim: error: r.json") and "No space left" in error[-1]
    assert list(folder.iterdir()) == []
