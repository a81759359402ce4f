"""`cachesim bench`: the timing model's speed, and a user's own Accel-Sim beside ours."""

import csv
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from experiments import bench_accel_sim, bench_timing
from experiments.accel_sim_oracle import CONFIGS, RESULTS, read_results
from experiments.bench_timing import speed_frame, speed_table
from experiments.cli import run_command
from traces.errors import InputError, WorkError

#: Behaves as accel-sim.out does: reads its list and configurations, prints GPGPU-Sim's lines.
FAKE = """#!{python}
import sys
from pathlib import Path

arguments = sys.argv[1:]
options = dict(zip(arguments[::2], arguments[1::2]))
traces = Path(options["-trace"])
for name in traces.read_text().split():
    header = (traces.parent / name).read_text().partition("#")[0]
    version = [line.split()[-1] for line in header.splitlines() if "binary version" in line]
configs = [value for key, value in zip(arguments[::2], arguments[1::2]) if key == "-config"]
print("versions", version, "configs", [Path(c).read_text() for c in configs])
{body}
"""
FINE = """
print("gpu_sim_cycle = 7")
for cycles in (1, 9420):
    print(f"gpu_tot_sim_cycle = {cycles}")
print("\\tL2_cache_stats_breakdown[GLOBAL_ACC_R][HIT] = 28")
print("\\tL2_cache_stats_breakdown[GLOBAL_ACC_R][MISS] = 60")
print("\\tL2_cache_stats_breakdown[GLOBAL_ACC_R][SECTOR_MISS] = 40")
print("\\tL2_cache_stats_breakdown[GLOBAL_ACC_W][MISS] = 5")
"""


def build(root: Path, body: str = FINE) -> Path:
    """A tree with a built Accel-Sim that runs `body`."""
    simulator = root / "gpu-simulator"
    binary = simulator / "bin" / "release" / "accel-sim.out"
    binary.parent.mkdir(parents=True)
    binary.write_text(FAKE.format(python=sys.executable, body=body))
    binary.chmod(0o755)
    for name in ("SM6_TITANX", "SM75_RTX2060"):
        config = simulator / "gpgpu-sim" / "configs" / "tested-cfgs" / name
        config.mkdir(parents=True)
        (config / "gpgpusim.config").write_text(f"-name {name}")
        (config / "net.icnt").write_text("k = 1;")
        traced = simulator / "configs" / "tested-cfgs" / name
        traced.mkdir(parents=True)
        (traced / "trace.config").write_text("-trace_opcode_latency_initiation_int 4,1")
    return binary


def run_chase(path: Path, config: str = "SM6_TITANX", kept: Path | None = None) -> pd.DataFrame:
    found = bench_accel_sim.find_accel_sim(path, None, [config])
    return bench_accel_sim.run_beside(found, [config], ["chase"], kept)


def test_both_simulators_run_the_exported_trace_and_are_timed(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    (row,) = run_chase(build(tmp_path), kept=kept).to_dict("records")
    assert (row["cycles_theirs"], row["run_cycles_theirs"]) == (9420, 4420)
    assert (row["l2_accesses_theirs"], row["l2_misses_theirs"]) == (128, 100)
    assert row["l2_accesses_ours"] == row["sectors"] == 128
    # A Python interpreter starts slower than a chase is timed, and neither takes no time.
    assert row["seconds"] > 0 and row["accel_sim_s"] > 0
    output = (kept / "SM6_TITANX" / "chase" / "output.txt").read_text()
    assert "versions ['61']" in output
    assert "['-name SM6_TITANX', '-trace_opcode_latency_initiation_int 4,1']" in output
    assert (kept / "SM6_TITANX" / "chase" / "net.icnt").is_file()


def test_the_kept_command_runs_accel_sim_again(tmp_path: Path) -> None:
    kept = tmp_path / "with space"
    kept.mkdir()
    run_chase(build(tmp_path / "tree"), "SM75_RTX2060", kept)
    run = kept / "SM75_RTX2060" / "chase"
    again = subprocess.run([run / "run.sh"], capture_output=True, text=True, check=True, cwd="/")
    assert again.stdout == (run / "output.txt").read_text()
    assert "versions ['75']" in again.stdout


def test_the_titan_with_its_l1_is_asked_for_after_the_files(tmp_path: Path) -> None:
    found = bench_accel_sim.find_accel_sim(build(tmp_path).parents[3], None, list(CONFIGS))
    arguments = found.arguments("SM6_TITANX_L1", Path("t/kernelslist.g"))
    assert shlex.join(arguments[1:]) == (
        "-trace t/kernelslist.g -config gpgpusim.config -config trace.config -gpgpu_gmem_skip_L1D 0"
    )


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("print('no GPU'); sys.exit(3)", "exit code 3: no GPU"),
        ("print('gpu_sim_cycle = 7')", "printed no gpu_tot_sim_cycle: gpu_sim_cycle = 7"),
    ],
)
def test_an_accel_sim_that_fails_is_named_with_its_last_words(
    tmp_path: Path, body: str, said: str
) -> None:
    binary = build(tmp_path, body)
    with pytest.raises(WorkError) as error:
        run_chase(binary)
    assert said in str(error.value) and str(binary) in str(error.value)
    assert "SM6_TITANX chase" in str(error.value)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    binary = build(tmp_path)
    with pytest.raises(InputError, match=r"nowhere: no accel-sim\.out there"):
        run_chase(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no SM6_TITANX/gpgpusim\.config in .*--accel-sim-conf"):
        bench_accel_sim.find_accel_sim(binary, tmp_path, ["SM6_TITANX"])
    binary.chmod(0o644)
    with pytest.raises(InputError, match="is not executable"):
        run_chase(binary)


def test_the_command_runs_every_machine_and_writes_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_timing, "QUICK", ("chase",))
    tree = build(tmp_path / "tree").parents[3]
    stem = tmp_path / "beside"
    arguments = ["bench", "--quick", "--accel-sim", str(tree), "-o", str(stem)]
    assert run_command(arguments) == 0
    with stem.with_suffix(".csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["config"], r["trace"]) for r in rows] == [
        (config, trace) for config in CONFIGS for trace in ("chase", "all")
    ]
    for one, total in zip(rows[::2], rows[1::2], strict=True):
        assert float(total["ratio"]) == pytest.approx(
            float(one["accel_sim_s"]) / float(one["seconds"])
        )
    # Without the breaks of long lines.
    told = re.sub(r"\s", "", capsys.readouterr().out)
    assert str(tree) in told
    # The fake prints nothing of the L1, which the words say.
    assert "L1accesses:0of2runsequal(not:SM6_TITANX_L1chase+inf%" in told


def test_options_without_meaning_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["bench", "--accel-sim-keep", "x"]) == 2
    assert "--accel-sim-keep x: needs --accel-sim" in capsys.readouterr().err
    assert run_command(["bench", "--only", "streams"]) == 2
    assert "unknown measurement 'streams'; did you mean 'stream'" in capsys.readouterr().err


def test_a_timing_measurement_is_a_json_line_with_exact_sectors(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench_timing.main("SM6_TITANX", "2", "chase,l1_throughput")
    found = json.loads(capsys.readouterr().out)
    results = read_results().loc["SM6_TITANX"]
    assert {r["trace"]: r["sectors"] for r in found["rows"]} == {
        name: results.loc[name, "l2_accesses"] for name in ("chase", "l1_throughput")
    }
    assert all(row["seconds"] > 0 and row["cpu_s"] > 0 for row in found["rows"])


def test_speed_is_the_ratio_of_sums_beside_accel_sims_own() -> None:
    def measured(seconds: float) -> dict[str, object]:
        rows = [
            {"trace": "chase", "sectors": 100, "seconds": seconds, "cpu_s": 0.25},
            {"trace": "stream", "sectors": 900, "seconds": 3 * seconds, "cpu_s": 0.25},
        ]
        return {"rows": rows, "peak_gib": seconds}

    results = pd.read_csv(RESULTS).set_index(["config", "trace"])
    frame = speed_frame({"SM6_TITANX": measured(0.5), "SM75_RTX2060": measured(2.0)}, results)
    assert frame["config"].tolist() == ["SM6_TITANX", "SM75_RTX2060", "all"]
    assert frame["msectors_per_s"].tolist() == pytest.approx([5e-4, 1.25e-4, 2e-4])
    wall_s = results.loc["SM6_TITANX"].loc[["chase", "stream"], "wall_s"].sum()
    assert frame["accel_sim_sectors_per_s"][0] == pytest.approx(1000 / wall_s)
    assert frame["ratio"][0] == pytest.approx(wall_s / 2)
    assert frame["cpu_s"].tolist() == [0.5, 0.5, 1.0]
    assert frame["peak_gib"][2] == 2.0
    table = speed_table(frame, 3, 21.5, 1.5, "a machine")
    notes = " ".join(table.notes)
    assert "median of 3 runs" in notes and "21.5 s; afterwards 1.5 s" in notes
