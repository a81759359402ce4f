"""The history textures: where a pixel was in the previous frame, and what is known of it.

A texel holds mean count, depth, variance of the mean, and mean of the tracked scalar. The sliding
rule keeps the counts of the last frames beside it, a byte each, and the online control variate the
means and covariance of lighting and result (`kernels.passes.covariance`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kernels.grid import Grid
from kernels.method import MAX_PAST_FRAMES, Method

_F = np.float32
_BYTES_PER_WORD = 4
NUM_WORDS = MAX_PAST_FRAMES // _BYTES_PER_WORD


def names_of(texture: str, frame: int) -> tuple[str, str]:
    """(read, written): the two textures that swap between frames."""
    return f"{texture}_{(frame + 1) % 2}", f"{texture}_{frame % 2}"


def history_names(frame: int) -> tuple[str, str]:
    """(read, written): the history texture of the previous frame and of this one."""
    return names_of("history", frame)


def reproject(grid: Grid, textures: dict[str, Any], active: Any) -> tuple[Any, Any, Any]:
    """(x, y, whether on screen) of each lane's pixel in the previous frame; no movement for
    inactive lanes.
    """
    x, y = grid.lanes
    velocity = textures.get("velocity")
    moved: Any = np.zeros((*x.shape, 2), _F) if velocity is None else grid.gather(velocity)
    moved = np.where(active[..., None], moved, _F(0))
    past = [
        np.floor(np.clip(at.astype(_F) + _F(0.5) + moved[..., k], _F(-1), _F(32768))).astype(
            np.int32
        )
        for k, at in enumerate((x, y))
    ]
    on_screen = (past[0] >= 0) & (past[0] < grid.width) & (past[1] >= 0) & (past[1] < grid.height)
    return past[0], past[1], on_screen & active


def read_history(history: Any, x: Any, y: Any, on_screen: Any) -> Any:
    """(..., 4) float32 texels of a history texture; 0 off screen."""
    at = history[np.where(on_screen, y, 0), np.where(on_screen, x, 0)].astype(_F)
    return np.where(on_screen[..., None], at, _F(0))


def has_history(history: Any, depth: Any) -> Any:
    """Whether history texels belong to a surface at this depth: within a tenth of it."""
    near = np.abs(history[..., 1] - depth) <= _F(0.1) * depth
    return (history[..., 1] > 0) & near


def is_known(method: Method, history: Any, depth: Any, on_screen: Any) -> Any:
    """Whether pixels have a history that the method accepts, see `Method.disocclusion`."""
    if method.disocclusion == "none":
        return np.ones(on_screen.shape, np.bool_)
    if method.disocclusion == "offscreen":
        return on_screen
    return has_history(history, depth)


def read_past_counts(past_counts: Any, x: Any, y: Any, on_screen: Any) -> Any:
    """(..., 4) uint32: a byte per frame, the newest lowest in the first word; 0 off screen."""
    at = past_counts[np.where(on_screen, y, 0), np.where(on_screen, x, 0)]
    return np.where(on_screen[..., None], at, np.uint32(0))


def push_count(past: Any, count: Any, known: Any) -> Any:
    """(..., 4) uint32: past counts with this frame's before them; it alone where nothing is
    known.
    """
    count = count.astype(np.uint32)
    older = np.concatenate([count[..., None] << np.uint32(24), past[..., :-1]], axis=-1)
    shifted = past << np.uint32(8) | older >> np.uint32(24)
    alone = np.repeat((count * np.uint32(0x01010101))[..., None], NUM_WORDS, axis=-1)
    return np.where(known[..., None], shifted, alone)


def mask_of(num_frames: int) -> list[np.uint32]:
    """The bits of the newest counts, by word."""
    bits = (1 << 8 * num_frames) - 1
    return [np.uint32(bits >> 32 * word & 0xFFFFFFFF) for word in range(NUM_WORDS)]


def mean_of_past(past: Any, num_frames: int) -> Any:
    """float32 mean of the newest counts."""
    bytes_of = past[..., None] >> (np.arange(4, dtype=np.uint32) * np.uint32(8)) & np.uint32(255)
    newest = bytes_of.reshape(*past.shape[:-1], -1)[..., :num_frames]
    return newest.sum(axis=-1).astype(_F) / _F(num_frames)


def oldest_of_past(past: Any, num_frames: int) -> Any:
    """float32: the count of `num_frames` ago."""
    word, byte = divmod(num_frames - 1, _BYTES_PER_WORD)
    return (past[..., word] >> np.uint32(8 * byte) & np.uint32(255)).astype(_F)
