"""What the cost function is told of a frame: which tiles scatter, how many samples each takes, how
large a millimetre is there, and what every pass reads and writes.

The same description comes from two sides. `measure_workload` reads it off a recording: the counts
and the warps' steps exactly, the scale from how far the samples lie from their pixels. A prediction
makes it from a scene's G-buffer and the estimator's counts (`experiments.cost_frames`), with no
recording at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from traces.errors import InputError
from traces.texture import WARP_SIZE, Texture

TILE_SIDE = 8
#: Facts sheet 2.3: the constant of the approximate inverse cdf.
APPROXIMATE_C = 2.5715
#: The constant `a` of Eq 5.12, facts sheet 2.6.
MIP_DAMPING = 1.0 / 16.0
MIP_RULES = ("eq-5.12", "textbook", "mip0")
MAX_LEVEL = 5
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Optics:
    """How a sample's distance d_j and mip follow from its place in the sequence.

    d_mm: profile scale of the sampled channel. dmfp_mm: the largest diffuse mean free path.
    centre_reweighting: no sample lands within its own pixel's radius. mip_rule: of `MIP_RULES`.
    num_levels: of the pre-filtered texture.
    """

    d_mm: float
    dmfp_mm: float
    centre_reweighting: bool
    mip_rule: str
    num_levels: int

    @staticmethod
    def of_method(method: Mapping[str, Any], num_levels: int, where: str = "method") -> Optics:
        """From a method's settings as a manifest holds them.

        Raises:
            InputError: a setting is missing or no number.
        """
        try:
            profile = method["profile"]
            lengths = [float(v) for v in profile["dmfp_mm"]]
            widest = int(np.argmax(lengths))
            albedo = float(profile["albedo"][widest])
            rule = str(method["mip_rule"]) if method["prefilter"] else "mip0"
            centre = bool(method["centre_reweighting"])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{where}: needs profile, mip_rule, prefilter and centre_reweighting ({error})"
            ) from None
        if rule not in MIP_RULES or not all(0 < v < 1e6 for v in lengths):
            raise InputError(f"{where}: mip_rule {rule!r}, dmfp_mm {lengths}: not a known method")
        # Facts sheet 2.2, the fit over the diffuse mean free path.
        shape = 3.5 + 100.0 * (albedo - 0.33) ** 4
        return Optics(lengths[widest] / shape, lengths[widest], centre, rule, num_levels)

    def radii(self, u: Floats, texels_per_mm: float) -> Floats:
        """Distances d_j in texels for u in [0, 1). Facts sheet 2.3 and 2.7."""
        start = 0.0
        if self.centre_reweighting:
            reach = 1.0 / (texels_per_mm * self.d_mm)
            start = 1.0 - 0.25 * np.exp(-reach) - 0.75 * np.exp(-reach / 3.0)
        xi = np.minimum(start + u * (1.0 - start), 1.0 - 2.0**-24)
        radius: Floats = self.d_mm * ((2.0 - APPROXIMATE_C) * xi - 2.0) * np.log1p(-xi)
        return radius * texels_per_mm

    def levels(
        self, radius: Floats, count: float, texels_per_mm: float, width: int, height: int
    ) -> Ints:
        """Mip level of samples at these distances, texels. Eq 5.12, facts sheet 2.6.

        count: samples of the pixel. width, height: texels of the frame.
        """
        if self.mip_rule == "mip0" or self.num_levels == 1:
            return np.zeros(radius.shape, np.int64)
        r = np.maximum(radius / texels_per_mm, 1e-5)
        density = (np.exp(-r / self.d_mm) + np.exp(-r / (3.0 * self.d_mm))) / (4.0 * self.d_mm)
        density = np.maximum(density, 1e-5) * count / texels_per_mm**2
        if self.mip_rule == "textbook":
            q = density / (2.0 * np.pi) / r
        else:
            q = density * MIP_DAMPING * width * height / self.dmfp_mm**2
        finer = sum((q < 4.0**-k).astype(np.int64) for k in range(MAX_LEVEL))
        return np.minimum(finer, self.num_levels - 1)


@dataclass(frozen=True)
class Read:
    """A texture that every sample (or tap) reads once. follows_mip: at the sample's level; else at
    full resolution.
    """

    texture: str
    texel_bytes: int
    follows_mip: bool
    bilinear: bool = False


@dataclass(frozen=True, eq=False)
class Scatter:
    """A launch whose pixels read around themselves.

    pass_name: "sampling", "pilot", "separable_h" or "separable_v". direction: "around", or "x" or
    "y" of a filter along a line. tile_x, tile_y: (n,), in the order of the CTAs, empty tiles
    included. counts: (n, 64) m' of each pixel, row by row; 0 where it does not scatter. A filter's
    taps beyond the frame are counted here, and not in `num_samples`, since it does not read there.
    texels_per_mm: (n,), 0 where nothing scatters. reads: of each sample, in order. taps_mm:
    distances of a filter's taps, in order; () for sampling. launch: its number in the frame.
    """

    pass_name: str
    direction: str
    tile_x: Ints
    tile_y: Ints
    counts: Ints
    texels_per_mm: Floats
    reads: tuple[Read, ...]
    taps_mm: tuple[float, ...]
    launch: int
    num_samples: int

    @cached_property
    def pixels(self) -> Ints:
        """(n,) pixels that scatter."""
        found: Ints = np.count_nonzero(self.counts, axis=1)
        return found

    @cached_property
    def samples(self) -> Ints:
        """(n,) samples of all pixels of a tile."""
        found: Ints = self.counts.sum(axis=1, dtype=np.int64)
        return found

    @cached_property
    def steps(self) -> Ints:
        """(n,) turns of the loop, summed over the tile's warps."""
        by_warp = self.counts.reshape(len(self.counts), -1, WARP_SIZE).max(axis=2, initial=0)
        found: Ints = by_warp.sum(axis=1, dtype=np.int64)
        return found


@dataclass(frozen=True)
class Sweep:
    """An access that goes over the frame pixel by pixel, each lane at its own.

    texel_bytes: of the texture. mip, width, height: of the level. operation, bilinear: as in
    `Instruction`. rows, lane_fetches: warp instructions and active lanes. launch: its number.
    """

    pass_name: str
    texture: str
    texel_bytes: int
    mip: int
    width: int
    height: int
    operation: str
    bilinear: bool
    rows: int
    lane_fetches: int
    launch: int


@dataclass(frozen=True)
class LaunchWork:
    """One kernel launch. launch: its number. instructions: warp instructions, accesses included.
    accesses: warp accesses.
    """

    launch: int
    pass_name: str
    num_ctas: int
    warps_per_cta: int
    registers_per_thread: int
    shared_bytes_per_cta: int
    instructions: int
    accesses: int


@dataclass(frozen=True, eq=False)
class Workload:
    """A frame as the cost function sees it. name: for messages and tables. textures: all that it
    reads or writes, in the order in which they lie in memory.
    """

    name: str
    width: int
    height: int
    optics: Optics
    textures: tuple[Texture, ...]
    scatters: tuple[Scatter, ...]
    sweeps: tuple[Sweep, ...]
    launches: tuple[LaunchWork, ...]

    @property
    def lane_fetches(self) -> int:
        """Texel fetches of all lanes."""
        scattered = sum(s.num_samples * len(s.reads) for s in self.scatters)
        return scattered + sum(s.lane_fetches for s in self.sweeps)

    @property
    def num_samples(self) -> int:
        """Samples n of the proportional baseline: those of all pixels, and the filters' taps."""
        return sum(s.num_samples for s in self.scatters)


def taps_mm(method: Mapping[str, Any]) -> tuple[float, ...]:
    """Distances of the separable filter's taps but the centre's, mm. Facts sheet 5."""
    num, burley = int(method["num_taps"]), method["separable_profile"] == "burley"
    reach = 3.0 if num > 20 else 2.0
    even = (2.0 * np.arange(num) - (num - 1)) / (num - 1)
    unit = max(max(method["profile"]["dmfp_mm"]) / 2.229, 1.0) if burley else 1.0
    offsets = reach * even * np.abs(even) * unit
    return tuple(float(o) for o in offsets if o)
