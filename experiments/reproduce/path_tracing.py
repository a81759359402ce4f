"""Volumetric path tracing of a slab, a ball or a mesh with Mitsuba, where that is installed.

Grey light and a medium without a refracting surface, as the profile has none. One mean free path
and one single-scattering albedo; the light is parallel. Pictures are radiance for irradiance 1 on a
surface that faces the light.

Mitsuba is no dependency of this project: `pip install -c constraints.txt -e .[path-tracing]`.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels.scenes.camera import Camera, Vector
from traces.errors import WorkError

if TYPE_CHECKING:
    from kernels.scenes.mesh import Mesh

Float = npt.NDArray[np.float32]
PACKAGE, VARIANT = "mitsuba", "scalar_rgb"
MISSING = (
    "Mitsuba is not installed here, so the comparison with volumetric path tracing is left out; "
    "`pip install -c constraints.txt -e '.[path-tracing]'` adds it"
)
#: Scattering events after which a path is given up; what is left of it by then is below 1e-4.
MAX_DEPTH = 1000


@dataclass(frozen=True)
class Medium:
    """mean_free_path_mm: between two events. albedo: of one event, in [0, 1)."""

    mean_free_path_mm: float
    albedo: float


def find_mitsuba() -> Any | None:
    """The module; None where it is not installed or does not load."""
    try:
        found = import_module(PACKAGE)
        found.set_variant(VARIANT)
    except (ImportError, OSError):
        return None
    return found


def trace_edge(medium: Medium, half_width_mm: float, num_pixels: int, num_samples: int) -> Float:
    """(num_pixels,) radiance along a line across a slab that is lit from above where x > 0.

    half_width_mm: the line runs from minus this to this. num_samples: paths per pixel.
    """
    mi = _mitsuba()
    wide = 4 * half_width_mm + 200 * medium.mean_free_path_mm
    transform = mi.ScalarTransform4f
    # The occluder stands above the camera, which therefore sees all light that leaves the slab.
    occluder = transform().translate([-2 * wide, 0, 4]).scale([2 * wide, 2 * wide, 1])
    scene = {
        "slab": {
            "type": "cube",
            "to_world": transform().translate([0, 0, -wide]).scale([wide, wide, wide]),
            **_inside(medium),
        },
        "occluder": {
            "type": "rectangle",
            "to_world": occluder,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        },
        "light": _light((0.0, 0.0, 1.0)),
        "sensor": {
            "type": "orthographic",
            "to_world": transform().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
            @ transform().scale([half_width_mm, half_width_mm, 1]),
            # Square pixels; all rows of the line see the same.
            "film": _film(num_pixels, 1),
            "near_clip": 0.1,
            "far_clip": 10.0,
        },
    }
    line: Float = _render(mi, scene, num_samples)[0]
    return line


def trace_sphere(
    medium: Medium,
    radius_cm: float,
    camera: Camera,
    towards: Vector,
    size: tuple[int, int],
    num_samples: int,
) -> Float:
    """(h, w) radiance of a ball at the origin. size: width, height, pixels."""
    mi = _mitsuba()
    ball = {"type": "sphere", "radius": 10 * radius_cm, **_inside(medium)}
    scene = {"ball": ball, "light": _light(towards), "sensor": _sensor(mi, camera, size)}
    return _render(mi, scene, num_samples)


def trace_mesh(
    medium: Medium,
    mesh: Mesh,
    camera: Camera,
    towards: Vector,
    size: tuple[int, int],
    num_samples: int,
) -> Float:
    """(h, w) radiance of a mesh, full of the medium. camera: in cm, as for `render_mesh`."""
    import trimesh

    mi = _mitsuba()
    corners = np.asarray(mesh.corners, np.float64).reshape(-1, 3) * 10.0
    faces = np.arange(len(corners)).reshape(-1, 3)
    solid = trimesh.Trimesh(corners, faces, process=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        solid.export(path)
        shape = {"type": "ply", "filename": str(path), "face_normals": True, **_inside(medium)}
        scene = {"mesh": shape, "light": _light(towards), "sensor": _sensor(mi, camera, size)}
        return _render(mi, scene, num_samples)


def _mitsuba() -> Any:
    found = find_mitsuba()
    if found is None:
        raise WorkError(MISSING)
    return found


def _inside(medium: Medium) -> dict[str, Any]:
    """A surface that light crosses unbent, and the medium behind it; lengths in mm."""
    return {
        "bsdf": {"type": "null"},
        "interior": {
            "type": "homogeneous",
            "sigma_t": {"type": "rgb", "value": 1.0 / medium.mean_free_path_mm},
            "albedo": {"type": "rgb", "value": medium.albedo},
            "phase": {"type": "isotropic"},
        },
    }


def _light(towards: Vector) -> dict[str, Any]:
    return {
        "type": "directional",
        "direction": [-float(v) for v in towards],
        "irradiance": {"type": "rgb", "value": 1.0},
    }


def _film(width: int, height: int) -> dict[str, Any]:
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "luminance",
        "rfilter": {"type": "box"},
    }


def _sensor(mi: Any, camera: Camera, size: tuple[int, int]) -> dict[str, Any]:
    origin, target = (
        [10.0 * float(v) for v in point] for point in (camera.position, camera.target)
    )
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(1 / camera.projection_x))),
        "fov_axis": "x",
        "near_clip": 1.0,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f().look_at(
            origin=origin, target=target, up=[float(v) for v in camera.up]
        ),
        "film": _film(*size),
    }


def _render(mi: Any, scene: dict[str, Any], num_samples: int) -> Float:
    described = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": MAX_DEPTH, "rr_depth": 50},
        **scene,
    }
    # A fixed seed: the same picture every time.
    picture = np.array(mi.render(mi.load_dict(described), spp=num_samples, seed=1))
    return picture.reshape(picture.shape[:2]).astype(np.float32)
