"""The dissertation's bandwidth-demand cost function, measured: a frame's demand on L1, L2 and DRAM
and its cycles, without simulating it.

The slides give the formulas and no prose; this is how their symbols are read here.

    T(n)  = k T'_k(n/k) + O(n)
    T'(n) = sum over i, a in A, r in R of w_iar S_iar + O(n)
    S(m)  = sum over j = 1..m' of M(d_j) + O(m'),   m' = f(m, sigma_0^2) <= m
    M(d)  = R(d) + O(d)

`SYMBOLS` says what each one is, in which unit, and where it is computed. Costs have four components
that are predicted side by side: bytes asked of L1, of L2, bytes moved by DRAM, and cycles.

R(d) has no closed form: what a read costs depends on its distance, on its mip, on what the warp's
other lanes ask, on which tiles share an L1 (`dispatch`) and how long its lines last. It is drawn
(`tiles`, `walk`): random samples of some of the tiles, at the distances that the profile has, go
through one L1. What the frame finds in the caches behind follows from what fills them (`window`).
All that follows from the method and the preset; one factor per level and the weights of the
cycles, `COEFFICIENTS`, are fitted to simulated frames (`fit`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from cachesim.config import Gpu
from cachesim.cost.cycles import LIMITS, has_timing, launch_cycles, limit_times
from cachesim.cost.frame import Frame, Step, build_frame
from cachesim.cost.machine import LevelOfCost, Machine
from cachesim.cost.memory import Memory
from cachesim.cost.tiles import ScatterCost, cost_scatter
from cachesim.cost.window import Passed, pass_level
from cachesim.cost.workload import Workload

#: (symbol, meaning, unit, where it comes from).
SYMBOLS = (
    ("n", "shading units: the pixels that scatter", "pixels", "the G-buffer's mask"),
    ("i", "one shading unit; handled as one of its tile, whose pixels cost alike", "-", "tiles"),
    ("k", "groups of units: the CTAs of a launch, 8x8 pixels each, as the SMs take them",
     "groups", "dispatch"),
    ("T'_k(n/k)", "cost of one group: what its samples ask of each level; in cycles, its share "
     "of the busiest SM's time", "B, cycles", "tiles, cycles"),
    ("T(n)", "cost of the frame", "B, cycles", "Prediction"),
    ("a in A", "technique of a tile: sampled (AFIS) or filtered (Separable)", "-", "launches"),
    ("r in R", "rate: full resolution alone, since no method here renders at another", "-", "1"),
    ("w_iar", "1 where the hybrid's classes give tile i technique a, else 0; always 1 where there "
     "is one technique", "-", "tile lists of the hybrid"),
    ("S_iar = S(m)", "cost of the samples of a pixel", "B, cycles", "tiles"),
    ("m", "budget: most samples that a pixel may take", "samples", "num_samples or b_max"),
    ("sigma_0^2", "target variance of the tracked luminance", "luminance^2", "the method"),
    ("m' = f(m, sigma_0^2)", "samples that the pixel takes: m, or what the adaptive estimator "
     "says after some frames", "samples", "the estimator run on the scene"),
    ("d_j", "distance of sample j from its pixel; its mip follows from it by Eq 5.12", "mm",
     "drawn from the profile"),
    ("M(d)", "cost of one sample at distance d", "B, cycles", "R(d) + O(d)"),
    ("R(d)", "its reads: sectors that the warp's lanes do not share, and what the caches do not "
     "hold", "B", "walk, window"),
    ("O(d)", "what comes with it: its arithmetic, and its share of making the mips",
     "B, cycles", "prefilter's sweeps, instruction counts"),
    ("O(m')", "cost of a pixel beside its samples: its own texels, history, the result's store",
     "B, cycles", "sweeps of the sampling pass"),
    ("O(n)", "cost of the frame beside: set-up, classification, update, combine, launches",
     "B, cycles", "sweeps of the other passes"),
)  # fmt: skip

#: Meaning of each coefficient; `{level}` for each cache.
COEFFICIENTS = {
    "{level}.passed": "what it passes on / what the model of reuse gives",
    "cycles.issue": "weight of the time to issue every instruction",
    "cycles.traffic": "weight of the time at the peak of L1, L2 or memory, whichever is longest",
    "cycles.latency": "cycles of a dependent access that nothing hides",
}


@dataclass(frozen=True)
class Coefficient:
    """A fitted number with its 95 % confidence interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class CostModel:
    """The coefficients of one GPU. gpu: its preset. frames: how many it was fitted to."""

    gpu: str
    coefficients: Mapping[str, Coefficient]
    frames: int

    def value(self, name: str, default: float = 1.0) -> float:
        """A coefficient's value; `default` where the model has none."""
        found = self.coefficients.get(name)
        return default if found is None else found.value

    @property
    def has_cycles(self) -> bool:
        return all(f"cycles.{limit}" in self.coefficients for limit in LIMITS)

    def frame(self) -> pd.DataFrame:
        """One row per coefficient: gpu, coefficient, value, low, high, meaning."""
        rows = []
        for name, c in self.coefficients.items():
            what = name.partition(".")[2]
            meaning = COEFFICIENTS.get(name) or COEFFICIENTS[f"{{level}}.{what}"]
            rows.append((self.gpu, name, c.value, c.low, c.high, meaning))
        return pd.DataFrame(rows, columns=["gpu", "coefficient", "value", "low", "high", "meaning"])


def coefficient_names(machine: Machine) -> tuple[str, ...]:
    """The coefficients that a machine's model has."""
    # What the L1 and a level that a few SMs share pass on is drawn, and needs none.
    names = [f"{v.name}.passed" for v in machine.levels[1:] if v is not machine.shared]
    return (*names, *(f"cycles.{limit}" for limit in LIMITS)) if has_timing(machine) else (*names,)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the model says of a frame.

    lane_fetches, num_samples: of all lanes. demand_bytes: level -> bytes, "dram" last. cycles: None
    where the model or the preset has none. by_launch: one row per launch: pass, l2_bytes,
    dram_bytes, cycles.
    """

    gpu: str
    workload: str
    lane_fetches: int
    num_samples: int
    demand_bytes: Mapping[str, float]
    cycles: float | None
    by_launch: pd.DataFrame


class Prepared:
    """A workload on a machine, with what no coefficient changes."""

    def __init__(self, workload: Workload, machine: Machine) -> None:
        self.workload, self.machine = workload, machine
        self.memory = Memory.of(workload, machine)
        self.costs: tuple[ScatterCost, ...] = tuple(
            cost_scatter(workload, scatter, machine, self.memory) for scatter in workload.scatters
        )
        self.frame: Frame = build_frame(workload, self.costs, machine, self.memory)
        sector = self.memory.sector_bytes
        #: Bytes asked of the L1, and of the level behind it.
        self.l1_bytes = sum(c.asked for c in self.costs) * sector + self.frame.l1_swept_bytes
        self.missed_bytes = sum(c.missed for c in self.costs) * sector
        self.asked_below_l1 = self.missed_bytes + _swept_bytes(self.frame, machine.levels[1])

    def pass_through(self, model: CostModel, index: int, steps: tuple[Step, ...]) -> Passed:
        """The frame's steps through level `index`; from 1, the level behind the L1."""
        level = self.machine.levels[index]
        factor = model.value(f"{level.name}.passed")
        if level is not self.machine.shared:
            return pass_level(level, self.frame.size, steps, factor)
        # What it passes on of the scattered reads was drawn, and is in the steps already.
        alone = tuple(Step(step.launch, swept=step.swept) for step in steps)
        return pass_level(level, self.frame.size, alone, 1.0).with_scattered(steps)


def _swept_bytes(frame: Frame, level: LevelOfCost) -> float:
    """Bytes that sweeps ask of the level behind the L1."""
    return sum(
        s.requests_bytes
        for step in frame.steps
        for s in step.swept
        if level.takes_stores or not s.is_store
    )


def predict(workload: Workload, gpu: Gpu, model: CostModel) -> Prediction:
    """Predict a frame's demand and cycles.

    gpu: the configuration that the model was fitted on, or one like it.
    """
    return predict_prepared(Prepared(workload, Machine.of(gpu)), model)


def predict_prepared(prepared: Prepared, model: CostModel) -> Prediction:
    """`predict`, of a workload that is prepared."""
    workload, machine = prepared.workload, prepared.machine
    demand = {"l1": prepared.l1_bytes}
    steps, passed = prepared.frame.steps, None
    l2_asked: Mapping[int, float] = {}
    for index, level in enumerate(machine.levels[1:], 1):
        passed = prepared.pass_through(model, index, steps)
        drawn = level is machine.shared
        demand[level.name] = prepared.asked_below_l1 if drawn else sum(passed.asked.values())
        if level.name == "l2":
            l2_asked = passed.asked
        steps = passed.steps
    assert passed is not None
    demand["dram"] = passed.read_bytes + passed.written_bytes
    cycles: list[float | None] = [None] * len(workload.launches)
    if has_timing(machine) and model.has_cycles:
        times = limit_times(
            workload, prepared.costs, machine, prepared.memory, l2_asked, passed.moved
        )
        weights = {limit: model.value(f"cycles.{limit}") for limit in LIMITS}
        start = launch_cycles(machine)
        cycles = [start + sum(weights[k] * time[k] for k in LIMITS) for time in times]
    rows = [
        (w.pass_name, l2_asked.get(w.launch, 0.0), passed.moved.get(w.launch, 0.0), c)
        for w, c in zip(workload.launches, cycles, strict=True)
    ]
    columns = ["pass", "l2_bytes", "dram_bytes", "cycles"]
    known = [c for c in cycles if c is not None]
    return Prediction(
        machine.gpu.name,
        workload.name,
        workload.lane_fetches,
        workload.num_samples,
        demand,
        float(sum(known)) if known else None,
        pd.DataFrame(rows, columns=columns).astype({"cycles": "float64"}),
    )
