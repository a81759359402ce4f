"""Meshes by path (glTF, OBJ, PLY): read, put upright, scaled to cm, with normals and maps."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from kernels.scenes.image_map import ImageMap, load_albedo, load_normals
from traces.errors import InputError, unknown

Float = npt.NDArray[np.float32]

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
AXES = {
    sign + axis: np.array([axis == a for a in "xyz"], float) * (1 if sign == "+" else -1)
    for axis in "xyz"
    for sign in "+-"
}
# Where neither a map nor a colour is given: the linear colour of light skin.
SKIN = (0.64, 0.395, 0.285)
# From crown to chin, and that over the breadth: an average man's 23.2 and 15.4 cm.
HEAD_CM = 23.0
HEAD_PER_BREADTH = 1.5
ABOVE_EARS = 0.4
# A smooth normal farther than this from its face's own belongs to an edge: the face's is used
# (cosine of 45 degrees).
EDGE_COSINE = 0.7071
# A map counts as upside down only where v and height are correlated at least so strongly.
MIN_CORRELATION = 0.5


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh in cm, y up, facing +z, the centre of its bounding box at the origin.

    name: stem of the file. attribution: from the licence beside it, "" if there is none.
    corners: (faces, 3, 3) float32 positions.
    normals: (faces, 3, 3) float32, unit, one per corner.
    uv: (faces, 3, 2) float32, v up; zeros if the file has none.
    tangents: (faces, 3, 3) float32, direction of growing u per corner, not normalised; zeros
    without uv.
    handedness: (faces,) float32, -1 where the map is mirrored, else 1.
    texels_per_cm: (faces,) float32, for a map one texel wide: sqrt(area in uv / area in cm^2).
    head_centre: (3,) float64, centre of the head's bounding box in cm; head_height: from crown to
    chin, cm.
    albedo: linear RGB where there is no albedo map.
    """

    name: str
    attribution: str
    corners: Float
    normals: Float
    uv: Float
    tangents: Float
    handedness: Float
    texels_per_cm: Float
    head_centre: npt.NDArray[np.float64]
    head_height: float
    albedo: tuple[float, float, float]
    albedo_map: ImageMap | None
    normal_map: ImageMap | None


def load_mesh(
    path: str | Path,
    *,
    albedo_map: str | Path | None = None,
    normal_map: str | Path | None = None,
    flip_v: bool | None = None,
    height_cm: float | None = None,
    up: str = "+y",
    forward: str = "+z",
) -> Mesh:
    """Read a mesh.

    albedo_map: sRGB image; None takes the file's own base colour map or colour.
    normal_map: tangent-space image, +y up; None takes the file's own.
    flip_v: whether v runs against the format's rule (glTF's points down), as maps from outside the
    file often need; None turns them where v falls with height over the mesh's front.
    height_cm: the bounding box is scaled to this height, as files rarely say their unit truly; None
    scales the head, as `_head_box` finds it, to 23 cm from crown to chin.
    up, forward: the file's axes that become +y and +z, as "+y", "-x" and so on.
    Raises InputError: no such file, an unknown suffix, nothing to draw, a map without uv
    coordinates.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise unknown("mesh format", path.suffix, SUFFIXES, str(path))
    if height_cm is not None and not (np.isfinite(height_cm) and height_cm > 0):
        raise InputError(f"{path}: height_cm {height_cm}: must be positive")
    rotation = _rotation(up, forward, path)
    raw = _read(path)
    faces = np.asarray(raw.faces)
    positions = np.asarray(raw.vertices, dtype=np.float64) @ rotation.T
    low, high = positions[faces].min(axis=(0, 1)), positions[faces].max(axis=(0, 1))
    if not high[1] > low[1]:
        raise InputError(f"{path}: the mesh has no height along {up}; choose another up axis")
    head_centre, head_height = _head_box(positions[faces].reshape(-1, 3))
    scale = HEAD_CM / head_height if height_cm is None else height_cm / (high[1] - low[1])
    positions = (positions - (low + high) / 2) * scale

    corners = positions[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(face_normals, axis=1)
    keep = areas > 0
    if not keep.any():
        raise InputError(f"{path}: every triangle is degenerate; nothing to draw")
    faces, corners, areas = faces[keep], corners[keep], areas[keep]
    face_normals = face_normals[keep] / areas[:, None]
    # trimesh keeps the normals that a file holds in the cache, where those it derives would go
    stored = raw._cache.cache.get("vertex_normals")
    if stored is not None and len(stored) == len(positions) and np.isfinite(stored).all():
        normals = (np.asarray(stored, dtype=np.float64) @ rotation.T)[faces]
    else:
        normals = _smooth_normals(positions, faces, corners, face_normals)

    uv, material = _texture(raw)
    if uv is None and (albedo_map is not None or normal_map is not None):
        raise InputError(
            f"{path}: the mesh has no uv coordinates, which albedo_map and normal_map need"
        )
    corner_uv = uv[faces] if uv is not None else np.zeros((len(faces), 3, 2))
    own_albedo = material.get("albedo_map") if uv is not None else None
    own_normals = material.get("normal_map") if uv is not None else None
    albedo_source = albedo_map if albedo_map is not None else own_albedo
    normal_source = normal_map if normal_map is not None else own_normals
    if flip_v is None:
        is_given = albedo_map is not None or normal_map is not None
        flip_v = is_given and _stands_on_its_head(corners, corner_uv, areas)
    if flip_v:
        corner_uv = corner_uv * [1, -1] + [0, 1]
    tangents, handedness, uv_areas = _tangents(corners, corner_uv, faces, len(positions))
    return Mesh(
        name=path.stem,
        attribution=_attribution(path),
        corners=corners.astype(np.float32),
        normals=_unit(normals).astype(np.float32),
        uv=corner_uv.astype(np.float32),
        tangents=tangents.astype(np.float32),
        handedness=handedness.astype(np.float32),
        texels_per_cm=np.sqrt(uv_areas / areas).astype(np.float32),
        head_centre=(head_centre - (low + high) / 2) * scale,
        head_height=head_height * scale,
        albedo=material.get("albedo", SKIN),
        albedo_map=None if albedo_source is None else load_albedo(albedo_source),
        normal_map=None if normal_source is None else load_normals(normal_source),
    )


def _read(path: Path) -> trimesh.Trimesh:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    # Each of trimesh's readers fails in ways of its own on a broken file
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a readable mesh: {reason[:200]}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not len(mesh.vertices):
        raise InputError(f"{path}: the mesh has no triangles")
    faces = np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise InputError(f"{path}: a triangle names a vertex that does not exist")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: NaN or infinite vertex positions")
    return mesh


def _rotation(up: str, forward: str, path: Path) -> npt.NDArray[np.float64]:
    """Rows: the file's axes that become x, y and z."""
    for what, axis in (("up axis", up), ("forward axis", forward)):
        if axis not in AXES:
            raise unknown(what, axis, AXES, str(path))
    if up[1] == forward[1]:
        raise InputError(f"{path}: up {up} and forward {forward}: must be different axes")
    return np.stack([np.cross(AXES[up], AXES[forward]), AXES[up], AXES[forward]])


def _head_box(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Centre and height of the head: the upper part of a bust, all of a mesh without shoulders.

    From the crown down to 1.5 times the breadth that is found in the upper two fifths of just that
    part, above the ears.
    """
    top, total = points[:, 1].max(), np.ptp(points[:, 1])
    height = total
    for share in np.linspace(0.1, 1.0, 91):
        upper = points[points[:, 1] >= top - ABOVE_EARS * share * total]
        if share * total >= HEAD_PER_BREADTH * np.ptp(upper[:, 0]):
            height = share * total
            break
    part = points[points[:, 1] >= top - height]
    centre = (part.min(axis=0) + part.max(axis=0)) / 2
    centre[1] = top - height / 2
    return centre, float(height)


def _smooth_normals(
    positions: npt.NDArray[np.float64],
    faces: npt.NDArray[np.int64],
    corners: npt.NDArray[np.float64],
    face_normals: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """(faces, 3, 3): the mean of the adjoining faces' normals, weighted by their angle; kept sharp
    at edges.
    """
    # Vertices that only uv coordinates keep apart are one
    _, merged = np.unique(positions, axis=0, return_inverse=True)
    index = merged.reshape(-1)[faces]
    total = np.zeros((index.max() + 1, 3))
    for corner in range(3):
        a = _unit(corners[:, (corner + 1) % 3] - corners[:, corner])
        b = _unit(corners[:, (corner + 2) % 3] - corners[:, corner])
        angle = np.arccos(np.clip((a * b).sum(axis=1), -1, 1))
        np.add.at(total, index[:, corner], face_normals * angle[:, None])
    smooth = _unit(total)[index]
    sharp = (smooth * face_normals[:, None]).sum(axis=-1) < EDGE_COSINE
    return np.where(sharp[..., None], face_normals[:, None], smooth)


def _tangents(
    corners: npt.NDArray[np.float64],
    uv: npt.NDArray[np.float64],
    faces: npt.NDArray[np.int64],
    num_vertices: int,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Direction of u per corner, smoothed over each vertex; handedness and twice the uv area per
    face.
    """
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uv1, uv2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = uv1[:, 0] * uv2[:, 1] - uv2[:, 0] * uv1[:, 1]
    # Solve edge = du * tangent + dv * bitangent; the sign of the area keeps mirrored maps right
    along_u = (edge1 * uv2[:, 1:] - edge2 * uv1[:, 1:]) * np.sign(area)[:, None]
    total = np.zeros((num_vertices, 3))
    for corner in range(3):
        np.add.at(total, faces[:, corner], along_u)
    return total[faces], np.where(area < 0, -1.0, 1.0), np.abs(area)


def _stands_on_its_head(
    corners: npt.NDArray[np.float64], uv: npt.NDArray[np.float64], areas: npt.NDArray[np.float64]
) -> bool:
    """Whether v falls with height over the front: maps of heads are painted upright."""
    edges = corners[:, 1:] - corners[:, :1]
    facing = np.cross(edges[:, 0], edges[:, 1])[:, 2] / areas
    weight = np.repeat(areas * np.maximum(facing, 0), 3)
    if not weight.any():
        return False
    height, v = corners[:, :, 1].reshape(-1), uv[:, :, 1].reshape(-1)
    height, v = (value - np.average(value, weights=weight) for value in (height, v))
    spread = np.sqrt((weight * height**2).sum() * (weight * v**2).sum())
    return bool((weight * height * v).sum() < -MIN_CORRELATION * spread)


def _texture(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float64] | None, dict[str, Any]]:
    """(vertices, 2) uv or None, and what the material says: albedo, albedo_map, normal_map."""
    found: dict[str, Any] = {}
    visual: Any = mesh.visual
    if visual is None or visual.kind != "texture":
        return None, found
    uv = getattr(visual, "uv", None)
    uv = None if uv is None or len(uv) != len(mesh.vertices) else np.asarray(uv, dtype=np.float64)
    if uv is not None and not np.isfinite(uv).all():
        uv = None
    material = visual.material
    found["albedo_map"] = getattr(material, "baseColorTexture", None) or getattr(
        material, "image", None
    )
    found["normal_map"] = getattr(material, "normalTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None:
        linear = np.asarray(factor, dtype=np.float64)[:3] / (255 if np.max(factor) > 1 else 1)
        # White is glTF's default: it says nothing about the surface
        if (linear < 1).any():
            found["albedo"] = tuple(float(value) for value in linear)
    return uv, found


def _attribution(path: Path) -> str:
    """The sentence that grants the licence in `<stem>_License.txt`, else its first line; "" without
    such a file.
    """
    licence = path.with_name(f"{path.stem}_License.txt")
    if not licence.is_file():
        return ""
    lines = [line.strip() for line in licence.read_text("utf-8", "replace").splitlines()]
    lines = [line for line in lines if line] or [""]
    granting = [line for line in lines if re.search(r"\blicen[sc]ed\b", line, re.IGNORECASE)]
    return (granting or lines)[0][:300]


def _unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: npt.NDArray[np.float64] = vectors / np.where(length > 0, length, 1)
    return unit
