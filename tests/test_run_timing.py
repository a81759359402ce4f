"""`cachesim run --timing`: tables, JSON, timeline, roofline and stat lines of the same run."""

import json
from pathlib import Path

import pytest

from experiments.cli import run_command
from experiments.gpgpusim_format import parse_stat_lines
from traces.parquet import write_parquet
from traces.synthetic import scatter

GPU = "titan-x-pascal-gpgpusim"


@pytest.fixture(scope="module")
def trace_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("traces") / "t.parquet"
    write_parquet(scatter(64, 32, 6.0, 4), path)
    return path


@pytest.fixture
def run(trace_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs `cachesim run` on the trace in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *options: run_command(["run", str(trace_file), "--gpu", GPU, *options])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--timeline", "t.json"], ["--timeline t.json", "add --timing"]),
        (["--roofline", "r.png"], ["--roofline r.png", "add --timing"]),
        (["--format", "gpgpusim"], ["--format gpgpusim", "add --timing"]),
        (["--timing", "--format", "gpgpusm"], ["'gpgpusm'", "'gpgpusim'"]),
        (["--timing", "--format", "gpgpusim", "--json", "-"], ["--format gpgpusim", "--json -"]),
        (["--timing", "--timeline", "t.txt"], ["t.txt", ".json"]),
        (["--timing", "--roofline", "r.bmp"], ["r.bmp", ".png, .pdf, .svg"]),
        (["--timing", "--timeline", "no/t.json"], ["no/t.json", "'no'"]),
        (["--timing", "--roofline", "no/r.png"], ["no/r.png", "'no'"]),
    ],
)
def test_options_that_do_not_fit_are_one_line_and_nothing_is_written(
    run, options: list[str], told: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*options) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("cachesim: error: ") and all(word in line for word in told)
    assert not list(tmp_path.iterdir())


def test_a_gpu_without_timing_tables_says_which_are_missing(
    run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--timing", "--set", "dram_timing=none") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "dram_timing" in line


def test_all_outputs_of_one_run_agree(
    run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ["--json", "r.json", "--timeline", "t.json", "--roofline", "r.png"]
    assert run("--timing", *files) == 0
    said = capsys.readouterr().out
    for title in ("Cache levels of", "Traffic and latency on", "Cycles of", "Where the cycles of"):
        assert f"{title} {GPU}" in said
    assert sum(line.startswith("Bottleneck: ") for line in said.splitlines()) == 1
    assert max(map(len, said.splitlines())) <= 100 and "…" not in said
    cycles = json.loads((tmp_path / "r.json").read_text())["cycles"]
    assert f"{cycles['total']:,}" in said
    assert sum(cycles["where"].values()) == cycles["total"] > cycles["launch"] > 0
    timeline = json.loads((tmp_path / "t.json").read_text())["traceEvents"]
    ends = [e["args"]["cycle"] + e["args"]["cycles"] for e in timeline if e["ph"] == "X"]
    assert 0 < max(ends) <= cycles["total"]
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")


def test_stat_lines_are_alone_on_stdout_and_agree_with_the_report(
    run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--timing", "--format", "gpgpusim", "--json", "r.json") == 0
    said = capsys.readouterr()
    report = json.loads((tmp_path / "r.json").read_text())
    found = parse_stat_lines(said.out)
    assert said.out.startswith("kernel_name = t ")
    assert found["gpu_sim_cycle"] == report["cycles"]["total"]
    assert found["L2_total_cache_accesses"] == report["l2"]["accesses"]
    assert found["L2_total_cache_misses"] == report["l2"]["misses"]
    l1 = found.get("L1T_total_cache_accesses", 0) + found.get("L1D_total_cache_accesses", 0)
    assert l1 == report["l1"]["accesses"]
    # Texture fetches are a filter's footprint here and one texel per lane there: it says so.
    assert "footprint" in said.err


def test_a_run_without_timing_has_no_cycles(run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--json", "-") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["cycles"] is None and report["time_ms"] is None
