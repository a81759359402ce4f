"""The report: integer counters per level with a stated population, ratios derived from them, and
the laws they obey.

Every count of a level is in that level's sectors (`sector_bytes` stands beside it), except
`requests`, which are tag look-ups.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import pandas as pd

from cachesim.timing.results import TimingResult


class ConservationError(AssertionError):
    """A law of the report does not hold: a defect of the simulator, never of its input."""


@dataclass(frozen=True)
class LevelCounters:
    """What one level was asked and did.

    requests: tag look-ups. accesses: sectors presented and looked up, stores included. hits,
        line_misses (no tag) and sector_misses (tag, sector absent): outcomes of accesses. merged:
        misses that joined one in flight (0 without a clock).
    writes: stores and atomics among accesses; write_misses: those among the misses. stores_down:
        store sectors passed to the next
    level. write_fills: sectors fetched so that a store can be merged. bypasses: sectors that passed
        without look-up, not accesses;
    bypassed_writes: stores and atomics among them. writebacks: dirty sectors evicted. dirty_at_end:
        dirty sectors still held.
    """

    sector_bytes: int
    requests: int = 0
    accesses: int = 0
    hits: int = 0
    line_misses: int = 0
    sector_misses: int = 0
    merged: int = 0
    writes: int = 0
    write_misses: int = 0
    stores_down: int = 0
    write_fills: int = 0
    bypasses: int = 0
    bypassed_writes: int = 0
    writebacks: int = 0
    dirty_at_end: int = 0

    @property
    def misses(self) -> int:
        return self.line_misses + self.sector_misses

    @property
    def miss_rate(self) -> float | None:
        """Misses / accesses of this level; None where nothing was asked."""
        return self.misses / self.accesses if self.accesses else None

    @property
    def presented(self) -> int:
        """Sectors that arrived at this level, those that go around it included."""
        return self.accesses + self.bypasses

    @property
    def demand_bytes(self) -> int:
        """Bytes asked of this level; what goes around it is no demand on it."""
        return self.accesses * self.sector_bytes

    @property
    def reads_down(self) -> int:
        """Sectors asked of the next level for reading: load misses not merged, fetches for stores,
        bypassed loads.
        """
        read_misses = self.misses - self.write_misses - self.merged
        return read_misses + self.write_fills + self.bypasses - self.bypassed_writes

    @property
    def writes_down(self) -> int:
        """Sectors sent to the next level for writing."""
        return self.stores_down + self.bypassed_writes + self.writebacks

    def __add__(self, other: LevelCounters) -> LevelCounters:
        """Counters over the union of two populations of one level."""
        if self.sector_bytes != other.sector_bytes:
            raise ValueError(
                f"sector_bytes {self.sector_bytes} and {other.sector_bytes} do not add"
            )
        added = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)}
        return LevelCounters(**(added | {"sector_bytes": self.sector_bytes}))

    def to_json(self) -> dict[str, Any]:
        """The level's entry of the report."""
        raw = {f.name: getattr(self, f.name) for f in fields(self)}
        return raw | {"misses": self.misses, "miss_rate": self.miss_rate}


@dataclass(frozen=True)
class DramCounters:
    """Sectors that moved between the last cache and memory."""

    sector_bytes: int
    sectors_read: int = 0
    sectors_written: int = 0

    @property
    def bytes(self) -> int:
        return (self.sectors_read + self.sectors_written) * self.sector_bytes

    def to_json(self) -> dict[str, int]:
        """The report's "dram" entry."""
        return {
            "sectors_read": self.sectors_read,
            "sectors_written": self.sectors_written,
            "sector_bytes": self.sector_bytes,
            "bytes": self.bytes,
        }


@dataclass(frozen=True)
class Part:
    """The share of the counters of one pass x texture x mip."""

    pass_name: str
    texture: str
    mip: int
    lane_fetches: int
    counters: dict[str, LevelCounters]
    dram: DramCounters


@dataclass(frozen=True)
class Report:
    """What one trace asked of one GPU.

    gpu: preset name. trace: identification of the trace. counters: by level, from the SM down.
        parts: None for a trace without
    provenance. num_rows: warp instructions issued. distinct_sectors: of the sliced levels, which
        are never emptied, how many different sectors were asked (compulsory misses); levels where
        it was not counted, or that something went around, are absent. timing: cycles and where they
        went; None for a counting run. timings: host seconds per stage.
    """

    gpu: str
    trace: dict[str, Any]
    fetch_path: str
    layout: str | None
    num_rows: int
    lane_fetches: int
    counters: dict[str, LevelCounters]
    dram: DramCounters
    parts: tuple[Part, ...] | None
    distinct_sectors: dict[str, int] = field(default_factory=dict)
    timing: TimingResult | None = None
    timings: dict[str, float] = field(default_factory=dict, compare=False)

    @property
    def levels(self) -> tuple[str, ...]:
        return tuple(self.counters)

    @property
    def cycles(self) -> dict[str, Any] | None:
        """The contract's "cycles": total, launch, where they went, and the same per pass."""
        return self.timing.to_json() if self.timing else None

    @property
    def time_ms(self) -> float | None:
        """Milliseconds at the preset's clock."""
        return self.timing.time_ms if self.timing else None

    @property
    def gpgpusim(self) -> dict[str, dict[str, int]] | None:
        """GPGPU-Sim's own counters, by level."""
        if self.timing is None:
            return None
        return {level: dict(counters) for level, counters in self.timing.gpgpusim.items()}

    @property
    def demand(self) -> dict[str, int]:
        """Demand in bytes: of each level the sectors looked up there, of DRAM those moved; lane
        fetches as a count.
        """
        presented = {f"{n}_bytes": c.demand_bytes for n, c in self.counters.items()}
        return {"lane_fetches": self.lane_fetches, **presented, "dram_bytes": self.dram.bytes}

    def check(self) -> None:
        """Hold the counters to their laws.

        Raises:
            ConservationError: one does not hold.
        """
        names = self.levels
        for name in names:
            c = self.counters[name]
            _law(f"{name}: accesses = hits + misses", c.accesses, c.hits + c.misses)
            for part, whole in (
                ("write_misses", "writes"),
                ("stores_down", "writes"),
                ("write_fills", "writes"),
                ("bypassed_writes", "bypasses"),
            ):
                holds = 0 <= getattr(c, part) <= getattr(c, whole)
                _law(f"{name}: 0 <= {part} <= {whole}", True, holds)
            held = c.writebacks + c.dirty_at_end
            _law(f"{name}: writebacks + dirty_at_end <= writes", True, held <= c.writes)
        for upper, lower in itertools.pairwise(names):
            u, d = self.counters[upper], self.counters[lower]
            passed = (u.reads_down + u.writes_down) * u.sector_bytes
            _law(
                f"{upper} passes down what {lower} is presented",
                passed,
                d.presented * d.sector_bytes,
            )
            _law(
                f"{upper} writes what {lower} is presented to write",
                u.writes_down * u.sector_bytes,
                (d.writes + d.bypassed_writes) * d.sector_bytes,
            )
        for name, distinct in self.distinct_sectors.items():
            misses = self.counters[name].misses
            _law(
                f"{name}: misses = {misses} >= {distinct} distinct sectors",
                True,
                misses >= distinct,
            )
        last = self.counters[names[-1]]
        moved = last.reads_down * last.sector_bytes, last.writes_down * last.sector_bytes
        dram = self.dram
        told = dram.sectors_read * dram.sector_bytes, dram.sectors_written * dram.sector_bytes
        _law(f"{names[-1]} passes down what DRAM moves", moved, told)
        if self.parts is not None:
            for name in names:
                total = sum(
                    (p.counters[name] for p in self.parts),
                    LevelCounters(self.counters[name].sector_bytes),
                )
                _law(f"{name}: parts sum to the total", self.counters[name], total)
            _law(
                "lane fetches: parts sum to the total",
                self.lane_fetches,
                sum(p.lane_fetches for p in self.parts),
            )
            _law(
                "dram: parts sum to the total",
                self.dram.bytes,
                sum(p.dram.bytes for p in self.parts),
            )

    def level_json(self, level: str) -> dict[str, Any]:
        """A level's entry: its counters, and `distinct_sectors`, None where not counted."""
        return self.counters[level].to_json() | {
            "distinct_sectors": self.distinct_sectors.get(level)
        }

    def to_json(self) -> dict[str, Any]:
        """The report of the design's contract, JSON-able."""
        by = None
        if self.parts is not None:
            by = [
                {
                    "pass": p.pass_name,
                    "texture": p.texture,
                    "mip": p.mip,
                    "lane_fetches": p.lane_fetches,
                    **{name: c.to_json() for name, c in p.counters.items()},
                    "dram": p.dram.to_json(),
                }
                for p in self.parts
            ]
        return {
            "gpu": self.gpu,
            "trace": self.trace,
            "fetch_path": self.fetch_path,
            "layout": self.layout,
            "levels": list(self.levels),
            **{name: self.level_json(name) for name in self.levels},
            "dram": self.dram.to_json(),
            "demand": self.demand,
            "warp_instructions": self.num_rows,
            "cycles": self.cycles,
            "time_ms": self.time_ms,
            **({"gpgpusim": self.gpgpusim} if self.timing else {}),
            "by": by,
        }

    def frame(self) -> pd.DataFrame:
        """One row per level: the counters, `misses`, `miss_rate` and `demand_bytes`."""
        rows = [
            {"level": n, **self.level_json(n), "demand_bytes": c.demand_bytes}
            for n, c in self.counters.items()
        ]
        return pd.DataFrame(rows).astype({"miss_rate": float, "distinct_sectors": "Int64"})

    def by_frame(self) -> pd.DataFrame:
        """One row per pass x texture x mip x level; DRAM is a level of its own with `bytes`. Empty
        without provenance.
        """
        rows: list[dict[str, Any]] = []
        for p in self.parts or ():
            key = {
                "pass": p.pass_name,
                "texture": p.texture,
                "mip": p.mip,
                "lane_fetches": p.lane_fetches,
            }
            rows += [
                {**key, "level": n, **c.to_json(), "bytes": c.demand_bytes}
                for n, c in p.counters.items()
            ]
            rows.append({**key, "level": "dram", **p.dram.to_json()})
        return pd.DataFrame(rows)


def _law(name: str, left: object, right: object) -> None:
    if left != right:
        raise ConservationError(f"law broken: {name}: {left} against {right}")


def sum_parts(parts: Sequence[Part], level: str) -> LevelCounters:
    """The sum of some parts' counters of one level; at least one part.

    Raises:
        ValueError: no part.
    """
    if not parts:
        raise ValueError("no parts to sum")
    total = parts[0].counters[level]
    for p in parts[1:]:
        total = total + p.counters[level]
    return total
