"""The experiments over many frames: what they measure, how they judge, a small run of each."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from experiments.reproduce import (
    adaptive_o1,
    adaptive_o1_results,
    changing_light,
    direct_distant,
    disocclusion,
    disocclusion_scenes,
    film,
    global_accumulation,
    jittering,
    light_flash,
    regular_lighting,
)
from experiments.reproduce.experiment import Settings
from experiments.reproduce.film_plots import Panel, line_figure, map_figure
from kernels.frame import render
from kernels.method import Method
from kernels.passes.estimate import estimate_count
from kernels.quality import reference_image
from kernels.scenes.analytic import Circle
from kernels.selfcheck import small_gbuffer

# The film.


def test_every_shot_is_the_frame_that_rendering_up_to_it_gives(device):
    gbuffer = small_gbuffer()
    method = Method(kind="adaptive", taa=True, b_max=16)
    for shot in film.play(gbuffer, method, 3, device):
        frame = render(gbuffer, method, shot.index + 1, device)
        assert np.array_equal(shot.combined, frame.combined)
        assert np.array_equal(shot.shown, frame.shown)
        assert np.array_equal(shot.history, frame.history)
        assert np.array_equal(shot.scattered[..., 3], frame.counts)


def test_the_reference_is_the_one_of_the_quality_measure(device):
    gbuffer = small_gbuffer()
    method = Method(kind="adaptive", taa=True, overlay=True, control="online")
    found = film.render_reference(gbuffer, method, 64, device)
    assert np.array_equal(found.combined, reference_image(gbuffer, Method(), device, 64))
    assert (found.counts[gbuffer.subsurface] == 64).all()


def test_the_spread_is_the_variance_over_frames():
    frames = np.random.default_rng(2).normal(3.0, 0.2, (20, 4, 5)).astype(np.float32)
    spread = film.Spread()
    for values in frames:
        spread.add(values)
    assert spread.mean == pytest.approx(frames.mean(axis=0, dtype=np.float64))
    assert spread.variance == pytest.approx(frames.var(axis=0, ddof=1, dtype=np.float64))


def test_a_long_table_has_a_row_per_cell_and_frame():
    cells = [(("a", "x"), [[1, 2], [3, 4]]), (("b", "x"), [[5, 6]])]
    found = film.long_table(cells, ("first", "second"), ("p", "q"), "frame")
    assert found.columns.tolist() == ["first", "second", "frame", "p", "q"]
    assert found.values.tolist() == [["a", "x", 0, 1, 2], ["a", "x", 1, 3, 4], ["b", "x", 0, 5, 6]]


def test_the_jittered_head_repeats_with_its_period(first_device):
    scene, period = film.jittered_head("front", (32, 18), first_device)
    assert scene(0) is scene(period) is not scene(1)
    assert len({scene(point).jitter for point in range(period)}) == period


def test_a_line_keeps_its_colour_in_every_panel():
    panels = [
        Panel("first", "y", {"a": [1, 2], "b": [2, 1]}, marks={0.5: "half"}),
        Panel("second", "y", {"b": [3, 4]}, x=[10, 20], is_log=True, limits=(1, 10)),
    ]
    first, second = line_figure(panels).axes
    colours = {line.get_label(): line.get_color() for line in first.lines[:2]}
    assert second.lines[0].get_color() == colours["b"] != colours["a"]
    assert list(second.lines[0].get_xdata()) == [10, 20] and second.get_yscale() == "log"
    assert first.texts[0].get_text() == "half"


def test_maps_share_their_limits_and_leave_no_axes_over():
    maps = {name: np.full((4, 6), value) for name, value in (("a", 1.0), ("b", 5.0), ("c", np.nan))}
    maps["c"][0, 0] = 2.0
    figure = map_figure(maps, "label", num_columns=2, outlines={"left": np.eye(4, 6) > 0})
    shown = [axes for axes in figure.axes if axes.images]
    assert [axes.get_title() for axes in shown] == ["a", "b", "c"]
    assert {axes.images[0].get_clim() for axes in shown} == {(1.0, 5.0)}


# adaptive-o1


def test_the_regions_are_where_the_light_is_steepest_and_most_even():
    x = np.arange(60)
    scalar = np.broadcast_to(1 / (1 + np.exp(-(x - 30.0))), (40, 60)).astype(np.float32)
    scatters = np.ones((40, 60), np.bool_)
    scatters[:, :8] = False
    regions = adaptive_o1.find_regions(scalar, scatters)
    columns = {name: np.flatnonzero(mask.any(axis=0)) for name, mask in regions.items()}
    assert abs(columns[adaptive_o1_results.EDGE] - 30).max() <= 2
    assert abs(columns[adaptive_o1_results.FLAT] - 30).min() > 8
    assert columns[adaptive_o1_results.FLAT].min() > 8, (
        "the border of what scatters is no flat area"
    )
    y, x = adaptive_o1.pick_pixel(regions[adaptive_o1_results.EDGE])
    assert regions[adaptive_o1_results.EDGE][y, x] and abs(y - 20) <= 2


def test_a_global_guide_is_the_estimator_with_the_shown_picture_as_history():
    method = Method(kind="adaptive")
    guide = adaptive_o1.GlobalGuide(method)
    rng = np.random.default_rng(4)
    pictures = rng.normal(0.5, 0.05, (6, 3, 4)).astype(np.float32)
    shown = rng.normal(0.5, 0.01, (6, 3, 4)).astype(np.float32)
    variance, mean = np.full((3, 4), method.sigma0_sq), np.full((3, 4), 64.0)
    for i in range(6):
        asked = guide.ask(pictures[i], shown[i])
        if i:
            variance = 0.8 * variance + 0.16 * (pictures[i] - shown[i - 1]) ** 2
        expected = estimate_count(mean, variance, method)
        mean = 0.8 * mean + 0.2 * expected
        assert asked == pytest.approx(expected, rel=1e-4)


def made_series(edge, flat, frames=40):
    """Constant counts but for one pixel of the edge, which takes two values in turn."""
    columns = list(adaptive_o1_results.COLUMNS)
    found = {}
    for region, (count, low, high) in (
        (adaptive_o1_results.EDGE, edge),
        (adaptive_o1_results.FLAT, flat),
    ):
        rows = np.zeros((frames, len(columns)))
        rows[:, columns.index("count")] = count
        rows[:, columns.index("pixel_count")] = np.where(np.arange(frames) % 2, low, high)
        rows[:, columns.index("step")] = high - low
        rows[:, columns.index("estimated_error")] = (
            0.02 if region == adaptive_o1_results.EDGE else 0.01
        )
        found[region] = rows
    return found


def test_counts_are_judged_by_one_pixel_of_each_region():
    names = (adaptive_o1_results.PAPER, adaptive_o1_results.ENGINE, adaptive_o1_results.LAST)
    wandering = dict.fromkeys(names, made_series((20, 8, 50), (8.4, 8, 8)))
    found = {c.quantity.split(",")[0]: c for c in adaptive_o1_results.judge_counts(wandering)}
    assert found["samples of one pixel in a flat area"].agrees
    assert found["samples of one pixel in a shadow's edge"].agrees
    assert found["samples of one pixel in a shadow's edge"].ours == "8 to 50"
    assert "2.00 times" in found["local standard deviation"].verdict
    still = dict.fromkeys(names, made_series((20, 20, 22), (12, 10, 14)))
    found = {c.quantity.split(",")[0]: c for c in adaptive_o1_results.judge_counts(still)}
    assert not found["samples of one pixel in a flat area"].agrees
    assert not found["samples of one pixel in a shadow's edge"].agrees


def test_no_reading_of_the_gain_is_claimed_and_near_ones_are_told():
    def cell(frame, shown):
        return {
            "frame_deviation": frame, "shown_deviation": shown, "frame_error": frame,
            "shown_error": shown, "count": 8,
        }  # fmt: skip

    edge, flat = adaptive_o1_results.EDGE, adaptive_o1_results.FLAT
    guided = {
        adaptive_o1_results.GUIDED: {edge: cell(11**0.5, 1.0), flat: cell(2**0.5, 1.0)},
        adaptive_o1_results.UNGUIDED: {edge: cell(3.0, 1.0), flat: cell(3.0, 2.0)},
    }
    gains = adaptive_o1_results.read_gains(guided)
    assert gains["variance, each frame / accumulated"] == pytest.approx({edge: 11, flat: 2})
    assert gains["accumulated variance, 8 samples / local guiding"] == pytest.approx(
        {edge: 1, flat: 4}
    )
    found = adaptive_o1_results.judge_gains(guided)
    assert all(c.agrees is None for c in found)
    near = ["within a factor" in c.verdict for c in found]
    assert near == [True, True, False, False]
    assert "less than the flat" in found[2].verdict


@pytest.mark.opencl
def test_an_overlay_reaches_the_global_picture_and_no_local_pixel(first_device):
    found = adaptive_o1.measure_overlay(
        small_gbuffer(64, 40), Method(kind="adaptive"), 10, first_device
    )
    frames = found["frames"]
    assert not frames[:, 0].any()
    assert frames[2:, 1].max() > 0.003
    assert (frames[2:, 3] >= frames[2:, 2]).all() and frames[-1, 3] > frames[-1, 2] + 1


def test_the_overlays_plot_keeps_a_quantity_to_an_axis():
    frames = np.array([[0.0, 0.02, 8.0, 12.0, 9.0], [3.0, 0.01, 8.0, 11.0, 9.0]])
    panels = adaptive_o1_results.overlay_figure({"frames": frames}).axes
    drawn = {axes.get_ylabel(): [line.get_ydata() for line in axes.lines] for axes in panels}
    assert np.array_equal(drawn["rms difference, last 8 frames"], [[0.02, 0.01]])
    assert np.array_equal(drawn["pixels that differ"], [[0, 3]])
    assert np.array_equal(drawn["samples"], [[8, 8], [12, 11], [9, 9]])


# disocclusion


def test_ages_count_from_when_the_disc_leaves_a_pixel():
    circle = Circle(64, 40, speed_pixels=4.0)
    ages = disocclusion_scenes.LaidOpen(circle)
    discs = [circle(f).depth_cm == circle.disc_cm for f in range(7)]
    found = [ages(f) for f in range(7)]
    assert (found[0] == -1).all()
    for frame in range(1, 7):
        fresh = discs[frame - 1] & ~discs[frame]
        assert fresh.any() and (found[frame][fresh] == 0).all()
        assert (found[frame][discs[frame]] == -1).all()
    left_at_2 = discs[1] & ~discs[2]
    assert (found[6][left_at_2] == 4).all()
    never = ~np.any(discs, axis=0)
    assert (found[6][never] == -1).all()


def test_a_scrolling_picture_brings_in_columns_at_its_right_edge():
    view = disocclusion_scenes.background(32, 8)
    scene, ages = disocclusion_scenes.scroll(view), disocclusion_scenes.scroll_age(32, 8)
    assert scene(0).velocity is None and (ages(0) == -1).all()
    for frame in (1, 3, 5):
        now, before = scene(frame), scene(frame - 1)
        past = np.arange(32) + now.velocity[0, :, 0].astype(int)
        inside = past < 32
        assert np.array_equal(now.irradiance[:, inside], before.irradiance[:, past[inside]])
        age = ages(frame)[0]
        assert (age[~inside] == 0).all() and (
            age == -1
        ).sum() == 32 - frame * disocclusion_scenes.SCROLL
    assert ages(5)[0, -1] == 0 and ages(5)[0, -2 * disocclusion_scenes.SCROLL - 1] == 2


def test_convergence_and_excess_are_measured_from_the_settled_value():
    assert disocclusion.converged_at([8, 4, 2, 1.2, 1, 1, 1, 1]) == 3
    assert disocclusion.converged_at([1, 1, 1, 1]) == 0
    assert disocclusion.excess([64, 20, 8, 8, 8, 8, 8, 8]) == 56 + 12


@pytest.mark.opencl
def test_the_slides_rule_spares_samples_where_nothing_is_known(first_device):
    methods = disocclusion.list_methods()
    exact = disocclusion.reference_scalars(48, 27, methods["variance"], first_device)
    curves = {
        rule: disocclusion.measure_event("first frame", method, exact, 24, first_device)["ages"]
        for rule, method in methods.items()
    }
    assert curves["none"][0, 0] == 48 * 27
    found = disocclusion.judge({"first frame": curves})
    assert [c.agrees for c in found] == [True, True, True]
    # Better for none: the claims are not met.
    swapped = {"none": curves["variance"], "variance": curves["none"]}
    found = disocclusion.judge({"first frame": swapped})
    assert [c.agrees for c in found] == [False, False, False]


# direct-distant


def test_the_border_is_where_a_twentieth_leaves_the_pixel():
    from kernels.maths.profile import SKIN, cdf

    at = direct_distant.border_column(640)
    near, far = direct_distant.NEAR, direct_distant.FAR
    scale = near + (far - near) * at / 640
    assert 1 - cdf(np.array([1 / scale]), SKIN.d_sampled_mm)[0] == pytest.approx(0.05)
    assert direct_distant.border_column(1280) == pytest.approx(2 * at)
    assert direct_distant.border_column(640, 0.1) < at


@pytest.mark.opencl
def test_beyond_the_border_no_samples_are_taken(first_device):
    scene, period = direct_distant.make_scene((96, 32), False)
    methods = direct_distant.list_methods()
    references = film.make_references(scene, period, methods["together"], 64, first_device)
    cells = {
        name: direct_distant.measure_wall(method, scene, references, 6, first_device)
        for name, method in methods.items()
    }
    border = direct_distant.border_column(96)
    counts = cells[direct_distant.IGNORED]["counts"]
    assert not counts[:, int(np.ceil(border)) :].any()
    assert (counts[:, : int(border)] > 0).all()
    rows = {name: cell["frames"] for name, cell in cells.items()}
    at = direct_distant.COLUMNS.index("idle_rate")
    assert rows[direct_distant.IGNORED][-1, at] == pytest.approx((counts == 0).mean())
    both = {direct_distant.STILL: rows, direct_distant.JITTERED: rows}
    maps = {name: cell["counts"] for name, cell in cells.items()}
    found = direct_distant.judge(both, maps, 96)
    assert [c.agrees for c in found[:3]] == [True, True, True]


# global-accumulation and jittering


def test_a_quarter_of_the_light_is_a_quarter_of_the_picture(device):
    """What lets references be made in full light alone."""
    gbuffer = small_gbuffer()
    full, dim = (
        film.render_reference(
            global_accumulation.dim(gbuffer, factor), Method(), 32, device
        ).combined
        for factor in (1.0, 0.25)
    )
    assert dim == pytest.approx(full / 4, rel=1e-3, abs=1e-6)
    assert full.max() > 0.1


def test_the_accumulation_is_judged_per_light():
    def cell(frame, shown):
        return np.tile([8.0, frame, shown], (8, 1))

    by_name = {
        global_accumulation.GUIDED: cell(35, 45),
        global_accumulation.EQUAL: cell(36, 46),
        global_accumulation.LEAST: cell(30, 39),
        global_accumulation.SEPARABLE: cell(44, 47),
    }
    found = global_accumulation.judge({"full light": by_name})
    assert [c.agrees for c in found] == [True, None, False, True]
    assert "-1.00 dB" in found[1].verdict and "-2.00 dB" in found[2].verdict


@pytest.mark.opencl
def test_the_factor_draws_the_coefficient_to_one(first_device):
    methods = jittering.list_methods()
    scene, period = film.jittered_head("front", (64, 36), first_device)
    plain = methods[jittering.NO_CONTROL]
    references = film.make_references(scene, period, plain, 64, first_device)
    rows = {
        name: jittering.measure_control(method, scene, references, 16, first_device)["frames"]
        for name, method in methods.items()
    }
    found = jittering.judge(rows)
    assert [c.agrees for c in found] == [True, True]
    assert np.isnan(rows[jittering.CONSTANT][:, 2]).all()


# Changing light


def made_measure(counts, cycles):
    """A flash of 9 frames with given counts; traffic in proportion to the cycles."""
    made = dataclasses.replace(light_flash.make_film(True), frames=9)
    made = dataclasses.replace(made, key={"off": 3, "on": 6}, traced={"before": 2, "off": 4})
    frames = {n: np.stack([c, np.full(9, 45.0)], axis=1) for n, c in counts.items()}
    keys = (
        "sampling_cycles", "update_cycles", "frame_ms", "frame_l2_bytes", "frame_dram_bytes",
        "extra_texture_l2_bytes", "extra_texture_dram_bytes", "extra_texture_lane_fetches",
        "sampled_g_l2_bytes", "sampled_g_dram_bytes",
    )  # fmt: skip
    traffic = {
        name: {
            label: dict.fromkeys(keys, float(value))
            | {"extra_texture_lane_fetches": 5 if name == changing_light.ONLINE else 0}
            for label in made.traced
        }
        for name, value in cycles.items()
    }
    return changing_light.Measured(made, frames, {n: {} for n in counts}, traffic)


def test_a_flash_is_judged_by_peaks_and_cycles():
    steady, spike = np.full(9, 10.0), np.array([64, 10, 10, 10, 50, 50, 40, 50, 40.0])
    names = (changing_light.NO_CV, changing_light.ONLINE, changing_light.CONSTANT)
    good = made_measure(
        dict(zip(names, (spike, steady, steady), strict=True)),
        dict(zip(names, (25, 10, 5), strict=True)),
    )
    found = light_flash.judge(good)
    assert all(c.agrees is not False for c in found)
    assert found[0].ours == "5.00 no CV, 1.00 online CV, 1.00 constant CV"
    assert [c.ours for c in found[2:4]] == ["2.50", "5.00"]
    bad = made_measure(
        dict(zip(names, (steady, spike, steady), strict=True)),
        dict(zip(names, (10, 25, 10), strict=True)),
    )
    found = light_flash.judge(bad)
    assert [c.agrees for c in found[:4]] == [False, False, False, False]
    assert "no net saving" in found[-1].verdict
    table = changing_light.traffic_table(good)
    assert len(table.frame) == 6 and table.frame["count"].max() == 50


def test_films_take_references_that_belong_to_their_light():
    for quick in (True, False):
        made = light_flash.make_film(quick)
        off, on = made.key["off"], made.key["on"]
        assert {made.reference_of(f) for f in range(made.frames)} == {0, off}
        assert made.reference_of(off - 1) == 0 == made.reference_of(on)
        assert made.reference_of(on - 1) == off
        assert sorted(made.traced.values()) == list(made.traced.values())
        assert max(made.traced.values()) < made.frames
        made = regular_lighting.make_film(quick)
        assert all(made.reference_of(f) in (None, f) for f in range(made.frames))
        assert made.reference_of(made.frames - 1) == made.frames - 1
    assert light_flash.make_film(False).size == (2560, 1440)
    assert regular_lighting.make_film(False).size == (2560, 1440)


# Whole runs


@pytest.mark.opencl
@pytest.mark.parametrize(
    "module",
    [adaptive_o1, disocclusion, direct_distant, global_accumulation, jittering],
)
def test_a_run_goes_on_where_it_stopped(module, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "QUICK_SIZE", (48, 27))
    monkeypatch.setattr(module, "REFERENCE_SAMPLES", 32)
    for name in ("QUICK_FRAMES", "QUICK_OVERLAY_FRAMES", "QUICK_AGES"):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, 8)
    settings = Settings(True, tmp_path)
    first = module.EXPERIMENT.run(settings)
    assert first.tables and first.figures and first.words and first.comparisons

    monkeypatch.setattr(film, "play", lambda *a: pytest.fail("played again"))
    monkeypatch.setattr(film, "render_reference", lambda *a: pytest.fail("rendered again"))
    again = module.EXPERIMENT.run(settings)
    assert again.comparisons == first.comparisons and set(again.figures) == set(first.figures)


@pytest.mark.opencl
def test_the_light_goes_on_where_it_stopped(tmp_path, monkeypatch):
    import cachesim

    monkeypatch.setattr(light_flash, "QUICK_SIZE", (48, 27))
    monkeypatch.setattr(light_flash, "QUICK_FRAMES", 12)
    monkeypatch.setattr(changing_light, "REFERENCE_SAMPLES", 32)
    settings = Settings(True, tmp_path)
    first = light_flash.EXPERIMENT.run(settings)
    online = first.tables["traffic"].frame.set_index("control").loc[changing_light.ONLINE]
    other = first.tables["traffic"].frame.set_index("control").loc[changing_light.CONSTANT]
    assert (online["extra_texture_l2_bytes"] > 0).all()
    assert (other["extra_texture_l2_bytes"] == 0).all() and (other["sampled_g_l2_bytes"] > 0).all()
    assert (online["frame_l2_bytes"] > online["update_l2_bytes"]).all()

    for owner, name in ((film, "play"), (film, "render_reference")):
        monkeypatch.setattr(owner, name, lambda *a: pytest.fail("rendered again"))
    monkeypatch.setattr(cachesim, "simulate", lambda *a, **k: pytest.fail("measured again"))
    again = light_flash.EXPERIMENT.run(settings)
    assert again.comparisons == first.comparisons
