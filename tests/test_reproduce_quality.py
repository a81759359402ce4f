"""The experiments on quality: ground truth, AFIS and Separable, quality over traffic, gallery."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import trimesh

from experiments.reproduce import (
    afis_vs_separable,
    catalogue,
    gallery,
    ground_truth,
    ground_truth_verdicts,
    ground_truth_volume,
    path_tracing,
    quality_traffic,
)
from experiments.reproduce.experiment import Settings
from experiments.reproduce.ground_truth_volume import Compared
from kernels.passes.separable_taps import line_share
from kernels.scenes.camera import Camera
from kernels.scenes.sphere import sphere
from traces.errors import InputError, WorkError


def power_law(scene, method, slope, budgets=(4, 16, 64, 256), floor=0.0):
    errors = [0.1 * n**slope + floor for n in budgets]
    return pd.DataFrame({"scene": scene, "method": method, "budget": budgets, "rms_error": errors})


def test_the_slope_of_a_power_law_is_its_exponent_and_a_floor_does_not_converge():
    errors = pd.concat(
        [
            power_law("ball", ground_truth_verdicts.EXACT, -0.7),
            power_law("ball", ground_truth_verdicts.PUBLISHED, -0.5),
            power_law("ball", ground_truth_verdicts.SEPARABLE, -0.5, (11, 27, 51), floor=1.0),
        ]
    )
    slopes = ground_truth_verdicts.fit_slopes(errors)
    by_method = slopes.set_index("method")
    assert by_method["slope"].tolist()[:2] == pytest.approx([-0.7, -0.5])
    assert by_method.loc[ground_truth_verdicts.SEPARABLE, "slope"] > -0.05
    afis, filtered = ground_truth_verdicts.judge(slopes, errors)
    assert afis.agrees is True and afis.ours.startswith("-0.70")
    assert filtered.agrees is None and "below it from 4 samples on" in filtered.verdict
    errors["rms_error"] = 0.1
    flat = ground_truth_verdicts.fit_slopes(errors)
    assert ground_truth_verdicts.judge(flat, errors)[0].agrees is False


def test_the_slab_says_whether_separable_converges():
    errors = pd.concat(
        [
            power_law("slab", method, slope, (11, 51, 201))
            for method, slope in (
                (ground_truth_verdicts.EXACT, -1),
                (ground_truth_verdicts.PUBLISHED, -1),
                (ground_truth_verdicts.SEPARABLE, -1),
            )
        ]
    )
    judged = ground_truth_verdicts.judge(ground_truth_verdicts.fit_slopes(errors), errors)
    assert judged[-1].agrees is True and judged[-1].verdict.startswith("converges: 18.3 times")


def compared(off):
    ones = np.ones((4, 4))
    lit = np.tile([1.0, 1.0, 0.0, 0.0], (4, 1))
    return Compared("ball", ones, ones + off, lit, np.ones((4, 4), bool))


def test_path_tracings_verdict_follows_from_the_error_and_a_quick_run_claims_nothing():
    assert compared(0.5).error() == 0.5 and compared(0.5).error(shade=True) == 0.5
    assert compared(0.5).error(False) == pytest.approx(0.5**0.5)
    assert compared(0.5).error(False, shade=True) == 1.0
    near, far = ground_truth_verdicts.judge_volume([compared(0.01), compared(0.2)], quick=False)
    assert near.agrees is True and far.agrees is False and "without scattering 1.000" in far.verdict
    assert ground_truth_verdicts.judge_volume([compared(0.2)], quick=True)[0].agrees is None
    frame = ground_truth_verdicts.volume_frame([compared(0.01)])
    assert frame["rms_error"][0] == pytest.approx(0.01)


@pytest.mark.parametrize("albedo", (0.2, 0.8, 0.95))
def test_the_h_function_has_chandrasekhars_zeroth_moment(albedo):
    nodes, weights = np.polynomial.legendre.leggauss(80)
    moment = weights @ ground_truth_volume.h_function((nodes + 1) / 2, albedo) / 2
    # [C60] section 38, Eq. 8.
    assert moment == pytest.approx(2 / albedo * (1 - np.sqrt(1 - albedo)), rel=1e-4)


def test_flat_ground_is_one_under_perpendicular_light_and_reciprocal():
    def bright(light, view):
        return ground_truth_volume.flat_brightness(np.array([light]), np.array([view]), 0.95)[0]

    assert bright(1.0, 1.0) == pytest.approx(1.0)
    assert bright(0.3, 0.8) / 0.3 == pytest.approx(bright(0.8, 0.3) / 0.8)
    assert bright(-0.1, 0.5) == bright(0.5, -0.1) == 0
    assert 0.3 < bright(0.3, 1.0) * 1.05 < bright(0.6, 1.0)


def test_view_rays_meet_the_ball_from_outside_and_its_middle_head_on():
    gbuffer = sphere(41, 31, radius_cm=1.0, distance_cm=8.0)
    camera = Camera("ball", (0.0, 0.0, 8.0), (0.0, 0.0, 0.0))
    rays = ground_truth_volume.view_rays(camera, 41, 31)
    cosine = -(gbuffer.normal * rays).sum(axis=-1)[gbuffer.subsurface]
    assert cosine.min() > 0 and -(gbuffer.normal * rays).sum(axis=-1)[15, 20] > 0.9999


def without_mitsuba(monkeypatch):
    def refuse(name):
        raise ImportError(name)

    monkeypatch.setattr(path_tracing, "import_module", refuse)


def test_without_mitsuba_path_tracing_is_left_out_and_said_so(monkeypatch, tmp_path):
    without_mitsuba(monkeypatch)
    assert path_tracing.find_mitsuba() is None
    parts = Settings(True, tmp_path).parts("toy")
    assert ground_truth_volume.compare_all(parts, True, [], None) == []
    with pytest.raises(WorkError, match="Mitsuba is not installed here"):
        path_tracing.trace_edge(ground_truth_volume.MEDIUM, 1.0, 4, 1)


def test_path_traced_light_across_an_edge_is_the_profiles():
    pytest.importorskip(path_tracing.PACKAGE)
    medium, half_width = ground_truth_volume.MEDIUM, 12.0
    edge = path_tracing.trace_edge(medium, half_width, 24, 2048)
    at = (np.arange(24) + 0.5) - half_width
    lit = edge[at > 8].mean()
    # Isotropic scattering in a half-space, light and view perpendicular: albedo H(1)^2 / (8 pi).
    h = ground_truth_volume.h_function(np.ones(1), medium.albedo)[0]
    assert lit == pytest.approx(medium.albedo * h * h / (8 * np.pi), rel=0.05)
    d = ground_truth_volume.profile_for(medium, np.pi * lit).d_mm[0]
    wanted = 0.5 * (1 + np.sign(at) * line_share(np.abs(at), d))
    assert np.sqrt(np.mean((edge / lit - wanted) ** 2)) < 0.03


def test_path_traced_balls_are_lit_from_the_side_of_the_light():
    pytest.importorskip(path_tracing.PACKAGE)
    camera = Camera("ball", (0.0, 0.0, 8.0), (0.0, 0.0, 0.0))
    picture = path_tracing.trace_sphere(
        ground_truth_volume.MEDIUM, 1.0, camera, (1.0, 0.4, 0.3), (16, 10), 64
    )
    assert picture[:, 8:].sum() > 2 * picture[:, :8].sum()
    assert picture[:5].sum() > picture[5:].sum()


def test_a_mesh_that_is_not_there_is_bad_input(monkeypatch):
    monkeypatch.setenv(ground_truth.MESHES_VARIABLE, "dragon.ply")
    with pytest.raises(InputError, match=r"dragon.ply: no such file"):
        ground_truth.load_meshes()


def papers_frame(**changed):
    """Ours as the paper prints it, with a hybrid between."""
    rows = []
    for (scene, method), (ms, db) in afis_vs_separable.PUBLISHED.items():
        found = {"time_ms": ms, "psnr_db": db or 50.0, "passes": {"sampling": ms}}
        rows.append({"scene": scene, "method": method} | found | changed.get(method, {}))
    for scene in afis_vs_separable.SCENES:
        found = {"time_ms": 2.0, "psnr_db": 44.0, "passes": {}}
        rows.append({"scene": scene, "method": afis_vs_separable.HYBRID} | found)
    return afis_vs_separable.add_published(pd.DataFrame(rows))


def test_the_papers_own_numbers_agree_with_themselves():
    frame = papers_frame()
    judged = [
        *afis_vs_separable.compare_numbers(frame, quick=False),
        *afis_vs_separable.compare_orders(frame, quick=False),
    ]
    assert all(c.agrees for c in judged if c.paper is not None)
    assert sum(c.paper is not None for c in judged) == 9 + 6 + 6
    told = {c.quantity: c for c in judged}
    assert told["close, time, adaptive / Separable"].ours == "0.67"
    assert told["ear, PSNR, adaptive - Separable"].ours == "+5.42"
    assert told["front, hybrid"].verdict.startswith("2.11 of the faster one's time, -0.28 dB")


def test_numbers_that_are_far_off_differ_and_a_quick_run_claims_nothing():
    slow = {"time_ms": 40.0, "psnr_db": 30.0, "passes": {}}
    frame = papers_frame(**{afis_vs_separable.ADAPTIVE: slow})
    judged = afis_vs_separable.compare_numbers(frame, quick=False)
    assert sum(c.agrees is False for c in judged) == 6
    orders = afis_vs_separable.compare_orders(frame, quick=False)
    assert [c.agrees for c in orders if c.paper] == [False, False, False, False, True, False]
    quick = afis_vs_separable.compare_orders(frame, quick=True)
    assert all(c.agrees is None for c in quick)


def test_bytes_at_a_quality_lie_on_the_curve_of_their_logarithm():
    found = quality_traffic.bytes_for([30.0, 40.0], [100.0, 10_000.0], 35.0)
    assert found == pytest.approx(1000.0)
    assert np.isnan(quality_traffic.bytes_for([30.0, 40.0], [1.0, 2.0], 41.0))


def test_a_cheaper_method_of_the_same_quality_has_a_ratio_below_one():
    def rows(method, qualities, num_bytes):
        return [
            {"scene": "front", "gpu": "h100-sxm", "method": method, "budget": i, "psnr_db": q,
             "l2_bytes": b, "dram_bytes": 10.0 * b}
            for i, (q, b) in enumerate(zip(qualities, num_bytes, strict=True))
        ]  # fmt: skip

    frame = pd.DataFrame(
        [
            *rows(quality_traffic.FIXED, (30.0, 40.0), (100.0, 10_000.0)),
            *rows(quality_traffic.ADAPTIVE, (35.0, 45.0), (500.0, 1.0)),
            *rows(quality_traffic.SEPARABLE, (30.0,), (200.0,)),
        ]
    )
    gains = quality_traffic.compare_at_equal_quality(frame)
    assert gains["l2_bytes_ratio"].dropna().tolist() == pytest.approx([0.5, 2.0])
    told = {c.quantity.split(" / ")[0]: c for c in quality_traffic.judge(gains)}
    assert "lower in 1 of 1 points" in told["L2 demand, AFIS, adaptive"].verdict
    assert "lower in 0 of 1 points" in told["DRAM traffic, Separable"].verdict
    assert told["L2 demand, hybrid"].ours == "-"


def test_the_gallery_lists_every_other_picture_in_the_catalogues_order(tmp_path):
    for name in ("taxonomy", gallery.NAME, "cv-toy"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a figure.png").write_bytes(b"")
    first, second = gallery.list_pictures(tmp_path)
    assert first.startswith("### [taxonomy](taxonomy.md)") and "[cv-toy]" in second
    assert "(taxonomy/a%20figure.png)" in first


def test_the_gallery_is_made_last():
    assert catalogue.NAMES[-1] == gallery.NAME


def test_the_detail_is_where_the_light_changes():
    flat = sphere(100, 60)
    light = np.zeros_like(flat.irradiance)
    light[25:31, 50:54] = 1
    rows, columns = gallery.find_detail(replace(flat, irradiance=light))
    assert rows.start <= 25 < 31 <= rows.stop and columns.start <= 50 < 54 <= columns.stop
    assert (rows.stop - rows.start, columns.stop - columns.start) == (12, 20)


def make_small(module, monkeypatch, tmp_path):
    """The smallest run that has every part."""
    if hasattr(module, "QUICK_SIZE"):
        monkeypatch.setattr(module, "QUICK_SIZE", (40, 24))
    for name, value in {
        "QUICK_FRAMES": 2,
        "QUICK_REFERENCE_SAMPLES": 64,
        "QUICK_COUNT_SIZE": (40, 24),
        "QUICK_COUNT_FRAMES": 2,
        "QUICK_VARIANCES": (0.001,),
        "QUICK_TAPS": (11, 27),
        "QUICK_SLAB_PIXELS_PER_MM": 1.0,
        "GPUS": {"rx-6900-xt": "Navi 21"},
    }.items():
        if hasattr(module, name):
            monkeypatch.setattr(module, name, value)
    if hasattr(module, "QUICK_SCENES"):
        monkeypatch.setattr(module, "QUICK_SCENES", ("front",))
    if module is ground_truth:
        without_mitsuba(monkeypatch)
        ball = tmp_path / "dragon.ply"
        trimesh.creation.icosphere(subdivisions=2, radius=5.0).export(ball)
        monkeypatch.setenv(ground_truth.MESHES_VARIABLE, str(ball))


@pytest.mark.opencl
@pytest.mark.parametrize(
    "module", (ground_truth, afis_vs_separable, quality_traffic, gallery), ids=lambda m: m.__name__
)
def test_a_run_that_goes_on_finds_its_cells_finished(module, tmp_path, monkeypatch):
    make_small(module, monkeypatch, tmp_path)
    settings = Settings(True, tmp_path)
    first = module.EXPERIMENT.run(settings)
    assert first.tables and first.figures and first.words and first.summary()
    if module is ground_truth:
        assert "counts-dragon" in first.figures and "volume" not in first.figures
        assert any("Mitsuba is not installed" in paragraph for paragraph in first.words)

    def refuse(*arguments, **named):
        pytest.fail("measured again")

    for owner, name in (
        ("cachesim", "simulate"),
        ("kernels.frame", "render"),
        ("kernels.dense", "scatter_densely"),
    ):
        monkeypatch.setattr(importlib.import_module(owner), name, refuse)
    again = module.EXPERIMENT.run(settings)
    assert again.comparisons == first.comparisons and set(again.figures) == set(first.figures)
