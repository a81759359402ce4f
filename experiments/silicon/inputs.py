"""What the workload's kernels read, and the pictures that they are held to, as a file.

The GPU at hand may stand in a machine without OpenCL: `silicon prepare` renders elsewhere, `silicon
measure --inputs` takes the files along. Neighbours are alike, so that each array is kept as
differences along its rows, split into planes of bytes, and compressed.
"""

from __future__ import annotations

import hashlib
import json
import lzma
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from traces.errors import InputError
from traces.files import replacing

#: Texels of each expected picture that are kept, spread over the frame; the rest is a hash.
NUM_KEPT = 16384
_VERSION = 1
Array = npt.NDArray[Any]

#: Arrays of a picture: (dtype, components).
ARRAYS: dict[str, tuple[str, int]] = {
    "scene_light": ("uint16", 4),
    "depth": ("float32", 1),
    "gbuffer_id": ("uint8", 1),
    "normal": ("uint32", 1),
    "albedo": ("uint16", 4),
    "scene_colour": ("uint16", 4),
    "counts": ("uint16", 1),
    "old_history": ("uint16", 4),
}


@dataclass(frozen=True)
class Expected:
    """A picture that the OpenCL kernels made: (h, w, 4) half floats as uint16.

    sha256: over its bytes. kept: (k, 4) uint16, every `stride`-th texel.
    """

    sha256: str
    stride: int
    kept: Array

    @staticmethod
    def of(picture: Array) -> Expected:
        texels = np.ascontiguousarray(picture.reshape(-1, 4))
        stride = max(1, len(texels) // NUM_KEPT)
        return Expected(hashlib.sha256(texels.tobytes()).hexdigest(), stride, texels[::stride])


@dataclass(frozen=True)
class Picture:
    """One picture's inputs.

    constants: of the fixed and of the adaptive method, as `workload.Constants` takes them.
    arrays: by the names of `ARRAYS`, (h, w) or (h, w, 4). expected: by "counts/texture", such as
    "fixed64/scattered", and "setup/1" for a level.
    """

    scene: str
    width: int
    height: int
    constants: dict[str, dict[str, Any]]
    arrays: dict[str, Array]
    expected: dict[str, Expected]

    @property
    def file_name(self) -> str:
        return file_name(self.scene, self.width, self.height)


def file_name(scene: str, width: int, height: int) -> str:
    """The name of a picture's file."""
    return f"{scene}_{width}x{height}.npz"


def pack(array: Array, effort: int = 6) -> Array:
    """An array as compressed bytes. effort: 0, fast, to 9, small."""
    words = np.ascontiguousarray(array)
    integers = words.view(f"uint{8 * words.itemsize}")
    if integers.ndim > 1:
        integers = np.diff(integers, axis=1, prepend=integers[:, :1] * 0)
    planes = integers.reshape(-1).view(np.uint8).reshape(-1, words.itemsize).T
    packed = lzma.compress(np.ascontiguousarray(planes).tobytes(), preset=effort)
    return np.frombuffer(packed, np.uint8)


def unpack(packed: Array, dtype: str, shape: tuple[int, ...]) -> Array:
    """The array that `pack` was given.

    Raises:
        InputError: the bytes are damaged or of another size.
    """
    kind = np.dtype(dtype)
    try:
        flat = np.frombuffer(lzma.decompress(packed.tobytes()), np.uint8)
        planes = flat.reshape(kind.itemsize, -1)
        integers = np.ascontiguousarray(planes.T).view(f"uint{8 * kind.itemsize}").reshape(shape)
    except (lzma.LZMAError, ValueError) as error:
        raise InputError(f"damaged array: {error}") from error
    if len(shape) > 1:
        integers = np.cumsum(integers, axis=1, dtype=integers.dtype)
    return integers.view(kind)


def write_picture(folder: Path, picture: Picture, effort: int = 6) -> Path:
    """Write a picture's file, whole or not at all; its path. effort: as of `pack`."""
    described = {
        "version": _VERSION,
        "scene": picture.scene,
        "width": picture.width,
        "height": picture.height,
        "constants": picture.constants,
        "expected": {
            name: {"sha256": e.sha256, "stride": e.stride, "num_kept": len(e.kept)}
            for name, e in picture.expected.items()
        },
    }
    members = {f"array/{name}": pack(array, effort) for name, array in picture.arrays.items()}
    members |= {f"expected/{name}": pack(e.kept, effort) for name, e in picture.expected.items()}
    path = folder / picture.file_name
    with replacing(path) as part:
        np.savez(part, description=np.array(json.dumps(described)), **members)  # type: ignore[arg-type]
    return path


def read_picture(path: Path) -> Picture:
    """Read a picture's file.

    Raises:
        InputError: there is none, or it is damaged or of another kind.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; `cachesim silicon prepare` writes it")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as held:
            described = json.loads(str(held["description"]))
            if described.get("version") != _VERSION:
                raise InputError(
                    f"{path}: version {described.get('version')}: allowed is {_VERSION}"
                )
            size = described["height"], described["width"]
            arrays = {
                name: unpack(held[f"array/{name}"], dtype, (*size, 4) if parts == 4 else size)
                for name, (dtype, parts) in ARRAYS.items()
            }
            expected = {
                name: Expected(
                    told["sha256"],
                    told["stride"],
                    unpack(held[f"expected/{name}"], "uint16", (told["num_kept"], 4)),
                )
                for name, told in described["expected"].items()
            }
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
        raise InputError(f"{path}: no prepared picture: {error}") from error
    return Picture(described["scene"], size[1], size[0], described["constants"], arrays, expected)


def compare_picture(found: Array, expected: Expected) -> dict[str, float]:
    """How a picture differs from the expected one. found: (h, w, 4) half floats as uint16.

    identical: 1 or 0. differing_rate: of the kept texels. max_difference: of their components.
    psnr: in dB over the largest expected component, only where they differ.
    """
    texels = np.ascontiguousarray(found.reshape(-1, 4))
    identical = hashlib.sha256(texels.tobytes()).hexdigest() == expected.sha256
    ours = texels[:: expected.stride].view(np.float16).astype(np.float64)
    theirs = np.ascontiguousarray(expected.kept).view(np.float16).astype(np.float64)
    difference = np.abs(ours - theirs)
    told = {
        "identical": float(identical),
        "differing_rate": float((difference > 0).any(axis=1).mean()),
        "max_difference": float(difference.max()),
    }
    error, peak = float((difference**2).mean()), float(np.abs(theirs).max())
    if error > 0 and peak > 0:
        told["psnr"] = float(10 * np.log10(peak**2 / error))
    return told
