"""The separable filter: its taps, its picture and trace against the reference, and its laws."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from recordings import assert_launches_equal
from scipy.integrate import quad

from kernels.frame import render
from kernels.gbuffer import GBuffer
from kernels.maths.profile import SKIN, evaluate
from kernels.method import Method
from kernels.passes.separable_taps import (
    SKIN_FALLOFF,
    SKIN_STRENGTH,
    line_share,
    make_taps,
    skin_profile,
    unit_offsets,
)
from kernels.record import estimate_rows, record
from kernels.reference import render_reference
from kernels.resources import to_half
from kernels.selfcheck import count_differences, small_gbuffer
from traces.check import check
from traces.errors import InputError
from traces.texture import unpack_texel

TAP_COUNTS = (11, 13, 17, 19, 25, 27)
METHODS = {
    "burley": Method(kind="separable"),
    "demo": Method(kind="separable", separable_profile="skin", num_taps=17),
    "legacy": Method(
        kind="separable", num_taps=13, scale="legacy", tile_order="morton", lane_map="quad2x2"
    ),
    "few planes": Method(kind="separable", num_taps=11, planes=("profile_id",)),
    "colour": Method(kind="separable", num_taps=3, planes=("colour",), lane_map="morton8x8"),
}


def plate(light, depth_cm=20.0, projection_x=40.0, holes=False):
    """A flat plate, all of it skin or with holes, under light (h, w)."""
    height, width = light.shape
    y, x = np.mgrid[0:height, 0:width]
    skin = ((x // 5 + y // 7) % 3 > 0) | (not holes)
    depth = np.broadcast_to(np.asarray(depth_cm, np.float32), light.shape)
    rgb = np.where(skin, light, 0)[..., None] * np.ones(3)
    return GBuffer(
        name="plate",
        irradiance=rgb.astype(np.float32),
        albedo=np.full((height, width, 3), 0.5, np.float32),
        non_subsurface=np.zeros((height, width, 3), np.float32),
        depth_cm=np.ascontiguousarray(depth),
        normal=np.broadcast_to(np.float32([0, 0, 1]), (height, width, 3)).copy(),
        profile_id=skin.astype(np.uint8),
        projection_x=projection_x,
    )


# The taps.


@pytest.mark.parametrize("profile", ["burley", "skin"])
@pytest.mark.parametrize("num_taps", [*TAP_COUNTS, 3, 101])
def test_weights_are_positive_symmetric_and_add_up_to_one(num_taps, profile):
    taps = make_taps(Method(kind="separable", num_taps=num_taps, separable_profile=profile))
    assert taps.shape == (num_taps, 4) and taps[0, 0] == 0
    assert np.allclose(taps[:, 1:].sum(axis=0), 1, atol=1e-6)
    assert (taps[:, 1:] >= 0).all() and (taps[0, 1:] > 0).all()
    others = taps[1:]
    assert (np.diff(others[:, 0]) > 0).all()
    assert np.array_equal(others[::-1, 0], -others[:, 0])
    assert np.allclose(others[::-1, 1:], others[:, 1:], rtol=1e-5)


def test_offsets_are_quadratic_within_three_units_or_two():
    assert unit_offsets(27)[[0, 13, 26]].tolist() == [-3, 0, 3]
    assert unit_offsets(19)[[0, 9, 18]].tolist() == [-2, 0, 2]
    assert unit_offsets(27)[20] == pytest.approx(3 * (7 / 13) ** 2)
    # The engine's default skin scatters 12 mm a unit, that of its authors 1 mm.
    assert make_taps(Method(num_taps=27))[-1, 0] == pytest.approx(36)
    assert make_taps(Method(num_taps=13))[-1, 0] == pytest.approx(24)
    assert make_taps(Method(num_taps=13, separable_profile="skin"))[-1, 0] == 2


@pytest.mark.parametrize("a", [1e-3, 0.1, 1.0, 7.0, 40.0])
def test_line_share_is_the_integral_of_the_profile_between_two_lines(a):
    d = 1.8

    def within_radius(r):
        return 2 * np.pi * r * evaluate(r, d) * (1 if r <= a else 2 / np.pi * np.arcsin(a / r))

    inside, outside = quad(within_radius, 0, a), quad(within_radius, a, 60 * d, limit=200)
    assert line_share(a, d)[0] == pytest.approx(inside[0] + outside[0], abs=2e-7)


def test_line_share_rises_from_nothing_to_everything():
    a = np.concatenate([[0], np.geomspace(1e-6, 1e3, 200)])
    share = line_share(a, 0.7)
    assert share[0] == 0 and share[-1] == 1
    assert (np.diff(share) >= 0).all()


def test_the_skin_taps_are_the_gaussians_times_their_stretch():
    taps = make_taps(Method(num_taps=25, separable_profile="skin"))
    offset = np.concatenate([taps[1:13, 0], [0], taps[13:, 0]]).astype(np.float64)
    stretch = np.gradient(offset)
    stretch[[0, -1]] /= 2
    for channel in range(3):
        expected = stretch * skin_profile(offset, SKIN_FALLOFF[channel])
        expected *= SKIN_STRENGTH[channel] / expected.sum()
        got = np.concatenate([taps[1:13, 1 + channel], taps[13:, 1 + channel]])
        assert np.allclose(got, np.delete(expected, 12), rtol=1e-4)
        centre = 1 - SKIN_STRENGTH[channel] + expected[12]
        assert taps[0, 1 + channel] == pytest.approx(centre, rel=1e-5)


def test_a_gaussian_of_the_skin_profile_is_one_over_the_plane():
    total = quad(lambda r: 2 * np.pi * r * skin_profile(r, 1 - 0.001), 0, 60)[0]
    assert total == pytest.approx(0.1 + 0.118 + 0.113 + 0.358 + 0.078, abs=1e-9)


@pytest.mark.parametrize(
    ("field", "value"),
    [("num_taps", 12), ("num_taps", 1), ("num_taps", 513), ("separable_profile", "wax")],
)
def test_settings_out_of_range_are_input_errors(field, value):
    with pytest.raises(InputError, match=field):
        Method(kind="separable", **{field: value})


# The passes.


@pytest.mark.parametrize("name", METHODS)
def test_trace_and_pictures_equal_the_reference(device, name):
    method, gbuffer = METHODS[name], small_gbuffer()
    (expected,) = render_reference(gbuffer, method)
    trace = record(gbuffer, method, device=device, chunk_bytes=1 << 16, self_check=False)
    assert [v.pass_name for v in trace.launches] == [
        "setup",
        "separable_h",
        "separable_v",
        "combine",
    ]
    assert_launches_equal(trace, expected.launches)
    frame = render(gbuffer, method, device=device)
    assert np.array_equal(frame.counts, expected.counts)
    assert np.array_equal(to_half(frame.scattered), expected.textures["scattered"][..., :3])
    assert np.array_equal(to_half(frame.combined), expected.textures["output"][..., :3])
    assert count_differences(device, method) == 0


def test_every_scattering_pixel_takes_each_tap_twice(first_device):
    gbuffer = small_gbuffer()
    for num_taps in (3, 27):
        frame = render(gbuffer, Method(kind="separable", num_taps=num_taps), device=first_device)
        assert np.array_equal(frame.counts, np.where(gbuffer.subsurface, 2 * num_taps, 0))


def test_the_trace_is_valid_bilinear_and_of_the_estimated_size(first_device):
    gbuffer, method = small_gbuffer(), METHODS["burley"]
    trace = record(gbuffer, method, device=first_device, self_check=False)
    assert check(trace).num_rows == estimate_rows(gbuffer, method)
    names = [trace.textures[i.texture].name for i in trace.instructions]
    in_loop = {
        (i.pass_name, name)
        for i, name in zip(trace.instructions, names, strict=True)
        if i.footprint == "bilinear"
    }
    assert in_loop == {
        ("separable_h", "setup"),
        ("separable_h", "profile_id"),
        ("separable_v", "tex"),
        ("separable_v", "profile_id"),
    }
    # A row of taps along x keeps its y, one along y its x.
    for chunk in trace.chunks():
        name = trace.launches[chunk.launch].pass_name
        if not name.startswith("separable"):
            continue
        _, y, x = unpack_texel(chunk.lanes)
        across = x if name == "separable_v" else y
        own = chunk.warp_offsets[:-1]
        rows = np.repeat(own, np.diff(chunk.warp_offsets))
        assert (across == across[rows])[chunk.active].all()


@pytest.mark.parametrize("profile", ["burley", "skin"])
@pytest.mark.parametrize("holes", [False, True])
def test_constant_light_comes_back_constant(first_device, holes, profile):
    """The white furnace, at the frame's edge and at silhouettes too."""
    gbuffer = plate(np.full((37, 45), 0.7), holes=holes)
    method = Method(kind="separable", separable_profile=profile)
    frame = render(gbuffer, method, device=first_device)
    expected = np.float32(np.float16(0.7))
    inside = frame.scattered[gbuffer.subsurface]
    assert np.abs(inside / expected - 1).max() <= 2**-10
    assert (frame.scattered[~gbuffer.subsurface] == 0).all()


def test_light_that_comes_in_goes_out(first_device):
    """A lit patch far from the frame's edge keeps its energy; each channel has its own width."""
    light = np.zeros((96, 96))
    light[44:52, 40:56] = 1
    gbuffer = plate(light, depth_cm=100.0, projection_x=13.0)  # 0.6 pixels per mm
    frame = render(gbuffer, Method(kind="separable"), device=first_device)
    total = frame.scattered.sum(axis=(0, 1), dtype=np.float64)
    assert np.allclose(total, light.sum(), rtol=5e-3)
    y, x = np.mgrid[0:96, 0:96] - 47.5
    spread = (frame.scattered * (x * x + y * y)[..., None]).sum(axis=(0, 1)) / total
    assert spread[0] > spread[1] > spread[2]


def edge_response(device, num_taps, pixels_per_mm=8.0):
    """Root mean square difference to the exact blur of a vertical edge of light, red channel."""
    width = 512
    light = np.zeros((8, width))
    light[:, width // 2 :] = 1
    gbuffer = plate(light, depth_cm=20.0, projection_x=pixels_per_mm * 20 / (0.05 * width))
    method = Method(kind="separable", num_taps=num_taps)
    got = render(gbuffer, method, device=device).scattered[4, :, 0]
    distance = (np.arange(width) + 0.5 - width / 2) / pixels_per_mm
    exact = (1 + np.sign(distance) * line_share(np.abs(distance), SKIN.d_mm[0])) / 2
    # Taps further out than the frame's edge count nothing, so that only the middle is comparable.
    middle = np.abs(distance) < 12
    return float(np.sqrt(np.mean((got - exact)[middle] ** 2)))


def test_more_taps_come_closer_to_the_profile(first_device):
    errors = [edge_response(first_device, n) for n in (27, 51, 101, 201)]
    assert errors[0] < 0.03 and errors[-1] < 0.002
    slope = np.polyfit(np.log([27, 51, 101, 201]), np.log(errors), 1)[0]
    assert slope < -1


def test_sampling_and_filtering_agree_on_light_that_changes_along_one_axis(first_device):
    light = np.zeros((128, 192))
    light[:, 96:] = 1
    gbuffer = plate(light, depth_cm=20.0, projection_x=8.0)  # 3.84 pixels per mm
    filtered = render(gbuffer, Method(kind="separable", num_taps=101), device=first_device)
    errors = []
    for num_samples in (16, 64, 256):
        method = Method(num_samples=num_samples, mip_rule="mip0", inverse_cdf="exact")
        sampled = render(gbuffer, method, device=first_device)
        rows = slice(48, 80)
        difference = (sampled.scattered - filtered.scattered)[rows, 64:128, 0]
        errors.append(float(np.sqrt(np.mean(difference**2))))
    assert errors[0] > 1.5 * errors[1] > 2 * errors[2]
    assert errors[2] < 0.03


def test_light_does_not_leak_across_a_step_in_depth(first_device):
    light = np.full((40, 64), 0.1)
    light[:, 32:] = 1
    depth = np.where(np.arange(64) < 32, 20.0, 30.0)
    near = render(plate(light, depth), Method(kind="separable"), device=first_device).scattered
    flat = render(plate(light, 20.0), Method(kind="separable"), device=first_device).scattered
    # With M = 40 a step of 10 cm is beyond the 1 / (0.03 M) = 0.83 cm at which taps count nothing;
    # the tap whose two texels are one of each counts a little.
    assert np.abs(near[20, 20:28, 0] - 0.1).max() < 0.01
    assert flat[20, 28, 0] > 0.2


def test_a_repeat_is_bit_identical(first_device):
    method = METHODS["burley"]
    first, second = (
        render(small_gbuffer(), method, device=first_device).scattered for _ in range(2)
    )
    assert np.array_equal(first, second)


def test_the_profile_decides_the_width(first_device):
    light = np.zeros((8, 256))
    light[:, 128:] = 1
    gbuffer = plate(light, depth_cm=20.0, projection_x=8 * 20 / (0.05 * 256))
    narrow = dataclasses.replace(SKIN, dmfp_mm=tuple(v / 4 for v in SKIN.dmfp_mm))
    widths = []
    for profile in (SKIN, narrow):
        frame = render(gbuffer, Method(kind="separable", profile=profile), device=first_device)
        widths.append(float(np.abs(frame.scattered[4, :, 0] - light[4]).sum()))
    assert widths[0] == pytest.approx(4 * widths[1], rel=0.1)
