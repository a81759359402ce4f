"""Moving cameras, lights and surfaces: velocity against projections, paths against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from kernels.frame import render
from kernels.maths.profile import SKIN, cdf
from kernels.method import Method
from kernels.scenes.analytic import Circle, wall
from kernels.scenes.camera import CAMERAS, Camera
from kernels.scenes.head import render_head
from kernels.scenes.jitter import CUT, SIGMA, Jitter, radical_inverse
from kernels.scenes.light import RIG
from kernels.scenes.motion import MovingScene, Overlaid, Relit, veil
from kernels.scenes.paths import dolly, flash, orbit, pulse, rotate, still, swing, switched
from kernels.scenes.velocity import BEHIND, camera_velocity
from kernels.selfcheck import small_gbuffer
from traces.errors import InputError

WIDTH, HEIGHT = 96, 54


def project(camera, points, width=WIDTH, height=HEIGHT):
    """(x, y, depth) of world points by a view and a projection matrix, pixels and cm."""
    forward = np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right = right / np.linalg.norm(right)
    view = np.eye(4)
    view[:3, :3] = right, np.cross(right, forward), forward
    view[:3, 3] = -view[:3, :3] @ camera.position
    m = camera.projection_x
    projection = np.diag([m, m * width / height, 1.0, 0.0])
    projection[3, 2] = 1.0
    clip = np.append(points, np.ones((*points.shape[:-1], 1)), axis=-1) @ (projection @ view).T
    ndc = clip[..., :2] / clip[..., 3:]
    return (ndc[..., 0] + 1) * width / 2, (1 - ndc[..., 1]) * height / 2, clip[..., 3]


CAMERA = Camera("test", (3.0, 2.0, 50.0), (1.0, -2.0, 0.0))


@pytest.mark.parametrize(
    "before",
    [
        dataclasses.replace(CAMERA, position=(6.0, 1.0, 48.0)),
        dataclasses.replace(CAMERA, target=(2.0, -1.0, 0.0)),
        dataclasses.replace(CAMERA, position=(3.0, 2.0, 40.0), projection_x=3.0, up=(0.1, 1, 0)),
        dataclasses.replace(CAMERA, position=(6.0, 1.0, 48.0), jitter=(0.4, 0.1)),
    ],
)
@pytest.mark.parametrize("jitter", [(0.0, 0.0), (0.3, -0.45)])
def test_velocity_joins_the_places_of_one_point_in_both_pictures(before, jitter):
    """Points are put where pixels of the present picture see them, and then projected twice."""
    now = dataclasses.replace(CAMERA, jitter=jitter)
    depth = np.random.default_rng(1).uniform(20, 60, (HEIGHT, WIDTH)).astype(np.float32)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 + jitter[0], np.arange(HEIGHT) + 0.5 + jitter[1])
    right, up, forward = now.basis()
    pixel = 2 / (WIDTH * now.projection_x)
    ray = (
        forward
        + ((x - WIDTH / 2) * pixel)[..., None] * right
        + ((HEIGHT / 2 - y) * pixel)[..., None] * up
    )
    points = now.position + ray * depth[..., None]
    now_x, now_y, now_depth = project(now, points)
    assert np.allclose([now_x, now_y, now_depth], [x, y, depth], atol=1e-4)

    past_x, past_y, _ = project(before, points)
    velocity = camera_velocity(depth, now, before)
    assert velocity.dtype == np.float32
    assert np.allclose(velocity, np.stack([past_x - x, past_y - y], axis=-1), atol=1e-4)


def test_a_still_camera_has_no_velocity_whatever_its_jitter():
    jittered = dataclasses.replace(CAMERA, jitter=(0.2, 0.3), name="other")
    assert camera_velocity(np.ones((4, 4), np.float32), jittered, CAMERA) is None


def test_the_background_moves_with_the_rotation_alone():
    nothing = np.zeros((HEIGHT, WIDTH), np.float32)
    ahead = dataclasses.replace(CAMERA, position=(4.0, 3.0, 52.0), target=(2.0, -1.0, 2.0))
    moved = camera_velocity(nothing, CAMERA, ahead)
    assert np.allclose(moved, 0, atol=1e-9)
    turned = dataclasses.replace(CAMERA, target=(2.0, -2.0, 0.0))
    very_far = np.full((HEIGHT, WIDTH), 1e7, np.float32)
    expected = camera_velocity(very_far, CAMERA, turned)
    assert np.allclose(camera_velocity(nothing, CAMERA, turned), expected, atol=1e-3)


def test_what_lay_behind_the_previous_camera_comes_from_off_the_screen():
    before = dataclasses.replace(CAMERA, position=(1.0, -2.0, 1.0))
    near = np.full((HEIGHT, WIDTH), 5.0, np.float32)
    assert (camera_velocity(near, CAMERA, before) == BEHIND).all()


@pytest.mark.opencl
@pytest.mark.parametrize(
    "path", [orbit(CAMERAS["close"], 6.0), dolly(CAMERAS["close"], 0.6)], ids=["orbit", "dolly"]
)
def test_the_head_is_found_again_where_velocity_points(path):
    """Depth in the previous picture, at the place that velocity names, is the surface's depth."""
    scene = MovingScene(lambda camera, rig: render_head(camera, 160, 90, rig=rig), path)
    before, now = scene(1), scene(2)
    y, x = np.mgrid[0:90, 0:160]
    past_x, past_y = x + 0.5 + now.velocity[..., 0], y + 0.5 + now.velocity[..., 1]
    inside = (past_x > 1) & (past_x < 159) & (past_y > 1) & (past_y < 89) & now.subsurface
    at = past_y[inside].astype(int), past_x[inside].astype(int)
    right, up, forward = path(2).basis()
    pixel = 2 / (160 * now.projection_x)
    ray = (
        forward
        + ((x + 0.5 - 80) * pixel)[..., None] * right
        + ((45 - y - 0.5) * pixel)[..., None] * up
    )
    points = path(2).position + ray * now.depth_cm[..., None]
    _, _, depth = project(path(1), points, 160, 90)
    # A texel is half a millimetre wide, and the head steep where it turns away.
    error = np.abs(before.depth_cm[at] - depth[inside])
    unmoved = np.abs(before.depth_cm[inside] - depth[inside])
    assert np.abs(now.velocity[now.subsurface]).max() > 1
    assert np.median(error) < 0.03 and np.median(error) < 0.3 * np.median(unmoved)
    assert (error < 0.5).mean() > 0.95


@pytest.mark.opencl
def test_jitter_of_a_pixel_is_a_shift_by_a_pixel():
    shifted = dataclasses.replace(CAMERAS["ear"], jitter=(1.0, -2.0))
    plain, moved = (render_head(c, 64, 36) for c in (CAMERAS["ear"], shifted))
    assert moved.jitter == (1.0, -2.0)
    expected, found = plain.depth_cm[:-2, 1:], moved.depth_cm[2:, :-1]
    both = (expected > 0) & (found > 0)
    assert both.mean() > 0.5
    assert (np.abs(expected - found)[both] < 0.02).mean() > 0.97
    assert np.abs(expected - plain.depth_cm[2:, :-1])[both].mean() > 0.05


@pytest.mark.parametrize("jitter", [(2.5, 0.0), (0.0, float("nan"))])
def test_jitter_beyond_reason_is_refused(jitter):
    with pytest.raises(InputError, match="jitter"):
        dataclasses.replace(CAMERA, jitter=jitter)


# The sequence.


def test_radical_inverses_mirror_the_digits():
    assert radical_inverse(np.arange(1, 7), 2) == pytest.approx(
        [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8]
    )
    assert radical_inverse(np.arange(1, 5), 3) == pytest.approx([1 / 3, 2 / 3, 1 / 9, 4 / 9])


@pytest.mark.parametrize("num_points", [1, 8, 100])
@pytest.mark.parametrize("name", ["box", "gaussian"])
def test_jitter_repeats_and_keeps_the_picture_in_place(name, num_points):
    jitter = Jitter(name, num_points)
    points = np.array([jitter(frame) for frame in range(num_points)])
    assert points.mean(axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert jitter(3) == jitter(3 + num_points)
    assert len({tuple(p) for p in points}) == num_points


def test_the_box_fills_the_pixel_evenly():
    points = Jitter("box", 576).points
    assert np.abs(points).max() < 0.51
    assert points.var(axis=0) == pytest.approx([1 / 12, 1 / 12], rel=0.01)
    counts, _, _ = np.histogram2d(*points.T, bins=4, range=[(-0.5, 0.5), (-0.5, 0.5)])
    assert np.abs(counts - 36).max() <= 4


def test_the_gaussian_is_the_cut_normal_distribution():
    points = Jitter("gaussian", 1000).points
    radius = np.sort(np.hypot(*points.T))
    assert radius[-1] <= CUT + 0.01
    cut = 1 - math.exp(-0.5 * (CUT / SIGMA) ** 2)
    cdf = (1 - np.exp(-0.5 * (radius / SIGMA) ** 2)) / cut
    assert np.abs(cdf - (np.arange(1000) + 0.5) / 1000).max() < 0.01
    assert points.var(axis=0) == pytest.approx([SIGMA**2] * 2, rel=0.04)


@pytest.mark.parametrize("change", [{"filter": "boks"}, {"num_points": 0}, {"num_points": 2000}])
def test_a_jitter_that_cannot_be_is_refused(change):
    with pytest.raises(InputError, match="jitter"):
        Jitter(**change)


# Paths.


def test_an_orbit_circles_the_target_at_its_distance():
    front = CAMERAS["front"]
    path = orbit(front, 3.0)
    assert path(0).position == front.position
    arms = np.array([np.subtract(path(f).position, front.target) for f in (0, 30, 60, 120)])
    assert np.linalg.norm(arms, axis=1) == pytest.approx(np.linalg.norm(arms[0]), rel=1e-6)
    distance, height = 140.0, 1.5
    expected = [(0, distance), (distance, 0), (0, -distance), (0, distance)]
    assert arms[:, [0, 2]] == pytest.approx(np.array(expected), abs=1e-4)
    assert arms[:, 1] == pytest.approx([height] * 4)


@pytest.mark.parametrize("degrees", [0, 37.5, 90, -720.25])
def test_rotation_is_rodrigues(degrees):
    axis = np.array([1.0, 2.0, -2.0]) / 3
    vector = np.array([0.3, -4.0, 1.5])
    cross = np.cross(np.eye(3), axis)  # cross @ v = axis x v
    angle = math.radians(degrees)
    matrix = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    assert rotate(vector, axis, degrees) == pytest.approx(matrix @ vector, abs=2e-6)


def test_a_dolly_moves_straight_and_stops_before_its_target():
    path = dolly(CAMERAS["front"], 2.0)
    start, later = CAMERAS["front"], path(10)
    gone = np.subtract(later.position, start.position)
    assert np.linalg.norm(gone) == pytest.approx(20)
    assert np.cross(gone, np.subtract(start.target, start.position)) == pytest.approx(0, abs=1e-9)
    assert later.basis()[2] == pytest.approx(start.basis()[2])
    with pytest.raises(InputError, match="frame 71: the target"):
        path(71)
    assert dolly(start, -5.0)(100).position[2] > 600


def test_a_swinging_light_turns_and_the_others_rest():
    later = swing(RIG, "key", 10.0)(9)
    key, old = later.lights[0].towards, RIG.lights[0].towards
    assert key == pytest.approx((old[2], old[1], -old[0]), abs=1e-6)
    assert later.lights[1:] == RIG.lights[1:]


def test_a_switched_light_alone_goes_off():
    path = switched(RIG, "key", flash(3, 5))
    assert path(2) == RIG == path(5)
    assert path(3).lights[0].irradiance == (0, 0, 0)
    assert path(3).lights[1:] == RIG.lights[1:] and path(3).ambient == RIG.ambient


def test_the_pulse_is_that_of_the_supplementary():
    expected = [max(0.0, 1 + 3 * math.sin(t / 10)) for t in range(200)]
    assert [pulse(t) for t in range(200)] == pytest.approx(expected, abs=1e-5)
    assert 0.0 in expected


@pytest.mark.parametrize(
    "make",
    [
        lambda: orbit(CAMERA, math.nan),
        lambda: dolly(CAMERA, math.inf),
        lambda: swing(RIG, "kay", 1.0),
        lambda: switched(RIG, "moon", pulse),
        lambda: flash(5, 5),
        lambda: veil(opacity=1.2),
        lambda: veil(radius_rate=0.0),
        lambda: Relit(small_gbuffer(), lambda frame: -1.0)(0),
        lambda: Relit(small_gbuffer(), pulse, small_gbuffer(20, 20)),
        lambda: wall(64, 36, near_pixels_per_mm=0.1, far_pixels_per_mm=0.2),
        lambda: Circle(64, 36, radius_rate=0.6),
        lambda: Circle(64, 36, disc_cm=39.0),
        lambda: Circle(64, 36, speed_pixels=64.0),
    ],
)
def test_what_cannot_be_is_an_input_error(make):
    with pytest.raises(InputError):
        make()


# Scenes.


class Renders:
    """A stand-in for a renderer that counts its work."""

    def __init__(self):
        self.views = []

    def __call__(self, camera, rig):
        self.views.append((camera, rig))
        return dataclasses.replace(small_gbuffer(), jitter=camera.jitter)


def test_a_still_view_is_rendered_once_and_handed_out_again():
    renders = Renders()
    scene = MovingScene(renders, still(CAMERA))
    assert scene(0) is scene(5) is scene(6)
    assert scene(5).velocity is None
    flashing = MovingScene(renders, still(CAMERA), switched(RIG, "key", flash(2, 4)))
    views = [flashing(frame) for frame in range(6)]
    assert views[0] is views[1] is views[4] and views[2] is views[3] is not views[0]
    assert len(renders.views) == 3


def test_jitter_renders_one_view_per_point_of_its_period():
    renders = Renders()
    jitter = Jitter("gaussian", 4)
    scene = MovingScene(renders, still(CAMERA), jitter=jitter, num_kept=4)
    assert [scene(frame).jitter for frame in range(12)] == [jitter(f) for f in range(12)]
    assert len(renders.views) == 4
    assert scene(1).velocity is None


def test_a_camera_that_stops_has_velocity_no_more():
    def path(frame):
        return dataclasses.replace(CAMERA, position=(3.0, 2.0, 50.0 - min(frame, 2)))

    scene = MovingScene(Renders(), path)
    assert [scene(f).velocity is None for f in range(5)] == [True, False, False, True, True]


def test_relit_is_linear_between_its_two_views():
    lit = small_gbuffer()
    scene = Relit(lit, lambda frame: frame / 2)
    assert scene(2) is lit
    dark, half, bright = scene(0), scene(1), scene(3)
    skin = lit.subsurface
    assert not dark.irradiance.any() and not dark.non_subsurface[skin].any()
    assert np.array_equal(dark.non_subsurface[~skin], lit.non_subsurface[~skin])
    assert np.allclose(half.irradiance, 0.5 * lit.irradiance)
    assert np.allclose(bright.irradiance, 1.5 * lit.irradiance)
    assert np.array_equal(bright.non_subsurface[~skin], lit.non_subsurface[~skin])


@pytest.mark.opencl
def test_relit_is_what_rendering_with_a_dimmed_light_gives():
    def view(factor):
        rig = switched(RIG, "key", lambda frame: factor)(0)
        return render_head(CAMERAS["front"], 64, 36, rig=rig)

    scene = Relit(view(1.0), lambda frame: 0.3, view(0.0))
    for name in ("irradiance", "non_subsurface"):
        assert np.allclose(getattr(scene(0), name), getattr(view(0.3), name), atol=2e-6)


def test_the_light_that_is_off_leaves_no_light(device):
    scene = Relit(small_gbuffer(), flash(1, 2))
    skin = scene(0).subsurface
    frames = [render(scene, Method(num_samples=8), count, device) for count in (1, 2, 3)]
    assert not frames[1].combined[skin].any()
    assert frames[0].combined[skin].any() and frames[2].combined[skin].any()


def test_a_veil_crosses_the_picture_and_comes_again():
    draw = veil(speed_pixels=4.0, radius_rate=0.25, opacity=0.6)
    opacity = [draw(frame, 40, 80)[..., 3] for frame in (0, 10, 25, 26)]
    columns = [np.flatnonzero(o.any(axis=0)) for o in opacity]
    assert columns[0].max() < 11 and columns[1][[0, -1]] == pytest.approx([31, 49], abs=2)
    assert columns[3].max() < 15 < 65 < columns[2][columns[2] > 40].size + 66
    assert max(o.max() for o in opacity) == pytest.approx(0.6, abs=0.01)
    still_view = small_gbuffer()
    scene = Overlaid(still_view, draw)
    assert scene(3) is scene(3)
    assert np.array_equal(scene(3).overlay, draw(3, 27, 44))
    assert scene(3).irradiance is still_view.irradiance


def test_the_disc_lies_where_velocity_says_it_lay():
    scene = Circle(120, 60, speed_pixels=3.5)
    for frame in (1, 9, 40):
        now = scene(frame)
        disc = now.depth_cm == scene.disc_cm
        assert not now.velocity[~disc].any()
        y, x = np.nonzero(disc)
        past = x + 0.5 + now.velocity[y, x, 0]
        centre = scene.centre(frame - 1)
        assert (np.hypot(past - centre[0], y + 0.5 - centre[1]) < 0.25 * 60 + 1e-3).all()
        assert disc.sum() == pytest.approx(math.pi * 15**2, rel=0.02)
    room = 120 - 30
    assert scene.centre(0)[0] == 15 and scene.centre(10)[0] == 50
    assert scene.centre(30)[0] == pytest.approx(15 + 2 * room - 105)
    assert Circle(120, 60, speed_pixels=0)(7).velocity is None


def test_what_the_disc_lays_open_starts_anew(device):
    scene = Circle(96, 48, speed_pixels=4.0)
    frame = render(scene, Method(kind="adaptive"), 10, device)
    discs = [scene(f).depth_cm == scene.disc_cm for f in (7, 8, 9)]
    laid_open = discs[1] & ~discs[2]
    undisturbed = ~(discs[0] | discs[1] | discs[2])
    assert laid_open.any()
    assert (frame.counts[laid_open] == 64).all()
    assert frame.counts[undisturbed].mean() < 32
    # The disc takes its history along.
    inner = discs[2] & np.roll(discs[2], 4, axis=1)
    assert frame.counts[inner].mean() < 40


def test_the_wall_is_a_plane_of_the_stated_scales():
    view = wall(192, 108)
    scale = 0.05 * 192 * view.projection_x / view.depth_cm.astype(np.float64)
    expected = 0.2 + (0.002 - 0.2) * (np.arange(192) + 0.5) / 192
    assert scale[0] == pytest.approx(expected, rel=1e-5)
    assert np.ptp(scale, axis=0) == pytest.approx(0, abs=1e-7)
    # Its normal is that of the points' plane.
    pixel = 2 / (192 * view.projection_x)
    x = (np.arange(192) + 0.5 - 96) * pixel * view.depth_cm[0]
    tangent = np.array([x[150] - x[20], 0.0, -(view.depth_cm[0, 150] - view.depth_cm[0, 20])])
    tangent = tangent / np.linalg.norm(tangent)
    normal = view.normal[50, 50].astype(np.float64)
    assert normal @ tangent == pytest.approx(0, abs=1e-6)
    assert np.linalg.norm(normal) == pytest.approx(1) and normal[2] > 0


def test_the_border_of_distant_scattering_crosses_the_wall():
    """Where a pixel's width holds 95 % of the scattering."""
    view = wall(192, 108)
    mm_per_pixel = view.depth_cm[0] / (0.05 * 192 * view.projection_x)
    distant = 1 - cdf(mm_per_pixel.astype(np.float64), SKIN.d_sampled_mm)
    border = int(np.argmax(distant <= 0.05))
    assert 192 * 0.5 < border < 192 * 0.8
    assert (np.diff(distant[: border + 1]) < 0).all()
