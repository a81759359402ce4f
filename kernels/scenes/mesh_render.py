"""Rendering a mesh into a G-buffer: ray casting with Embree, band by band of rows.

Not bit-identical over processors: Embree chooses its instructions at run time. Save the G-buffer to
hand on the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.gbuffer import GBuffer
from kernels.scenes.camera import Camera, Vector, camera_named, check_size
from kernels.scenes.light import RIG, Light, Rig
from kernels.scenes.mesh import HEAD_CM, Mesh, load_mesh
from traces.errors import InputError

Float = npt.NDArray[np.float32]
Rays = tuple[Float, Float]

# Pixels in flight at once: a few hundred bytes each.
BAND_PIXELS = 1 << 17
SHADOW_RAYS = 32
OCCLUSION_RAYS = 64
# Centre of the procedural head's bounding box, cm.
HEAD_CENTRE = (0.0, 0.0, 0.45)
# Shadow rays start this far off the surface, in shares of the head's height: 0.23 mm.
LIFT = 1e-3
ROUGHNESS = np.float32(0.26)
REFLECTANCE = np.float32(0.028)


def mesh_camera(name: str, mesh: Mesh) -> Camera:
    """One of the procedural head's views, moved and scaled to the mesh's head.

    Raises InputError for another name.
    """
    view = camera_named(name)
    scale = mesh.head_height / HEAD_CM

    def moved(point: Vector) -> Vector:
        x, y, z = mesh.head_centre + scale * (np.array(point) - HEAD_CENTRE)
        return float(x), float(y), float(z)

    return Camera(name, moved(view.position), moved(view.target), projection_x=view.projection_x)


def render_mesh(
    path: str | Path | Mesh,
    width: int,
    height: int,
    *,
    camera: str | Camera = "front",
    rig: Rig = RIG,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> GBuffer:
    """Render a mesh; every pixel of it is skin (profile 1).

    path: a file for load_mesh, or its result. width, height: pixels. camera: close, ear, front,
    side (placed from the bounding box) or a Camera in cm. rig: the lights. progress: called with
    the share done after each band.
    options: for load_mesh.
    Returns a GBuffer of (height, width). Raises InputError for what load_mesh refuses, for sizes
    that are not 1 to 16384 pixels, and where the camera does not see the mesh.
    """
    check_size(width, height)
    mesh = path if isinstance(path, Mesh) else load_mesh(path, **options)
    camera = mesh_camera(camera, mesh) if isinstance(camera, str) else camera
    caster = _Caster(mesh)
    occlusion = _corner_occlusion(mesh, caster)
    planes = {
        name: np.zeros((height, width, 3), np.float32)
        for name in ("irradiance", "albedo", "non_subsurface", "normal")
    }
    planes["non_subsurface"][:] = rig.background
    depth = np.zeros((height, width), np.float32)
    band_rows = max(1, BAND_PIXELS // width)
    for first_row in range(0, height, band_rows):
        rows = slice(first_row, min(first_row + band_rows, height))
        origins, directions = _primary_rays(camera, width, height, rows)
        hit = caster.first_hit(origins, directions)
        found = hit["primID"] >= 0
        if found.any():
            shaded = _shade(
                mesh, caster, occlusion, rig, camera, width, directions[found], hit, found
            )
            flat = found.reshape(-1, width)
            for name, plane in planes.items():
                plane[rows][flat] = shaded[name]
            depth[rows][flat] = shaded["depth_cm"]
        if progress is not None:
            progress(rows.stop / height)
    if not depth.any():
        raise InputError(f"{mesh.name}: camera {camera.name}: the mesh is not in view")
    return GBuffer(
        name=f"{mesh.name}:{camera.name}",
        depth_cm=depth,
        profile_id=(depth > 0).astype(np.uint8),
        projection_x=camera.projection_x,
        attribution=mesh.attribution,
        jitter=camera.jitter,
        **planes,
    )


class _Caster:
    """Embree's scene of one mesh."""

    def __init__(self, mesh: Mesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene(robust=True)
        self._triangles = TriangleMesh(self._scene, np.ascontiguousarray(mesh.corners))

    def first_hit(self, origins: Float, directions: Float) -> dict[str, Any]:
        """Of (n, 3) rays: primID (-1 where nothing is), u, v, tfar."""
        hit: dict[str, Any] = self._scene.run(origins, directions, query="INTERSECT", output=True)
        return hit

    def blocked(self, origins: Float, directions: Float) -> npt.NDArray[np.bool_]:
        """(n,) whether anything lies on each ray."""
        hit: npt.NDArray[np.bool_] = self._scene.run(origins, directions, query="OCCLUDED") != -1
        return hit


def _primary_rays(camera: Camera, width: int, height: int, rows: slice) -> Rays:
    """Origins and directions, row by row. A direction is 1 long along the view axis, so that the
    ray parameter is the linear depth.
    """
    right, up, _ = camera.basis()
    forward = camera.centre_ray(width)
    pixel = 2.0 / (width * camera.projection_x)
    x = (np.arange(width) + 0.5 - width / 2) * pixel
    y = (height / 2 - np.arange(rows.start, rows.stop) - 0.5) * pixel
    directions = forward + x[None, :, None] * right + y[:, None, None] * up
    rays: Float = directions.reshape(-1, 3).astype(np.float32)
    return _repeat(_vector(camera.position), len(rays)), rays


def _shade(
    mesh: Mesh,
    caster: _Caster,
    occlusion: Float,
    rig: Rig,
    camera: Camera,
    width: int,
    directions: Float,
    hit: dict[str, Any],
    found: npt.NDArray[np.bool_],
) -> dict[str, Float]:
    """The G-buffer's planes at the pixels found, (n, 3) or (n,)."""
    face = hit["primID"][found]
    u, v, depth = (hit[name][found].astype(np.float32) for name in ("u", "v", "tfar"))
    weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
    position = _vector(camera.position) + directions * depth[:, None]
    smooth = _unit((mesh.normals[face] * weights).sum(axis=1))
    view = -_unit(directions)
    # A mesh may be wound either way: turn normals to the viewer's side
    true = np.cross(*np.moveaxis(mesh.corners[face][:, 1:] - mesh.corners[face][:, :1], 1, 0))
    away = (_dot(true, view) < 0) != (_dot(smooth, true) < 0)
    smooth = np.where(away[:, None], -smooth, smooth)
    uv = (mesh.uv[face] * weights).sum(axis=1)
    texels = mesh.texels_per_cm[face] * depth * np.float32(2 / (width * camera.projection_x))
    normal = _mapped_normal(mesh, face, weights, uv, texels, smooth)
    if mesh.albedo_map is not None:
        albedo = mesh.albedo_map.sample(uv, texels * mesh.albedo_map.width)
    else:
        albedo = _repeat(_vector(mesh.albedo), len(position))

    # Diffuse irradiance apart from the mirrored part
    open_sky = (occlusion[face][:, :, None] * weights).sum(axis=1)
    lifted = (position + smooth * np.float32(LIFT * mesh.head_height)).astype(np.float32)
    irradiance = _vector(rig.ambient) * open_sky * (0.75 + 0.25 * normal[:, 1:2])
    mirrored = _vector(rig.ambient) * open_sky * open_sky * REFLECTANCE
    for light in rig.lights:
        towards = light.direction().astype(np.float32)
        facing = np.maximum(_dot(normal, towards), 0)
        seen = open_sky[:, 0].copy()
        if light.shadows:
            lit = (facing > 0) & (_dot(smooth, towards) > -0.1)
            seen[:] = 0
            seen[lit] = _visible_share(caster, lifted[lit], light)
        received = _vector(light.irradiance) * (facing * seen)[:, None]
        irradiance += received
        mirrored += received * _glint(normal, towards, view, light.radius)[:, None]
    return {
        "irradiance": irradiance.astype(np.float32),
        "albedo": np.clip(albedo, 0, 1),
        "non_subsurface": mirrored.astype(np.float32),
        "normal": normal,
        "depth_cm": depth,
    }


def _mapped_normal(
    mesh: Mesh, face: npt.NDArray[np.int32], weights: Float, uv: Float, texels: Float, smooth: Float
) -> Float:
    """The smooth normal, bent by the normal map."""
    if mesh.normal_map is None:
        return smooth
    tangent = (mesh.tangents[face] * weights).sum(axis=1)
    tangent = _unit(tangent - smooth * _dot(smooth, tangent)[:, None])
    bitangent = np.cross(smooth, tangent) * mesh.handedness[face][:, None]
    x, y, z = np.moveaxis(mesh.normal_map.sample(uv, texels * mesh.normal_map.width), 1, 0)[
        :, :, None
    ]
    return _unit(tangent * x + bitangent * y + smooth * np.maximum(z, 0.1))


def _glint(normal: Float, towards: Float, view: Float, radius: float) -> Float:
    """GGX lobe with Kelemen's visibility term, widened by the size of the light; as in head.cl."""
    half_way = _unit(towards + view)
    alpha = ROUGHNESS + np.float32(0.35 * radius)
    a2 = alpha * alpha
    across = np.clip(_dot(normal, half_way), 0, 1)
    along = np.maximum(_dot(half_way, towards), 0.05)
    schlick = REFLECTANCE + (1 - REFLECTANCE) * (1 - along) ** 5
    spread = across * across * (a2 - 1) + 1
    lobe: Float = schlick * a2 / (4 * along * along * spread * spread)
    return lobe


def _visible_share(caster: _Caster, origins: Float, light: Light) -> Float:
    """Share of the light's disc seen from each of (n, 3) points.

    Four rays to the rim and one to the centre first; only where they disagree, the whole pattern.
    """
    pattern = _disc_pattern(light, SHADOW_RAYS)
    rim = _disc_points(light, np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [0, 0]]) * 0.98)
    hidden = np.stack([caster.blocked(origins, _repeat(ray, len(origins))) for ray in rim]).sum(
        axis=0
    )
    share: Float = (hidden == 0).astype(np.float32)
    mixed = np.flatnonzero((hidden > 0) & (hidden < len(rim)))
    if len(mixed):
        points = np.ascontiguousarray(origins[mixed])
        blocked = np.zeros(len(mixed), np.float32)
        for ray in pattern:
            blocked += caster.blocked(points, _repeat(ray, len(points)))
        share[mixed] = 1 - blocked / len(pattern)
    return share


def _disc_pattern(light: Light, count: int) -> Float:
    """(count, 3) directions, equal areas of the disc each: Vogel's spiral by the golden angle."""
    index = np.arange(count)
    angle = index * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt((index + 0.5) / count)
    return _disc_points(light, np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius[:, None])


def _disc_points(light: Light, points: npt.NDArray[np.float64]) -> Float:
    """(n, 3) unit directions to (n, 2) points of the light's unit disc."""
    towards = light.direction()
    across = np.cross(towards, [0.0, 1.0, 0.0] if abs(towards[1]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    offsets = points[:, :1] * across + points[:, 1:] * np.cross(towards, across)
    return _unit((towards + offsets * light.radius).astype(np.float32))


def _corner_occlusion(mesh: Mesh, caster: _Caster) -> Float:
    """(faces, 3): share of the sky seen from each corner, weighted by the cosine."""
    # Once per vertex and normal
    pairs = np.concatenate([mesh.corners, mesh.normals], axis=2).reshape(-1, 6)
    unique, back = np.unique(pairs, axis=0, return_inverse=True)
    position, normal = unique[:, :3], unique[:, 3:]
    origins = np.ascontiguousarray(position + normal * np.float32(3 * LIFT * mesh.head_height))
    # Directions of the unit sphere added to the normal have a cosine-weighted distribution
    index = np.arange(OCCLUSION_RAYS)
    z = 1 - (2 * index + 1) / OCCLUSION_RAYS
    angle = index * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1).astype(np.float32)
    seen: Float = np.zeros(len(unique), np.float32)
    for point in sphere:
        seen += ~caster.blocked(
            origins, np.ascontiguousarray(_unit(normal * np.float32(1.001) + point))
        )
    share: Float = (seen / np.float32(OCCLUSION_RAYS))[back.reshape(-1)].reshape(-1, 3)
    return share


def _vector(values: tuple[float, ...]) -> Float:
    return np.array(values, dtype=np.float32)


def _repeat(vector: Float, count: int) -> Float:
    """(count, 3) contiguous rows, which Embree needs."""
    return np.repeat(vector[None], count, axis=0)


def _dot(a: Float, b: Float) -> Float:
    result: Float = (a * b).sum(axis=-1)
    return result


def _unit(vectors: Float) -> Float:
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    unit: Float = (vectors / np.maximum(length, np.float32(1e-20))).astype(np.float32)
    return unit
