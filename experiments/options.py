"""Options that several commands share, and what turns their text into values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from traces.errors import InputError

TracePath = Annotated[
    Path, typer.Argument(metavar="TRACE", help="A .parquet recording or a lane-address .npz.")
]
GpuName = Annotated[
    str,
    typer.Option(
        "--gpu", metavar="NAME|FILE.toml", help="A preset (see `cachesim presets`) or your file."
    ),
]
Overrides = Annotated[
    list[str],
    typer.Option("--set", metavar="FIELD=VALUE", help="Override a field: l1.capacity=64KiB."),
]
FetchPathName = Annotated[
    str | None,
    typer.Option("--fetch-path", metavar="texture|readonly|global", help="How loads enter the L1."),
]
LayoutName = Annotated[
    str | None,
    typer.Option("--layout", metavar="NAME", help="Texel layout; the GPU's own unless given."),
]
DeviceName = Annotated[
    str | None,
    typer.Option(
        "--device", metavar="NAME", help="Part of the OpenCL device's or platform's name."
    ),
]
SceneName = Annotated[
    str,
    typer.Option(
        "--scene",
        metavar="NAME|FILE",
        help="close, ear, front, side; circle, which moves; wall; a mesh (.glb .gltf .obj .ply); a "
        "G-buffer (.npz .exr).",
    ),
]
CameraName = Annotated[
    str | None,
    typer.Option("--camera", metavar="NAME", help="Camera of a mesh: close, ear, front, side."),
]
AlbedoMap = Annotated[
    Path | None, typer.Option("--albedo-map", metavar="FILE", help="Albedo picture of a mesh.")
]
NormalMap = Annotated[
    Path | None,
    typer.Option("--normal-map", metavar="FILE", help="Tangent-space normal map of a mesh."),
]
ImageSize = Annotated[
    str, typer.Option("--size", metavar="WxH", help="Frame size in pixels, up to 16384 a side.")
]
Folder = Annotated[
    Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")
]

MAX_SIDE = 16384


def parse_image_size(text: str) -> tuple[int, int]:
    """(width, height) of "1920x1080".

    Raises:
        InputError: not two whole numbers, or a side that is not in 1..16384.
    """
    match = re.fullmatch(r"(-?\d+)[xX](-?\d+)", text.strip())
    if match is None:
        raise InputError(f"--size {text!r}: write WIDTHxHEIGHT, for example 1920x1080")
    width, height = int(match[1]), int(match[2])
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise InputError(f"--size {text!r}: {name} {side}: allowed are 1 to {MAX_SIDE} pixels")
    return width, height


def parse_names(text: str, option: str) -> list[str]:
    """The names of a comma-separated list.

    Raises:
        InputError: an empty list, an empty name, or one that is repeated.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise InputError(f"{option} {text!r}: an empty name; write names with commas between")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{option} {text!r}: {name!r} is repeated")
    return names


def check_fetch_path(name: str | None) -> None:
    """Raises InputError where `name` is given and is no fetch path."""
    from typing import get_args

    from cachesim.config import FetchPath
    from traces.errors import unknown

    if name is not None and name not in get_args(FetchPath):
        raise unknown("fetch path", name, get_args(FetchPath), "--fetch-path")


def scene_arguments(
    scene: str, camera: str | None, albedo_map: Path | None, normal_map: Path | None
) -> dict[str, Any]:
    """Keyword arguments of `load_scene` that only a mesh takes.

    Raises:
        InputError: they are given and the scene is no mesh, or a map does not exist.
    """
    given = {
        "camera": camera,
        "albedo_map": albedo_map,
        "normal_map": normal_map,
    }
    given = {name: value for name, value in given.items() if value is not None}
    is_mesh = Path(scene).suffix.lower() in (".glb", ".gltf", ".obj", ".ply")
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        if not is_mesh:
            raise InputError(f"{option} {value}: only a mesh takes it, not scene {scene!r}")
        if isinstance(value, Path) and not value.is_file():
            raise InputError(f"{option} {value}: no such file")
    return dict(given)
