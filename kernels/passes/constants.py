"""What one picture fixes for the passes that sample or filter: scales, densities, level ratios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.method import Method

_F = np.float32
#: The constant `a` of Eq 5.12, chosen by its author to damp the influence of the count.
MIP_DAMPING = 1.0 / 16.0


@dataclass(frozen=True)
class Constants:
    """Numbers that one picture fixes, as float32.

    texels_per_mm_at_cm: texels per mm at a depth of 1 cm. d: the sampled channel's profile scale,
    mm. rate, density: -1 / (3 d), 1/mm, and 1 / (4 d), 1/mm, of red, green, blue and the sampled
    channel. mip_scale: the mip rule's factor. ratio: (num_levels, 2), width and height of each
    level over those of level 0.
    """

    texels_per_mm_at_cm: np.float32
    d: np.float32
    rate: npt.NDArray[np.float32]
    density: npt.NDArray[np.float32]
    mip_scale: np.float32
    ratio: npt.NDArray[np.float32]

    @staticmethod
    def of(method: Method, width: int, height: int, projection_x: float) -> Constants:
        """The constants for a frame. projection_x: 1 / tan(fov_x / 2)."""
        profile = method.profile
        d = np.array([*profile.d_mm, profile.d_sampled_mm])
        # Facts sheet 2.5: UV per mm at depth z is 0.05 M / z, or M / (6 z) in the engine before its
        # correction.
        step = 0.05 if method.scale == "physical" else 1.0 / 6.0
        if method.mip_rule == "textbook":
            mip_scale = 1.0 / (2.0 * np.pi)
        else:
            # a / lmax^2 / t, t = (texels per mm)^2 / (width height).
            mip_scale = MIP_DAMPING * width * height / profile.dmfp_max_mm**2
        levels = range(resources.count_levels(width, height, method))
        ratio = [[_F(width >> k) / _F(width), _F(height >> k) / _F(height)] for k in levels]
        return Constants(
            _F(width * step * projection_x),
            _F(d[3]),
            (-1.0 / (3.0 * d)).astype(np.float32),
            (1.0 / (4.0 * d)).astype(np.float32),
            _F(mip_scale),
            np.array(ratio, np.float32),
        )
