"""The profile against volumetric path tracing: a slab with an edge of light, balls, meshes by path.

Nothing is fitted: the medium's mean free path and the brightness of the evenly lit slab, which is
the profile's albedo, fix the profile by its searchlight fit.

The profile says how far light spreads, not how a surface's brightness depends on the directions of
light and view. Without a refracting surface that is no cosine, so the light that the profile
spreads on curved shapes is the brightness that flat ground would have there: the law of diffuse
reflection by a half-space that scatters evenly, [C60] section 34 and its H functions.

[C60] Chandrasekhar, Radiative Transfer, Dover 1960.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from experiments.reproduce import path_tracing
from experiments.reproduce.path_tracing import Medium
from kernels.dense import scatter_densely
from kernels.maths.profile import Profile, shape_dmfp, shape_searchlight
from kernels.method import Method
from kernels.scenes.analytic import wall
from kernels.scenes.camera import Camera
from kernels.scenes.sphere import SIDEWAYS, sphere

if TYPE_CHECKING:
    from experiments.reproduce.parts import Arrays, Parts
    from kernels.gbuffer import GBuffer
    from kernels.opencl.device import Device
    from kernels.scenes.mesh import Mesh

Float = npt.NDArray[np.float64]

MEDIUM = Medium(mean_free_path_mm=1.0, albedo=0.95)
#: Of the slab's line, in mean free paths; beyond two thirds of it the light is even.
HALF_WIDTH_MM = 15.0
#: Sizes and paths per pixel, full and quick.
EDGE, QUICK_EDGE = (120, 16384), (30, 1024)
BALL, QUICK_BALL = ((192, 108), 4096), ((40, 23), 128)
MESH_PATHS, QUICK_MESH_PATHS = 512, 16
#: Balls, strongly and weakly curved; the camera stands this many radii from their middle.
RADII_CM = {"small ball": 1.0, "large ball": 4.0}
DISTANCE_RADII = 8.0
#: A mesh's mean free path over its head's height.
MESH_SCALE = 0.01


@dataclass(frozen=True, eq=False)
class Compared:
    """One shape: brightness over that of the evenly lit slab, along a line or as pictures.

    traced: by path tracing. predicted: by the profile. unscattered: of flat ground that is lit and
    seen as the surface is there. mask: what is compared. attribution: owed to the shape.
    """

    name: str
    traced: Float
    predicted: Float
    unscattered: Float
    mask: npt.NDArray[np.bool_]
    attribution: str = ""

    def error(self, predicted: bool = True, shade: bool = False) -> float:
        """Root mean square difference from the traced brightness, of the prediction or of the
        light without scattering; in the shade alone, where no light arrives, or everywhere.
        """
        shown = self.predicted if predicted else self.unscattered
        where = self.mask & (self.unscattered == 0) if shade else self.mask
        return float(np.sqrt(np.mean((shown - self.traced)[where] ** 2))) if where.any() else 0.0


def h_function(cosine: Float, albedo: float) -> Float:
    """Chandrasekhar's H of isotropic scattering. cosine: in [0, 1]. albedo: of an event, below 1.

    H(mu) = 1 / (sqrt(1 - albedo) + albedo / 2 int_0^1 mu' H(mu') / (mu + mu') dmu'), [C60] section
    37, iterated; each turn at least halves the difference for albedos below 0.99.
    """
    nodes, weights = np.polynomial.legendre.leggauss(48)
    at, weights = (nodes + 1) / 2, weights / 2

    def improve(mu: Float, h: Float) -> Float:
        kernel = at / (np.maximum(mu, 1e-12)[..., None] + at)
        result: Float = 1 / (np.sqrt(1 - albedo) + albedo / 2 * (kernel * (weights * h)).sum(-1))
        return result

    h = np.ones_like(at)
    for _ in range(100):
        h = (h + improve(at, h)) / 2
    return improve(np.asarray(cosine, np.float64), h)


def flat_brightness(light_cosine: Float, view_cosine: Float, albedo: float) -> Float:
    """Brightness of flat ground over that under perpendicular light and view; 0 where a cosine is
    not positive. albedo: of one scattering event. [C60] section 34.
    """
    lit = (light_cosine > 0) & (view_cosine > 0)
    mu_0, mu = (np.where(lit, cosine, 1.0) for cosine in (light_cosine, view_cosine))
    perpendicular = h_function(np.ones(1), albedo)[0]
    law = 2 * mu_0 / (mu_0 + mu) * h_function(mu_0, albedo) * h_function(mu, albedo)
    found: Float = np.where(lit, law / perpendicular**2, 0.0)
    return found


def profile_for(medium: Medium, albedo: float) -> Profile:
    """The profile of a medium whose evenly lit surface has this albedo."""
    d = medium.mean_free_path_mm / float(shape_searchlight(albedo))
    return Profile("medium", (albedo,) * 3, (d * float(shape_dmfp(albedo)),) * 3)


def compare_all(
    parts: Parts, quick: bool, meshes: Sequence[Mesh], device: Device
) -> list[Compared]:
    """Every shape that path tracing can have; empty where Mitsuba is not installed."""
    if path_tracing.find_mitsuba() is None:
        return []
    num_pixels, num_samples = QUICK_EDGE if quick else EDGE
    inputs = {"version": metadata.version(path_tracing.PACKAGE), "medium": vars(MEDIUM)}
    edge = parts.arrays(
        "traced-slab",
        inputs | {"edge": [HALF_WIDTH_MM, num_pixels, num_samples]},
        lambda: {"r": path_tracing.trace_edge(MEDIUM, HALF_WIDTH_MM, num_pixels, num_samples)},
    )["r"]
    at = (np.arange(num_pixels) + 0.5) / num_pixels * 2 * HALF_WIDTH_MM - HALF_WIDTH_MM
    lit = float(edge[at > HALF_WIDTH_MM * 2 / 3].mean())
    method = Method(profile=profile_for(MEDIUM, np.pi * lit))
    found = [_compare_slab(edge / lit, method, device)]

    size, num_samples = QUICK_BALL if quick else BALL
    for name, radius in RADII_CM.items():
        distance = DISTANCE_RADII * radius
        gbuffer = sphere(*size, radius_cm=radius, distance_cm=distance)
        camera = Camera(name, (0.0, 0.0, distance), (0.0, 0.0, 0.0))

        def trace_ball(radius: float = radius, camera: Camera = camera) -> Arrays:
            picture = path_tracing.trace_sphere(MEDIUM, radius, camera, SIDEWAYS, size, num_samples)
            return {"r": picture}

        cell = f"traced-{name.replace(' ', '-')}"
        keyed = inputs | {"ball": [radius, distance, *size, num_samples]}
        traced = parts.arrays(cell, keyed, trace_ball)["r"]
        found.append(_compare_picture(name, gbuffer, camera, traced / lit, method, device))
    paths = QUICK_MESH_PATHS if quick else MESH_PATHS
    for mesh in meshes:
        found.append(_compare_mesh(parts, mesh, inputs, lit, size, paths, device))
    return found


def _compare_slab(traced: Float, method: Method, device: Device) -> Compared:
    """The line across the edge; the prediction is dense, on a flat wall with the line's pixels."""
    num_pixels = len(traced)
    scale = num_pixels / (2 * HALF_WIDTH_MM)
    flat = wall(8, num_pixels, near_pixels_per_mm=scale, far_pixels_per_mm=scale)
    lit = np.arange(num_pixels) < num_pixels / 2
    light = np.broadcast_to(lit[:, None, None], (num_pixels, 8, 3)).astype(np.float32)
    middle = np.zeros((num_pixels, 8), bool)
    middle[:, 4] = True
    shown = scatter_densely(replace(flat, irradiance=light), method, device, pixels=middle)
    predicted = shown[::-1, 4, 0].astype(np.float64)
    everywhere = np.ones(num_pixels, bool)
    return Compared("slab", traced, predicted, lit[::-1].astype(np.float64), everywhere)


def _compare_picture(
    name: str,
    gbuffer: GBuffer,
    camera: Camera,
    traced: Float,
    method: Method,
    device: Device,
) -> Compared:
    """A picture under one light from `SIDEWAYS`, whose shadows are where nothing arrives."""
    from scipy.ndimage import binary_erosion

    normal = gbuffer.normal.astype(np.float64)
    light = normal @ (np.asarray(SIDEWAYS) / np.linalg.norm(SIDEWAYS))
    view = -(normal * view_rays(camera, gbuffer.width, gbuffer.height)).sum(axis=-1)
    bright = flat_brightness(light, view, MEDIUM.albedo)
    cosine = np.maximum(light, 1e-6)
    seen = np.clip(gbuffer.irradiance[..., 0] / cosine, 0, 1)
    arriving = (bright * seen).astype(np.float32)
    lit = replace(gbuffer, irradiance=np.repeat(arriving[..., None], 3, axis=2))
    shown = scatter_densely(lit, method, device)[..., 0].astype(np.float64)
    # A pixel of the outline shows the shape in a part of it only.
    inner = binary_erosion(gbuffer.subsurface)
    return Compared(name, traced, shown, arriving.astype(np.float64), inner, gbuffer.attribution)


def view_rays(camera: Camera, width: int, height: int) -> Float:
    """(height, width, 3) unit directions from the camera through the pixels' centres."""
    right, up, forward = camera.basis()
    pixel = 2.0 / (width * camera.projection_x)
    x = ((np.arange(width) + 0.5 - width / 2) * pixel)[None, :, None]
    y = ((height / 2 - np.arange(height) - 0.5) * pixel)[:, None, None]
    rays = forward + x * right + y * up
    unit: Float = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return unit


def _compare_mesh(
    parts: Parts,
    mesh: Mesh,
    inputs: dict[str, Any],
    lit: float,
    size: tuple[int, int],
    num_samples: int,
    device: Device,
) -> Compared:
    """A mesh from the front under one small light; its maps are left out."""
    from kernels.scenes.light import Light, Rig
    from kernels.scenes.mesh_render import mesh_camera, render_mesh

    bare = replace(mesh, albedo_map=None, normal_map=None)
    camera = mesh_camera("front", bare)
    light = Light("key", SIDEWAYS, (1.0, 1.0, 1.0), radius=1e-3)
    rig = Rig((light,), ambient=(0.0, 0.0, 0.0), background=(0.0, 0.0, 0.0))
    gbuffer = render_mesh(bare, *size, camera=camera, rig=rig)
    medium = Medium(10 * MESH_SCALE * mesh.head_height, MEDIUM.albedo)
    digest = float(np.abs(mesh.corners.astype(np.float64)).sum())
    keyed = inputs | {"mesh": [mesh.name, len(mesh.corners), digest, *size, num_samples]}
    traced = parts.arrays(
        f"traced-{mesh.name}",
        keyed,
        lambda: {"r": path_tracing.trace_mesh(medium, bare, camera, SIDEWAYS, size, num_samples)},
    )["r"]
    method = Method(profile=profile_for(medium, np.pi * lit))
    return _compare_picture(mesh.name, gbuffer, camera, traced / lit, method, device)
