"""Paths: cameras, rigs and the strength of light as functions of the frame number.

Angles go through our own sine and cosine, so that every machine gets the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from kernels.maths.polynomial import poly_cos_sin
from kernels.scenes.camera import Camera, Vector
from kernels.scenes.light import Rig
from traces.errors import InputError, unknown

CameraPath = Callable[[int], Camera]
RigPath = Callable[[int], Rig]
#: A factor of the light by frame number, 0 or more.
Intensity = Callable[[int], float]


def still(camera: Camera) -> CameraPath:
    """A camera that rests."""
    return lambda frame: camera


def orbit(camera: Camera, degrees_per_frame: float) -> CameraPath:
    """A camera that circles its target around its up axis, to the right for positive angles.

    Raises InputError unless the angle is finite.
    """
    check_finite("orbit", "degrees_per_frame", degrees_per_frame)
    x, y, z = camera.up
    axis = np.array(camera.up, dtype=np.float64) / np.sqrt(x * x + y * y + z * z)
    arm = np.subtract(camera.position, camera.target, dtype=np.float64)

    def at(frame: int) -> Camera:
        turned = rotate(arm, axis, frame * degrees_per_frame)
        return _moved(camera, turned + camera.target)

    return at


def dolly(camera: Camera, cm_per_frame: float) -> CameraPath:
    """A camera that moves straight towards its target, or away for negative speeds.

    Raises InputError unless the speed is finite, and, for a frame, where the target is reached.
    """
    check_finite("dolly", "cm_per_frame", cm_per_frame)
    forward = camera.basis()[2]
    x, y, z = np.subtract(camera.target, camera.position, dtype=np.float64)
    distance = float(np.sqrt(x * x + y * y + z * z))

    def at(frame: int) -> Camera:
        if frame * cm_per_frame >= distance:
            raise InputError(f"dolly: frame {frame}: the target, {distance:g} cm ahead, is reached")
        return _moved(camera, camera.position + forward * (frame * cm_per_frame))

    return at


def swing(rig: Rig, light: str, degrees_per_frame: float) -> RigPath:
    """A rig one of whose lights circles around the vertical axis.

    Raises InputError: no light of that name, or an angle that is not finite.
    """
    check_finite("swing", "degrees_per_frame", degrees_per_frame)
    _find(rig, light)
    upright = np.array([0.0, 1.0, 0.0])

    def at(frame: int) -> Rig:
        return replace(
            rig,
            lights=tuple(
                replace(
                    each,
                    towards=_vector(
                        rotate(np.array(each.towards, float), upright, frame * degrees_per_frame)
                    ),
                )
                if each.name == light
                else each
                for each in rig.lights
            ),
        )

    return at


def switched(rig: Rig, light: str, intensity: Intensity) -> RigPath:
    """A rig one of whose lights is dimmed and brightened; `flash`, `pulse`.

    Raises InputError: no light of that name.
    """
    _find(rig, light)

    def at(frame: int) -> Rig:
        factor = intensity(frame)
        return replace(
            rig,
            lights=tuple(
                replace(each, irradiance=_vector(factor * np.array(each.irradiance)))
                if each.name == light
                else each
                for each in rig.lights
            ),
        )

    return at


def flash(off: int, on: int) -> Intensity:
    """A light that goes off in frame `off` and on again in frame `on`: 0 between them, else 1.

    Raises InputError unless 0 <= off < on.
    """
    if not 0 <= off < on:
        raise InputError(f"flash: off in frame {off}, on in frame {on}: need 0 <= off < on")
    return lambda frame: 0.0 if off <= frame < on else 1.0


def pulse(frame: int) -> float:
    """h(t) = 1 + 3 sin(t / 10), 0 where that is negative: the dynamic light of the control
    variates' supplementary, with t the frame.
    """
    _, sine = poly_cos_sin(_turn(frame * (18.0 / math.pi)))
    return max(0.0, 1.0 + 3.0 * float(sine[0]))


def rotate(
    vector: npt.NDArray[np.float64], axis: npt.NDArray[np.float64], degrees: float
) -> npt.NDArray[np.float64]:
    """A vector turned around a unit axis (Rodrigues), counter-clockwise seen from its tip; within
    1e-7 of its length, and the same bits on every machine.
    """
    cosine, sine = (float(value[0]) for value in poly_cos_sin(_turn(degrees)))
    along = float(axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2])
    turned: npt.NDArray[np.float64] = (
        vector * cosine + np.cross(axis, vector) * sine + axis * (along * (1 - cosine))
    )
    return turned


def _turn(degrees: float) -> npt.NDArray[np.uint32]:
    """(1,): the angle as a fraction of a turn in 32-bit fixed point."""
    return np.array([round(degrees / 360 * 2**32) % 2**32], np.uint32)


def _moved(camera: Camera, position: npt.NDArray[np.float64]) -> Camera:
    """The camera elsewhere; what is stated of its view does not hold there."""
    return replace(camera, position=_vector(position), coverage_rate=None, pixels_per_mm=None)


def _vector(values: npt.NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def check_finite(what: str, field_name: str, value: float) -> None:
    if not math.isfinite(value):
        raise InputError(f"{what}: {field_name} {value}: must be a finite number")


def _find(rig: Rig, light: str) -> None:
    names = [each.name for each in rig.lights]
    if light not in names:
        raise unknown("light", light, names, "rig")
