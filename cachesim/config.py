"""GPU configuration: what the models need of a machine, checked once and immutable after.

Sizes are integers in bytes here; TOML files and overrides may write "48 KiB" (`cachesim.units`). A
preset file gives every field as `{ value, source, confidence }`; `cachesim.presets` keeps the
sources beside the values.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from cachesim.timing_config import (
    CacheTiming,
    DramTiming,
    Icnt,
    L1TextureTiming,
    L1Timing,
    L2Timing,
    SmTiming,
)
from cachesim.units import parse_size

#: Bounds keep addresses, and the models' tables, within what a machine can hold.
MAX_BYTES = 1 << 40
MAX_COUNT = 1 << 40
MAX_INSTANCES = 4096
MAX_LINES = 1 << 27


def _whole_number(value: Any) -> Any:
    """Refuse `true` where a number belongs; pydantic would read it as 1."""
    if isinstance(value, bool):
        raise ValueError(f"{value!r} is not a whole number")
    return value


Bytes = Annotated[int, BeforeValidator(parse_size), Field(gt=0, le=MAX_BYTES)]
Count = Annotated[int, BeforeValidator(_whole_number), Field(gt=0, le=MAX_COUNT)]
Instances = Annotated[int, BeforeValidator(_whole_number), Field(gt=0, le=MAX_INSTANCES)]

Replacement = Literal["lru", "fifo", "tree-plru", "random", "srrip"]
SetHash = Literal["linear", "xor", "fermi", "ipoly"]
PartitionHash = Literal["linear", "xor", "ipoly", "random"]
WritePolicy = Literal["read-only", "write-through", "write-back", "write-evict", "local-write-back"]
WriteAllocate = Literal["none", "write-allocate", "fetch-on-write", "lazy-fetch-on-read"]
FetchPath = Literal["texture", "readonly", "global"]
MAX_SECTORS_PER_LINE = 8
MAX_LINE_BYTES = 4096
MAX_IPOLY_SLICES = 256


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CacheLevel(_Model):
    """One level of cache: the geometry and rules of each of its instances.

    capacity: bytes of one cache unit (of all slices together for a sliced level); changing it
        scales the number of sets at fixed ways.
    line_bytes: tag granule. sector_bytes: fill granule. ways: associativity.
    write_policy, write_allocate: facts sheet section 3.2's `wr` and `wralloc`. "read-only" levels
        are bypassed by stores; "local-write-back" is write-back for local and write-evict for
        global accesses (a texel store is global).
    """

    capacity: Bytes
    line_bytes: Bytes
    sector_bytes: Bytes
    ways: Count
    replacement: Replacement
    set_hash: SetHash
    write_policy: WritePolicy
    write_allocate: WriteAllocate

    @property
    def num_instances_in_capacity(self) -> int:
        """How many cache instances share `capacity`: 1, or the number of slices."""
        return 1

    @property
    def num_sets(self) -> int:
        """Sets of one instance (unit or slice)."""
        return self.capacity // (self.num_instances_in_capacity * self.line_bytes * self.ways)

    @property
    def sectors_per_line(self) -> int:
        return self.line_bytes // self.sector_bytes

    @model_validator(mode="after")
    def _geometry_fits(self) -> Self:
        for field in ("line_bytes", "sector_bytes"):
            value = getattr(self, field)
            if value & (value - 1) or not 16 <= value <= MAX_LINE_BYTES:
                # A texel has up to 16 bytes; smaller sectors would split it.
                raise ValueError(
                    f"{field} = {value}: allowed are powers of two from 16 to {MAX_LINE_BYTES}"
                )
        if self.line_bytes % self.sector_bytes:
            raise ValueError(
                f"sector_bytes = {self.sector_bytes} does not divide line_bytes = {self.line_bytes}"
            )
        if self.sectors_per_line > MAX_SECTORS_PER_LINE:
            raise ValueError(
                f"sector_bytes = {self.sector_bytes} makes {self.sectors_per_line} sectors per "
                f"line; allowed are up to {MAX_SECTORS_PER_LINE}"
            )
        way_bytes = self.num_instances_in_capacity * self.line_bytes * self.ways
        if self.capacity % way_bytes:
            raise ValueError(
                f"capacity = {self.capacity} B is not a multiple of instances x ways x "
                f"line_bytes = {way_bytes} B"
            )
        if self.ways > 32767 or self.num_sets * self.ways > (1 << 24):
            raise ValueError(f"ways = {self.ways}, {self.num_sets} sets: too large to simulate")
        if self.replacement == "tree-plru" and self.ways > 64:
            raise ValueError(f"ways = {self.ways} with tree-plru: allowed are up to 64")
        if self.set_hash == "ipoly" and self.num_sets not in (16, 32, 64):
            raise ValueError(
                f"set_hash = 'ipoly' with {self.num_sets} sets: allowed are 16, 32, 64"
            )
        if self.set_hash == "fermi" and self.num_sets not in (32, 64):
            raise ValueError(f"set_hash = 'fermi' with {self.num_sets} sets: allowed are 32, 64")
        if self.set_hash == "xor" and self.num_sets & (self.num_sets - 1):
            raise ValueError(f"set_hash = 'xor' with {self.num_sets} sets: needs a power of two")
        return self


class L1(CacheLevel):
    """The first level of an SM (RDNA: the L0 of a CU).

    units_per_sm: independent cache units; a warp uses unit (its slot in the SM / 2) mod
        units_per_sm.
    bypass_loads: whether plain global loads skip this level (fetch path "global").
    """

    units_per_sm: Instances = 1
    bypass_loads: bool = False


class GL1(CacheLevel):
    """RDNA's graphics L1, one per shader array. sms_per_instance: CUs that share one."""

    sms_per_instance: Count


class L2(CacheLevel):
    """The L2, in slices behind the partition hash.

    num_channels x slices_per_channel = slices.
    channel_interleave: bytes of consecutive addresses on one channel; its slices share them in
        equal runs.
    partition_hash: facts sheet section 3.3, `gpgpu_memory_partition_indexing`; "random" is any
        uniform hash of the slice's run (section 3.4).
    """

    num_channels: Instances
    slices_per_channel: Instances = 1
    channel_interleave: Bytes
    partition_hash: PartitionHash

    @property
    def num_instances_in_capacity(self) -> int:
        return self.num_slices

    @property
    def num_slices(self) -> int:
        return self.num_channels * self.slices_per_channel

    @model_validator(mode="after")
    def _interleave_fits(self) -> Self:
        run = self.channel_interleave // self.slices_per_channel
        if (
            self.channel_interleave % self.slices_per_channel
            or run & (run - 1)
            or run < self.line_bytes
        ):
            raise ValueError(
                f"channel_interleave = {self.channel_interleave} gives each of "
                f"{self.slices_per_channel} slices runs of {run} B; allowed are powers of two of "
                f"at least line_bytes = {self.line_bytes}"
            )
        if self.partition_hash == "xor" and self.num_channels & (self.num_channels - 1):
            raise ValueError(
                f"partition_hash = 'xor' with num_channels = {self.num_channels}: "
                "needs a power of two"
            )
        # The hash spreads over the next power of two of channels (facts sheet 3.4, mode 2).
        entries = (1 << (self.num_channels - 1).bit_length()) * self.slices_per_channel
        if self.partition_hash == "ipoly" and entries > MAX_IPOLY_SLICES:
            raise ValueError(
                f"partition_hash = 'ipoly' with num_channels = {self.num_channels} and "
                f"slices_per_channel = {self.slices_per_channel}: allowed are up to "
                f"{MAX_IPOLY_SLICES} slices"
            )
        return self


class LLC(L2):
    """A memory-side last-level cache (RDNA2's Infinity Cache), sliced like the L2."""


class SM(_Model):
    """The shader multiprocessors (RDNA: CUs).

    count: how many. max_warps, max_ctas: residency limits of one.
    warp_size: lanes of one issued access; 64 takes two 32-lane rows of a group together.
    registers, shared: 32-bit registers and bytes of shared memory of one SM, which a launch may
        ask for.
    """

    count: Instances
    max_warps: Instances
    max_ctas: Instances
    warp_size: Literal[32, 64] = 32
    registers: Count
    shared: Bytes


class Dram(_Model):
    """The memory behind the last cache. sector_bytes: the atom it moves."""

    sector_bytes: Bytes


class Gpu(_Model):
    """One machine.

    l1_texture: a separate texture L1 (the `-gpgpusim` presets), used by fetch path "texture".
    texture_layout: the texel layout of sampled textures, a name in `traces.layout.LAYOUTS`.
    lane_address_path: the fetch path of a lane-address trace unless told otherwise.
    sm_timing to dram_timing: what the timing model needs besides; counting does without them.
    """

    name: str
    vendor: Literal["nvidia", "amd", "other"]
    clock_hz: Count
    texture_layout: str
    lane_address_path: FetchPath = "readonly"
    sm: SM
    l1: L1
    l1_texture: L1 | None = None
    gl1: GL1 | None = None
    l2: L2
    llc: LLC | None = None
    dram: Dram
    sm_timing: SmTiming | None = None
    l1_timing: L1Timing | None = None
    l1_texture_timing: L1TextureTiming | None = None
    gl1_timing: CacheTiming | None = None
    icnt: Icnt | None = None
    l2_timing: L2Timing | None = None
    llc_timing: CacheTiming | None = None
    dram_timing: DramTiming | None = None

    @model_validator(mode="after")
    def _levels_fit(self) -> Self:
        if self.gl1 is not None and self.gl1.write_policy != "read-only":
            raise ValueError("gl1.write_policy: a GL1 is read-only")
        last = self.llc or self.l2
        if last.sector_bytes % self.dram.sector_bytes:
            raise ValueError(
                f"dram.sector_bytes = {self.dram.sector_bytes} does not divide the last cache's "
                f"sector_bytes = {last.sector_bytes}"
            )
        given = {path: level for path, level, _ in self._levels()}
        for first in ("l1", "l1_texture"):
            chain = [path for path in (first, "gl1", "l2", "llc") if path in given]
            for upper, lower in pairwise(chain):
                if given[upper].sector_bytes % given[lower].sector_bytes:
                    raise ValueError(
                        f"{lower}.sector_bytes = {given[lower].sector_bytes} does not divide "
                        f"{upper}.sector_bytes = {given[upper].sector_bytes}"
                    )
        for path, level, instances in self._levels():
            lines = instances * level.num_sets * level.ways
            if lines > MAX_LINES:
                raise ValueError(
                    f"{path}.capacity = {level.capacity} makes {lines} lines in {instances} "
                    f"instances; allowed are up to {MAX_LINES}"
                )
        return self

    def _levels(self) -> list[tuple[str, CacheLevel, int]]:
        """Path, level and number of its instances in the whole GPU, of the levels there are."""
        levels: list[tuple[str, CacheLevel, int]] = [
            ("l1", self.l1, self.sm.count * self.l1.units_per_sm),
            ("l2", self.l2, self.l2.num_slices),
        ]
        if self.l1_texture is not None:
            units = self.sm.count * self.l1_texture.units_per_sm
            levels.append(("l1_texture", self.l1_texture, units))
        if self.gl1 is not None:
            levels.append(("gl1", self.gl1, -(-self.sm.count // self.gl1.sms_per_instance)))
        if self.llc is not None:
            levels.append(("llc", self.llc, self.llc.num_slices))
        return levels
