"""Profile, sequence, count rule and mip rule, held to closed forms and to the published numbers."""

from __future__ import annotations

import numpy as np
import pytest

from kernels.maths import profile
from kernels.maths.profile import SKIN, Profile
from kernels.maths.sequence import pcg3d16, r2
from kernels.method import Method
from kernels.passes import estimate, sampling
from kernels.passes.constants import Constants
from traces.errors import InputError

XI = np.arange(0.0005, 1, 0.0005)


def test_profile_integrates_to_its_albedo():
    r = np.linspace(1e-6, 80, 2_000_001)
    ring = 2 * np.pi * r * profile.evaluate(r, 1.3, 0.6)
    assert np.trapezoid(ring, r) == pytest.approx(0.6, rel=1e-5)
    assert np.allclose(ring, 0.6 * profile.pdf(r, 1.3))


def test_density_is_the_derivative_of_the_distribution_and_its_mean_is_two_and_a_half_d():
    r = np.linspace(0, 120, 2_000_001)
    assert np.allclose(
        np.gradient(profile.cdf(r, 2.0), r)[1:-1], profile.pdf(r, 2.0)[1:-1], atol=1e-8
    )
    assert np.trapezoid(r * profile.pdf(r, 2.0), r) == pytest.approx(2.5 * 2.0, rel=1e-6)


def test_exact_inverse_round_trips():
    assert np.abs(profile.cdf(profile.inverse_cdf_exact(XI, 1.8), 1.8) - XI).max() < 1e-12


@pytest.mark.parametrize(
    ("share", "quantile"), [(0.5, 1.552), (0.9, 6.062), (0.95, 8.129), (0.99, 12.953)]
)
def test_quantiles(share, quantile):
    assert profile.inverse_cdf_exact(share, 1.0) == pytest.approx(quantile, abs=6e-4)


def test_the_constant_of_the_approximation_minimises_the_error_of_the_cdf():
    constants = np.arange(2.5, 2.65, 0.0005)
    error = [
        np.mean((profile.cdf(profile.inverse_cdf_approximate(XI, 1.0, c), 1.0) - XI) ** 2)
        for c in constants
    ]
    assert constants[np.argmin(error)] == pytest.approx(profile.APPROXIMATE_C, abs=5.1e-4)
    assert min(error) == pytest.approx(2.9e-5, rel=0.02)


@pytest.mark.parametrize(
    ("xi", "percent"), [(0.1, 1.06), (0.37, 2.42), (0.75, -0.9), (0.9, -4.5), (0.99, -8.8)]
)
def test_relative_error_of_the_approximate_radius(xi, percent):
    ratio = profile.inverse_cdf_approximate(xi, 1.0) / profile.inverse_cdf_exact(xi, 1.0)
    assert 100 * (ratio - 1) == pytest.approx(percent, abs=0.06)


def test_shapes():
    assert profile.shape_searchlight(0.8) == pytest.approx(1.05)
    assert profile.shape_searchlight(0.3) == pytest.approx(1.85 - 0.3 + 7 * 0.125)
    assert profile.shape_diffuse(0.5) == pytest.approx(1.9 - 0.5 + 3.5 * 0.09)
    assert profile.shape_dmfp(0.91058) == pytest.approx(14.862, abs=1e-3)


def test_skin_samples_its_red_channel():
    assert SKIN.widest_channel == 0
    assert SKIN.d_sampled_mm == pytest.approx(1.7998, abs=5e-5)


@pytest.mark.parametrize("bad", [{"albedo": (0.5, 0.5, 1.5)}, {"dmfp_mm": (1.0, 0.0, 1.0)}])
def test_profile_refuses_impossible_values(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        Profile(**({"name": "bad", "albedo": (0.5, 0.5, 0.5), "dmfp_mm": (1.0, 1.0, 1.0)} | bad))


def test_first_points_of_the_sequence():
    x, y = (v / 2**32 for v in r2(np.arange(1, 5)))
    assert np.allclose(x, [0.75488, 0.50976, 0.26463, 0.01951], atol=6e-6)
    assert np.allclose(y, [0.56984, 0.13968, 0.70952, 0.27936], atol=6e-6)


@pytest.mark.parametrize(
    ("name", "at", "hashes"),
    [
        ("jcgt", (0, 0, 0), (47928, 18063, 47824)),
        ("jcgt", (1, 2, 3), (20732, 51808, 35516)),
        ("jcgt", (100, 200, 7), (54219, 20404, 4480)),
        ("unreal", (0, 0, 0), (7000, 6616, 52874)),
        ("unreal", (1, 2, 3), (26825, 11689, 49510)),
    ],
)
def test_hash_vectors(name, at, hashes):
    assert tuple(int(v[0]) for v in pcg3d16(*at, name)) == hashes


@pytest.mark.parametrize("xi", [0.0, 0.01, 0.37, 0.75, 0.99, 1 - 2.0**-24])
@pytest.mark.parametrize("exact", [False, True])
def test_float32_inverse_agrees_with_float64(xi, exact):
    inverse = profile.inverse_cdf_exact if exact else profile.inverse_cdf_approximate
    found = sampling.invert_cdf(np.array([1 - xi], np.float32), exact)[0]
    assert found == pytest.approx(float(inverse(xi, 1.0)), rel=2e-6, abs=5e-7)


@pytest.mark.parametrize(
    ("ratio", "kappa", "count"),
    [
        (1.0, 0.2, 16),
        (1.0, 1.0, 16),
        (1.25, 0.2, 26.4),
        (1.25, 1.0, 52),
        (2.0, 0.2, 57.6),
        (2.0, 1.0, 64),  # 160 before the clamp
        (0.8, 0.2, 8),  # 7.68 before the clamp
        (0.8, 1.0, 8),  # -12.8 before the clamp
    ],
)
def test_paper_rule(ratio, kappa, count):
    method = Method(kind="adaptive", kappa=kappa)
    assert estimate.k_minus_1(method) + 1 == pytest.approx(9)
    variance = np.float32(ratio * method.sigma0_sq)
    found = estimate.estimate_count(np.float32(16), variance, method)
    assert found == pytest.approx(count, rel=1e-5)


def test_undamped_paper_rule_equals_the_sliding_form():
    method = Method(kind="adaptive", kappa=1.0, b_min=1, b_max=2048)
    for mean_count, ratio in [(10, 1.1), (30, 1.5), (64, 0.95)]:
        variance = np.float32(ratio * method.sigma0_sq)
        found = estimate.estimate_count(np.float32(mean_count), variance, method)
        assert found == pytest.approx((ratio - 1) * mean_count * 9 + mean_count, rel=1e-4)


@pytest.mark.parametrize(("variance", "count"), [(0.0, 8), (0.0012, 12), (0.01, 64)])
def test_engine_rule(variance, count):
    method = Method(kind="adaptive", rule="engine", sigma0_sq=1e-4)
    found = estimate.estimate_count(np.float32(30), np.float32(variance), method)
    assert found == pytest.approx(count, rel=1e-5)


MIP_TABLE = [
    ("legacy", 20, 59.7, ((2.23, 3.52, 5.19), (1.73, 3.02, 4.69), (0.73, 2.02, 3.69))),
    ("legacy", 50, 23.9, ((0.91, 2.20, 3.87), (0.41, 1.70, 3.37), (0, 0.70, 2.37))),
    ("legacy", 100, 11.9, ((0, 1.20, 2.87), (0, 0.70, 2.37), (0, 0, 1.37))),
    ("physical", 20, 17.9, ((0.49, 1.78, 3.45), (0, 1.28, 2.95), (0, 0.28, 1.95))),
    ("physical", 50, 7.17, ((0, 0.46, 2.13), (0, 0, 1.63), (0, 0, 0.63))),
]


@pytest.mark.parametrize(("scale", "depth_cm", "texels_per_mm", "levels"), MIP_TABLE)
def test_published_mip_levels(scale, depth_cm, texels_per_mm, levels):
    """1080p, fov 30 degrees; rows n = 8, 16, 64; columns the radius' 50, 90 and 99 % quantile."""
    method = Method(scale=scale)
    constants = Constants.of(method, 1920, 1080, 1 / np.tan(np.radians(15)))
    per_mm = constants.texels_per_mm_at_cm / depth_cm
    assert per_mm == pytest.approx(texels_per_mm, rel=4e-3)
    r = profile.inverse_cdf_exact(np.array([0.5, 0.9, 0.99]), SKIN.d_sampled_mm)
    p = profile.pdf(r, SKIN.d_sampled_mm)
    for n, row in zip((8, 16, 64), levels, strict=True):
        q = p * constants.mip_scale * n / per_mm**2
        assert np.maximum(-np.log2(q), 0) / 2 == pytest.approx(row, abs=0.012)
        expected = np.minimum(np.ceil(np.maximum(-np.log2(q), 0) / 2), 5)
        assert sampling.find_level(q.astype(np.float32), 6).tolist() == expected.tolist()


def test_a_level_begins_exactly_at_a_power_of_four():
    at = np.float32(4.0 ** -np.arange(6))
    below = np.nextafter(at, np.float32(0))
    assert sampling.find_level(at, 6).tolist() == [0, 1, 2, 3, 4, 5]
    assert sampling.find_level(below, 6).tolist() == [1, 2, 3, 4, 5, 5]
    assert sampling.find_level(below, 3).tolist() == [1, 2, 2, 2, 2, 2]


def test_textbook_rule_asks_for_levels_five_to_seven_higher():
    r = profile.inverse_cdf_exact(np.array([0.5, 0.9, 0.99]), SKIN.d_sampled_mm)
    p = profile.pdf(r, SKIN.d_sampled_mm)
    projection = 1 / np.tan(np.radians(15))
    paper, textbook = (
        Constants.of(Method(scale="legacy", mip_rule=rule), 1920, 1080, projection)
        for rule in ("eq-5.12", "textbook")
    )
    per_mm = paper.texels_per_mm_at_cm / 20
    level = -np.log2(p * paper.mip_scale * 8 / per_mm**2) / 2
    # [KC08]: half the logarithm of texels of level 0 per sample, with the density per area.
    expected = np.log2(per_mm**2 / (8 * p / (2 * np.pi * r))) / 2
    found = -np.log2(p * textbook.mip_scale * 8 / per_mm**2 / r) / 2
    assert found == pytest.approx(expected, abs=1e-5)
    assert (found - level > 4).all() and (found - level < 8).all()
