"""The sample points: Roberts' R2 sequence in fixed point, started at a hash of pixel and frame.

[R18] Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018; [JO20] Jarzynski and
Olano, Hash Functions for GPU Rendering, JCGT 9(3), 2020. Fixed point because a float32 fraction of
an index near 65 000 keeps only 8 bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[np.uint32]

#: (1 / phi, 1 / phi^2) x 2^32 for phi = 1.3247179572...; the second is truncated.
R2_STEPS = (0xC13FA9A9, 0x91E10DA5)
#: (multiplier, increment) of the hash's linear congruential step.
HASHES = {"jcgt": (12829, 47989), "unreal": (1664525, 1013904223)}


def r2(index: Any) -> tuple[Words, Words]:
    """The point of each index as two fractions of 2^32. `index`: integers, uint32 range."""
    m = np.asarray(index).astype(np.uint32)
    return m * np.uint32(R2_STEPS[0]), m * np.uint32(R2_STEPS[1])


def pcg3d16(x: Any, y: Any, z: Any, hash_name: str = "jcgt") -> tuple[Words, Words, Words]:
    """Three 16-bit hashes of three integers. [JO20]. `x`, `y`, `z`: broadcastable, uint32 range."""
    multiplier, increment = (np.uint32(v) for v in HASHES[hash_name])
    x, y, z = np.broadcast_arrays(*(np.atleast_1d(v).astype(np.uint32) for v in (x, y, z)))
    x, y, z = (v * multiplier + increment for v in (x, y, z))
    for _ in range(2):
        x = x + y * z
        y = y + z * x
        z = z + x * y
    return x >> np.uint32(16), y >> np.uint32(16), z >> np.uint32(16)
