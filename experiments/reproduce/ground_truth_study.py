"""What `ground-truth` has of one scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from kernels.gbuffer import GBuffer


@dataclass(frozen=True, eq=False)
class Study:
    """One scene. dense: (h, w, 3) float32 scattered light. shown: the same of the methods."""

    name: str
    gbuffer: GBuffer
    dense: npt.NDArray[np.float32]
    shown: dict[str, npt.NDArray[np.float32]]
