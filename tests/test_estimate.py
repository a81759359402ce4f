"""Sample counts: the rules on paper, the exact sliding form, and the estimators without history."""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np
import pytest

from kernels import program
from kernels.access import Access
from kernels.frame import render
from kernels.maths.profile import cdf
from kernels.method import Method
from kernels.passes import estimate
from kernels.passes.history import (
    mask_of,
    mean_of_past,
    names_of,
    oldest_of_past,
    push_count,
)
from kernels.record import record
from kernels.reference import render_reference
from kernels.selfcheck import count_differences, small_gbuffer
from traces.errors import InputError

F = np.float32


def count_of(mean_count, variance, oldest=None, **fields):
    method = Method(kind="adaptive", **fields)
    given = None if oldest is None else F(oldest)
    return float(estimate.estimate_count(F(mean_count), F(variance), method, given))


# The rules.


@pytest.mark.parametrize("estimator", ["last-frame", "two-pass"])
def test_four_samples_at_twice_the_error_give_sixteen(estimator):
    found = count_of(4, 0.02**2, estimator=estimator, sigma0_sq=0.01**2)
    assert found == pytest.approx(16, rel=1e-5)


def test_the_slides_form_is_the_paper_without_damping_whatever_kappa():
    for mean_count, ratio in [(10, 1.1), (30, 1.5), (60, 0.97)]:
        variance = ratio * 0.001
        found = count_of(mean_count, variance, rule="o1", kappa=0.2, b_min=1, b_max=2048)
        assert found == count_of(mean_count, variance, kappa=1.0, b_min=1, b_max=2048)
        assert found == pytest.approx((ratio - 1) * mean_count * 9 + mean_count, rel=1e-4)


def test_the_sliding_form_replaces_the_count_that_leaves_the_window():
    for mean_count, ratio, oldest in [(20, 1.0, 33), (20, 1.2, 12), (20, 1.1, 40)]:
        found = count_of(mean_count, ratio * 0.001, oldest, rule="sliding", b_min=1, b_max=255)
        assert found == pytest.approx((ratio - 1) * mean_count * 9 + oldest, rel=1e-4)


def test_the_sliding_form_is_the_o1_form_where_counts_stand_still():
    for ratio in (0.98, 1.0, 1.3):
        given = {"mean_count": 24, "variance": ratio * 0.001}
        assert count_of(**given, oldest=24, rule="sliding") == pytest.approx(
            count_of(**given, rule="o1")
        )


@pytest.mark.parametrize("num_frames", [1, 3, 4, 5, 8, 9, 13, 16])
def test_the_past_counts_are_a_window_of_frames(num_frames):
    rng = np.random.default_rng(num_frames)
    counts = rng.integers(1, 256, 40)
    window = deque([int(counts[0])] * num_frames, maxlen=num_frames)
    past = np.zeros((1, 4), np.uint32)
    mask = np.array(mask_of(num_frames), np.uint32)
    for frame, count in enumerate(counts):
        past = push_count(past, np.array([F(count)]), np.array([frame > 0]))
        window.append(int(count))
        assert oldest_of_past(past, num_frames)[0] == window[0]
        assert mean_of_past(past, num_frames)[0] == F(sum(window)) / F(num_frames)
        # What the kernel adds in halves of words.
        kept = past[0] & mask
        assert sum(int(kept.view(np.uint8)[k]) for k in range(16)) == sum(window)


def test_the_sliding_history_is_the_mean_of_the_last_nine_counts(device):
    method = Method(kind="adaptive", rule="sliding", b_max=250, sigma0_sq=0.002)
    gbuffer = small_gbuffer()
    frames = [render(gbuffer, method, n, device) for n in range(1, 14)]
    counts = np.array([frame.counts for frame in frames], np.float32)
    skin = gbuffer.subsurface
    assert np.ptp(counts[:, skin], axis=0).max() > 100 and len(np.unique(counts)) > 9
    for last, frame in enumerate(frames):
        # Before the first frame lie counts equal to its own.
        window = [counts[max(0, k)] for k in range(last - 8, last + 1)]
        assert np.allclose(frame.history[..., 0], np.mean(window, axis=0), rtol=1e-3)
        assert np.array_equal(frame.history[..., 0] > 0, skin)


# Without history.


def test_the_variance_between_samples_predicts_that_between_frames(device):
    """On average; the samples are spread more evenly than random ones, so frames differ less."""
    method = Method(kind="adaptive", estimator="last-frame", b_min=24, b_max=24, bilateral=False)
    gbuffer = small_gbuffer()
    skin = gbuffer.subsurface
    means, variances = [], []
    for frame in render_reference(gbuffer, method, 24, traced=False):
        history = frame.textures[f"history_{len(means) % 2}"].astype(np.float64)
        means.append(history[..., 3][skin])
        variances.append(history[..., 2][skin])
    between = np.var(means, axis=0, ddof=1)
    within = np.mean(variances, axis=0)
    lively = within > np.quantile(within, 0.5)
    assert 0.15 < between[lively].mean() / within[lively].mean() < 1.2
    assert np.corrcoef(between, within)[0, 1] > 0.6


@pytest.mark.parametrize("weights", ["self-normalised", "mean"])
def test_the_spread_is_the_variance_of_a_ratio_of_sums(weights):
    """Against the formula over all samples, in double precision."""
    from kernels.passes.spread import find_spread

    rng = np.random.default_rng(3)
    n = 12
    u, w = rng.uniform(0.1, 2, n), rng.uniform(0.5, 1.5, n)
    w = np.ones(n) if weights == "mean" else w
    result = np.array([[0.4, 0.3, 0.2, 0.0]], F)
    beyond = [np.array([b], F) for b in (0.9, 0.8, 0.7, 0.85)]
    moments = [np.array([value], F) for value in (u.sum(), w.sum(), u @ u, u @ w, w @ w)]
    method = Method(kind="adaptive", estimator="last-frame", weights=weights)
    found, mean = find_spread(moments, result, result, beyond, np.array([n]), method)

    luminance = np.array([0.3, 0.59, 0.11])
    tracked = luminance @ np.array([0.4, 0.3, 0.2]) ** (1 / 2.2)
    share = 0.85 if weights == "mean" else luminance @ [0.9, 0.8, 0.7]
    ratio = u.sum() / w.sum()
    of_ratio = n / (n - 1) * ((u - ratio * w) ** 2).sum() / w.sum() ** 2
    slope = tracked / (2.2 * (luminance @ [0.4, 0.3, 0.2])) * share
    assert mean[0] == pytest.approx(tracked, rel=1e-5)
    assert found[0] == pytest.approx(slope**2 * of_ratio, rel=1e-4)


def lane_fetches(trace):
    found = {}
    for chunk in trace.chunks():
        name = trace.launches[chunk.launch].pass_name
        found[name] = found.get(name, 0) + chunk.num_lane_fetches
    return found


def test_the_pilots_traffic_is_counted(device):
    gbuffer = small_gbuffer()
    method = Method(kind="adaptive", estimator="two-pass", num_pilots=6, b_min=10, b_max=10)
    trace = record(gbuffer, method, device=device, self_check=False)
    assert [v.pass_name for v in trace.launches[-3:]] == ["pilot", "sampling", "combine"]
    pixels, skin = gbuffer.width * gbuffer.height, int(gbuffer.subsurface.sum())
    found = lane_fetches(trace)
    assert found["pilot"] == 2 * pixels + skin * (1 + 3 * 6)
    assert found["sampling"] == 2 * pixels + skin * (1 + 1 + 3 * 10)
    assert "update" not in found


def test_pilots_are_discarded(device):
    """With the count given, the picture is that of the fixed method."""
    gbuffer = small_gbuffer()
    method = Method(kind="adaptive", estimator="two-pass", b_min=10, b_max=10)
    adaptive = render(gbuffer, method, 2, device)
    fixed = render(gbuffer, Method(num_samples=10), 2, device)
    assert np.array_equal(adaptive.scattered, fixed.scattered)
    assert adaptive.history is None


@pytest.mark.parametrize("estimator", ["two-pass", "last-frame"])
def test_estimators_without_history_put_samples_where_the_light_changes(device, estimator):
    gbuffer = small_gbuffer(64, 40, depth_cm=12.0)
    method = Method(kind="adaptive", estimator=estimator, sigma0_sq=1e-4)
    light = gbuffer.irradiance.mean(axis=2)
    edge = np.zeros(light.shape, bool)
    edge[:, 3:-3] = np.abs(light[:, 6:] - light[:, :-6]) > 0.3
    counts = render(gbuffer, method, 4, device).counts
    away = gbuffer.subsurface & (light > 0.5) & ~edge
    assert counts[edge & gbuffer.subsurface].mean() > 1.3 * counts[away].mean()


# Direct and distant light.


def test_the_distant_share_is_what_the_profile_scatters_beyond_the_pixel():
    from kernels.passes.constants import Constants

    method = Method()
    constants = Constants.of(method, 1920, 1080, 3.732)
    depth = np.array([5, 20, 100, 800], F)
    found = estimate.distant_share(depth, constants.texels_per_mm_at_cm, constants.rate[3])
    radius = depth / (0.05 * 1920 * 3.732)
    assert found == pytest.approx(1 - cdf(radius, method.profile.d_sampled_mm), rel=1e-4)


@pytest.mark.parametrize("estimator", ["history", "two-pass", "last-frame"])
def test_pixels_without_distant_light_take_no_samples_and_stay_diffuse(device, estimator):
    gbuffer = small_gbuffer()
    slope = np.linspace(10, 40, gbuffer.width, dtype=F)
    depth = np.where(gbuffer.depth_cm > 0, slope, F(0))
    gbuffer = dataclasses.replace(gbuffer, depth_cm=depth.astype(F))
    method = Method(kind="adaptive", estimator=estimator, epsilon_u=0.5)
    texel_mm = depth / F(0.05 * gbuffer.width * gbuffer.projection_x)
    distant = 1 - cdf(texel_mm.astype(np.float64), method.profile.d_sampled_mm)
    near_the_bound = np.abs(distant - 0.5) < 0.01
    takes = gbuffer.subsurface & (distant > 0.5)
    assert takes.any() and (gbuffer.subsurface & ~takes).any()
    for num_frames in (1, 3):
        frame = render(gbuffer, method, num_frames, device)
        clear = ~near_the_bound
        assert np.array_equal((frame.counts > 0)[clear], takes[clear])
        diffuse = gbuffer.subsurface & (frame.counts == 0)
        light = gbuffer.irradiance[diffuse].astype(np.float16)
        assert np.array_equal(frame.scattered[diffuse], light)


def test_no_share_is_small_enough_for_epsilon_zero(device):
    gbuffer = small_gbuffer()
    separated = render(gbuffer, Method(kind="adaptive", epsilon_u=0.0), 1, device)
    plain = render(gbuffer, Method(kind="adaptive"), 1, device)
    assert np.array_equal(separated.counts, plain.counts)
    assert np.array_equal(separated.scattered, plain.scattered)


def test_pixels_without_samples_read_no_history(device):
    """A warp of them costs the read of its light and the store alone."""
    gbuffer = small_gbuffer()
    far = dataclasses.replace(gbuffer, depth_cm=gbuffer.depth_cm * F(1e4))
    method = Method(kind="adaptive", epsilon_u=0.05)
    found = lane_fetches(record(far, method, device=device, self_check=False))
    assert found["sampling"] == 2 * gbuffer.width * gbuffer.height


def test_separation_tracks_the_distant_light_alone(device):
    """Light that flickers only between direct-lit neighbours leaves counts less disturbed."""
    gbuffer = small_gbuffer(64, 40, depth_cm=60.0)

    def scene(frame):
        light = gbuffer.irradiance * F(1.0 + 0.5 * (frame % 2))
        return dataclasses.replace(gbuffer, irradiance=light.astype(F))

    skin = gbuffer.subsurface
    plain, separated = (
        render(scene, Method(kind="adaptive", epsilon_u=epsilon, kappa=0.0), 8, device)
        for epsilon in (None, 0.0)
    )
    assert separated.history[..., 2][skin].mean() < 0.9 * plain.history[..., 2][skin].mean()


# What is refused, and how the accesses stand.


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rule": "sliding", "alpha": 0.1}, "alpha 0.1: the sliding rule needs"),
        ({"rule": "sliding", "b_max": 256}, "b_max 256: allowed with the sliding rule"),
        ({"estimator": "last-frame", "b_min": 1}, "b_min 1: the last-frame estimator needs 2"),
        ({"estimator": "two-pass", "num_pilots": 1}, "num_pilots 1: allowed are 2"),
        ({"estimator": "two-pass", "control": "constant"}, "control 'constant'"),
        ({"epsilon_u": 1.0}, "epsilon_u 1.0: allowed are 0 to below 1"),
        ({"epsilon_u": 0.1, "centre_reweighting": False}, "None without centre_reweighting"),
        ({"eta_cov": 0.0}, "eta_cov 0.0"),
        ({"epsilon_a": -1.0}, "epsilon_a -1.0"),
        ({"disocclusion": "offscren"}, "did you mean 'offscreen'"),
    ],
)
def test_impossible_settings_are_refused(fields, message):
    with pytest.raises(InputError, match=message):
        Method(kind="adaptive", **fields)


def test_a_fixed_count_asks_nothing_of_the_adaptive_fields():
    method = Method(kind="adaptive", estimator="two-pass")
    assert dataclasses.replace(method, kind="fixed", control="constant").max_samples == 64


def test_the_estimate_reads_what_its_method_needs():
    def names(**fields):
        return [a.texture for a in estimate.accesses(Method(kind="adaptive", **fields), 0)]

    assert names() == ["velocity", "history_1"]
    assert names(rule="sliding") == ["velocity", "history_1", "past_counts_1"]
    assert names(estimator="two-pass") == ["pilot"]
    assert names(estimator="last-frame") == ["velocity", "history_1"]
    assert estimate.accesses(Method(), 0) == ()
    assert names_of("past_counts", 3) == ("past_counts_0", "past_counts_1")
    assert all(isinstance(a, Access) and a.subsurface_only for a in estimate.accesses(Method(), 0))


@pytest.mark.parametrize(
    "fields",
    [
        {"rule": "sliding", "alpha": 0.4},
        {"rule": "o1"},
        {"estimator": "two-pass", "weights": "mean"},
        {"estimator": "two-pass", "epsilon_u": 0.8, "planes": ("normal",)},
        {"estimator": "last-frame", "centre_reweighting": False},
        {"estimator": "last-frame", "epsilon_u": 0.8, "weights": "mean"},
        {"epsilon_u": 0.8},
        {"disocclusion": "none", "estimator": "last-frame"},
    ],
)
def test_devices_equal_the_reference(device, fields):
    method = Method(kind="adaptive", b_max=20, **fields)
    assert count_differences(device, method) == 0


@pytest.mark.parametrize(
    "fields",
    [
        {"estimator": "two-pass", "epsilon_u": 0.8},
        {"estimator": "last-frame", "epsilon_u": 0.8},
        {"rule": "sliding", "epsilon_u": 0.8},
    ],
)
def test_one_lane_per_work_item_computes_the_same_bits(device, monkeypatch, fields):
    """What GPUs run, on whatever device is here."""
    monkeypatch.setattr(program, "lanes_per_item", lambda device, kernel: 1)
    assert count_differences(device, Method(kind="adaptive", b_max=21, **fields)) == 0
