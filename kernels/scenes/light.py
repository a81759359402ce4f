"""Lights as data.

Distances do not matter: every light stands far off and is a disc as seen from the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from traces.errors import InputError

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Light:
    """A distant disc of light.

    name: key, fill, rim ...
    towards: direction from the scene to the light, world space (y up, the face looks along +z); any
    length.
    irradiance: linear RGB that a surface facing the light receives.
    radius: tangent of the disc's angular radius; half the width of a penumbra per distance to the
    edge that casts it.
    shadows: whether it casts any.
    """

    name: str
    towards: Vector
    irradiance: Vector
    radius: float
    shadows: bool = True

    def __post_init__(self) -> None:
        if not any(self.towards) or not np.isfinite(self.towards).all():
            raise InputError(
                f"light {self.name}: towards {self.towards}: must be a finite direction"
            )
        if not np.isfinite(self.irradiance).all() or min(self.irradiance) < 0:
            raise InputError(f"light {self.name}: irradiance {self.irradiance}: must be 0 or more")
        if not 0 < self.radius <= 1:
            raise InputError(
                f"light {self.name}: radius {self.radius}: must be above 0 and at most 1"
            )

    def direction(self) -> npt.NDArray[np.float64]:
        """Unit vector towards the light."""
        x, y, z = (float(value) for value in self.towards)
        unit: npt.NDArray[np.float64] = np.array([x, y, z]) / np.sqrt(x * x + y * y + z * z)
        return unit


@dataclass(frozen=True)
class Rig:
    """The lights of a scene.

    ambient: linear RGB that an unoccluded surface receives from all around.
    background: linear RGB of the empty frame, dark grey.
    """

    lights: tuple[Light, ...]
    ambient: Vector = (0.072, 0.078, 0.088)
    background: Vector = (0.012, 0.0125, 0.014)

    def as_array(self) -> npt.NDArray[np.float32]:
        """(n, 8) float32: direction, radius, irradiance, 1 where the light casts shadows."""
        rows = [
            (*light.direction(), light.radius, *light.irradiance, float(light.shadows))
            for light in self.lights
        ]
        return np.array(rows, dtype=np.float32).reshape(-1, 8)


# A portrait in one key: fully lit skin receives about 1, skin in the key's shadow 0.05 to 0.1. The
# key stands high to the head's left, so that the shadow of nose, brow and cheek has its soft edge
# in every view. Fixed before any time was taken: with it the adaptive count wanders in the penumbra
# and rests on even skin as the paper's plot shows (tests/test_scenes.py).
RIG = Rig(
    lights=(
        Light("key", (0.58, 0.58, 0.68), (0.98, 0.93, 0.86), 0.10),
        Light("fill", (-0.75, 0.15, 0.65), (0.045, 0.050, 0.060), 0.5, shadows=False),
        Light("rim", (-0.80, 0.35, -0.75), (0.50, 0.53, 0.60), 0.10),
    )
)
