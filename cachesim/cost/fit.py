"""Fitting the cost function's coefficients to simulated frames, level by level.

What a level passes on is the demand of the next, so that each level's coefficients are fitted to
the demand behind it, with those above already known: relative differences, least squares.
The cycles' weights are a non-negative linear fit to the passes' cycles as shares of the frame's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares, nnls
from scipy.stats import t as student

from cachesim.config import Gpu
from cachesim.cost.cycles import LIMITS, has_timing, launch_cycles, limit_times
from cachesim.cost.frame import Step
from cachesim.cost.machine import Machine
from cachesim.cost.model import Coefficient, CostModel, Prepared
from cachesim.cost.window import Passed
from cachesim.cost.workload import Floats, Workload
from cachesim.report import Report
from traces.errors import InputError

#: Bounds of everything but the cycles' weights.
BOUNDS = (0.02, 50.0)
_DIFFERENCE_STEP = 0.05
_CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Observation:
    """A simulated frame. demand_bytes: level -> bytes, with "dram". cycles, by pass: with their
    launch latency; {} where it was not timed.
    """

    workload: Workload
    demand_bytes: Mapping[str, float]
    pass_cycles: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def of(workload: Workload, report: Report, timed: Report | None = None) -> Observation:
        """From a counting report, and a timed one for the cycles."""
        demand = {
            **{name: float(c.demand_bytes) for name, c in report.counters.items()},
            "dram": float(report.dram.bytes),
        }
        cycles: dict[str, float] = {}
        if timed is not None and timed.timing is not None:
            for part in timed.timing.passes:
                cycles[part.name] = cycles.get(part.name, 0.0) + float(part.cycles)
        return Observation(workload, demand, cycles)


def fit(
    observations: Sequence[Observation],
    gpu: Gpu,
    progress: Callable[[float], None] | None = None,
) -> CostModel:
    """Fit the model of one GPU.

    progress: called with the share done, 0 to 1.

    Raises:
        InputError: fewer than two frames.
    """
    if len(observations) < 2:
        raise InputError(f"cost fit: {len(observations)} frames: need two or more")
    return _Fit(observations, gpu, progress or (lambda share: None)).run()


class _Fit:
    """One GPU's fit."""

    def __init__(
        self, observations: Sequence[Observation], gpu: Gpu, progress: Callable[[float], None]
    ) -> None:
        self.machine = Machine.of(gpu)
        self.observations, self.progress = observations, progress
        self.model = CostModel(gpu.name, {}, len(observations))
        self.prepared = []
        for k, observation in enumerate(observations):
            progress(0.3 * k / len(observations))
            self.prepared.append(Prepared(observation.workload, self.machine))

    def run(self) -> CostModel:
        steps = [p.frame.steps for p in self.prepared]
        l2_asked: list[Mapping[int, float]] = []
        passed: list[Passed] = []
        for index, level in enumerate(self.machine.levels[1:], 1):
            passed = self._fit_cache(index, steps)
            if level.name == "l2":
                l2_asked = [p.asked for p in passed]
            steps = [p.steps for p in passed]
            self.progress(0.5 + 0.5 * index / len(self.machine.levels))
        if has_timing(self.machine) and any(o.pass_cycles for o in self.observations):
            self._fit_cycles(l2_asked, [p.moved for p in passed])
        self.progress(1.0)
        return self.model

    def _fit_cache(self, index: int, steps: Sequence[tuple[Step, ...]]) -> list[Passed]:
        """Fit a level behind the L1 to the demand of what follows it; what it passes on then."""
        levels = self.machine.levels
        following = levels[index + 1] if index + 1 < len(levels) else None

        def pass_on(k: int, model: CostModel) -> Passed:
            return self.prepared[k].pass_through(model, index, steps[k])

        def demand(k: int, model: CostModel) -> float:
            found = pass_on(k, model)
            if following is None or following.takes_stores:
                return found.read_bytes + found.written_bytes
            return found.read_bytes

        if levels[index] is not self.machine.shared:
            behind = "dram" if following is None else following.name
            self._fit_level(f"{levels[index].name}.passed", behind, demand)
        return [pass_on(k, self.model) for k in range(len(self.prepared))]

    def _fit_level(self, name: str, level: str, asked: Callable[[int, CostModel], float]) -> None:
        """Fit a coefficient to the demand of a level."""
        observed = np.array([o.demand_bytes[level] for o in self.observations])

        def differences(value: Floats) -> Floats:
            known = {**self.model.coefficients, name: Coefficient(*[float(value[0])] * 3)}
            model = replace(self.model, coefficients=known)
            found = np.array([asked(k, model) for k in range(len(observed))])
            relative: Floats = found / np.maximum(observed, 1.0) - 1.0
            return relative

        solved = least_squares(
            differences, np.ones(1), bounds=BOUNDS, diff_step=_DIFFERENCE_STEP, xtol=1e-3,
            ftol=1e-4, max_nfev=8,
        )  # fmt: skip
        (half,) = _spread(solved.jac, solved.fun, len(observed))
        value = float(solved.x[0])
        low, high = (float(np.clip(value + s * half, *BOUNDS)) for s in (-1, 1))
        fitted = {**self.model.coefficients, name: Coefficient(value, low, high)}
        self.model = replace(self.model, coefficients=fitted)

    def _fit_cycles(
        self, l2_asked: Sequence[Mapping[int, float]], moved: Sequence[Mapping[int, float]]
    ) -> None:
        """Fit the weights of the limits to the cycles of the passes."""
        rows: list[list[float]] = []
        wanted: list[float] = []
        start = launch_cycles(self.machine)
        for k, observation in enumerate(self.observations):
            if not observation.pass_cycles:
                continue
            total = sum(observation.pass_cycles.values())
            launches = observation.workload.launches
            times = limit_times(
                observation.workload,
                self.prepared[k].costs,
                self.machine,
                self.prepared[k].memory,
                l2_asked[k],
                moved[k],
            )
            for name, cycles in observation.pass_cycles.items():
                chosen = [t for w, t in zip(launches, times, strict=True) if w.pass_name == name]
                rows.append([sum(t[limit] for t in chosen) / total for limit in LIMITS])
                wanted.append((cycles - start * len(chosen)) / total)
        matrix, target = np.array(rows), np.array(wanted)
        # Columns of like size, so that the solver's steps are.
        size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
        weights = nnls(matrix / size, target)[0] / size
        width = _spread(matrix / size, matrix @ weights - target, len(target)) / size
        known = dict(self.model.coefficients)
        for limit, weight, half in zip(LIMITS, weights, width, strict=True):
            low, high = max(0.0, weight - half), weight + half
            known[f"cycles.{limit}"] = Coefficient(float(weight), float(low), float(high))
        self.model = replace(self.model, coefficients=known)


def _spread(jacobian: Any, residual: Any, num_observed: int) -> Floats:
    """Half widths of the confidence intervals, from the curvature at the solution."""
    freedom = max(num_observed - jacobian.shape[1], 1)
    variance = float(np.sum(residual**2)) / freedom
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
    quantile = float(student.ppf(0.5 + _CONFIDENCE / 2.0, freedom))
    width: Floats = quantile * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return width
