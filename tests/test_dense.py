"""The dense evaluation against NumPy, closed forms and the samples that tend to it; its ball."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kernels.dense import combine_densely, reach_mm, reference, scatter_densely
from kernels.frame import render
from kernels.maths.profile import cdf
from kernels.method import Method
from kernels.passes.separable_taps import line_share
from kernels.scenes.analytic import wall
from kernels.scenes.sphere import sphere
from traces.errors import InputError

EXACT = Method(inverse_cdf="exact", mip_rule="mip0", prefilter=False, scale="legacy")


def a_ball(width=28, height=20):
    """A ball that the frame cuts, before nothing, seen from afar."""
    return sphere(width, height, radius_cm=12.0, distance_cm=60.0)


def some_pixels(gbuffer):
    """Some of the middle and of every border."""
    chosen = np.zeros(gbuffer.subsurface.shape, bool)
    chosen[::6, ::7] = chosen[-1, 12] = chosen[9, -8] = True
    return chosen


@pytest.mark.parametrize(
    "change",
    (
        {},
        {"weights": "mean"},
        {"normal_weights": False},
        {"bilateral": False, "scale": "physical"},
    ),
    ids=str,
)
def test_the_kernel_sums_what_numpy_sums(device, change):
    method = replace(EXACT, **change)
    gbuffer = a_ball()
    some = some_pixels(gbuffer)
    found = scatter_densely(gbuffer, method, device, pixels=some)
    wanted = reference(gbuffer, method, some)
    assert np.abs(found - wanted).max() < 1e-5
    assert (found[~some | ~gbuffer.subsurface] == 0).all() and (found > 0).any()


def test_finer_points_change_little():
    gbuffer = a_ball()
    some = some_pixels(gbuffer)
    coarse = reference(gbuffer, EXACT, some)
    fine = reference(gbuffer, EXACT, some, divisions=((12, 4), (7, 16), (2, 64)))
    assert 0 < np.abs(coarse - fine).max() < 5e-4


def test_even_light_comes_out_even(first_device):
    gbuffer = a_ball()
    light = np.broadcast_to(np.float32([0.5, 0.25, 1.0]), gbuffer.irradiance.shape)
    even = replace(gbuffer, irradiance=np.ascontiguousarray(light))
    found = scatter_densely(even, EXACT, first_device)[gbuffer.subsurface]
    assert np.abs(found - [0.5, 0.25, 1.0]).max() < 1e-6


def test_the_mean_of_a_flat_wall_loses_no_light(first_device):
    flat = wall(24, 24, near_pixels_per_mm=0.5, far_pixels_per_mm=0.5)
    even = replace(flat, irradiance=np.ones_like(flat.irradiance))
    method = Method(weights="mean")
    found = scatter_densely(even, method, first_device)
    # Whole texels at the rim of the reach; a millionth of the light goes further.
    assert found == pytest.approx(np.ones_like(found), abs=3e-3)


def test_an_edge_of_light_is_blurred_as_the_closed_form_says(first_device):
    scale, height = 6.0, 120
    flat = wall(4, height, near_pixels_per_mm=scale, far_pixels_per_mm=scale)
    light = np.zeros_like(flat.irradiance)
    light[: height // 2] = 1
    column = np.zeros(flat.subsurface.shape, bool)
    column[:, 1] = True
    lit = replace(flat, irradiance=light)
    found = scatter_densely(lit, Method(), first_device, pixels=column)[:, 1]
    at = (height / 2 - np.arange(height) - 0.5) / scale
    for channel, d in enumerate(Method().profile.d_mm):
        wanted = 0.5 * (1 + np.sign(at) * line_share(np.abs(at), d))
        # A texel's own light counts for all that ends within its side.
        off = np.abs(found[:, channel] - wanted)
        assert off.max() < 0.4 * cdf(1 / scale, d) and off[np.abs(at) > 1.5].max() < 0.01


def test_samples_tend_to_the_dense_evaluation(first_device):
    gbuffer = a_ball(64, 40)
    dense = scatter_densely(gbuffer, EXACT, first_device)

    def error(**change):
        light = render(gbuffer, replace(EXACT, **change), 1, first_device).scattered
        return np.sqrt(np.mean((light - dense)[gbuffer.subsurface] ** 2))

    few, more, many = (error(num_samples=n) for n in (16, 128, 1024))
    assert few > 2.5 * more > 6 * many
    assert error(num_samples=1024, inverse_cdf="approximate") > many


def test_the_reach_holds_all_but_a_millionth():
    widest = max(Method().profile.d_mm)
    assert cdf(reach_mm(Method()), widest) == pytest.approx(1 - 1e-6, abs=1e-9)


def test_the_finished_picture_has_the_albedo_and_what_does_not_scatter():
    gbuffer = a_ball()
    behind = np.full_like(gbuffer.irradiance, 0.25)
    gbuffer = replace(gbuffer, non_subsurface=behind)
    found = combine_densely(gbuffer, np.ones_like(behind))
    mask = gbuffer.subsurface
    assert np.allclose(found[mask], gbuffer.albedo[mask] + 0.25)
    assert np.all(found[~mask] == 0.25)


def test_what_cannot_be_evaluated_is_refused(first_device):
    with pytest.raises(InputError, match="centre_reweighting False"):
        scatter_densely(a_ball(), replace(EXACT, centre_reweighting=False), first_device)
    near = wall(64, 64, near_pixels_per_mm=100.0, far_pixels_per_mm=100.0)
    with pytest.raises(InputError, match="take a smaller frame"):
        scatter_densely(near, Method(), first_device)


def test_no_pixels_are_no_work(first_device):
    gbuffer = a_ball()
    nothing = np.zeros(gbuffer.subsurface.shape, bool)
    assert not scatter_densely(gbuffer, EXACT, first_device, pixels=nothing).any()


def test_progress_ends_at_one(first_device):
    told = []
    scatter_densely(a_ball(), EXACT, first_device, progress=told.append)
    assert told[-1] == 1.0 and told == sorted(told)


def test_the_balls_surface_is_a_sphere():
    gbuffer = sphere(40, 30, radius_cm=3.0, distance_cm=20.0)
    hit = gbuffer.subsurface
    pixel = 2.0 / (40 * gbuffer.projection_x)
    x = (np.arange(40) - 19.5)[None, :] * pixel * gbuffer.depth_cm
    y = (14.5 - np.arange(30))[:, None] * pixel * gbuffer.depth_cm
    point = np.stack([x, y, 20.0 - gbuffer.depth_cm], axis=-1)
    assert np.linalg.norm(point[hit], axis=-1) == pytest.approx(3.0, abs=1e-4)
    assert gbuffer.normal[hit] == pytest.approx(point[hit] / 3.0, abs=1e-4)
    # The nearest point faces the camera; light comes from the right.
    assert gbuffer.depth_cm[hit].min() == pytest.approx(17.0, abs=0.01)
    light = gbuffer.irradiance[..., 0]
    assert light[:, 20:].sum() > 3 * light[:, :20].sum() and (light[~hit] == 0).all()


@pytest.mark.parametrize("change", ({"radius_cm": 50.0}, {"towards": (0.0, 0.0, 0.0)}))
def test_a_ball_that_cannot_be_is_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        sphere(8, 8, **change)
