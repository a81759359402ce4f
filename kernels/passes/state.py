"""What a pass's `arguments` takes from the pipeline, so that no pass knows the pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from kernels.method import Method
from kernels.passes.constants import Constants


class DeviceState(Protocol):
    """The device state of one method at one frame size, with a G-buffer loaded.

    buffers: device buffers by texture name, and "counts", "ratio" and "taps". num_levels: of the
    setup texture. constants, depth_falloff, has_velocity, has_overlay, jitter: of the G-buffer.
    """

    method: Method
    width: int
    height: int
    num_levels: int
    constants: Constants
    depth_falloff: np.float32
    has_velocity: np.int32
    has_overlay: np.int32
    jitter: tuple[float, float]

    @property
    def buffers(self) -> Mapping[str, Any]:
        """OpenCL buffers."""
