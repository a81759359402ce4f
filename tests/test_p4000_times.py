"""The P4000 times: cases, resuming, tables and words; and the command end to end at a tiny size."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cachesim import presets
from experiments import p4000_plots, p4000_study, p4000_tables, p4000_words
from experiments.cli import run_command
from experiments.p4000_cases import METHODS, PUBLISHED_MS, SCENES, Case, list_cases
from experiments.p4000_times import select
from kernels.grid import Grid
from kernels.selfcheck import small_gbuffer
from traces.errors import InputError

GPU = "quadro-p4000"


def make_pass(name, ms, **changes):
    """A pass as a cell holds it, bound by DRAM."""
    given = {
        "pass": name,
        "time_ms": ms,
        "cycles": int(ms * 1_480_000),
        "launch_cycles": 0,
        "bound": "dram",
        "bound_share": 0.6,
        "where": {"dram": 6, "issue": 4},
        "occupancy": 0.5,
        "warp_instructions": {"memory": 10},
        "l1_mb": 800.0,
        "l1_miss_rate": 0.9,
        "l2_mb": 720.0,
        "l2_miss_rate": 0.25,
        "dram_mb": 180.0,
        "dram_of_peak": 0.75,
    }
    return given | changes


def make_cell(scene, method, sampling_ms, scale="legacy", planes="all", **changes):
    """A cell whose other passes take 0.5 ms together."""
    names = ["setup", "prefilter", "combine"] + ["update"] * (method == "adaptive")
    passes = [make_pass(n, 0.5 / len(names)) for n in names] + [make_pass("sampling", sampling_ms)]
    count = 16.0 if method == "adaptive" else float(METHODS[method].num_samples)
    given = {
        "scene": scene,
        "scale": scale,
        "planes": planes,
        "method": method,
        "gpu": GPU,
        "size": "1920x1080",
        "coverage_rate": 0.9,
        "pixels_per_mm": 20.0,
        "mean_count": count,
        "warp_count": 2 * count if method == "adaptive" else count,
        "lane_fetches": 1,
        "time_ms": 0.5 + sampling_ms,
        "passes": passes,
    }
    return given | changes


def test_published_parts_sum_to_the_published_totals():
    for (scene, method), parts in PUBLISHED_MS.items():
        if method == "baseline":
            continue
        rest = sum(ms for name, ms in parts.items() if name != "total")
        expected = 10.57 if (scene, method) == ("ear", "fixed") else parts["total"]
        assert rest == pytest.approx(expected, abs=0.011)
    # The slide says how many times slower than adaptive the baseline is.
    ratio = PUBLISHED_MS["close", "baseline"]["total"] / PUBLISHED_MS["close", "adaptive"]["total"]
    assert ratio == pytest.approx(91.07, abs=0.005)


def test_cases_cover_every_combination_and_begin_with_the_papers_own():
    cases = list_cases()
    assert len({case.name for case in cases}) == len(cases) == 3 * 2 * 2 * len(METHODS)
    assert [case.name for case in cases[:3]] == [f"{s}-legacy-all-fixed" for s in SCENES]
    assert {METHODS[m].num_samples for m in METHODS if not METHODS[m].adaptive} == {8, 16, 32, 64}


def test_the_baseline_reads_mip_0_alone_and_plane_sets_change_what_is_read_not_how_many():
    baseline = Case("close", "legacy", "all", "baseline").settings
    assert baseline.mip_rule == "mip0" and not baseline.prefilter and baseline.num_samples == 64
    irradiance = Case("close", "physical", "irradiance", "adaptive").settings
    assert irradiance.planes == ("colour",) and irradiance.scale == "physical"
    assert irradiance.sigma0_sq == 0.001, "the paper's target variance, with the paper's rule"


def test_only_selects_scenes_and_methods_by_name():
    methods = tuple(METHODS)
    assert select(None, (SCENES, methods)) == (SCENES, methods)
    assert select("front", (SCENES, methods)) == (("front",), methods)
    assert select("adaptive,ear,fixed", (SCENES, methods)) == (("ear",), ("fixed", "adaptive"))
    with pytest.raises(InputError, match=r"--only.*'fronts'.*did you mean 'front'"):
        select("fronts", (SCENES, methods))


@pytest.fixture
def study(monkeypatch, tmp_path):
    """run(gpu) -> names measured, over four small cases whose measuring is replaced."""
    gbuffer = small_gbuffer()
    cases = [
        Case("front", "legacy", p, m) for p in ("all", "irradiance") for m in ("fixed", "forced-8")
    ]
    measured = []

    def measure(case, gbuffer, counts, gpu, device, progress):
        if case.name == run.fails_at:
            raise KeyboardInterrupt
        measured.append(case.name)
        progress(1.0)
        return {"name": case.name, "time_ms": float(counts.max())}

    def run(gpu, fails_at=None):
        measured.clear()
        run.fails_at = fails_at
        told, shares = [], []
        try:
            run.cells = p4000_study.run_cases(
                cases, {"front": gbuffer}, gpu, tmp_path, told=told.append, progress=shares.append
            )
        except KeyboardInterrupt:
            run.cells = None
        run.told, run.shares = told, shares
        return list(measured)

    monkeypatch.setattr(p4000_study, "measure", measure)
    run.names = [case.name for case in cases]
    return run


@pytest.mark.opencl
def test_a_finished_case_is_not_timed_again(study):
    gpu = presets.load(GPU)
    assert study(gpu) == study.names
    first = study.cells
    assert study(gpu) == [] and study.cells == first
    assert study.told[0].startswith("4 of 4 cases lie finished")


@pytest.mark.opencl
def test_a_stopped_run_goes_on_where_it_was(study, tmp_path):
    gpu = presets.load(GPU)
    assert study(gpu, fails_at=study.names[2]) == study.names[:2]
    assert {p.stem for p in tmp_path.iterdir()} == set(study.names[:2]), "whole files, no parts"
    assert study(gpu) == study.names[2:]
    assert study.shares == sorted(study.shares) and study.shares[-1] == pytest.approx(1)
    assert "left" in study.told[1] and study.told[1].startswith("3 of 4")


@pytest.mark.opencl
def test_another_machine_or_a_broken_file_is_timed_again(study, tmp_path):
    gpu = presets.load(GPU)
    study(gpu)
    (tmp_path / f"{study.names[1]}.json").write_text('{"time_ms": 1')
    assert study(gpu) == [study.names[1]]
    assert study(gpu.model_copy(update={"clock_hz": 1_202_000_000})) == study.names


def test_a_digest_tells_one_light_on_a_scene_from_another():
    gbuffer = small_gbuffer()
    dimmer = dataclasses.replace(gbuffer, irradiance=gbuffer.irradiance * np.float32(0.5))
    assert p4000_study.digest(gbuffer) == p4000_study.digest(small_gbuffer())
    assert p4000_study.digest(gbuffer) != p4000_study.digest(dimmer)


def test_the_count_that_a_warp_waits_for_is_its_largest():
    rng = np.random.default_rng(4)
    counts = rng.integers(0, 65, (21, 30)).astype(np.uint16)
    counts[0:4, 8:16] = 0
    largest = [counts[y : y + 4, x : x + 8].max() for y in range(0, 21, 4) for x in range(0, 30, 8)]
    expected = np.mean([n for n in largest if n])
    assert p4000_study._warp_count(counts, Grid(30, 21, "raster", "linear")) == expected


def test_a_time_is_worth_the_forced_count_that_takes_as_long():
    forced = {n: 2 + 0.5 * n for n in (8, 16, 32, 64)}
    for n in (4, 8, 11, 20, 64, 80):
        assert p4000_tables.count_worth(forced, 2 + 0.5 * n) == pytest.approx(n)
    assert p4000_tables.count_worth(forced | {16: math.nan, 32: math.nan}, 2 + 0.5 * 20) == 20
    assert math.isnan(p4000_tables.count_worth({8: 1.0}, 1.0))
    assert math.isnan(p4000_tables.count_worth({8: 1.0, 64: 1.0}, 1.0)), "no time per sample"


def test_ratios_stand_beside_the_published():
    cells = [
        make_cell("close", m, t)
        for m, t in (("fixed", 12.0), ("adaptive", 3.0), ("baseline", 30.0))
    ]
    row = p4000_tables.ratios_frame(cells).iloc[0]
    assert row["sampling_ratio"] == 0.25 and row["count_ratio"] == 0.25
    assert row["paper_sampling_ratio"] == pytest.approx(0.140, abs=5e-4)
    assert row["baseline_ratio"] == pytest.approx(30.5 / 12.5)
    assert row["paper_baseline_ratio"] == pytest.approx(22.07, abs=0.01)


def test_each_time_stands_under_the_published_with_its_bound_count_and_coverage():
    cells = [make_cell("ear", "adaptive", 2.5), make_cell("ear", "adaptive", 2.0, "physical")]
    table = p4000_tables.times_table(cells, GPU, "1920x1080")
    paper, ours, physical = (row for _, row in table.frame.iterrows())
    assert (paper["scale"], paper["sampling"], paper["total"]) == ("paper", "2.72", "4.03")
    assert (ours["sampling"], ours["mean_count"], ours["coverage"]) == ("2.50 d", "16.0", "90.0%")
    assert physical["scale"] == "physical" and physical["total"] == "2.50"
    assert "d DRAM" in table.notes[0]
    small = p4000_tables.times_table(cells, GPU, "480x270")
    assert "not how the times compare" in small.notes[0]


def test_the_csv_holds_every_pass_with_its_published_time():
    frame = p4000_tables.passes_frame([make_cell("front", "fixed", 1.5)])
    assert list(frame["pass"]) == ["setup", "prefilter", "combine", "sampling", "total"]
    by_pass = frame.set_index("pass")
    assert by_pass.loc["sampling", "published_ms"] == 1.45
    assert by_pass.loc["total", "time_ms"] == pytest.approx(by_pass["time_ms"].iloc[:-1].sum())
    assert by_pass.loc["sampling", "where_dram"] == 6


def test_words_name_the_bound_the_traffic_and_whether_the_times_agree():
    cells = [make_cell("front", "fixed", 1.5), make_cell("front", "adaptive", 1.0)]
    fixed, adaptive, *rest = p4000_words.explain(cells, "legacy", "all")
    assert fixed.startswith(
        "front, fixed, sampling: 1.50 ms, the paper 1.45 (1.03 of it: they agree)"
    )
    assert "Bound by DRAM (60% of its cycles" in fixed and "180 MB of DRAM, 75%" in fixed
    assert (
        "1.00 ms, the paper 0.38 (2.63 of it)." in adaptive and "hungriest lane, 32.0" in adaptive
    )
    assert [line.partition(":")[0] for line in rest] == [
        "set-up",
        "pre-filter",
        "update",
        "combine",
    ]


def test_words_say_when_the_baseline_is_not_explained_and_when_it_is():
    slow, fast = make_cell("close", "baseline", 24.0), make_cell("close", "fixed", 12.0)
    told = p4000_words.explain([fast, slow], "legacy", "all")[-1]
    assert "takes 1.96 times" in told and "22.1 times" in told and "not itemised" in told
    slow = make_cell("close", "baseline", 275.0)
    assert "not itemised" not in p4000_words.explain([fast, slow], "legacy", "all")[-1]


def test_words_judge_the_adaptive_time_by_forced_counts():
    cells = [make_cell("ear", m, 0.1 * METHODS[m].num_samples) for m in METHODS if m != "adaptive"]
    inside, outside = (
        p4000_words.judge(p4000_tables.counts_frame([*cells, make_cell("ear", "adaptive", ms)]))
        for ms in (2.0, 5.0)
    )
    assert "grows 8.00 to 8.00 times" in inside[0]
    assert "in 1 of 1 combinations." in inside[1]
    assert "in 0 of 1" in outside[1] and "worth 50.0, mean 16.0, most 32.0" in outside[1]


def test_figures_show_what_was_timed_and_the_published_at_its_own_resolution_alone():
    cells = [make_cell("ear", m, 0.1 * METHODS[m].num_samples) for m in METHODS]
    panel = p4000_plots.counts_figure(cells, GPU).axes[0]
    grey = [line for line in panel.lines if line.get_label().startswith("paper")]
    assert [line.get_ydata()[0] for line in grey] == [9.72, 2.72]
    forced = next(line for line in panel.lines if line.get_label() == "forced, legacy, all")
    assert list(forced.get_ydata()) == pytest.approx([0.8, 1.6, 3.2, 6.4])
    bars = p4000_plots.passes_figure(cells, "legacy", "all", GPU).axes[0].containers
    assert [bar.get_height() for bar in bars[0]] == list(PUBLISHED_MS["ear", "fixed"].values())
    assert bars[1][2].get_height() == pytest.approx(6.4)
    small = [cell | {"size": "480x270"} for cell in cells]
    assert p4000_plots.passes_figure(small, "legacy", "all", GPU) is None
    panel = p4000_plots.counts_figure(small, GPU).axes[0]
    assert not [line for line in panel.lines if line.get_label().startswith("paper")]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder that a tiny run filled."""
    folder = tmp_path_factory.mktemp("p4000")
    assert run_command([*ARGUMENTS, "-o", str(folder)]) == 0
    return folder


ARGUMENTS = ["p4000-times", "--size", "64x36", "--only", "front,fixed,adaptive,forced-8"]


@pytest.mark.opencl
def test_the_command_writes_tables_words_and_figures(finished: Path):
    tables = {
        f"p4000-{t}{s}"
        for t in ("times", "traffic", "ratios", "counts")
        for s in (".csv", ".md", ".tex")
    }
    figures = {f"p4000-counts{s}" for s in (".png", ".pdf")}
    maps = {f"p4000-counts-front-{s}.png" for s in ("legacy", "physical")}
    assert tables | figures | maps | {"p4000-explained.md"} == {
        p.name for p in finished.iterdir() if p.is_file()
    }
    assert len(list((finished / "p4000-64x36").iterdir())) == 3 * 2 * 2


@pytest.mark.opencl
def test_passes_sum_to_the_total_and_fewer_samples_take_less_time(finished: Path):
    frame = pd.read_csv(finished / "p4000-times.csv")
    for _, case in frame.groupby(["scale", "planes", "method"]):
        by_pass = case.set_index("pass")["time_ms"]
        assert by_pass.drop("total").sum() == pytest.approx(by_pass["total"])
        assert ("update" in by_pass) == (case["method"].iloc[0] == "adaptive")
    sampling = frame[frame["pass"] == "sampling"].set_index(["scale", "planes", "method"])
    for scale in ("legacy", "physical"):
        times = sampling["time_ms"]
        assert times[scale, "all", "forced-8"] < times[scale, "all", "fixed"]
        assert times[scale, "irradiance", "fixed"] < times[scale, "all", "fixed"]
    assert sampling["mean_count"].between(8, 64).all()
    assert (sampling["warp_count"] >= sampling["mean_count"]).all()


@pytest.mark.opencl
def test_a_second_run_times_nothing_and_says_the_same(finished: Path, capsys):
    cells = finished / "p4000-64x36"
    before = {p.name: p.read_bytes() for p in cells.iterdir()}
    words = (finished / "p4000-explained.md").read_bytes()
    assert run_command([*ARGUMENTS, "-o", str(finished)]) == 0
    assert "12 of 12 cases lie finished" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in cells.iterdir()} == before
    assert (finished / "p4000-explained.md").read_bytes() == words
    cell = json.loads(next(iter(before.values())))
    assert cell["gpu"] == GPU and cell["size"] == "64x36"


def test_options_that_do_not_go_together_are_refused(capsys, tmp_path):
    assert run_command(["p4000-times", "--quick", "--size", "8x8", "-o", str(tmp_path)]) == 2
    assert "--quick has a size of its own" in capsys.readouterr().err
    assert run_command(["p4000-times", "--only", "fixt", "-o", str(tmp_path)]) == 2
    assert "did you mean 'fixed'" in capsys.readouterr().err
