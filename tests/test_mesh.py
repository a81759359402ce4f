"""Meshes: are depth, normals, shadows and maps those that geometry gives?"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from kernels.scene import load_scene
from kernels.scenes import mesh_render
from kernels.scenes.camera import Camera
from kernels.scenes.light import Light, Rig
from kernels.scenes.mesh import load_mesh
from kernels.scenes.mesh_render import render_mesh
from traces.errors import InputError

DARK = (0.0, 0.0, 0.0)
SIDEWAYS = Light("key", (0.6, 0.3, 0.74), (1.0, 0.5, 0.25), 0.05)
HEAD = Path(__file__).resolve().parents[2] / "shared" / "assets" / "head"
scan = pytest.mark.skipif(
    not (HEAD / "LeePerrySmith.glb").is_file(),
    reason="the head scan is not at ../shared/assets/head",
)


@pytest.fixture
def ball(tmp_path):
    """A sphere of radius 10 cm in units of its own, as binary glTF."""
    path = tmp_path / "ball.glb"
    trimesh.creation.icosphere(subdivisions=5, radius=0.37).export(path)
    return path


def quad(path, texture=None, normal_map=None):
    """A square facing +z whose u runs to +x and v to +y, from -1 to 1, as OBJ."""
    path.write_text(
        "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    return path


def facing(distance=40.0, projection_x=3.0):
    return Camera("facing", (0.0, 0.0, distance), DARK, projection_x=projection_x)


def rays(gbuffer, camera):
    right, up, forward = camera.basis()
    half = 1 / camera.projection_x
    x = ((np.arange(gbuffer.width) + 0.5) / gbuffer.width * 2 - 1) * half
    y = (1 - (np.arange(gbuffer.height) + 0.5) / gbuffer.height * 2) * half
    y = y * gbuffer.height / gbuffer.width
    return forward + x[None, :, None] * right + y[:, None, None] * up


def test_a_sphere_has_the_depth_normals_and_light_of_a_sphere(ball):
    camera = Camera("above", (12.0, 30.0, 40.0), DARK, projection_x=4.0)
    rig = Rig((SIDEWAYS,), ambient=DARK)
    gbuffer = render_mesh(ball, 160, 90, camera=camera, rig=rig, height_cm=20.0)
    origin, direction = np.array(camera.position), rays(gbuffer, camera)
    a, b = (direction**2).sum(-1), direction @ origin
    discriminant = b * b - a * (origin @ origin - 100)
    depth = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
    seen = discriminant > 0
    assert gbuffer.coverage_rate == pytest.approx(seen.mean(), rel=0.01)
    inside = discriminant > 20  # away from the silhouette, where facets stand out
    np.testing.assert_allclose(gbuffer.depth_cm[inside], depth[inside], atol=0.02)
    normal = (origin + direction * depth[..., None]) / 10
    np.testing.assert_allclose(gbuffer.normal[inside], normal[inside], atol=5e-3)
    # Convex, so nothing hides the light: Lambert's law
    cosine = normal @ SIDEWAYS.direction()
    lit = inside & (cosine > 0.1)
    expected = cosine[lit, None] * np.array(SIDEWAYS.irradiance)
    np.testing.assert_allclose(gbuffer.irradiance[lit], expected, atol=6e-3)
    assert not gbuffer.irradiance[inside & (cosine < -0.05)].any()


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_a_cube_keeps_its_edges_in_every_format(tmp_path, suffix):
    path = tmp_path / f"cube{suffix}"
    trimesh.creation.box((1.0, 1.0, 1.0)).export(path)
    camera = Camera("corner", (20.0, 17.0, 30.0), DARK)
    gbuffer = load_scene(str(path), 96, 54, camera=camera, height_cm=10.0)
    assert gbuffer.name == "cube:corner"
    normals = gbuffer.normal[gbuffer.subsurface]
    assert (np.sort(np.abs(normals), axis=1).round(3) == [0, 0, 1]).all()
    assert {tuple(n) for n in normals.round(0)} == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}
    position = np.array(camera.position) + rays(gbuffer, camera) * gbuffer.depth_cm[..., None]
    on_face = np.abs(position[gbuffer.subsurface]).max(axis=1)
    np.testing.assert_allclose(on_face, 5, atol=1e-4)


def test_the_penumbra_of_a_straight_edge_is_a_segment_of_the_disc(tmp_path):
    """Below a half-plane at height h, a disc light overhead of tangent r is hidden in a segment."""
    path = tmp_path / "edge.obj"
    path.write_text(
        "v -10 0 -10\nv 10 0 -10\nv 10 0 10\nv -10 0 10\n"
        "v -10 5 -10\nv 0 5 -10\nv 0 5 10\nv -10 5 10\n"
        "f 1 3 2\nf 1 4 3\nf 5 7 6\nf 5 8 7\n"
    )
    light = Light("lamp", (0.0, 1.0, 0.0), (1.0, 1.0, 1.0), 0.2)
    camera = Camera("below", (9.0, 1.9, 30.0), (0.0, -2.5, 0.0))
    gbuffer = render_mesh(
        path, 240, 135, camera=camera, rig=Rig((light,), ambient=DARK), height_cm=5.0
    )
    place = np.array(camera.position) + rays(gbuffer, camera) * gbuffer.depth_cm[..., None]
    # The box is centred: the floor lies at y = -2.5; its far ends may see past the plate
    floor = (gbuffer.depth_cm > 0) & (place[..., 1] < -2.4) & (np.abs(place[..., 2]) < 8)
    floor &= np.abs(place[..., 0]) < 4
    s = np.clip(place[floor][:, 0] / (5 * light.radius), -1, 1)
    share = 1 - (np.arccos(s) - s * np.sqrt(1 - s * s)) / np.pi
    received = gbuffer.irradiance[floor][:, 0]
    assert ((share > 0.1) & (share < 0.9)).sum() > 100
    # 32 rays: steps of 1/32; and the surface is lifted by a tenth of a millimetre
    np.testing.assert_allclose(received, share, atol=2.5 / 32)
    assert np.abs(received - share).mean() < 0.01


def test_open_sky_is_full_on_a_ball_and_none_inside_one(ball):
    rig = Rig((), ambient=(1.0, 1.0, 1.0))
    gbuffer = render_mesh(ball, 64, 36, camera=facing(), rig=rig, height_cm=20.0)
    up = gbuffer.normal[..., 1:2]
    expected = np.where(gbuffer.subsurface[..., None], 0.75 + 0.25 * up, 0)
    np.testing.assert_allclose(
        gbuffer.irradiance, np.broadcast_to(expected, (36, 64, 3)), atol=0.02
    )
    mesh = load_mesh(ball)
    inside = dataclasses.replace(mesh, normals=-mesh.normals)
    caster = mesh_render._Caster(inside)
    assert not mesh_render._corner_occlusion(inside, caster).any()


def test_maps_lie_the_right_way_round_and_are_linear(tmp_path):
    path = quad(tmp_path / "quad.obj")
    # Seen as a picture: red left above, green right above, blue left below, grey right below
    image = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [128, 128, 128]]], np.uint8)
    colours = tmp_path / "colours.png"
    Image.fromarray(image.repeat(32, axis=0).repeat(32, axis=1)).save(colours)
    gbuffer = load_scene(
        path, 64, 64, camera=facing(40, 3.0), albedo_map=colours, height_cm=20.0, flip_v=False
    )
    corners = {(20, 20): (1, 0, 0), (20, 44): (0, 1, 0), (44, 20): (0, 0, 1)}
    for (y, x), colour in corners.items():
        np.testing.assert_allclose(gbuffer.albedo[y, x], colour, atol=1e-3)
    # sRGB 128 is 21.6 % of full
    np.testing.assert_allclose(gbuffer.albedo[44, 44], 0.2158, atol=1e-3)
    flipped = load_scene(
        path, 64, 64, camera=facing(40, 3.0), albedo_map=colours, height_cm=20.0, flip_v=True
    )
    np.testing.assert_allclose(flipped.albedo[44, 20], (1, 0, 0), atol=1e-3)


@pytest.mark.parametrize("flip_v", [False, True])
def test_a_normal_map_tilts_towards_growing_u_and_the_pictures_top(tmp_path, flip_v):
    path = quad(tmp_path / "quad.obj")
    flat, tilted = tmp_path / "flat.png", tmp_path / "tilted.png"
    Image.new("RGB", (8, 8), (128, 128, 255)).save(flat)
    Image.new("RGB", (8, 8), (178, 204, 230)).save(tilted)
    options = {"camera": facing(), "height_cm": 20.0, "flip_v": flip_v}
    plain = load_scene(path, 32, 32, normal_map=flat, **options)
    np.testing.assert_allclose(plain.normal[16, 16], (0, 0, 1), atol=6e-3)
    bent = load_scene(path, 32, 32, normal_map=tilted, **options)
    expected = np.array([178, 204, 230]) / 127.5 - 1
    expected[1] *= -1 if flip_v else 1
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(bent.normal[16, 16], expected, atol=6e-3)


def test_maps_from_outside_are_turned_where_they_would_stand_on_their_head(tmp_path):
    image = tmp_path / "map.png"
    Image.new("RGB", (4, 4), (200, 150, 120)).save(image)
    upright = quad(tmp_path / "quad.obj")
    assert load_mesh(upright, albedo_map=image).uv[0, 0, 1] == 0, "v grows with height: as it is"
    turned = tmp_path / "turned.obj"
    text = upright.read_text()
    turned.write_text(
        text.replace("vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1", "vt 0 1\nvt 1 1\nvt 1 0\nvt 0 0")
    )
    assert load_mesh(turned).uv[0, 0, 1] == 1, "without a map from outside the file is right"
    assert load_mesh(turned, albedo_map=image).uv[0, 0, 1] == 0
    assert load_mesh(turned, normal_map=image).uv[0, 0, 1] == 0
    sideways = tmp_path / "sideways.obj"
    sideways.write_text(
        text.replace("vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1", "vt 1 0\nvt 1 1\nvt 0 1\nvt 0 0")
    )
    assert load_mesh(sideways, albedo_map=image).uv[0, 0, 1] == 0, "no way up, so no turn"


def test_axes_and_scale_are_ones_own_choice(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.creation.box((2.0, 3.0, 8.0)).export(path)
    upright = load_mesh(path, up="+z", forward="-y", height_cm=16.0)
    size = np.ptp(upright.corners.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(size, (4, 16, 6), rtol=1e-6)
    true = np.cross(
        upright.corners[:, 1] - upright.corners[:, 0], upright.corners[:, 2] - upright.corners[:, 0]
    )
    outward = (true * upright.corners.mean(axis=1)).sum(axis=1)
    assert (outward > 0).all(), "a rotation, not a mirror image"


def test_bands_of_rows_do_not_show(ball, monkeypatch):
    whole = render_mesh(ball, 60, 37, camera="front")
    monkeypatch.setattr(mesh_render, "BAND_PIXELS", 60 * 5)
    shares = []
    banded = render_mesh(ball, 60, 37, camera="front", progress=shares.append)
    assert np.array_equal(whole.depth_cm, banded.depth_cm)
    assert np.array_equal(whole.irradiance, banded.irradiance)
    assert len(shares) == 8 and shares[-1] == 1


def test_bad_meshes_are_refused_in_one_line(tmp_path, ball):
    def refused(words, path, **options):
        with pytest.raises(InputError) as caught:
            load_mesh(path, **options)
        assert words in str(caught.value) and "\n" not in str(caught.value)
        assert path.name in str(caught.value)

    refused("no such file", tmp_path / "none.glb")
    refused("unknown mesh format '.fbx'", tmp_path / "none.fbx")
    refused("unknown up axis 'y'; did you mean", ball, up="y")
    refused("must be different axes", ball, up="+z")
    refused("height_cm 0.0: must be positive", ball, height_cm=0.0)
    refused("has no uv coordinates", ball, albedo_map=tmp_path / "none.png")
    whole = ball.read_bytes()
    for keep in (0, 15, 400, len(whole) // 2):
        cut = tmp_path / "cut.glb"
        cut.write_bytes(whole[:keep])
        refused("cut.glb", cut)
    broken = tmp_path / "broken.obj"
    broken.write_text("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n")
    refused("NaN or infinite", broken)
    broken.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused("broken.obj", broken)
    broken.write_text("v 0 0 0\nv 1 1 0\nv 2 2 0\nf 1 2 3\n")
    refused("degenerate", broken)
    broken.write_text("v 0 0 0\nv 1 0 0\nv 1 0 1\nf 1 2 3\n")
    refused("no height", broken)
    flat = quad(tmp_path / "flat.obj")
    with pytest.raises(InputError, match=r"none.png: albedo map: no such file"):
        load_mesh(flat, albedo_map=tmp_path / "none.png")
    text = tmp_path / "text.png"
    text.write_text("no picture")
    with pytest.raises(InputError, match=r"text.png: normal map: not a readable image"):
        load_mesh(flat, normal_map=text)


def test_a_camera_that_misses_the_mesh_and_an_unknown_one_are_refused(ball):
    away = Camera("away", (0.0, 0.0, 90.0), (0.0, 0.0, 180.0))
    with pytest.raises(InputError, match="away: the mesh is not in view"):
        render_mesh(ball, 16, 16, camera=away)
    with pytest.raises(InputError, match="unknown camera 'fron'; did you mean 'front'"):
        load_scene(ball, 16, 16, camera="fron")
    with pytest.raises(InputError, match="from 1 to 16384"):
        load_scene(ball, 0, 16)


def test_a_licence_beside_the_mesh_is_its_attribution(ball):
    assert load_mesh(ball).attribution == ""
    beside = ball.with_name("ball_License.txt")
    beside.write_text("Licence\n\nBall by A. Nyone is licensed under CC BY.\nDo what you like.\n")
    assert load_mesh(ball).attribution == "Ball by A. Nyone is licensed under CC BY."
    beside.write_text("\nPublic domain\n")
    assert load_scene(ball, 8, 8).attribution == "Public domain"


@pytest.fixture(scope="module")
def head():
    return load_mesh(
        HEAD / "LeePerrySmith.glb",
        albedo_map=HEAD / "Map-COL.jpg",
        normal_map=HEAD / "Infinite-Level_02_Tangent_SmoothUV.jpg",
    )


@scan
def test_the_scanned_head_is_found_measured_and_attributed(head):
    assert "Infinite, 3D Head Scan by Lee Perry-Smith" in head.attribution
    assert "Creative Commons Attribution 3.0" in head.attribution
    assert head.head_height == pytest.approx(23)
    # A bust: shoulders about 40 cm wide below a head of 23 cm
    size = np.ptp(head.corners.reshape(-1, 3), axis=0)
    assert 35 < size[0] < 45 and 33 < size[1] < 42
    # The file's v points up, against glTF's rule
    unflipped = load_mesh(HEAD / "LeePerrySmith.glb")
    np.testing.assert_allclose(head.uv[..., 1], 1 - unflipped.uv[..., 1], atol=1e-6)


@scan
@pytest.mark.parametrize(
    ("view", "coverage", "scale"),
    [("close", 1.0, 22.4), ("ear", 0.93, 17.4), ("front", 0.22, 2.6), ("side", 0.28, 3.6)],
)
def test_the_scanned_head_fills_the_four_views_with_skin(head, view, coverage, scale):
    gbuffer = render_mesh(head, 192, 108, camera=view)
    assert gbuffer.coverage_rate == pytest.approx(coverage, abs=0.02)
    assert gbuffer.pixels_per_mm() * 10 == pytest.approx(scale, rel=0.03)
    red, green, blue = np.median(gbuffer.albedo[gbuffer.subsurface], axis=0)
    assert red > green > blue > 0.05, "the colour of skin"
    light = gbuffer.irradiance[gbuffer.subsurface].mean(axis=1)
    assert (light > 0.4).mean() > 0.1 and (light < 0.15).mean() > 0.08, "lit, and in shadow"


@scan
def test_the_normal_map_adds_detail_to_the_scan_without_turning_it(head):
    smooth = render_mesh(dataclasses.replace(head, normal_map=None), 96, 54, camera="close")
    bent = render_mesh(head, 96, 54, camera="close")
    cosine = (smooth.normal * bent.normal).sum(axis=-1)[bent.subsurface]
    assert 0.95 < cosine.mean() < 0.9999
