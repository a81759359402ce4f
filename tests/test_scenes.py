"""Scenes: has the head the stated size, do the views show what their table says?"""

import dataclasses
import hashlib

import numpy as np
import pytest

from kernels.frame import advance, start_pipeline
from kernels.method import Method
from kernels.opencl.device import open_device
from kernels.picture import preview, save_png, tone_map
from kernels.scene import load_scene, open_scene
from kernels.scenes import head
from kernels.scenes.analytic import Circle, wall
from kernels.scenes.camera import CAMERAS, Camera
from kernels.scenes.light import RIG, Light, Rig
from traces.errors import InputError

PLANES = ("irradiance", "albedo", "non_subsurface", "depth_cm", "normal", "profile_id")
STUDY = (480, 270)


@pytest.fixture(scope="module")
def views():
    """The four views at a quarter of the study's resolution, by name."""
    return {name: load_scene(name, *STUDY) for name in CAMERAS}


def digest(gbuffer):
    planes = (np.ascontiguousarray(getattr(gbuffer, name)).tobytes() for name in PLANES)
    return hashlib.sha256(b"".join(planes)).hexdigest()


def positions(gbuffer, camera):
    """World position of every pixel, from its depth alone."""
    right, up, forward = camera.basis()
    half_width = 1 / camera.projection_x
    x = ((np.arange(gbuffer.width) + 0.5) / gbuffer.width * 2 - 1) * half_width
    y = (1 - (np.arange(gbuffer.height) + 0.5) / gbuffer.height * 2) * half_width
    y = y * gbuffer.height / gbuffer.width
    rays = forward + x[None, :, None] * right + y[:, None, None] * up
    return np.array(camera.position) + rays * gbuffer.depth_cm[..., None]


def test_size_and_camera_are_checked_before_anything_else():
    for width, height in ((0, 10), (10, 0), (-5, 10), (16385, 10), (10, 16385)):
        with pytest.raises(InputError, match="from 1 to 16384"):
            load_scene("front", width, height)
    with pytest.raises(InputError, match="did you mean 'close'"):
        load_scene("clse", 16, 16)
    with pytest.raises(InputError, match=r"camera 'ear'.*only a mesh"):
        load_scene("front", 16, 16, camera="ear")
    with pytest.raises(InputError, match="height_cm: only a mesh takes it"):
        load_scene("front", 16, 16, height_cm=20.0)
    with pytest.raises(InputError, match="projection_x: only a captured"):
        load_scene("front", 16, 16, projection_x=2.0)


@pytest.mark.parametrize(
    "change",
    [
        {"projection_x": 0.0},
        {"projection_x": float("nan")},
        {"target": (0.0, -2.0, 140.0)},
        {"up": (0.0, -1.5, -140.0)},
        {"position": (float("inf"), 0.0, 0.0)},
    ],
)
def test_a_camera_that_cannot_see_is_refused(change):
    with pytest.raises(InputError, match="camera front"):
        dataclasses.replace(CAMERAS["front"], **change)


def test_circle_and_wall_are_scenes_by_name():
    moving = open_scene("circle", 160, 90)
    assert isinstance(moving, Circle)
    assert np.array_equal(moving(5).depth_cm, Circle(160, 90, speed_pixels=2.0)(5).depth_cm)
    assert np.array_equal(load_scene("circle", 160, 90).depth_cm, moving(0).depth_cm)
    for scene in (open_scene("wall", 64, 36), load_scene("wall", 64, 36)):
        assert np.array_equal(scene.depth_cm, wall(64, 36).depth_cm)
    # A disc of a quarter of the height would not fit.
    assert load_scene("circle", 8, 64).subsurface.all()
    for name in ("circle", "wall"):
        with pytest.raises(InputError, match=f"{name}: camera: only the head or a mesh"):
            load_scene(name, 64, 36, camera="ear")
        with pytest.raises(InputError, match="from 1 to 16384"):
            load_scene(name, 0, 36)
    with pytest.raises(InputError, match="did you mean 'circle'"):
        load_scene("circl", 64, 36)


def test_camera_axes_are_orthonormal_and_right_handed():
    for camera in CAMERAS.values():
        axes = np.stack(camera.basis())
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(-1), (
            "right, up, forward: forward is -z of the view"
        )


@pytest.mark.parametrize(
    "change",
    [
        {"towards": (0.0, 0.0, 0.0)},
        {"irradiance": (1.0, -0.1, 1.0)},
        {"radius": 0.0},
        {"irradiance": (float("nan"), 0.0, 0.0)},
    ],
)
def test_a_light_that_cannot_be_is_refused(change):
    with pytest.raises(InputError, match="light key"):
        dataclasses.replace(RIG.lights[0], **change)


@pytest.mark.opencl
@pytest.mark.parametrize("name", CAMERAS)
def test_each_view_has_its_stated_coverage_and_scale(views, name):
    camera = CAMERAS[name]
    assert views[name].coverage_rate == pytest.approx(camera.coverage_rate, abs=0.01)
    at_1080p = views[name].pixels_per_mm() * 1920 / STUDY[0]
    assert at_1080p == pytest.approx(camera.pixels_per_mm, rel=0.02)


@pytest.mark.opencl
def test_a_patch_of_skin_fills_the_close_view_whole(views):
    assert views["close"].subsurface.all()


@pytest.mark.opencl
def test_the_head_has_the_size_of_a_man(views):
    front, side = (positions(views[name], CAMERAS[name]) for name in ("front", "side"))
    skin = front[views["front"].subsurface]
    assert skin[:, 1].max() == pytest.approx(11.5, abs=0.4), "crown"
    above_ears = skin[np.abs(skin[:, 1] - 4) < 1]
    assert np.ptp(above_ears[:, 0]) == pytest.approx(15.4, abs=1.0), "breadth"
    profile = side[views["side"].subsurface]
    upper = profile[profile[:, 1] > 1.5]
    assert np.ptp(upper[:, 2]) == pytest.approx(19.7, abs=1.0), "length without the nose"
    # The chin is the lowest point of the front half of the face
    face = profile[(profile[:, 2] > 7) & (profile[:, 1] > -16)]
    assert face[:, 1].min() == pytest.approx(-11.3, abs=0.5), "chin"
    nose = profile[profile[:, 2].argmax()]
    assert -5 < nose[1] < -3 and 10.8 < nose[2] < 11.8, "the nose stands out farthest"


@pytest.mark.opencl
def test_eyes_are_no_skin_and_stand_six_centimetres_apart(views):
    front = views["front"]
    place = positions(front, CAMERAS["front"])
    eyes = (front.profile_id == 0) & (front.depth_cm > 0) & (place[..., 1] > -3)
    left, right = (place[eyes & (side * place[..., 0] > 0)] for side in (1, -1))
    assert len(left) > 5 and len(right) > 5
    assert left[:, 0].mean() - right[:, 0].mean() == pytest.approx(6.3, abs=0.3)
    assert abs(left[:, 1].mean()) < 0.4
    assert not front.irradiance[eyes].any() and not front.albedo[eyes].any()
    assert front.non_subsurface[eyes].max() > 0.05


@pytest.mark.opencl
@pytest.mark.parametrize("name", ["close", "ear", "front"])
def test_a_soft_shadow_edge_crosses_the_view(views, name):
    light = views[name].irradiance[views[name].subsurface].mean(axis=1)
    assert (light > 0.4).mean() > 0.15, "lit skin"
    assert (light < 0.15).mean() > 0.10, "skin in shadow"
    # Between the two lies a ramp, not a step
    assert ((light > 0.15) & (light < 0.4)).mean() > 0.05
    assert 0.8 < np.percentile(light, 99.5) < 1.15, "fully lit skin receives about 1"


def seen_by_the_key(gbuffer):
    """(h, w) share of the key light that each pixel sees; NaN where it stands too flat to tell."""
    key = RIG.lights[0]
    alone = load_scene(gbuffer.name, *STUDY, rig=Rig((key,), ambient=(0.0, 0.0, 0.0)))
    facing = gbuffer.normal @ key.direction().astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = alone.irradiance[..., 0] / key.irradiance[0] / facing
    return np.where((facing > 0.4) & gbuffer.subsurface, seen, np.nan)


@pytest.mark.opencl
def test_counts_wander_in_the_penumbra_and_rest_on_even_skin(views):
    # The paper's plot over 600 frames: 8 to about 55 samples in a shadow edge, 8 throughout where
    # the light is even. Its constants were tuned at the legacy scale. This fixes scene, light and
    # target variance against each other, whatever the times.
    gbuffer = views["front"]
    seen = seen_by_the_key(gbuffer)
    penumbra, even = (seen > 0.25) & (seen < 0.75), seen > 0.98
    assert penumbra.sum() > 100 and even.sum() > 1000
    pipeline = start_pipeline(gbuffer, Method(kind="adaptive", scale="legacy"), open_device())
    counts = []
    for frame in range(150):
        advance(pipeline, gbuffer, frame)
        if frame >= 32:
            counts.append(pipeline.read("scattered")[..., 3])
    largest, least = np.max(counts, axis=0), np.min(counts, axis=0)
    assert 30 <= np.median(largest[penumbra]) <= 64
    assert np.median(least[penumbra]) == 8
    assert np.median(largest[even]) == 8
    # And they have settled: the frames that the studies trace are like those that follow.
    means = [frame[gbuffer.subsurface].mean() for frame in counts]
    assert means[0] == pytest.approx(np.mean(means), rel=0.03)


@pytest.mark.opencl
def test_normals_agree_with_the_surface_that_depth_describes(views):
    gbuffer, camera = views["close"], CAMERAS["close"]
    place = positions(gbuffer, camera)
    across = place[1:-1, 2:] - place[1:-1, :-2]
    down = place[2:, 1:-1] - place[:-2, 1:-1]
    true = np.cross(down, across)
    true /= np.linalg.norm(true, axis=-1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(gbuffer.normal, axis=-1), 1, atol=1e-5)
    agreement = (true * gbuffer.normal[1:-1, 1:-1]).sum(axis=-1)
    # Fine relief bends normals by some degrees; at silhouettes differences mean nothing
    assert np.median(agreement) > np.cos(np.radians(10))
    assert np.percentile(agreement, 5) > np.cos(np.radians(35))


@pytest.mark.opencl
def test_light_adds_up(views):
    rendered = {
        lights: load_scene("ear", 96, 54, rig=Rig(lights, ambient=ambient)).irradiance
        for lights, ambient in [((light,), (0.0, 0.0, 0.0)) for light in RIG.lights]
        + [(RIG.lights, RIG.ambient), ((), RIG.ambient)]
    }
    whole = rendered.pop(RIG.lights)
    np.testing.assert_allclose(sum(rendered.values()), whole, atol=1e-5)
    assert rendered[()].max() <= max(RIG.ambient), "ambient light cannot exceed an open sky"


@pytest.mark.opencl
def test_a_larger_light_casts_a_softer_shadow():
    def partly_lit(radius):
        light = Light("key", RIG.lights[0].towards, (1.0, 1.0, 1.0), radius)
        rig = Rig((light,), ambient=(0.0, 0.0, 0.0))
        gbuffer = load_scene("close", 160, 90, rig=rig)
        towards = np.maximum(gbuffer.normal @ light.direction().astype(np.float32), 1e-3)
        seen = gbuffer.irradiance[..., 0] / towards
        return ((seen > 0.1) & (seen < 0.9) & (towards > 0.2)).mean()

    assert partly_lit(0.02) < 0.6 * partly_lit(0.1) < 0.6 * partly_lit(0.3)


def test_every_device_renders_the_same_bytes(device):
    first = head.open_device()
    for name in CAMERAS:
        here = head.render_head(CAMERAS[name], 97, 61, device)
        there = head.render_head(CAMERAS[name], 97, 61, first)
        assert digest(here) == digest(there), f"{device.name} against {first.name}: {name}"


@pytest.mark.opencl
def test_bands_of_rows_do_not_show(monkeypatch):
    whole = load_scene("ear", 120, 83)
    monkeypatch.setattr(head, "BAND_PIXELS", 120 * 16)
    shares = []
    assert digest(load_scene("ear", 120, 83, progress=shares.append)) == digest(whole)
    assert len(shares) == 6 and shares == sorted(shares) and shares[-1] == 1


@pytest.mark.opencl
@pytest.mark.parametrize("size", [(1, 1), (17, 9), (64, 64), (9, 200)])
def test_any_size_and_aspect_shows_the_same_patch(size):
    gbuffer = load_scene("close", *size)
    assert (gbuffer.width, gbuffer.height) == size
    middle = gbuffer.depth_cm[size[1] // 2, size[0] // 2]
    assert middle == pytest.approx(16.1, abs=0.8)


@pytest.mark.opencl
def test_a_camera_of_ones_own_sees_the_head_and_one_that_misses_it_is_refused():
    above = Camera("above", (0.0, 80.0, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0))
    gbuffer = load_scene("front", 64, 36, camera=above)
    assert gbuffer.name == "above"
    assert gbuffer.depth_cm[18, 32] == pytest.approx(80 - 11.5, abs=0.2)
    away = Camera("away", (0.0, 0.0, 100.0), (0.0, 0.0, 200.0))
    with pytest.raises(InputError, match=r"away.*empty"):
        load_scene("front", 16, 16, camera=away)


def test_tone_mapping_is_srgb_below_the_knee_and_never_clips_early():
    grey = np.full((1, 1, 3), 0.18, np.float32)
    assert (tone_map(grey) == 118).all(), "18 % grey in sRGB"
    ramp = np.linspace(0, 8, 400, dtype=np.float32).reshape(-1, 1, 1).repeat(3, axis=2)
    values = tone_map(ramp)[:, 0, 0].astype(int)
    assert values[0] == 0 and values[-1] < 255 and (np.diff(values) >= 0).all()


def test_a_picture_is_written_whole_or_not_at_all(tmp_path, views):
    from PIL import Image

    path = tmp_path / "ear.png"
    save_png(path, preview(views["ear"]))
    with Image.open(path) as image:
        assert np.array_equal(np.asarray(image), preview(views["ear"]))
    with pytest.raises(TypeError):
        save_png(path, np.zeros((2, 2, 7), np.uint8))
    assert [entry.name for entry in tmp_path.iterdir()] == ["ear.png"]
    with pytest.raises(InputError, match="cannot write"):
        save_png(tmp_path / "missing" / "ear.png", preview(views["ear"]))
