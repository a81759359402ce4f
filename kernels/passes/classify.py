"""Classify pass of the hybrid method: which tiles are sampled, filtered, passed through or empty.

Facts sheet 5 and 8: the slides' map of regions has no formula in any source, so that the rules are
ours. A tile is sampled where one of the method's rules holds: the mean estimated count of its
scattering pixels is above a threshold; the mean radius of the scatter at its nearest pixel, 2.5 d,
is above a number of pixels; its largest painted importance reaches a threshold. Otherwise it is
filtered. Where that radius is below `passthrough_px` the light stays where it is.

The estimate's reads of the history are traced here too, where its counts are asked for. Filtered
and passed-through pixels take part in the history, with their number of fetches as their count: a
filtered tile is free of noise, so that it stays filtered until its light changes, and is then
sampled again. Without history the paper's rule gives the largest count, so that all tiles begin
sampled; the engine's gives the least, so that they begin filtered.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kernels import resources
from kernels.access import Access
from kernels.grid import WARPS_PER_CTA, Grid
from kernels.method import Method
from kernels.passes.history import history_names, reproject
from kernels.passes.setup import texels
from kernels.tiles import EMPTY, PASSTHROUGH, SAMPLED, SEPARABLE, count_tiles
from traces.texture import INACTIVE_TEXEL, WARP_SIZE, pack_texel

if TYPE_CHECKING:
    from kernels.passes.constants import Constants
    from kernels.passes.state import DeviceState

_F = np.float32
#: Mean radius of Burley's profile over its scale d. Facts sheet 2.1.
MEAN_RADIUS = 2.5


def reads_history(method: Method) -> bool:
    """Whether the classes depend on counts that are estimated."""
    return method.adaptive and "count" in method.hybrid_rules


def radius_at_cm(method: Method, constants: Constants) -> np.float32:
    """Mean radius of the scatter in pixels at a depth of 1 cm."""
    return _F(MEAN_RADIUS * method.profile.d_sampled_mm * float(constants.texels_per_mm_at_cm))


def importance_code(method: Method) -> int:
    """The least importance, of 255, that has a tile sampled."""
    return math.ceil(255 * method.importance_threshold)


def accesses(method: Method, frame: int) -> tuple[Access, ...]:
    """The pass's accesses."""
    found = [Access("setup")]
    if reads_history(method):
        found += [
            Access("velocity", subsurface_only=True),
            Access(history_names(frame)[0], subsurface_only=True),
        ]
    if "painted" in method.hybrid_rules:
        found.append(Access("importance", subsurface_only=True))
    return (
        *found,
        Access("tile_class", "store"),
        Access("tex", "store"),
        Access("scattered", "store"),
    )


def arguments(state: DeviceState, level: int, frame: int) -> list[Any]:
    """The kernel's arguments between the warp's and the trace's."""
    names = ("setup", "counts", "velocity", "importance", "tile_class", "tex", "scattered")
    method = state.method
    return [
        *(state.buffers[name] for name in names),
        state.has_velocity,
        np.int32(method.num_samples),
        np.int32("count" in method.hybrid_rules),
        np.int32("radius" in method.hybrid_rules),
        _F(method.count_threshold),
        _F(method.radius_threshold_px),
        np.uint32(importance_code(method)),
        _F(method.passthrough_px),
        radius_at_cm(method, state.constants),
    ]


def reference(
    grid: Grid,
    textures: dict[str, Any],
    method: Method,
    constants: Constants,
    frame: int,
    counts: npt.NDArray[np.int32],
) -> list[npt.NDArray[np.uint32]]:
    """Write `tile_class`, and `tex` and `scattered` of some classes; the texels of each access.

    counts: (num_warps, 32) samples of each lane, 0 where nothing scatters.
    """
    texel = np.where(grid.inside[..., None], grid.gather(textures["setup"][0]), 0).astype(_F)
    scatters = texel[..., 3] > 0

    def per_tile(lanes: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return lanes.reshape(grid.num_ctas, WARPS_PER_CTA * WARP_SIZE)

    number = per_tile(scatters).sum(axis=1)
    total = per_tile(np.where(scatters, counts, 0)).sum(axis=1)
    nearest = per_tile(np.where(scatters, texel[..., 3], _F(np.inf))).min(axis=1)
    radius = radius_at_cm(method, constants) / nearest
    sampled = np.zeros(grid.num_ctas, np.bool_)
    if "count" in method.hybrid_rules:
        sampled |= total.astype(_F) > _F(method.count_threshold) * number.astype(_F)
    if "radius" in method.hybrid_rules:
        sampled |= radius > _F(method.radius_threshold_px)
    if "painted" in method.hybrid_rules:
        painted = np.where(scatters, grid.gather(textures["importance"]), 0)
        sampled |= per_tile(painted).max(axis=1) >= importance_code(method)
    small = radius < _F(method.passthrough_px)
    found = np.select([number == 0, small, sampled], [EMPTY, PASSTHROUGH, SAMPLED], SEPARABLE)

    tile_x, tile_y = grid.tiles & np.uint32(0xFFFF), grid.tiles >> np.uint32(16)
    across, down = count_tiles(grid.width, grid.height)
    textures["tile_class"] = np.zeros((down, across), np.uint8)
    textures["tile_class"][tile_y, tile_x] = found
    of_lane = np.repeat(found, WARPS_PER_CTA)[:, None]
    is_line = grid.inside & (of_lane != SEPARABLE)
    is_result = grid.inside & ((of_lane == EMPTY) | (of_lane == PASSTHROUGH))
    result = np.concatenate([texel[..., :3], scatters[..., None]], axis=-1).astype(_F)
    written = (
        ("tex", is_line, resources.to_setup(texel)),
        ("scattered", is_result, resources.to_half(result)),
    )
    for name, mask, value in written:
        before = grid.gather(textures[name])
        kept = np.where(mask[..., None], value, before)
        textures[name] = grid.scatter_into(textures[name], kept)

    first = np.zeros((grid.num_warps, WARP_SIZE), np.bool_)
    first[::WARPS_PER_CTA, 0] = True
    own_tile = np.repeat(pack_texel(0, tile_y, tile_x), WARPS_PER_CTA)[:, None]
    past_x, past_y, on_screen = reproject(grid, textures, scatters)
    lanes = {
        "setup": texels(grid, grid.inside),
        "velocity": texels(grid, scatters),
        "importance": texels(grid, scatters),
        "tile_class": np.where(first, own_tile, INACTIVE_TEXEL),
        "tex": texels(grid, is_line),
        "scattered": texels(grid, is_result),
        history_names(frame)[0]: np.where(on_screen, pack_texel(0, past_y, past_x), INACTIVE_TEXEL),
    }
    return [lanes[access.texture] for access in accesses(method, frame)]
