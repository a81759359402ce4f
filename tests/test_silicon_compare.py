"""The model beside silicon: what is compared, and with what arithmetic."""

from __future__ import annotations

import math
from dataclasses import replace

import pandas as pd
import pytest

from cachesim import presets, simulate
from cachesim.report import DramCounters, LevelCounters, Report
from experiments.cli import run_command
from experiments.silicon import compare
from experiments.silicon.cases import Case
from experiments.silicon.compare import (
    PRESETS,
    QUANTITIES,
    modelled_of,
    preset_of,
    quantities_of,
    read_measured,
    summarise,
)
from experiments.silicon.compare_plots import correlation_figure
from experiments.silicon.model import Group, simulate_group
from experiments.silicon.prepare import method_of
from experiments.silicon.rows import Measurements, Row, write_measurements
from experiments.silicon.validate import choose_cases
from kernels.record import record
from kernels.scene import load_scene
from traces.errors import InputError

SAMPLING = Case("ear", 480, 270, "fixed64", "texture", "sampling", 0)
COMBINE = replace(SAMPLING, pass_name="combine", fetch="load")
COUNTERS = {
    "l1tex__t_sectors_pipe_tex_mem_texture.sum": 1000.0,
    "l1tex__t_sectors_pipe_tex_mem_texture_lookup_hit.sum": 900.0,
    "l1tex__t_sectors_pipe_lsu_mem_global_op_ld.sum": 0.0,
    "l1tex__t_sectors_pipe_lsu_mem_global_op_ld_lookup_hit.sum": 0.0,
    "lts__t_sectors_srcunit_tex_op_read.sum": 100.0,
    "lts__t_sectors_srcunit_tex_op_read_lookup_hit.sum": 25.0,
    "dram__sectors_read.sum": 75.0,
    "gpc__cycles_elapsed.max": 5000.0,
}
MEASURED = {
    "l1_sectors": 1000.0,
    "l1_hit_rate": 0.9,
    "l2_sectors": 100.0,
    "l2_hit_rate": 0.25,
    "dram_sectors": 75.0,
    "cycles": 5000.0,
}


def write(path, rows, **manifest):
    write_measurements(path, Measurements({"device": "NVIDIA H200"} | manifest, tuple(rows)))
    return path


def counted(case, counters):
    return [Row("workload", case.text, n, v, "base", "ncu") for n, v in counters.items()]


def test_counters_become_the_quantities_that_are_compared():
    assert quantities_of(COUNTERS) == MEASURED
    assert quantities_of({"dram__sectors_read.sum": 3.0}) == {"dram_sectors": 3.0}
    assert quantities_of({}) == {}


def test_the_models_loads_are_told_without_its_stores():
    counters = {
        "l1": LevelCounters(32, accesses=120, hits=60, line_misses=60, writes=20, write_misses=20),
        "l2": LevelCounters(32, accesses=60, hits=10, line_misses=50, writes=20, write_misses=15),
    }
    report = Report("g", {}, "texture", None, 1, 1, counters, DramCounters(32, 35, 4), None)
    found = modelled_of(report)
    assert found == {
        "dram_sectors": 35.0,
        "l1_sectors": 100.0,
        "l1_hit_rate": pytest.approx(0.6),
        "l2_sectors": 40.0,
        "l2_hit_rate": pytest.approx(1 - 35 / 40),
    }


def test_a_measurement_is_read_from_both_kinds_of_file(tmp_path):
    ours = write(tmp_path / "a.csv", counted(SAMPLING, COUNTERS))
    assert read_measured(ours).cases == {SAMPLING: MEASURED}
    assert read_measured(ours).device == "NVIDIA H200"
    names = ",".join(f'"{name}"' for name in COUNTERS)
    numbers = ",".join(f'"{value:,.0f}"' for value in COUNTERS.values())
    page = tmp_path / "b.csv"
    page.write_text(
        f'"ID","Kernel Name",{names}\n"",""{"," * len(COUNTERS)}\n'
        f'"0","{SAMPLING.prefix}__sampling_fixed_texture",{numbers}\n"1","other",{numbers}\n'
    )
    assert read_measured(page).cases == {SAMPLING: MEASURED}


def test_times_alone_give_cycles_alone_and_say_so(tmp_path):
    rows = [Row("workload", SAMPLING.text, "cycles", 4000.0, "cycles", "event")]
    path = write(tmp_path / "a.csv", rows, counters="none: ncu is missing")
    found = read_measured(path)
    assert found.cases == {SAMPLING: {"cycles": 4000.0}}
    assert "Counters: none: ncu is missing." in found.notes


def test_a_wrong_picture_is_told(tmp_path):
    rows = [*counted(SAMPLING, COUNTERS), Row("picture", "scene=ear", "identical", 0, "1", "host")]
    assert any(
        "Wrong picture: scene=ear" in n for n in read_measured(write(tmp_path / "a", rows)).notes
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("nothing\n", "no Nsight Compute CSV"),
        ('"ID","Kernel Name","a__b"\n"","",""\n"0","gemm","1"\n', "found gemm"),
        ('# {"device": "x"}\nmeasurement,case,quantity,value,unit,source\n', "no launch"),
    ],
)
def test_a_file_without_the_workload_is_rejected_in_one_line(tmp_path, capsys, text, told):
    path = tmp_path / "a.csv"
    path.write_text(text)
    assert run_command(["validate", "silicon", str(path)]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_with_no_data_it_says_not_measured(capsys, monkeypatch):
    monkeypatch.setattr(compare, "committed_files", list)
    assert run_command(["validate", "silicon"]) == 0
    assert capsys.readouterr().out == "not measured\n"


def test_errors_means_and_correlation():
    measured = {SAMPLING: MEASURED, COMBINE: MEASURED | {"l1_sectors": 2000.0}}
    modelled = {
        SAMPLING: MEASURED | {"l1_sectors": 1100.0, "l1_hit_rate": 0.85},
        COMBINE: MEASURED | {"l1_sectors": 1900.0},
    }
    frame = compare.compare(measured, modelled)
    assert len(frame) == 2 * len(QUANTITIES)
    summary = summarise(frame).set_index("quantity")
    assert summary.loc["L1 sectors", "mean_error"] == pytest.approx((0.1 + 0.05) / 2)
    assert summary.loc["L1 sectors", "worst_error"] == pytest.approx(0.1)
    assert summary.loc["L1 sectors", "correlation"] == pytest.approx(1)
    assert summary.loc["L1 hit rate", "mean_error"] == pytest.approx(0.025)
    assert math.isnan(summary.loc["SM cycles", "correlation"])
    assert summary["met"].to_dict() == {
        "L1 sectors": False,
        "L1 hit rate": True,
        "L2 sectors": True,
        "L2 hit rate": True,
        "DRAM sectors read": True,
        "SM cycles": True,
    }


def test_what_only_one_side_has_is_not_compared():
    modelled = {SAMPLING: {"l1_sectors": 1.0}}
    assert len(compare.compare({SAMPLING: MEASURED, COMBINE: MEASURED}, modelled)) == 1
    assert compare.compare({COMBINE: MEASURED}, modelled).empty
    assert compare.relative(0, 0) == 0 and math.isnan(compare.relative(1, 0))


def test_the_plot_has_a_point_per_launch():
    modelled = {SAMPLING: MEASURED | {"l1_sectors": 1100.0}, COMBINE: MEASURED}
    frame = compare.compare({SAMPLING: MEASURED, COMBINE: MEASURED}, modelled)
    figure = correlation_figure(frame, "a card")
    axes = figure.axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    points = [tuple(map(float, p)) for line in axes.lines[1:] for p in line.get_xydata()]
    assert sorted(points) == [(1000.0, 1000.0), (1000.0, 1100.0)]


def test_a_devices_name_finds_its_preset():
    assert preset_of("NVIDIA H100 80GB HBM3") == "h100-sxm"
    assert preset_of("NVIDIA H200") == "h200"
    assert {name for _, name in PRESETS} <= set(presets.names())
    with pytest.raises(InputError, match="'NVIDIA L4': no preset for it"):
        preset_of("NVIDIA L4")


def test_pictures_are_chosen_by_name(tmp_path):
    other = replace(SAMPLING, scene="front")
    rows = counted(SAMPLING, COUNTERS) + counted(other, COUNTERS)
    measured = read_measured(write(tmp_path / "a.csv", rows))
    assert choose_cases(measured, ["front_480x270"]) == [other]
    assert len(choose_cases(measured, [])) == 2
    with pytest.raises(InputError, match="unknown picture"):
        choose_cases(measured, ["side_480x270"])


def test_each_launch_is_modelled_from_empty_caches(first_device):
    """As if nothing else had been recorded; and the clock counts cycles."""
    gpu = presets.load("h100-sxm")
    group = Group("ear", 96, 64, "adaptive", "load")
    found = simulate_group(group, gpu, timing=False, device=first_device)
    assert [c.pass_name for c in found].count("prefilter") == 5
    case = Case("ear", 96, 64, "adaptive", "load", "update", 0)
    method = replace(method_of("adaptive"), passes=("update",))
    alone = record(
        load_scene("ear", 96, 64, device=first_device),
        method,
        num_frames=8,
        device=first_device,
        self_check=False,
        instruction_target="sm_90",
    )
    expected = simulate(alone, gpu, fetch_path="global", layout="row-major", threaded=False)
    assert found[case].counters == expected.counters
    assert found[case].dram == expected.dram

    timed = simulate_group(group, gpu, timing=True, device=first_device, wanted=[case])
    assert list(timed) == [case]
    values = modelled_of(timed[case])
    assert values["cycles"] > 500
    assert values["l1_sectors"] == modelled_of(found[case])["l1_sectors"]


def test_the_frame_of_a_comparison_is_a_table():
    frame = compare.compare({SAMPLING: MEASURED}, {SAMPLING: MEASURED})
    table = compare.launches_table(frame, ["note"])
    assert isinstance(table.frame, pd.DataFrame)
    assert list(table.frame["error_text"])[:2] == ["+0.0%", "+0.0 points"]
