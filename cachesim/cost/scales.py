"""How large a millimetre is on a recording's tiles, from how far their samples lie."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cachesim.cost.workload import TILE_SIDE, Floats, Optics

#: Share of a tile's samples whose distance tells the scale, and from which distance it does.
NEAR_SHARE = 0.25
_FAR_TEXELS = 8.0
_SCALES = np.geomspace(1e-3, 1e3, 481)


def find_scales(optics: Optics, tiles: Mapping[str, Any], width: int, height: int) -> Floats:
    """(n,) texels per mm: where samples lie far from their pixels, from the distance of the
    nearest of them, which the frame's edge does not clamp; else from the mean of distances
    between whole texels. Tiles too near the edge take the scale of the nearest that is not.
    """
    near = np.array([float(optics.radii(np.array(NEAR_SHARE), s)) for s in _SCALES])
    mean = np.array([_mean_between_texels(optics, s) for s in _SCALES])
    distance = tiles["distance"]
    is_far = distance[:, 1] > _FAR_TEXELS
    scale = np.where(
        is_far,
        np.interp(distance[:, 1], near, _SCALES),
        np.interp(distance[:, 0], mean, _SCALES),
    )
    x, y = (tiles[k] * TILE_SIDE + TILE_SIDE / 2 for k in "xy")
    room = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
    scatters = tiles["counts"].any(axis=1)
    clamped = scatters & (room < TILE_SIDE / 2 + np.where(is_far, 1.2 * distance[:, 1], 0.0))
    sound = np.flatnonzero(scatters & ~clamped)
    if len(sound):
        at = np.column_stack([x, y])
        nearest = cKDTree(at[sound]).query(at[clamped])[1]
        scale[clamped] = scale[sound[nearest]]
    found: Floats = scale
    return found


def _mean_between_texels(optics: Optics, texels_per_mm: float) -> float:
    """Mean distance of the samples' texels from their pixels, both whole numbers."""
    u = (np.arange(256) + 0.5) / 256
    angle = 2.0 * np.pi * (np.arange(256) * 0.6180339887498949 % 1.0)
    radius = optics.radii(u, texels_per_mm)
    x, y = (np.floor(0.5 + radius * turn) for turn in (np.cos(angle), np.sin(angle)))
    return float(np.hypot(x, y).mean())
