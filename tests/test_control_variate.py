"""Control variates: the covariance on paper, counts under changing light, and what they cost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kernels.frame import gbuffer_of, render
from kernels.method import Method
from kernels.passes import covariance
from kernels.pipeline import Pipeline
from kernels.record import record
from kernels.reference import render_reference
from kernels.selfcheck import _count_in_frame, small_gbuffer
from traces.errors import InputError
from traces.texture import INACTIVE_TEXEL, unpack_texel

F = np.float32
CONTROLS = ("none", "constant", "online")


def flickering(gbuffer, strength=0.5):
    """The same surface under light that changes from frame to frame."""

    def scene(frame):
        factor = F(1.0 + strength * np.sin(1.7 * frame))
        return dataclasses.replace(gbuffer, irradiance=gbuffer.irradiance * factor)

    return scene


def moving(gbuffer):
    """Changing light, moving surface, jittered camera."""
    y, x = np.mgrid[0 : gbuffer.height, 0 : gbuffer.width].astype(F)
    velocity = np.stack([0.3 * x - 4, 1.5 * np.sin(y)], axis=-1).astype(F)
    lit = flickering(gbuffer)

    def scene(frame):
        offset = (0.4 * (frame % 3 - 1), 0.7 - 0.35 * frame)
        return dataclasses.replace(lit(frame), velocity=velocity, jitter=offset)

    return scene


def even(gbuffer, value=0.4):
    """Everywhere skin at one depth, with even light."""
    shape = (gbuffer.height, gbuffer.width)
    return dataclasses.replace(
        gbuffer,
        irradiance=np.full((*shape, 3), value, F),
        profile_id=np.ones(shape, np.uint8),
        depth_cm=np.full(shape, 20, F),
    )


# The covariance.


def test_the_moments_are_the_exponential_moving_covariance():
    rng = np.random.default_rng(5)
    z = rng.normal([0.5, 0.4], 0.1, (60, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
    eta = 0.05
    moments = covariance.first_moments(F(z[:1, 0]), F(z[:1, 1]))
    mean, sigma = z[0].copy(), np.zeros((2, 2))
    for f, g in z[1:]:
        moments = covariance.update_moments(moments, F([f]), F([g]), eta)
        difference = np.array([f, g]) - mean
        sigma = (1 - eta) * sigma + eta * (1 - eta) * np.outer(difference, difference)
        mean = (1 - eta) * mean + eta * np.array([f, g])
    assert moments[0] == pytest.approx([*mean, sigma[0, 1], sigma[1, 1]], rel=1e-4)
    found = covariance.find_coefficient(moments, 0.0)[0]
    assert found == pytest.approx(sigma[0, 1] / sigma[1, 1], rel=1e-4)


def test_the_coefficient_of_a_multiple_is_the_factor():
    moments = covariance.first_moments(F([0.6]), F([0.5]))
    for frame in range(50):
        g = F([0.5 + 0.3 * np.sin(frame)])
        moments = covariance.update_moments(moments, F(1.2) * g, g, 0.05)
    assert covariance.find_coefficient(moments, 0.0)[0] == pytest.approx(1.2, rel=1e-4)


def test_epsilon_pulls_the_coefficient_of_nothing_to_one():
    still = np.array([[0.5, 0.5, 0.0, 0.0], [0.5, 0.5, 1e-7, 2e-6], [0.5, 0.5, -0.02, 0.05]], F)
    assert covariance.find_coefficient(still, 0.0) == pytest.approx([1, 0.05, -0.4])
    found = covariance.find_coefficient(still, 1e-4)
    assert found == pytest.approx([1, 1.001e-4 / 1.02e-4, -0.0199 / 0.0501])


# The picture.


@pytest.mark.parametrize("control", CONTROLS[1:])
def test_given_the_counts_the_picture_does_not_change(device, control):
    scene = moving(small_gbuffer())
    plain = Method(kind="adaptive", b_min=12, b_max=12)
    with_control = dataclasses.replace(plain, control=control)
    for num_frames in (1, 4):
        frames = [render(scene, method, num_frames, device) for method in (plain, with_control)]
        assert np.array_equal(frames[0].combined, frames[1].combined)
        assert not np.array_equal(frames[0].history[..., 3], frames[1].history[..., 3])


@pytest.mark.parametrize("control", CONTROLS[1:])
def test_pixels_of_equal_count_have_equal_colour(device, control):
    scene = flickering(small_gbuffer())
    plain, other = (
        render(scene, Method(kind="adaptive", control=name), 6, device)
        for name in ("none", control)
    )
    same = plain.counts == other.counts
    assert (~same).any()
    assert np.array_equal(plain.combined[same], other.combined[same])


# The counts.


def test_even_light_that_changes_takes_the_least_samples_with_the_constant_control(device):
    scene = flickering(even(small_gbuffer()))
    plain, constant = (
        render(scene, Method(kind="adaptive", control=name), 28, device)
        for name in ("none", "constant")
    )
    assert (constant.counts == 8).all()
    assert plain.counts.mean() > 40
    # What is left of the residual is the rounding of the result.
    assert np.abs(constant.history[..., 3]).max() < 1e-3
    assert constant.history[..., 2].max() < 1e-5 < plain.history[..., 2].min()


@pytest.mark.parametrize("control", CONTROLS[1:])
def test_changing_light_looks_less_like_noise_with_a_control(device, control):
    scene = flickering(small_gbuffer(64, 40))
    plain, other = (
        render(scene, Method(kind="adaptive", control=name), 24, device)
        for name in ("none", control)
    )
    assert other.num_samples < 0.7 * plain.num_samples


def test_a_still_scene_keeps_its_variance_with_the_constant_control(device):
    """The lighting does not vary, so that taking it away changes the mean alone."""
    gbuffer = small_gbuffer()
    plain, constant = (
        render(gbuffer, Method(kind="adaptive", control=name, b_min=8, b_max=8), 12, device)
        for name in ("none", "constant")
    )
    skin = gbuffer.subsurface
    ratio = constant.history[..., 2][skin].mean() / plain.history[..., 2][skin].mean()
    assert ratio == pytest.approx(1, abs=0.02)


def test_epsilon_pulls_the_coefficient_of_a_still_scene_to_one():
    """Under jitter alone the lighting varies at its edge: without epsilon a would be near 0."""
    gbuffer = small_gbuffer()
    offsets = [(0.3, -0.2), (-0.4, 0.1), (0.1, 0.4)]
    found = []
    for epsilon in (0.0, 1e-4, 1e-2):
        method = Method(kind="adaptive", control="online", epsilon_a=epsilon, b_max=8)
        last = render_reference(
            lambda frame: dataclasses.replace(gbuffer, jitter=offsets[frame % 3]),
            method,
            8,
            traced=False,
        )[-1]
        moments = last.textures["covariance_1"].astype(F)[gbuffer.subsurface]
        lively = moments[:, 3] > 1e-5
        assert lively.any() and not lively.all()
        coefficient = covariance.find_coefficient(moments, epsilon)
        assert (np.abs(coefficient[moments[:, 3] == 0] - 1) < 0.2).all()
        found.append(np.abs(coefficient[lively] - 1).mean())
    assert found[0] > 0.8
    assert found[0] > 1.2 * found[1] > 3 * found[2]


def test_the_lighting_is_read_where_the_centre_lies_without_the_jitter():
    """A ramp of light: its value between texels is exact."""
    gbuffer = even(small_gbuffer())
    ramp = (np.arange(gbuffer.width, dtype=F) * F(1 / 64) + F(0.25))[None, :, None]
    light = np.broadcast_to(ramp, gbuffer.irradiance.shape).copy()
    gbuffer = dataclasses.replace(gbuffer, irradiance=light, jitter=(0.25, -0.5))
    method = Method(kind="adaptive", control="online", b_max=8)
    (frame,) = render_reference(gbuffer, method)
    mean_of_light = frame.textures["covariance_0"][..., 1].astype(F)
    expected = (ramp[0, 1:, 0] - F(0.25 / 64)) ** F(1 / 2.2)
    assert mean_of_light[5, 1:] == pytest.approx(expected, rel=1e-3)
    # At the edge the position is clamped.
    assert mean_of_light[5, 0] == pytest.approx(0.25 ** (1 / 2.2), rel=1e-3)


# The trace.


def fetches_of(trace, pass_name):
    """Lane fetches by (texture, operation, footprint) of one pass."""
    found = {}
    for chunk in trace.chunks():
        if trace.launches[chunk.launch].pass_name != pass_name:
            continue
        active = (chunk.lanes != INACTIVE_TEXEL).sum(axis=1)
        for code, count in zip(chunk.instruction.tolist(), active.tolist(), strict=True):
            access = trace.instructions[code]
            key = (trace.textures[access.texture].name, access.operation, access.footprint)
            found[key] = found.get(key, 0) + count
    return found


def test_the_constant_control_reads_result_and_lighting_once_more(device):
    gbuffer = small_gbuffer()
    pixels, skin = gbuffer.width * gbuffer.height, int(gbuffer.subsurface.sum())
    plain, constant, online = (
        fetches_of(
            record(gbuffer, Method(kind="adaptive", control=name), device=device, self_check=False),
            "update",
        )
        for name in CONTROLS
    )
    more = {("scattered", "load", "point"): pixels + skin, ("setup", "load", "bilinear"): skin}
    assert constant == plain | more
    # One more texture: its old texel read, its new one written.
    extra = {("covariance_1", "load", "point"): skin, ("covariance_0", "store", "point"): pixels}
    assert online == constant | extra


def test_the_lighting_is_fetched_beside_the_pixel(device):
    gbuffer = dataclasses.replace(even(small_gbuffer(16, 8)), jitter=(0.25, -0.5))
    method = Method(kind="adaptive", control="constant", passes=("update",))
    trace = record(gbuffer, method, device=device, self_check=False)
    own, light = (
        np.concatenate(
            [
                chunk.lanes[
                    [
                        trace.instructions[code].footprint == footprint
                        and trace.textures[trace.instructions[code].texture].name == name
                        for code in chunk.instruction
                    ]
                ]
                for chunk in trace.chunks()
            ]
        )
        for name, footprint in (("velocity", "point"), ("setup", "bilinear"))
    )
    (_, y, x), (mip, light_y, light_x) = unpack_texel(own), unpack_texel(light)
    assert (mip == 0).all()
    assert np.array_equal(light_x, np.maximum(x.astype(int) - 1, 0))
    assert np.array_equal(light_y, y)


@pytest.mark.parametrize(
    "fields",
    [
        {"control": "constant"},
        {"control": "online"},
        {"control": "online", "epsilon_a": 0.0, "eta_cov": 0.5, "rule": "engine"},
        {"control": "online", "disocclusion": "offscreen", "rule": "sliding"},
        {"control": "constant", "disocclusion": "none", "epsilon_u": 0.7},
        {"control": "online", "epsilon_u": 0.0, "weights": "mean"},
    ],
)
def test_devices_equal_the_reference(device, fields):
    """Fetches of every launch, and the pictures and histories that the last frame leaves."""
    scene = moving(small_gbuffer())
    method = Method(kind="adaptive", b_max=20, **fields)
    expected = render_reference(scene, method, 4)
    first = gbuffer_of(scene, 0)
    pipeline = Pipeline(method, first.width, first.height, device)
    for frame, found in enumerate(expected):
        pipeline.load(gbuffer_of(scene, frame))
        assert _count_in_frame(pipeline, frame, found.launches) == 0
    names = ["output", "history_0", "history_1"]
    names += ["covariance_0", "covariance_1"] if method.control == "online" else []
    for name in names:
        assert np.array_equal(pipeline.read(name), expected[-1].textures[name].astype(F)), name


def test_an_unknown_control_is_refused():
    with pytest.raises(InputError, match="did you mean 'online'"):
        Method(control="onlin")
