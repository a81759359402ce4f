"""Traces made from a formula instead of a recording: for tests, benchmarks and the guide.

All but `stream` work on 8x8 tiles in raster order, one tile per CTA, two warps of 8x4 pixels each,
lanes row-major; pixels beyond the edge are inactive. They make their chunks anew at every pass over
the trace, from a seed, a row of tiles at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.texture import INACTIVE_TEXEL, WARP_SIZE, Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, Trace

WARPS_PER_TILE = 2
_TILE = 8
_BASE_ADDRESS = 0x7F40_0000_0000
_CTAS_PER_CHUNK = 256
#: Burley's approximate inverse cumulative distribution, r = d ((2 - c) xi - 2) ln(1 - xi).
_BURLEY_C = 2.5715
#: The engine's default skin profile: d and the largest diffuse mean free path.
_SKIN_D_MM, _SKIN_MEAN_FREE_PATH_MM = 1.8, 26.748

Pixels = npt.NDArray[np.int64]
#: rows(x, y, inside, random) -> (warps, rows, 32) uint32 packed texels of a row of tiles, from
#: (warps, 32) pixels.
Rows = Callable[
    [Pixels, Pixels, npt.NDArray[np.bool_], np.random.Generator], npt.NDArray[np.uint32]
]


def stream(
    num_warps: int, loads_per_warp: int = 16, bytes_per_lane: int = 8, warps_per_cta: int = 8
) -> Trace:
    """A lane-address trace in which every lane reads its own bytes once: load i of all warps is one
    contiguous run.

    num_warps: a multiple of warps_per_cta. bytes_per_lane: 1, 2, 4, 8 or 16.
    """
    num_ctas = num_warps // warps_per_cta

    def chunks() -> Iterator[Chunk]:
        for first in range(0, num_ctas, _CTAS_PER_CHUNK):
            num = min(_CTAS_PER_CHUNK, num_ctas - first) * warps_per_cta
            warp = first * warps_per_cta + np.arange(num)[:, None, None]
            load = np.arange(loads_per_warp)[None, :, None]
            lane = np.arange(WARP_SIZE)
            address = (
                _BASE_ADDRESS + ((load * num_warps + warp) * WARP_SIZE + lane) * bytes_per_lane
            )
            yield _chunk(0, first, address.astype(np.uint64), np.zeros(loads_per_warp, np.uint16))

    instruction = Instruction("import", -1, access_bytes=bytes_per_lane)
    launch = Launch(0, "import", num_ctas, warps_per_cta)
    return Trace({"scene": "stream"}, (), [instruction], [launch], chunks)


def pixel_pass(texture: Texture, operation: str = "load", mip: int = 0) -> Trace:
    """Each lane accesses its own texel of one level: a copy's loads, or its stores."""

    def rows(x: Pixels, y: Pixels, inside: Any, _: np.random.Generator) -> npt.NDArray[np.uint32]:
        return np.where(inside, pack_texel(mip, y, x), INACTIVE_TEXEL)[:, None, :]

    instruction = Instruction("copy", 0, operation)
    return _tiled("pixel pass", [texture], [instruction], [0], texture.mip_size(mip), 0, rows)


def gather(texture: Texture, radius_texels: int, num_samples: int, seed: int = 0) -> Trace:
    """Each lane loads `num_samples` texels of mip 0, uniform in the square of +- `radius_texels`
    around its own, clamped.
    """

    def rows(
        x: Pixels, y: Pixels, inside: Any, random: np.random.Generator
    ) -> npt.NDArray[np.uint32]:
        shape = (2, len(x), num_samples, WARP_SIZE)
        dx, dy = random.integers(-radius_texels, radius_texels, shape, endpoint=True)
        at_x = np.clip(x[:, None] + dx, 0, texture.width - 1)
        at_y = np.clip(y[:, None] + dy, 0, texture.height - 1)
        return np.where(inside[:, None], pack_texel(0, at_y, at_x), INACTIVE_TEXEL)

    program = [0] * num_samples
    size = texture.width, texture.height
    return _tiled("gather", [texture], [Instruction("gather", 0)], program, size, seed, rows)


def scatter(
    width: int,
    height: int,
    pixels_per_mm: float,
    num_samples: int,
    *,
    adaptive: bool = False,
    seed: int = 0,
    frames: int = 1,
) -> Trace:
    """What the sampling pass looks like: a centre fetch, then per sample colour at mip l, normal
    and profile id at mip 0.

    Radii follow Burley's profile of skin, angles are uniform, and l is the dissertation's Eq 5.12.
    It shares no code with the recorder and no bits with any recording.

    adaptive: lanes stop after a random count from 1 to `num_samples`, alike in a warp but not
        equal.
    """
    colour = Texture("setup", "RGBA16F", width, height, 6)
    planes = [
        colour,
        Texture("normal", "RGBA8", width, height),
        Texture("profile id", "R8", width, height),
    ]

    def rows(
        x: Pixels, y: Pixels, inside: Any, random: np.random.Generator
    ) -> npt.NDArray[np.uint32]:
        shape = (len(x), num_samples, WARP_SIZE)
        xi, turn = random.random((2, *shape))
        count = np.full((len(x), 1, 1), num_samples)
        if adaptive:
            spread = random.integers(-2, 3, (len(x), 1, WARP_SIZE))
            count = np.clip(random.integers(1, num_samples + 1, (len(x), 1, 1)) + spread, 1, None)
        mip = _mip(xi, count, pixels_per_mm)
        radius = pixels_per_mm * _SKIN_D_MM * ((2 - _BURLEY_C) * xi - 2) * np.log1p(-xi)
        u = np.clip((x[:, None] + 0.5 + radius * np.cos(2 * np.pi * turn)) / width, 0, 1 - 1e-7)
        v = np.clip((y[:, None] + 0.5 + radius * np.sin(2 * np.pi * turn)) / height, 0, 1 - 1e-7)
        fine = pack_texel(0, np.floor(v * height), np.floor(u * width))
        level_width, level_height = np.maximum(1, width >> mip), np.maximum(1, height >> mip)
        coarse = pack_texel(mip, np.floor(v * level_height), np.floor(u * level_width))
        # Lanes that are done, or have no pixel, fetch nothing.
        takes = inside[:, None] & (np.arange(num_samples)[:, None] < count)
        samples = np.stack([coarse, fine, fine], axis=2)
        samples[~np.broadcast_to(takes[:, :, None], samples.shape)] = INACTIVE_TEXEL
        centre = np.where(inside, pack_texel(0, y, x), INACTIVE_TEXEL)
        return np.concatenate([centre[:, None], samples.reshape(len(x), -1, WARP_SIZE)], axis=1)

    instructions = [Instruction("sampling", t, arithmetic=(("fp32", 20),)) for t in range(3)]
    program = [0] + [0, 1, 2] * num_samples
    return _tiled("scatter", planes, instructions, program, (width, height), seed, rows, frames)


def _mip(xi: npt.NDArray[np.float64], count: Pixels, pixels_per_mm: float) -> Pixels:
    """Eq 5.12 with a = 1/16 and p = Burley's radial density in 1/mm at the radius of `xi`; rounded
    up, clamped to 0..5.
    """
    r = ((2 - _BURLEY_C) * xi - 2) * np.log1p(-xi)
    density = (np.exp(-r) + np.exp(-r / 3)) / (4 * _SKIN_D_MM)
    # t, the UV area of a square mm, is that of a 1080p frame whatever the trace's size, so that
    # small traces look like large ones.
    t = pixels_per_mm**2 / (1920 * 1080)
    level = -0.5 * np.log2(density * count / (16 * _SKIN_MEAN_FREE_PATH_MM**2 * t))
    return np.clip(np.ceil(level), 0, 5).astype(np.int64)


def _tiled(
    scene: str,
    textures: Sequence[Texture],
    instructions: Sequence[Instruction],
    program: Sequence[int],
    size: tuple[int, int],
    seed: int,
    rows: Rows,
    frames: int = 1,
) -> Trace:
    """A trace of one launch per frame. program: the instruction of each row of a warp. Warps' fully
    inactive rows are left out.
    """
    width, height = size
    across, down = -(-width // _TILE), -(-height // _TILE)
    launches = [
        Launch(frame, instructions[0].pass_name, across * down, WARPS_PER_TILE)
        for frame in range(frames)
    ]

    def chunks() -> Iterator[Chunk]:
        random = np.random.default_rng(seed)
        lane = np.arange(WARP_SIZE)
        warp = np.arange(across * WARPS_PER_TILE)[:, None]
        x = warp // WARPS_PER_TILE * _TILE + lane % _TILE
        for frame in range(frames):
            for tile_y in range(down):
                y = tile_y * _TILE + warp % WARPS_PER_TILE * (_TILE // 2) + lane // _TILE
                inside = (x < width) & (y < height)
                made = rows(x, y, inside, random)
                yield _chunk(frame, tile_y * across, made, np.array(program, np.uint16))

    return Trace(
        {"scene": scene, "seed": seed}, list(textures), list(instructions), launches, chunks
    )


def _chunk(
    launch: int, first_cta: int, lanes: npt.NDArray[Any], program: npt.NDArray[np.uint16]
) -> Chunk:
    """The chunk of (warps, rows, 32) lanes in which every warp runs the same program; rows without
    an active lane are left out.
    """
    num_warps, num_rows, _ = lanes.shape
    instruction = np.tile(program, num_warps)
    kept = np.ones((num_warps, num_rows), bool)
    if lanes.dtype == np.uint32:
        kept = (lanes != INACTIVE_TEXEL).any(axis=2)
    offsets = np.zeros(num_warps + 1, np.int64)
    offsets[1:] = np.cumsum(kept.sum(axis=1))
    flat = kept.ravel()
    return Chunk(launch, first_cta, offsets, instruction[flat], lanes.reshape(-1, WARP_SIZE)[flat])
