"""The roofline: where points and roofs stand, and what a reader sees of them."""

from pathlib import Path

import pytest
from timing_samples import CLOCK_HZ, NUM_SMS, one_pass, timing_result

from cachesim import presets
from cachesim.config import Gpu
from cachesim.timing.results import LevelTiming
from cachesim.timing_config import SmTiming
from experiments.output import write_figure
from experiments.roofline import (
    bandwidth_roofs,
    issue_roof,
    roofline_figure,
    roofline_points,
)


@pytest.fixture
def gpu() -> Gpu:
    """Four SMs of two schedulers, two instructions each, at 1 GHz."""
    card = presets.load("titan-x-pascal")
    sm = card.sm.model_copy(update={"count": NUM_SMS})
    timing = SmTiming.model_construct(num_schedulers=2, issue_per_warp=2)
    return card.model_copy(update={"sm": sm, "sm_timing": timing, "clock_hz": CLOCK_HZ})


def test_a_point_is_instructions_per_byte_at_the_issue_rate() -> None:
    points = {p.level: p for p in roofline_points(timing_result())}
    assert {p.giga_per_s for p in points.values()} == {6000 / 10_000}
    assert points["l1"].instructions_per_byte == pytest.approx(6000 / 1_000_000)
    assert points["dram"].instructions_per_byte == pytest.approx(6000 / 240_000)


def test_a_points_distance_from_its_roof_is_the_levels_utilisation() -> None:
    result = timing_result(one_pass("a"), one_pass("b", 3))
    roofs = bandwidth_roofs(result)
    assert roofs == pytest.approx({"l1": 512.0, "l2": 128.0, "dram": 32.0})
    parts = {part.name: part for part in result.passes}
    for p in roofline_points(result):
        under = p.giga_per_s / (roofs[p.level] * p.instructions_per_byte)
        assert under == pytest.approx(parts[p.pass_name].utilisation(p.level))


def test_the_issue_roof_is_what_all_schedulers_issue(gpu: Gpu) -> None:
    assert issue_roof(gpu) == pytest.approx(NUM_SMS * 2 * 2)
    with pytest.raises(ValueError, match="sm_timing"):
        issue_roof(gpu.model_copy(update={"sm_timing": None}))


def test_a_level_or_pass_that_did_nothing_has_no_point() -> None:
    levels = {"l1": LevelTiming(0, 512_000, 0, 0), "dram": LevelTiming(64, 32_000, 0, 0)}
    idle = one_pass("idle", cycles=1000, where={"launch": 1000})
    points = roofline_points(timing_result(one_pass("some", levels=levels), idle))
    assert [(p.pass_name, p.level) for p in points] == [("some", "dram")]


def test_the_figure_has_a_roof_per_level_the_issue_roof_and_a_mark_per_point(gpu: Gpu) -> None:
    result = timing_result(one_pass("setup"), one_pass("sampling", 3))
    figure = roofline_figure(result, gpu, "t on gpu")
    (axes,) = figure.axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    labels = [line.get_label() for line in axes.lines]
    for wanted in ("L1: 512 GB/s", "L2: 128 GB/s", "DRAM: 32 GB/s", "setup", "sampling"):
        assert labels.count(wanted) == 1
    assert sum(label.startswith("issue: 16 G") for label in labels) == 1
    assert "(1/B)" in axes.get_xlabel() and "per second" in axes.get_ylabel()
    marks = [line for line in axes.lines if len(line.get_xdata()) == 1]
    assert len(marks) == len(roofline_points(result)) == 6
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    for mark in marks:
        assert left < mark.get_xdata()[0] < right and bottom < mark.get_ydata()[0] < top
    assert bottom < issue_roof(gpu) < top


def test_levels_differ_in_colour_and_in_dash(gpu: Gpu) -> None:
    levels = dict.fromkeys(("l1", "gl1", "l2", "llc", "dram"), LevelTiming(640, 32_000, 10, 1))
    figure = roofline_figure(timing_result(one_pass(levels=levels)), gpu, "t")
    roofs = [line for line in figure.axes[0].lines if "GB/s" in str(line.get_label())]
    assert len(roofs) == 5
    assert len({line.get_color() for line in roofs}) == 5
    # matplotlib calls every dash of one's own "--"; the pattern tells them apart.
    assert len({str(line._unscaled_dash_pattern) for line in roofs}) == 5


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_the_figure_is_written_in_every_format(gpu: Gpu, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"r{suffix}"
    write_figure(path, roofline_figure(timing_result(), gpu, "t on gpu"))
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}
    assert path.read_bytes().startswith(starts[suffix])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_run_without_work_is_drawn_without_points(gpu: Gpu) -> None:
    idle = one_pass("idle", cycles=1000, where={"launch": 1000}, levels={})
    assert roofline_figure(timing_result(idle), gpu, "t").axes
