"""The few numbers of a GPU's memory system that the cost function needs, from its configuration."""

from __future__ import annotations

from dataclasses import dataclass

from cachesim.config import CacheLevel, Gpu
from cachesim.cost.workload import LaunchWork
from cachesim.dispatch import resident_ctas
from traces.trace import Launch


@dataclass(frozen=True)
class LevelOfCost:
    """One level of cache. instances: independent caches, of `sms` SMs each. lines: of one. flushed:
    empty at each launch. takes_stores: stores are looked up here; else they pass by.
    """

    name: str
    instances: int
    sms: int
    lines: int
    line_bytes: int
    sector_bytes: int
    flushed: bool
    takes_stores: bool

    @property
    def sectors_per_line(self) -> int:
        return self.line_bytes // self.sector_bytes


@dataclass(frozen=True)
class Machine:
    """The levels from the SM down, and what the fetches of the texture path see."""

    gpu: Gpu
    levels: tuple[LevelOfCost, ...]

    @staticmethod
    def of(gpu: Gpu) -> Machine:
        """The machine of a configuration, on fetch path "texture"."""
        first = gpu.l1_texture or gpu.l1
        count = gpu.sm.count
        found: list[tuple[str, CacheLevel, int, int]] = [
            ("l1", first, count * first.units_per_sm, 1)
        ]
        if gpu.gl1 is not None:
            sms = gpu.gl1.sms_per_instance
            found.append(("gl1", gpu.gl1, -(-count // sms), sms))
        found.append(("l2", gpu.l2, 1, count))
        if gpu.llc is not None:
            found.append(("llc", gpu.llc, 1, count))
        return Machine(gpu, tuple(_level(*level) for level in found))

    @property
    def shared(self) -> LevelOfCost | None:
        """The level that a few SMs share (RDNA's GL1)."""
        return next((v for v in self.levels[1:] if v.instances > 1), None)

    def resident(self, launch: LaunchWork) -> int:
        """CTAs of a launch that one SM holds."""
        return resident_ctas(
            self.gpu.sm,
            Launch(
                0,
                launch.pass_name,
                launch.num_ctas,
                launch.warps_per_cta,
                launch.registers_per_thread,
                launch.shared_bytes_per_cta,
            ),
        )

    @property
    def warp_shape(self) -> tuple[int, int]:
        """Pixels (x, y) of one access: 8x4 of 32 lanes, 8x8 of 64."""
        return 8, self.gpu.sm.warp_size // 8


def _level(name: str, config: CacheLevel, instances: int, sms: int) -> LevelOfCost:
    return LevelOfCost(
        name,
        instances,
        sms,
        config.capacity // config.line_bytes,
        config.line_bytes,
        config.sector_bytes,
        flushed=name in ("l1", "gl1"),
        takes_stores=config.write_policy != "read-only",
    )
