"""The traces that Accel-Sim was run on, made anew: lane addresses of scattered, streaming and
dependent loads, bit for bit those of the runs in `tests/oracles/accel-sim/results.csv`.

All images are RGBA16F, 8 bytes a texel, and begin at `BASE_ADDRESS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from traces.errors import unknown
from traces.lane_address import lane_address_trace
from traces.texture import WARP_SIZE
from traces.trace import Trace

BASE_ADDRESS = 0x7F40_0000_0000
#: From an image that is read to the one that is written.
_TARGET_OFFSET = 0x100_0000
_TEXEL_BYTES = 8
#: Pixels of a warp, across and down.
_WARP_TILE = (8, 4)
#: Burley's approximate inverse cumulative distribution, r = d ((2 - c) xi - 2) ln(1 - xi), whose
#: mean is about 2.5 d.
_BURLEY_C, _BURLEY_MEAN = 2.5715, 2.5

Integers = npt.NDArray[np.int64]
Reals = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LaneAddresses:
    """The fields of a lane-address file, as `traces.lane_address` describes them."""

    addresses: npt.NDArray[np.uint64]
    warps_per_cta: int = 8
    loads_in_flight: int = 4
    compute_per_load: int = 3
    bytes_per_lane: int = _TEXEL_BYTES
    stores: npt.NDArray[np.bool_] | None = None

    def trace(self, name: str) -> Trace:
        """The Trace, called `name`."""
        return lane_address_trace(**vars(self), name=name)


def oracle_trace(name: str) -> Trace:
    """One of `ORACLE_TRACES`. Raises: InputError: an unknown name."""
    if name not in ORACLE_TRACES:
        raise unknown("oracle trace", name, ORACLE_TRACES)
    return ORACLE_TRACES[name]().trace(name)


def _with_zeros_between(value: Integers) -> npt.NDArray[np.uint64]:
    """Bit k of the 16-bit values moved to bit 2 k."""
    spread = value.astype(np.uint64)
    for shift, kept in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(kept)
    return spread


def _texel_address(x: Integers, y: Integers, width: int, layout: str) -> npt.NDArray[np.uint64]:
    """Byte addresses of texels in an image whose rows are stored one after the other ("linear") or
    in Morton order.
    """
    if layout == "morton":
        index = _with_zeros_between(x) | _with_zeros_between(y) << np.uint64(1)
    else:
        index = (y * width + x).astype(np.uint64)
    return index * np.uint64(_TEXEL_BYTES) + np.uint64(BASE_ADDRESS)


def _pixels(width: int, height: int, block: tuple[int, int]) -> tuple[Integers, Integers]:
    """(warps, 32) x and y of every lane's pixel: blocks of the image, warps of a block and lanes of
    a warp, each in rows.
    """
    sides = (
        (height // block[1], block[1]),
        (width // block[0], block[0]),
        (block[1] // _WARP_TILE[1], _WARP_TILE[1]),
        (block[0] // _WARP_TILE[0], _WARP_TILE[0]),
        (_WARP_TILE[1], 1),
        (_WARP_TILE[0], 1),
    )
    steps = np.indices([count for count, _ in sides]).reshape(6, -1, WARP_SIZE)
    across, down = (
        sum(steps[axis] * sides[axis][1] for axis in axes) for axes in ((1, 3, 5), (0, 2, 4))
    )
    return np.asarray(across), np.asarray(down)


def _around(pixel: Integers, offset: Reals, side: int) -> Integers:
    """(warps, samples, 32) nearest texels at `offset` from each pixel, clamped to the image."""
    at = np.clip(np.rint(pixel[:, None, :] + offset), 0, side - 1)
    return at.astype(np.int64)


def _warps_of(block: tuple[int, int]) -> int:
    return block[0] * block[1] // WARP_SIZE


def gauss(
    radius: float, layout: str, *, is_shared: bool = False, loads_in_flight: int = 4
) -> LaneAddresses:
    """16 fetches, normally distributed with sigma = radius / 2 texels, around each pixel of a
    256x256 image. is_shared: every pixel has the same offsets.
    """
    size, num_samples = 256, 16
    x, y = _pixels(size, size, (16, 16))
    shape = (1, num_samples, 1, 2) if is_shared else (len(x), num_samples, WARP_SIZE, 2)
    offset = np.random.default_rng(1).normal(0, radius / 2, shape)
    return LaneAddresses(
        _texel_address(
            _around(x, offset[..., 0], size), _around(y, offset[..., 1], size), size, layout
        ),
        loads_in_flight=loads_in_flight,
    )


def stream() -> LaneAddresses:
    """Every lane of 2048 warps reads 16 times 8 bytes of its own: no reuse."""
    index = np.arange(16 * 2048 * WARP_SIZE, dtype=np.uint64).reshape(16, 2048, WARP_SIZE)
    addresses = np.uint64(BASE_ADDRESS) + index * np.uint64(_TEXEL_BYTES)
    return LaneAddresses(np.ascontiguousarray(addresses.transpose(1, 0, 2)))


def chase() -> LaneAddresses:
    """One warp loads 256 contiguous bytes, one load at a time, each from a fresh 4 KiB page."""
    load, lane = np.arange(16)[:, None] * 4096, np.arange(WARP_SIZE) * _TEXEL_BYTES
    addresses = (BASE_ADDRESS + load + lane).astype(np.uint64)[None]
    return LaneAddresses(addresses, warps_per_cta=1, loads_in_flight=1)


def empty() -> LaneAddresses:
    """2048 warps without any access: what a launch costs."""
    return LaneAddresses(np.zeros((2048, 0, WARP_SIZE), np.uint64))


def latency(step_bytes: int) -> LaneAddresses:
    """One lane of one warp, 64 loads, one at a time, one FMA each: the unloaded latency of a
    level.
    """
    addresses = np.zeros((1, 64, WARP_SIZE), np.uint64)
    addresses[0, :, 0] = BASE_ADDRESS + np.arange(64) * step_bytes
    return LaneAddresses(addresses, warps_per_cta=1, loads_in_flight=1, compute_per_load=1)


def l1_throughput() -> LaneAddresses:
    """8 warps, each 64 loads of one sector of each of the same 32 lines: sectors per cycle out of
    the L1.
    """
    line = BASE_ADDRESS + np.arange(WARP_SIZE) * 128
    addresses = np.broadcast_to(line.astype(np.uint64), (8, 64, WARP_SIZE))
    return LaneAddresses(addresses.copy(), compute_per_load=1)


def burley(
    block: tuple[int, int],
    num_samples: int,
    mean_texels: float,
    loads_in_flight: int,
    compute_per_load: int,
    seed: int,
) -> LaneAddresses:
    """Fetches at radii of Burley's profile with a mean of about `mean_texels`, around each pixel of
    a 256x128 image in Morton order.
    """
    width, height = 256, 128
    x, y = _pixels(width, height, block)
    xi, turn = np.random.default_rng(seed).random((2, len(x), num_samples, WARP_SIZE))
    radius = mean_texels / _BURLEY_MEAN * ((2 - _BURLEY_C) * xi - 2) * np.log1p(-xi)
    angle = 2 * np.pi * turn
    return LaneAddresses(
        _texel_address(
            _around(x, radius * np.cos(angle), width),
            _around(y, radius * np.sin(angle), height),
            width,
            "morton",
        ),
        _warps_of(block),
        loads_in_flight,
        compute_per_load,
    )


def far(radius: float, layout: str, seed: int) -> LaneAddresses:
    """8 widely scattered fetches from every 32nd warp of a 2048x1024 image: a footprint far over
    an L2 of 3 MiB.
    """
    width, height = 2048, 1024
    x, y = (pixel[::32] for pixel in _pixels(width, height, (8, 8)))
    dx, dy = np.random.default_rng(seed).normal(0, radius / 2, (2, len(x), 8, WARP_SIZE))
    return LaneAddresses(
        _texel_address(_around(x, dx, width), _around(y, dy, height), width, layout)
    )


def blur_and_store(radius: float, layout: str, seed: int) -> LaneAddresses:
    """7 scattered fetches around each pixel of a 512x256 image, then its store to another image."""
    width, height, num_samples = 512, 256, 7
    x, y = _pixels(width, height, (16, 16))
    dx, dy = np.random.default_rng(seed).normal(0, radius / 2, (2, len(x), num_samples, WARP_SIZE))
    reads = _texel_address(_around(x, dx, width), _around(y, dy, height), width, layout)
    writes = _texel_address(x, y, width, layout)[:, None] + np.uint64(_TARGET_OFFSET)
    stores = np.arange(num_samples + 1) == num_samples
    return LaneAddresses(np.concatenate([reads, writes], axis=1), stores=stores)


def _gauss_traces() -> dict[str, Callable[[], LaneAddresses]]:
    def make(radius: int, layout: str) -> Callable[[], LaneAddresses]:
        return lambda: gauss(radius, layout)

    return {
        f"g{radius}_{layout}": make(radius, layout)
        for radius in (8, 32, 128)
        for layout in ("linear", "morton")
    }


#: Name, as in `results.csv`, -> what makes it.
ORACLE_TRACES: Mapping[str, Callable[[], LaneAddresses]] = {
    **_gauss_traces(),
    "g32_morton_shared": lambda: gauss(32, "morton", is_shared=True),
    "g32_morton_u16": lambda: gauss(32, "morton", loads_in_flight=16),
    "stream": stream,
    "chase": chase,
    "empty": empty,
    "latency_l1": lambda: latency(0),
    "latency_dram": lambda: latency(4096),
    "l1_throughput": l1_throughput,
    "burley10_64threads": lambda: burley((8, 8), 32, 10.0, 1, 12, 3),
    "burley30_256threads": lambda: burley((16, 16), 16, 30.0, 4, 30, 4),
    "far200_morton": lambda: far(200, "morton", 5),
    "blur16_store": lambda: blur_and_store(16, "morton", 6),
}

__all__ = ["ORACLE_TRACES", "LaneAddresses", "oracle_trace"]
