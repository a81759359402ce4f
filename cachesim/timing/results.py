"""What the timing model found: cycles and where they went, per pass and in total.

Everything is an integer with a stated population; rates, means and bandwidths are derived.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

#: Where an issue slot, the cycle of a scheduler, can go, and what it says when most go there.
REASONS: dict[str, str] = {
    "issue": "the schedulers issued instructions",
    "arithmetic": "most warps waited for an execution unit or its result",
    "l1_bandwidth": "memory instructions waited for the L1's ports, tags, banks or filters",
    "l1_reservation": "a miss found no MSHR, merge slot, line or queue entry and was tried again, "
    "without long queues below",
    "interconnect": "requests or replies queued in the interconnect",
    "l2": "requests queued at the L2 slices (and GL1, LLC)",
    "dram": "requests queued at the memory controllers or for the memory's bus",
    "latency": "no queue was long: the warps in flight do not cover the unloaded latency",
    "launch": "the kernel's launch latency",
    "idle": "the SM had no warp: the start and the tail of a kernel",
}

#: From this share of issue slots on, issue is the bound: more warps or faster memory would not help
#: much. Below it the bound is what the other slots waited for.
ISSUE_BOUND = 0.8


@dataclass(frozen=True)
class LevelTiming:
    """Traffic of one level against its peak.

    bytes: moved at this level's data port. peak_bytes_per_kilocycle: of all its instances, per 1000
        core cycles. latency_cycles, num_latencies: sum over, and number of, the requests whose data
        came from this level, from leaving the SM's load/store queue until the data was back.
    """

    bytes: int
    peak_bytes_per_kilocycle: int
    latency_cycles: int
    num_latencies: int

    def __add__(self, other: LevelTiming) -> LevelTiming:
        return LevelTiming(
            self.bytes + other.bytes,
            max(self.peak_bytes_per_kilocycle, other.peak_bytes_per_kilocycle),
            self.latency_cycles + other.latency_cycles,
            self.num_latencies + other.num_latencies,
        )

    @property
    def mean_latency_cycles(self) -> float | None:
        return self.latency_cycles / self.num_latencies if self.num_latencies else None


@dataclass(frozen=True)
class PassTiming:
    """One pass: the sum over its kernel launches.

    cycles: core cycles from launch to the last CTA's end, the launch latency included.
    launch_cycles: the launch latencies. where: reason -> cycles; they sum to `cycles`. An issue
        slot, the cycle of one scheduler, counts 1 / schedulers of all SMs; the remainder of the
        division goes to the largest shares.
    warp_instructions: kind -> issued warp instructions ("memory" among them).
    resident_warp_cycles: sum over SMs and cycles of resident warps; sm_cycles: SMs x cycles without
        the launch; max_warps: of one SM. levels: "l1", ("gl1",) "l2", ("llc",) "dram".
    rows_opened: activate commands of memory.
    """

    name: str
    num_launches: int
    cycles: int
    launch_cycles: int
    where: Mapping[str, int]
    warp_instructions: Mapping[str, int]
    resident_warp_cycles: int
    sm_cycles: int
    max_warps: int
    levels: Mapping[str, LevelTiming]
    rows_opened: int = 0

    @property
    def occupancy(self) -> float | None:
        """Mean resident warps / the SM's limit, while the kernel ran."""
        slots = self.sm_cycles * self.max_warps
        return self.resident_warp_cycles / slots if slots else None

    @property
    def bottleneck(self) -> str:
        """Issue where it took at least `ISSUE_BOUND` of the cycles after the launch; else what took
        most of the others.
        """
        where = {r: n for r, n in self.where.items() if r != "launch"}
        if where.get("issue", 0) < ISSUE_BOUND * sum(where.values()):
            where.pop("issue", None)
        return max(where, key=lambda r: where[r]) if any(where.values()) else "launch"

    def utilisation(self, level: str) -> float | None:
        """Achieved / peak bandwidth of a level, while the kernel ran."""
        cycles = self.cycles - self.launch_cycles
        peak = self.levels[level].peak_bytes_per_kilocycle * cycles
        return 1000 * self.levels[level].bytes / peak if peak else None

    def __add__(self, other: PassTiming) -> PassTiming:
        def merged(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
            keys = list(dict.fromkeys([*a, *b]))
            return {k: a[k] + b[k] if k in a and k in b else a.get(k, b.get(k)) for k in keys}

        return PassTiming(
            self.name,
            self.num_launches + other.num_launches,
            self.cycles + other.cycles,
            self.launch_cycles + other.launch_cycles,
            merged(self.where, other.where),
            merged(self.warp_instructions, other.warp_instructions),
            self.resident_warp_cycles + other.resident_warp_cycles,
            self.sm_cycles + other.sm_cycles,
            max(self.max_warps, other.max_warps),
            merged(self.levels, other.levels),
            self.rows_opened + other.rows_opened,
        )

    def to_json(self) -> dict[str, Any]:
        """The pass's entry of the report."""
        return {
            "pass": self.name,
            "num_launches": self.num_launches,
            "cycles": self.cycles,
            "launch": self.launch_cycles,
            "where": dict(self.where),
            "warp_instructions": dict(self.warp_instructions),
            "occupancy": self.occupancy,
            "bottleneck": self.bottleneck,
            "rows_opened": self.rows_opened,
            "levels": {
                name: {
                    "bytes": level.bytes,
                    "peak_bytes_per_kilocycle": level.peak_bytes_per_kilocycle,
                    "utilisation": self.utilisation(name),
                    "mean_latency_cycles": level.mean_latency_cycles,
                    "num_latencies": level.num_latencies,
                }
                for name, level in self.levels.items()
            },
        }


@dataclass(frozen=True)
class TimingResult:
    """The clocked part of a report.

    clock_hz: of the SMs. passes: in order of first launch. gpgpusim: GPGPU-Sim's own counters under
        its own names (facts sheet 4): name -> integer, per level "l1", "l2" and "dram".
    """

    clock_hz: int
    passes: Sequence[PassTiming]
    gpgpusim: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @property
    def total(self) -> PassTiming:
        """All passes together; its name is "total"."""
        whole = PassTiming("total", 0, 0, 0, dict.fromkeys(REASONS, 0), {}, 0, 0, 0, {})
        for one in self.passes:
            whole = whole + one
        return whole

    @property
    def time_ms(self) -> float:
        return self.milliseconds(self.total)

    def milliseconds(self, part: PassTiming) -> float:
        """A pass's time at the preset's clock."""
        return part.cycles / self.clock_hz * 1e3

    def to_json(self) -> dict[str, Any]:
        """The report's "cycles" entry: total, launch, where, and the same per pass."""
        total = self.total.to_json()
        total["total"] = total.pop("cycles")
        del total["pass"]
        return total | {"by_pass": [part.to_json() for part in self.passes]}

    def frame(self) -> pd.DataFrame:
        """One row per pass and a last one "total": cycles, milliseconds, where, bottleneck."""
        rows = [
            {
                "pass": part.name,
                "cycles": part.cycles,
                "time_ms": self.milliseconds(part),
                "occupancy": part.occupancy,
                "bottleneck": part.bottleneck,
                **{f"where_{reason}": part.where.get(reason, 0) for reason in REASONS},
                **{f"{name}_utilisation": part.utilisation(name) for name in part.levels},
            }
            for part in (*self.passes, self.total)
        ]
        return pd.DataFrame(rows)
