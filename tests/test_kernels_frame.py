"""Pictures: the white furnace, accumulation, disocclusion, and quality against the reference."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from kernels.frame import render
from kernels.method import Method
from kernels.quality import luminance, psnr, reference_image
from kernels.selfcheck import small_gbuffer
from traces.errors import InputError

WIDTH, HEIGHT = 48, 40


@pytest.fixture(scope="module")
def gbuffer():
    return small_gbuffer(WIDTH, HEIGHT)


def flat(gbuffer, value=0.37):
    """The same surface, everywhere skin, under constant light."""
    shape = (gbuffer.height, gbuffer.width)
    return dataclasses.replace(
        gbuffer,
        irradiance=np.full((*shape, 3), value, np.float32),
        profile_id=np.ones(shape, np.uint8),
        depth_cm=np.full(shape, 20, np.float32),
    )


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("kind", ["fixed", "adaptive"])
def test_constant_light_comes_back_constant(device, gbuffer, kind, centre):
    method = Method(kind=kind, num_samples=16, centre_reweighting=centre)
    scattered = render(flat(gbuffer), method, 3, device).scattered
    assert np.abs(scattered - np.float16(0.37)).max() <= np.spacing(np.float16(0.37))


def test_the_plain_mean_keeps_constant_light_on_average(device, gbuffer):
    method = Method(num_samples=512, weights="mean", inverse_cdf="exact", normal_weights=False)
    scattered = render(flat(gbuffer), method, 1, device).scattered
    assert scattered.mean(axis=(0, 1)) == pytest.approx([0.37] * 3, rel=5e-3)


def test_light_bleeds_into_the_shadow_and_red_furthest(device, gbuffer):
    shadowed = flat(gbuffer)
    light = np.where(np.arange(WIDTH) < WIDTH // 2, 1, 0).astype(np.float32)
    light = np.broadcast_to(light[None, :, None], (HEIGHT, WIDTH, 3)).copy()
    shadowed = dataclasses.replace(shadowed, irradiance=light)
    scattered = render(shadowed, Method(num_samples=256), 1, device).scattered
    red, green, blue = scattered[:, WIDTH // 2 + 4].mean(axis=0)
    assert red > green > blue > 0
    assert scattered[:, :, 0].mean(axis=0)[[2, WIDTH // 2, -3]] == pytest.approx(
        sorted(scattered[:, :, 0].mean(axis=0)[[2, WIDTH // 2, -3]], reverse=True)
    )


def test_pixels_without_skin_pass_through(device, gbuffer):
    frame = render(gbuffer, Method(num_samples=8), 1, device)
    outside = ~gbuffer.subsurface
    assert outside.any()
    expected = gbuffer.non_subsurface[outside].astype(np.float16)
    assert np.array_equal(frame.combined[outside], expected)
    assert (frame.scattered[outside] == 0).all()
    assert (frame.counts[outside] == 0).all()
    assert (frame.counts[~outside] == 8).all()


def test_frames_without_history_take_the_most_samples_and_a_still_scene_then_fewer(device, gbuffer):
    method = Method(kind="adaptive")
    first, settled = (render(gbuffer, method, n, device) for n in (1, 10))
    skin = gbuffer.subsurface
    assert (first.counts[skin] == 64).all()
    assert settled.counts[skin].min() == 8
    assert settled.num_samples < 0.7 * first.num_samples


def test_samples_gather_where_the_light_changes(device, gbuffer):
    shadowed = flat(gbuffer)
    light = np.where(np.arange(WIDTH) < WIDTH // 2, 1, 0.02).astype(np.float32)
    light = np.broadcast_to(light[None, :, None], (HEIGHT, WIDTH, 3)).copy()
    shadowed = dataclasses.replace(shadowed, irradiance=light)
    counts = render(shadowed, Method(kind="adaptive"), 12, device).counts.mean(axis=0)
    assert counts[WIDTH // 2 : WIDTH // 2 + 6].mean() > 1.5 * counts[:6].mean()


def test_a_surface_that_appears_has_no_history(device, gbuffer):
    near = flat(gbuffer)
    far_depth = near.depth_cm.copy()
    far_depth[:, WIDTH // 2 :] *= np.float32(1.2)
    far = dataclasses.replace(near, depth_cm=far_depth)
    method = Method(kind="adaptive")
    frame = render(lambda index: near if index < 8 else far, method, 9, device)
    assert (frame.counts[:, : WIDTH // 2] < 64).all()
    assert (frame.counts[:, WIDTH // 2 :] == 64).all()
    fresh = frame.history[:, WIDTH // 2 :]
    assert (fresh[..., 0] == 64).all()
    assert np.allclose(fresh[..., 2], method.sigma0_sq, rtol=1e-3)


def test_accumulation_is_the_exponential_mean_of_the_frames(device, gbuffer):
    method = Method(num_samples=8, alpha=0.25)
    frames = []
    for count in range(1, 5):
        frames.append(render(gbuffer, method, count, device))
    expected = frames[0].combined
    for frame in frames[1:]:
        expected = expected + np.float32(0.25) * (frame.combined - expected)
    assert np.array_equal(frames[-1].accumulated, expected)


def test_more_samples_and_accumulation_come_closer_to_the_reference(device, gbuffer):
    reference = reference_image(gbuffer, Method(), device, num_samples=1024)
    skin = gbuffer.subsurface
    quality = [
        psnr(render(gbuffer, Method(num_samples=n), 1, device).combined, reference, skin)
        for n in (4, 16, 64)
    ]
    assert quality == sorted(quality) and quality[-1] > quality[0] + 10
    few = render(gbuffer, Method(num_samples=4), 12, device)
    assert psnr(few.accumulated, reference, skin) > psnr(few.combined, reference, skin) + 3


def test_psnr_on_paper():
    image = np.full((2, 2, 3), 0.25, np.float32)
    mask = np.array([[True, True], [False, False]])
    other = image.copy()
    other[1] = 1
    assert psnr(other, image, mask) == math.inf
    other[0] = 0.5
    step = 0.5 ** (1 / 2.2) - 0.25 ** (1 / 2.2)
    assert psnr(other, image, mask) == pytest.approx(-20 * math.log10(step))
    assert luminance(np.ones((1, 1, 3), np.float32)) == pytest.approx(1)


def test_psnr_refuses_what_does_not_match():
    image = np.zeros((2, 2, 3), np.float32)
    with pytest.raises(InputError, match="shapes"):
        psnr(image, image[:1], np.ones((2, 2), bool))
    with pytest.raises(InputError, match="empty"):
        psnr(image, image, np.zeros((2, 2), bool))


def test_render_refuses_no_frames(gbuffer):
    with pytest.raises(InputError, match="num_frames 0"):
        render(gbuffer, Method(), 0)
