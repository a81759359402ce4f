"""Captured G-buffers: `.npz` and multi-channel OpenEXR, read and written.

`.npz` (no pickles): one array per field of GBuffer, under its name. irradiance, albedo,
non_subsurface and normal (h, w, 3), depth_cm (h, w): any float type; profile_id (h, w): any integer
type, 0 to 255; projection_x: a number. These may be left out: non_subsurface (black), importance
(h, w), velocity (h, w, 2) and overlay (h, w, 4) (none), jitter (two numbers, 0), attribution and
name (texts).

OpenEXR: the channels of CHANNELS, half or float, profile.ID half, float or uint. nonsss.* may be
left out, and so may those of PLANES. projection_x is the header's float attribute `projectionX`,
jitter its pair of doubles `jitter`, attribution its text attribute `attribution`.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.gbuffer import GBuffer
from kernels.scenes.camera import MAX_SIZE
from traces.errors import InputError
from traces.files import replacing, writing

# GBuffer field: the EXR channels that hold it, in order.
CHANNELS: dict[str, tuple[str, ...]] = {
    "irradiance": ("irradiance.R", "irradiance.G", "irradiance.B"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "non_subsurface": ("nonsss.R", "nonsss.G", "nonsss.B"),
    "depth_cm": ("depth.Z",),
    "normal": ("N.X", "N.Y", "N.Z"),
    "profile_id": ("profile.ID",),
}
OPTIONAL = ("non_subsurface",)
#: The same of the fields that are None where they are left out.
PLANES: dict[str, tuple[str, ...]] = {
    "importance": ("importance.Y",),
    "velocity": ("velocity.X", "velocity.Y"),
    "overlay": ("overlay.R", "overlay.G", "overlay.B", "overlay.A"),
}


def load_npz(path: str | Path, projection_x: float | None = None) -> GBuffer:
    """Read a `.npz` G-buffer. projection_x: replaces or supplies the file's.

    Raises InputError, one line with file and field: no such file, not an npz file, truncated, a
    pickled array, a missing field, a wrong shape or type, values that GBuffer refuses.
    """
    path = _existing(path)
    try:
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise InputError(f"{path}: one array; need an .npz file with an array per field")
            fields = {name: _member(path, archive, name) for name in archive.files}
    except (zipfile.BadZipFile, ValueError, EOFError, OSError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a readable .npz file: {_line(error)}") from None
    texts = {name: str(fields.pop(name, "")) for name in ("name", "attribution")}
    stored = fields.pop("projection_x", None)
    if stored is not None and (stored.size != 1 or stored.dtype.kind not in "fiu"):
        raise InputError(
            f"{path}: projection_x: {stored.dtype} of shape {stored.shape}: need one number"
        )
    number = float(stored.reshape(())) if stored is not None else None
    jitter = fields.pop("jitter", None)
    projection_x = number if projection_x is None else projection_x
    return _gbuffer(path, fields, projection_x, jitter, **texts)


def save_npz(path: str | Path, gbuffer: GBuffer) -> None:
    """Write all of a G-buffer, compressed; whole or not at all. Raises InputError or WorkError."""
    arrays: dict[str, Any] = _planes(gbuffer)
    texts: dict[str, Any] = {
        "name": np.array(gbuffer.name),
        "attribution": np.array(gbuffer.attribution),
    }
    numbers: dict[str, Any] = {
        "projection_x": np.float64(gbuffer.projection_x),
        "jitter": np.array(gbuffer.jitter, np.float64),
    }
    with replacing(path) as part, writing(path), part.open("wb") as file:
        np.savez_compressed(file, **arrays, **texts, **numbers)


def load_exr(path: str | Path, projection_x: float | None = None) -> GBuffer:
    """Read an OpenEXR G-buffer. projection_x: replaces or supplies the header's `projectionX`.

    Raises InputError, one line with file and channel: no such file, not OpenEXR, truncated, a
    missing channel, channels of different size, values that GBuffer refuses.
    """
    path = _existing(path)
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header, channels = dict(file.header()), file.channels()
            pixels = {name: channel.pixels for name, channel in channels.items()}
    # OpenEXR raises RuntimeError, and other kinds for headers that it half understands
    except Exception as error:
        raise InputError(f"{path}: not a readable OpenEXR file: {_line(error)}") from None
    fields: dict[str, npt.NDArray[Any]] = {}
    for field, names in (CHANNELS | PLANES).items():
        missing = [name for name in names if name not in pixels]
        may_miss = field in OPTIONAL or field in PLANES
        if missing and not (may_miss and len(missing) == len(names)):
            held = ", ".join(sorted(pixels)) or "none"
            raise InputError(
                f"{path}: channel {missing[0]} ({field}) is missing; the file holds {held}"
            )
        planes = [pixels[name] for name in names if name in pixels]
        if len({plane.shape for plane in planes}) > 1:
            raise InputError(f"{path}: channels {', '.join(names)} have different sizes")
        if planes:
            fields[field] = np.stack(planes, axis=-1) if len(names) > 1 else planes[0]
    ids = fields["profile_id"]
    if ids.dtype.kind == "f":
        if not (np.isfinite(ids).all() and (ids == np.rint(ids)).all() and np.abs(ids).max() < 1e9):
            raise InputError(f"{path}: profile.ID: need whole numbers from 0 to 255")
        fields["profile_id"] = ids.astype(np.int64)
    number = header.get("projectionX")
    attribution = str(header.get("attribution", ""))
    jitter = None if "jitter" not in header else np.asarray(header["jitter"])
    projection_x = number if projection_x is None else projection_x
    return _gbuffer(path, fields, projection_x, jitter, attribution=attribution, name="")


def save_exr(path: str | Path, gbuffer: GBuffer) -> None:
    """Write a G-buffer as 32-bit float channels (profile.ID uint), ZIP-compressed; whole or not at
    all.

    Raises InputError or WorkError.
    """
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "projectionX": float(gbuffer.projection_x),
        "attribution": gbuffer.attribution,
        "jitter": np.array(gbuffer.jitter, np.float64),
    }
    channels: dict[str, npt.NDArray[Any]] = {}
    for field, plane in _planes(gbuffer).items():
        planes = plane.reshape(gbuffer.height, gbuffer.width, -1)
        for index, name in enumerate((CHANNELS | PLANES)[field]):
            dtype = np.uint32 if field == "profile_id" else np.float32
            channels[name] = np.ascontiguousarray(planes[:, :, index], dtype=dtype)
    with replacing(path) as part, writing(path):
        try:
            OpenEXR.File(header, channels).write(str(part))
        except RuntimeError as error:
            raise OSError(_line(error)) from None


def _planes(gbuffer: GBuffer) -> dict[str, npt.NDArray[Any]]:
    """The arrays that a G-buffer has, by field."""
    planes = {name: getattr(gbuffer, name) for name in (*CHANNELS, *PLANES)}
    return {name: plane for name, plane in planes.items() if plane is not None}


def _gbuffer(
    path: Path,
    fields: dict[str, npt.NDArray[Any]],
    projection_x: float | None,
    jitter: npt.NDArray[Any] | None,
    name: str,
    attribution: str,
) -> GBuffer:
    """The checked G-buffer of a file's arrays."""
    missing = [field for field in CHANNELS if field not in fields and field not in OPTIONAL]
    if missing:
        raise InputError(
            f"{path}: field {missing[0]} is missing; the file holds {', '.join(sorted(fields))}"
        )
    if projection_x is None:
        raise InputError(
            f"{path}: projection_x is missing: need 1 / tan(fov_x / 2), in the file or as an option"
        )
    shape = fields["depth_cm"].shape
    if len(shape) == 2 and max(shape) > MAX_SIZE:
        raise InputError(
            f"{path}: depth_cm: {shape[1]}x{shape[0]}: at most {MAX_SIZE} pixels a side"
        )
    ids = fields["profile_id"]
    if ids.dtype.kind not in "iub" or (
        ids.size and not 0 <= int(ids.min()) <= int(ids.max()) <= 255
    ):
        raise InputError(f"{path}: profile_id: {ids.dtype}: need whole numbers from 0 to 255")
    if jitter is None:
        jitter = np.zeros(2)
    if jitter.shape != (2,) or jitter.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: jitter: {jitter.dtype} of shape {jitter.shape}: need two numbers"
        )
    planes: dict[str, Any] = {"profile_id": ids.astype(np.uint8)}
    for field in (*CHANNELS, *PLANES):
        if field == "profile_id" or (field in PLANES and field not in fields):
            continue
        value = fields.get(field, np.zeros((*shape, 3), np.float32))
        if value.dtype.kind not in "fiu":
            raise InputError(f"{path}: {field}: {value.dtype}: need numbers")
        # Values beyond float32 become infinite, which GBuffer refuses by name
        with np.errstate(over="ignore"):
            planes[field] = np.ascontiguousarray(value, dtype=np.float32)
    title = name or path.stem
    try:
        return GBuffer(
            name=title,
            projection_x=float(projection_x),
            attribution=attribution,
            jitter=(float(jitter[0]), float(jitter[1])),
            **planes,
        )
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{title}: ')}") from None


def _member(path: Path, archive: Any, name: str) -> npt.NDArray[Any]:
    try:
        value: npt.NDArray[Any] = archive[name]
    except ValueError as error:
        pickled = "allow_pickle" in str(error)
        reason = "a pickled array; only plain arrays are read" if pickled else _line(error)
        raise InputError(f"{path}: {name}: {reason}") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
        raise InputError(f"{path}: {name}: truncated or corrupt: {_line(error)}") from None
    if not isinstance(value, np.ndarray):
        raise InputError(f"{path}: {name}: not an array")
    return value


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    return path


def _line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
