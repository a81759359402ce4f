"""`cachesim validate accel-sim`: the comparison itself, and the model held to it on small traces.

All traces are compared by the command; those here are the ones that take little time.
"""

import csv
import re
from pathlib import Path

import matplotlib.colors
import pandas as pd
import pytest

from experiments import accel_sim_oracle, validate_accel_sim
from experiments.accel_sim_oracle import CONFIGS, QUANTITIES, RESULTS, VERSION
from experiments.cli import run_command
from experiments.validate_accel_sim import compare, compare_run, summarise, verdicts
from experiments.validate_plots import correlation_figure
from traces.errors import InputError

TRACES = (
    "chase",
    "empty",
    "latency_l1",
    "latency_dram",
    "l1_throughput",
    "g32_morton_shared",
    "far200_morton",
)


@pytest.fixture(scope="module")
def frame() -> pd.DataFrame:
    """Every machine on `TRACES`."""
    return compare(accel_sim_oracle.read_results(), list(CONFIGS), TRACES)


def row_of(config: str, trace: str = "a", **found: int) -> dict[str, object]:
    """A comparison in which Accel-Sim had 10000 cycles and 1000 of everything, and we the same but
    for `found`.
    """
    expected = {"cycles": 15_000, "run_cycles": 10_000} | {
        name: 1000 for name in QUANTITIES if "cycles" not in name
    }
    return compare_run(config, trace, expected | found, expected)


def test_accesses_that_depend_on_the_trace_alone_are_equal(frame: pd.DataFrame) -> None:
    assert (frame["l1_accesses_ours"] == frame["l1_accesses_theirs"]).all()
    bypassed = frame[frame["config"] == "SM6_TITANX"]
    assert (bypassed["l2_accesses_ours"] == bypassed["l2_accesses_theirs"]).all()
    assert (bypassed["l1_accesses_ours"] == 0).all()
    assert frame["l2_accesses_theirs"].sum() > 1_000_000


@pytest.mark.parametrize("trace", TRACES)
def test_cycles_are_accel_sims(frame: pd.DataFrame, trace: str) -> None:
    part = frame[frame["trace"] == trace]
    for name in ("cycles", "run_cycles"):
        assert part[f"{name}_error"].abs().max() <= 0.20, part[f"{name}_error"].tolist()


@pytest.mark.parametrize("trace", ["chase", "latency_l1", "latency_dram", "l1_throughput"])
def test_unloaded_latencies_and_l1_throughput_are_accel_sims(
    frame: pd.DataFrame, trace: str
) -> None:
    part = frame[frame["trace"] == trace]
    assert part["run_cycles_error"].abs().max() <= 0.005, part["run_cycles_error"].tolist()
    for level in ("l1", "l2"):
        assert (part[f"{level}_misses_ours"] == part[f"{level}_misses_theirs"]).all()


@pytest.mark.parametrize("trace", ["far200_morton"])
def test_misses_of_scattered_fetches_are_accel_sims(frame: pd.DataFrame, trace: str) -> None:
    part = frame[frame["trace"] == trace]
    for name in ("l1_misses", "l2_accesses", "l2_misses"):
        assert part[f"{name}_within"].all(), part[f"{name}_error"].tolist()


def test_the_mean_error_of_these_traces_is_within_its_bound(frame: pd.DataFrame) -> None:
    summary = summarise(frame)
    cycles = summary[summary["quantity"].isin(["cycles", "cycles without launch"])]
    assert set(cycles["config"]) == {*CONFIGS, "all"}
    assert cycles["met"].all()
    assert (cycles["correlation"] > 0.99).all()


def test_launch_is_left_out_on_both_sides() -> None:
    results = accel_sim_oracle.read_results()
    expected = accel_sim_oracle.theirs(results.loc[("SM75_RTX2060", "empty")])
    assert (expected["cycles"], expected["run_cycles"]) == (5071, 71)


def test_a_counter_is_within_three_percent_or_half_a_percent_of_the_accesses() -> None:
    def within(expected: int, found: int, accesses: int) -> bool:
        base = dict.fromkeys(QUANTITIES, accesses)
        row = compare_run(
            "SM75_RTX2060", "a", base | {"l1_misses": found}, base | {"l1_misses": expected}
        )
        return bool(row["l1_misses_within"])

    assert within(100, 103, 100) and not within(100, 104, 100)
    # 0.5 % of 1000 accesses are 5.
    assert within(100, 105, 1000) and not within(100, 106, 1000)
    assert within(100, 97, 100) and not within(100, 94, 1000)
    assert within(0, 0, 0) and within(0, 5, 1000) and not within(0, 6, 1000)


def test_what_the_trace_alone_decides_must_be_equal() -> None:
    assert not row_of("SM75_RTX2060", l1_accesses=1001)["l1_accesses_within"]
    assert not row_of("SM6_TITANX", l2_accesses=1001)["l2_accesses_within"]
    assert row_of("SM75_RTX2060", l2_accesses=1001)["l2_accesses_within"]


def test_verdicts_name_the_runs_that_miss_a_bound_worst_first() -> None:
    rows = [
        row_of("SM6_TITANX", "fine"),
        row_of("SM6_TITANX_L1", "near", l1_misses=1050),
        row_of("SM75_RTX2060", "far", l1_misses=700, cycles=18_500, run_cycles=13_500),
    ]
    told = verdicts(pd.DataFrame(rows))
    assert told[0] == (
        "Cycles, launch included: mean error SM6_TITANX 0.0%, SM6_TITANX_L1 0.0%, "
        "SM75_RTX2060 23.3% (bound 10%), worst +23.3% in SM75_RTX2060 far (bound 20%): "
        "outside: the mean of SM75_RTX2060, SM75_RTX2060 far +23.3%."
    )
    misses = next(line for line in told if line.startswith("L1 misses"))
    assert misses.endswith("(not: SM75_RTX2060 far -30.0%, SM6_TITANX_L1 near +5.0%).")
    assert "1 of 3 runs within 3% or 0.5% of the accesses" in misses
    accesses = next(line for line in told if line.startswith("L2 accesses"))
    assert "1 of 1 runs equal where loads skip the L1; 2 of 2 runs within" in accesses
    assert told[-1] == (
        "Bounds not met: Cycles, launch included; Cycles, launch excluded; L1 misses."
    )
    assert verdicts(pd.DataFrame(rows[:1]))[-1] == "All bounds are met."


def test_the_summary_leaves_out_runs_in_which_a_quantity_does_not_occur() -> None:
    nothing = dict.fromkeys(QUANTITIES, 0) | {"cycles": 5050, "run_cycles": 50}
    rows = [
        compare_run("SM75_RTX2060", "empty", nothing, nothing),
        row_of("SM75_RTX2060", "a", l1_misses=1010),
        row_of("SM75_RTX2060", "b", l1_misses=970),
    ]
    summary = summarise(pd.DataFrame(rows)).set_index("quantity")
    misses = summary.loc["L1 misses"]
    assert misses["mean_error"] == pytest.approx(0.02)
    assert (misses["worst_error"], misses["worst_trace"]) == (pytest.approx(-0.03), "b")
    assert (misses["num_within"], misses["num_runs"]) == (2, 2)
    assert pd.isna(misses["correlation"])
    assert summary.loc["cycles", "num_runs"] == 3
    assert summary.loc["cycles", "correlation"] == pytest.approx(1.0)


def test_the_version_is_the_one_that_the_numbers_say() -> None:
    told = " ".join(RESULTS.with_name("README.md").read_text(encoding="utf-8").split())
    hashes = re.findall(r"\b[0-9a-f]{7,8}\b", VERSION)
    assert len(hashes) == 2 and all(each in told for each in hashes)
    assert VERSION.endswith("October 2024") and "October 2024" in told


def test_the_plot_has_a_panel_per_quantity_and_a_point_per_run(frame: pd.DataFrame) -> None:
    figure = correlation_figure(frame)
    panels = dict(zip(QUANTITIES, figure.axes, strict=True))
    for name, axes in panels.items():
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
        points = [line for line in axes.lines if line.get_linestyle() == "None"]
        shown = sum(len(line.get_xdata()) for line in points)
        assert shown == (frame[f"{name}_theirs"] > 0).sum()
        diagonal = next(line for line in axes.lines if line.get_linestyle() == "-")
        assert (diagonal.get_xdata() == diagonal.get_ydata()).all()
    looks = {(line.get_color(), line.get_marker()) for line in panels["cycles"].lines[1:]}
    colours, markers = zip(*(look for look in looks if look[1] != "None"), strict=True)
    assert len(set(colours)) == len(set(markers)) == len(CONFIGS)
    # Colours that differ in lightness as well are told apart in grey.
    assert len({round(sum(matplotlib.colors.to_rgb(c)), 2) for c in colours}) == len(CONFIGS)


def test_the_command_prints_the_tables_and_writes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    arguments = ["validate", "accel-sim", "--config", "SM6_TITANX", "--trace", "chase"]
    assert run_command([*arguments, "-o", str(folder)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    for text in (VERSION, "9,420", "Cycles, launch excluded:", "All bounds are met."):
        assert text in told
    tables = ("accel-sim", "accel-sim-counters", "accel-sim-summary")
    files = {f"{table}.{suffix}" for table in tables for suffix in ("csv", "md", "tex")}
    assert {path.name for path in folder.iterdir()} == files | {"accel-sim.png", "accel-sim.pdf"}
    with (folder / "accel-sim.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["cycles_theirs"] == "9420" and row["l2_misses_ours"] == "128"


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--config", "SM6_TITAN", "unknown config 'SM6_TITAN'; did you mean 'SM6_TITANX'"),
        ("--trace", "chas", "unknown oracle trace 'chas'; did you mean 'chase'"),
    ],
)
def test_an_unknown_name_is_refused(
    option: str, value: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["validate", "accel-sim", option, value]) == 2
    assert said in capsys.readouterr().err


def test_numbers_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"results\.csv: no such file.*checkout"):
        accel_sim_oracle.read_results(tmp_path / "results.csv")
    cut = tmp_path / "cut.csv"
    cut.write_text("\n".join(RESULTS.read_text(encoding="utf-8").splitlines()[:-1]))
    with pytest.raises(InputError, match=r"cut\.csv: no row for config \w+, trace \w+"):
        accel_sim_oracle.read_results(cut)
    assert validate_accel_sim.relative_error(1, 0) == float("inf")
