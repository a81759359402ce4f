"""Scenes by name or path: the one way in for every source of a G-buffer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kernels.gbuffer import GBuffer
from kernels.scenes.analytic import circle, wall
from kernels.scenes.camera import CAMERAS, Camera, camera_named, check_size
from kernels.scenes.light import RIG, Rig
from traces.errors import InputError, unknown

if TYPE_CHECKING:
    from kernels.frame import Scene
    from kernels.opencl.device import Device

CIRCLE, WALL = "circle", "wall"
SCENES: tuple[str, ...] = (*CAMERAS, CIRCLE, WALL)
MESHES = (".glb", ".gltf", ".obj", ".ply")
CAPTURES = (".npz", ".exr")
# The resolution of the study.
WIDTH, HEIGHT = 1920, 1080


def open_scene(
    name_or_path: str | Path,
    width: int | None = None,
    height: int | None = None,
    *,
    overlay: bool = False,
    **options: Any,
) -> Scene:
    """The scene as the frame loop takes it: what moves is a function from frame to G-buffer, the
    rest one view. `circle` moves.

    overlay: draw `motion.veil` over a scene that has nothing transparent of its own. The rest: as
    `load_scene`, which see for the errors.
    """
    # Refuses what the scene does not take.
    first = load_scene(name_or_path, width, height, **options)
    scene: Scene = first
    if str(name_or_path) == CIRCLE:
        scene = circle(first.width, first.height)
    if overlay and first.overlay is None:
        from kernels.scenes.motion import Overlaid, veil

        return Overlaid(scene, veil())
    return scene


def load_scene(
    name_or_path: str | Path,
    width: int | None = None,
    height: int | None = None,
    *,
    camera: str | Camera | None = None,
    device: Device | None = None,
    rig: Rig = RIG,
    projection_x: float | None = None,
    progress: Callable[[float], None] | None = None,
    **mesh_options: Any,
) -> GBuffer:
    """Load or render one view; the first where the scene moves.

    name_or_path: close, ear, front or side, the procedural head's views; circle, a disc that moves
    before a background; wall, which recedes; a mesh (.glb, .gltf, .obj, .ply); or a captured
    G-buffer (.npz, .exr).
    width, height: pixels, 1 to 16384; None is 1920x1080, or a capture's own size, from which it may
    not differ.
    camera: for a mesh, one of the four names (placed from its bounding box) or a Camera in cm; None
    is front. For the procedural head, a Camera instead of the named one.
    device: for the procedural head; None opens the default one.
    rig: lights of a head or a mesh; circle and wall have their own.
    projection_x: for a capture that does not state it, or states it wrongly.
    progress: called with the share done, in [0, 1].
    mesh_options: albedo_map, normal_map, flip_v, height_cm, up, forward: see mesh.load_mesh.
    Raises InputError: an unknown name or format, a bad file, a size out of range, an option that
    the source lacks.
    """
    name = str(name_or_path)
    suffix = Path(name).suffix.lower()
    is_capture, is_mesh, is_analytic = suffix in CAPTURES, suffix in MESHES, name in (CIRCLE, WALL)
    if name not in SCENES and not is_capture and not is_mesh:
        raise unknown(
            "scene", name, [*SCENES, *(f"a path ending in {s}" for s in MESHES + CAPTURES)]
        )
    _refuse(name, mesh_options, is_mesh, "a mesh")
    _refuse(name, {"projection_x": projection_x}, is_capture, "a captured G-buffer")
    if is_capture:
        _refuse(name, {"camera": camera}, False, "a rendered scene")
        return _capture(Path(name), suffix, width, height, projection_x)

    width, height = WIDTH if width is None else width, HEIGHT if height is None else height
    check_size(width, height)
    if is_analytic:
        _refuse(name, {"camera": camera}, False, "the head or a mesh")
        return circle(width, height)(0) if name == CIRCLE else wall(width, height)
    if is_mesh:
        from kernels.scenes.mesh_render import render_mesh

        view = "front" if camera is None else camera
        return render_mesh(
            name, width, height, camera=view, rig=rig, progress=progress, **mesh_options
        )
    from kernels.scenes.head import render_head

    if isinstance(camera, str) and camera != name:
        raise InputError(
            f"{name}: camera {camera!r}: this scene is its own camera; only a mesh takes a name"
        )
    view = camera if isinstance(camera, Camera) else camera_named(name)
    return render_head(view, width, height, device, rig, progress)


def _capture(
    path: Path, suffix: str, width: int | None, height: int | None, projection_x: float | None
) -> GBuffer:
    from kernels.scenes.capture import load_exr, load_npz

    gbuffer = (load_npz if suffix == ".npz" else load_exr)(path, projection_x)
    wanted = (width or gbuffer.width, height or gbuffer.height)
    if wanted != (gbuffer.width, gbuffer.height):
        raise InputError(
            f"{path}: size {wanted[0]}x{wanted[1]}: the captured G-buffer is "
            f"{gbuffer.width}x{gbuffer.height}; leave the size out"
        )
    return gbuffer


def _refuse(name: str, options: dict[str, Any], applies: bool, what: str) -> None:
    """Raise InputError for options that are given where they do not apply."""
    given = [option for option, value in options.items() if value is not None]
    if given and not applies:
        raise InputError(f"{name}: {given[0]}: only {what} takes it")
