"""Temporal anti-aliasing and overlay: the reference's bits, what they keep, what disturbs them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from recordings import assert_launches_equal

from kernels.frame import render
from kernels.gbuffer import GBuffer
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes import taa
from kernels.quality import psnr, reference_image
from kernels.record import record
from kernels.reference import render_reference
from kernels.resources import to_half
from kernels.scenes.analytic import Circle
from kernels.scenes.jitter import Jitter
from kernels.scenes.motion import Overlaid, veil
from kernels.selfcheck import small_gbuffer
from traces.errors import InputError

NUM_FRAMES = 3
METHODS = {
    "taa alone": Method(num_samples=6, taa=True),
    "with local guiding": Method(kind="adaptive", b_max=16, taa=True, overlay=True),
    "other order": Method(
        num_samples=5,
        taa=True,
        overlay=True,
        taa_weight=0.3,
        tile_order="morton",
        lane_map="morton8x8",
        passes=("overlay", "taa"),
    ),
    "overlay alone": Method(num_samples=5, overlay=True),
}


def disturbed_gbuffer():
    """A small G-buffer whose surface moves, partly in from outside, under something transparent."""
    still = small_gbuffer()
    y, x = np.mgrid[0 : still.height, 0 : still.width].astype(np.float32)
    velocity = np.stack([0.3 * x - 4, 1.5 * np.sin(y)], axis=-1).astype(np.float32)
    overlay = veil(opacity=0.7)(7, still.height, still.width)
    return dataclasses.replace(still, velocity=velocity, overlay=overlay)


def picture_of(colour, velocity=None, depth_cm=None):
    """A G-buffer whose finished picture is (h, w, 3) `colour`, but for the last pixel: skin."""
    height, width = colour.shape[:2]
    profile = np.zeros((height, width), np.uint8)
    profile[-1, -1] = 1
    if depth_cm is None:
        depth_cm = np.full((height, width), 20, np.float32)
    if velocity is not None:
        velocity = np.broadcast_to(np.float32(velocity), (height, width, 2)).copy()
    return GBuffer(
        name="picture",
        irradiance=np.zeros((height, width, 3), np.float32),
        albedo=np.zeros((height, width, 3), np.float32),
        non_subsurface=colour.astype(np.float32),
        depth_cm=depth_cm,
        normal=np.zeros((height, width, 3), np.float32),
        profile_id=profile,
        projection_x=3.7,
        velocity=velocity,
    )


SHOW = Method(num_samples=1, taa=True)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("scene", [small_gbuffer, disturbed_gbuffer])
def test_trace_and_pictures_equal_the_reference(device, name, scene):
    method, gbuffer = METHODS[name], scene()
    expected = render_reference(gbuffer, method, NUM_FRAMES)
    trace = record(
        gbuffer,
        method,
        num_frames=NUM_FRAMES,
        traced_frames="all",
        device=device,
        chunk_bytes=1,
        self_check=False,
    )
    launches = [
        launch
        for found in expected
        for launch in found.launches
        if launch[0].pass_name in method.passes
    ]
    assert_launches_equal(trace, launches)

    textures = expected[-1].textures
    frame = render(gbuffer, method, NUM_FRAMES, device)
    assert np.array_equal(to_half(frame.combined), textures["output"][..., :3])
    if method.taa:
        shown = textures[taa.texture_names(NUM_FRAMES - 1)[1]]
        assert np.array_equal(to_half(frame.shown), shown[..., :3])
        assert (shown[..., 3] == 1).all()
    else:
        assert frame.shown is None


def test_every_pixel_reads_its_neighbourhood_once(device):
    gbuffer = small_gbuffer()
    method = dataclasses.replace(SHOW, passes=("taa",))
    trace = record(gbuffer, method, num_frames=2, device=device, self_check=False)
    found: dict[tuple[str, str, str], int] = {}
    for chunk in trace.chunks():
        for code, active in zip(chunk.instruction, chunk.active, strict=True):
            access = trace.instructions[code]
            key = trace.textures[access.texture].name, access.operation, access.footprint
            found[key] = found.get(key, 0) + int(active.sum())
    pixels = gbuffer.width * gbuffer.height
    assert found == {
        ("depth", "load", "point"): 9 * pixels,
        ("output", "load", "point"): 9 * pixels,
        ("velocity", "load", "point"): pixels,
        ("taa_0", "load", "bilinear"): pixels,
        ("taa_1", "store", "point"): pixels,
    }


def test_the_rest_of_the_method_does_not_notice_the_taa(device):
    gbuffer = disturbed_gbuffer()
    plain, shown = (
        render(gbuffer, Method(kind="adaptive", taa=taa), 4, device) for taa in (False, True)
    )
    for name in ("scattered", "combined", "accumulated", "counts", "history"):
        assert np.array_equal(getattr(plain, name), getattr(shown, name)), name


@pytest.mark.parametrize("kind", ["fixed", "adaptive"])
def test_constant_light_comes_back_constant(device, kind):
    """A white furnace, moving, jittered and with every neighbour at another depth."""
    y, x = np.mgrid[0:24, 0:32].astype(np.float32)
    velocity = np.stack([3 * np.sin(y), 7 * np.cos(x)], axis=-1)
    flat = dataclasses.replace(
        picture_of(np.zeros((24, 32, 3)), velocity),
        irradiance=np.full((24, 32, 3), 0.37, np.float32),
        albedo=np.full((24, 32, 3), 0.75, np.float32),
        profile_id=np.ones((24, 32), np.uint8),
        depth_cm=(20 + 0.01 * x * y).astype(np.float32),
    )
    method = Method(kind=kind, num_samples=8, taa=True)
    frame = render(flat, method, 6, device)
    expected = np.float16(np.float16(0.37) * np.float32(0.75))
    assert np.abs(frame.shown - expected).max() <= 2 * np.spacing(expected)


def test_without_history_the_frame_is_shown_as_it_is(device):
    colour = np.random.default_rng(3).random((20, 24, 3))
    first = render(picture_of(colour), SHOW, 1, device)
    assert np.array_equal(first.shown, first.combined)
    # The left 5 columns come in from outside the frame.
    moving = render(picture_of(colour, (-5.0, 0.0)), SHOW, 2, device)
    assert np.array_equal(moving.shown[:, :5], moving.combined[:, :5])


def mixed(old, new, weight):
    """The blend of two greys, each weighed down by its luma."""
    of_new, of_old = weight / (1 + new), (1 - weight) / (1 + old)
    return (new * of_new + old * of_old) / (of_new + of_old)


@pytest.mark.parametrize(
    ("speed", "num_blends", "weight"),
    [(0, 3, 0.05), (-12, 3, 0.05 + 0.15 * 12 / 40), (45, 1, 0.2), (-60, 1, 0.2)],
)
def test_a_grey_follows_the_recurrence_with_a_weight_that_grows_with_speed(
    device, speed, num_blends, weight
):
    """Every 3x3 neighbourhood of the pattern holds 0, 1 and the grey that jumps, so that nothing is
    clamped; it moves by multiples of its period.
    """
    y, x = np.mgrid[0:12, 0:96]
    pattern = np.where((y + x) % 3 == 0, 0.0, 1.0)
    grey = (x % 3 == 1) & (y % 3 == 1)

    def scene(frame):
        value = 0.25 if frame < 2 else 0.75
        colour = np.where(grey, value, pattern)
        return picture_of(np.repeat(colour[..., None], 3, axis=2), (speed, 0.0))

    method = dataclasses.replace(SHOW, taa_weight=0.05, alpha=0.2)
    frame = render(scene, method, 2 + num_blends, device)
    expected = 0.25
    for _ in range(num_blends):
        expected = mixed(expected, 0.75, weight)
    # Where all of that history lies inside the picture.
    kept = grey & (x + num_blends * speed >= 0) & (x + num_blends * speed < 96) & (y < 9)
    assert kept.any()
    assert frame.shown[kept] == pytest.approx(expected, abs=1e-3)


def test_history_that_no_neighbour_shows_is_clamped_away(device):
    dark, bright = (picture_of(np.full((16, 16, 3), value)) for value in (0.1, 0.6))
    frame = render(lambda index: dark if index < 5 else bright, SHOW, 6, device)
    assert frame.shown[:14, :14] == pytest.approx(np.float16(0.6), rel=1e-3)


@pytest.mark.parametrize("step", [(3, 0), (-2, 5)])
def test_a_picture_that_moves_whole_texels_stays_sharp(device, step):
    texture = np.random.default_rng(1).random((40, 48, 3))

    def scene(frame):
        moved = np.roll(texture, (frame * step[1], frame * step[0]), axis=(0, 1))
        return picture_of(moved, (-step[0], -step[1]))

    frame = render(scene, SHOW, 4, device)
    inner = slice(16, 30), slice(12, 38)
    assert frame.shown[inner] == pytest.approx(frame.combined[inner], rel=2e-3, abs=1e-4)
    backwards = render(
        lambda index: dataclasses.replace(scene(index), velocity=-scene(index).velocity),
        SHOW,
        4,
        device,
    )
    assert np.abs(backwards.shown[inner] - backwards.combined[inner]).mean() > 0.05


def test_between_texels_the_history_is_linear(device):
    """A ramp that moves a quarter texel a frame: nearest history would lag behind."""

    def scene(frame):
        ramp = (np.arange(64) - 0.25 * frame) / 64
        return picture_of(np.broadcast_to(ramp[None, :, None], (16, 64, 3)), (-0.25, 0.0))

    frame = render(scene, dataclasses.replace(SHOW, taa_weight=0.02, alpha=0.02), 12, device)
    inner = frame.shown[:14, 20:60], frame.combined[:14, 20:60]
    assert np.abs(inner[0] - inner[1]).max() < 0.25 / 64 / 8


def test_the_nearest_surface_around_says_where_to_look():
    depth = np.full((24, 24), 40, np.float32)
    depth[8:16, 8:16] = 20
    depth[0, 0] = 0
    gbuffer = picture_of(np.zeros((24, 24, 3)), (0.0, 0.0), depth)
    method = dataclasses.replace(SHOW, passes=("taa",))
    step, offsets, lanes = render_reference(gbuffer, method, 1)[0].launches[-1]
    assert step.pass_name == "taa"
    velocity_rows = lanes[offsets[:-1] + 18]
    x, y = Grid(24, 24, method.tile_order, method.lane_map).lanes
    got_x, got_y = velocity_rows & 0x3FFF, velocity_rows >> 14 & 0x3FFF
    for px, py, at_x, at_y in zip(*(v.ravel() for v in (x, y, got_x, got_y)), strict=True):
        around = [
            (depth[v, u] or np.inf, (u, v) != (px, py), u, v)
            for v in range(max(0, py - 1), min(24, py + 2))
            for u in range(max(0, px - 1), min(24, px + 2))
        ]
        assert depth[at_y, at_x] == min(around)[0]
        if min(around)[0] == depth[py, px]:
            assert (at_x, at_y) == (px, py)


def test_it_converges_to_the_reference_with_frames(device):
    gbuffer = small_gbuffer(48, 40)
    skin = gbuffer.subsurface
    target = reference_image(gbuffer, Method(), device, num_samples=1024)
    method = Method(num_samples=4, taa=True)
    frames = [render(gbuffer, method, count, device) for count in (1, 8, 40)]
    quality = [psnr(frame.shown, target, skin) for frame in frames]
    assert quality[0] + 2 < quality[1] < quality[2]
    assert quality[2] > psnr(frames[2].combined, target, skin) + 5


def test_jittered_frames_accumulate_to_the_filtered_edge(device):
    """The rim of a resting disc: all or nothing in each frame, its pixels' coverage after some."""
    scene = Circle(48, 48, speed_pixels=0, radius_rate=0.3, jitter=Jitter("box", 8))
    bare = dataclasses.replace(scene, jitter=None)(0)
    method = Method(num_samples=8, taa=True, taa_weight=0.05)
    smooth, hard = (render(each, method, 40, device).shown for each in (scene, bare))

    fine = (np.arange(48 * 16) + 0.5) / 16
    centre_x, centre_y = scene.centre(0)
    disc = np.hypot(fine[None, :] - centre_x, fine[:, None] - centre_y) < 0.3 * 48
    coverage = disc.reshape(48, 16, 48, 16).mean(axis=(1, 3))
    # Left below, the disc is dark and what is behind it bright.
    rim = (coverage > 0.05) & (coverage < 0.95)
    rim[:26], rim[:, 24:] = False, False
    dark, bright = hard[30, 12], hard[46, 2]
    # The TAA weighs by luma.
    of_dark, of_bright = (1 / (1 + np.dot((0.25, 0.5, 0.25), colour)) for colour in (dark, bright))
    share = coverage * of_dark / (coverage * of_dark + (1 - coverage) * of_bright)
    share = share[rim][:, None]
    errors = [
        np.abs((shown[rim] - bright) / (dark - bright) - share).mean() for shown in (smooth, hard)
    ]
    assert errors[0] < 0.09 < 0.2 < errors[1]


def test_an_overlay_is_drawn_over_and_disturbs_the_taa_but_no_history(device):
    still = small_gbuffer(96, 64)
    draw = veil(speed_pixels=6.0, opacity=0.8)
    method = Method(kind="adaptive", taa=True, overlay=True)
    over = render(Overlaid(still, draw), method, 8, device)
    bare = render(still, method, 8, device)

    for name in ("scattered", "counts", "history"):
        assert np.array_equal(getattr(over, name), getattr(bare, name)), name
    layer = to_half(draw(7, 64, 96)).astype(np.float32)
    opacity = layer[..., 3:]
    expected = bare.combined * (1 - opacity) + layer[..., :3] * opacity
    assert over.combined == pytest.approx(expected, rel=1e-3, abs=1e-4)
    # Behind the veil, where it has left, the history still shows it.
    left = (draw(6, 64, 96)[..., 3] > 0.2) & (opacity[..., 0] == 0)
    assert left.any()
    assert np.array_equal(over.combined[left], bare.combined[left])
    assert np.abs(over.shown[left] - bare.shown[left]).max() > 0.003


def test_a_scene_without_overlay_leaves_the_pass_nothing_to_draw(device):
    gbuffer = small_gbuffer()
    method = Method(num_samples=4)
    plain = render(gbuffer, method, 1, device)
    with_pass = render(gbuffer, dataclasses.replace(method, overlay=True), 1, device)
    assert np.array_equal(plain.combined, with_pass.combined)
    # A veil that vanishes leaves nothing behind.
    draw = veil(opacity=0.5)
    scene = [dataclasses.replace(gbuffer, overlay=draw(5, 27, 44)), gbuffer]
    gone = render(lambda frame: scene[frame], dataclasses.replace(method, overlay=True), 2, device)
    assert np.array_equal(gone.combined, render(gbuffer, method, 2, device).combined)


@pytest.mark.parametrize("weight", [0.0, 1.5, float("nan")])
def test_a_weight_out_of_range_is_an_input_error(weight):
    with pytest.raises(InputError, match="taa_weight"):
        Method(taa=True, taa_weight=weight)


def test_an_overlay_of_impossible_opacity_is_an_input_error():
    overlay = np.full((27, 44, 4), 1.5, np.float32)
    with pytest.raises(InputError, match="overlay: opacity"):
        dataclasses.replace(small_gbuffer(), overlay=overlay)
