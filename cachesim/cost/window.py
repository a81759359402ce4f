"""Reuse in the caches behind the L1: what of a frame's steps a level finds and what it passes on.

A level keeps what was touched in a window of time that ends now. The window is as long as its lines
last: the different lines touched in it fill the level. So a texture that one pass wrote is found by
the next where little was touched between, and neighbouring tiles find each other's samples where
they run at about the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cachesim.cost.frame import Step, Swept
from cachesim.cost.machine import LevelOfCost
from cachesim.cost.workload import Floats

_SEARCH_STEPS = 7
_EXPONENT_MAX = 700.0


def miss_probability(x: Any, sectors_per_line: int) -> Any:
    """Probability that a read misses where each sector of the line gets x reads, on average, in the
    time T that an untouched line stays.

    A line's life has k reads with probability p^(k - 1) (1 - p), p = 1 - exp(-g x), of which the
    first of each of its g sectors misses. T follows from the cache being full [Che, Tung, Wang
    2002].
    """
    g = sectors_per_line
    ends = np.exp(-np.minimum(g * x, _EXPONENT_MAX))
    return g * ends / (1.0 + (g - 1) * ends)


@dataclass(frozen=True)
class Passed:
    """What a level was asked and what it passes on. asked, moved: launch -> bytes, its demand and
    what it passes on. steps: the next level's. read_bytes, written_bytes: passed on.
    """

    asked: dict[int, float]
    moved: dict[int, float]
    steps: tuple[Step, ...]
    read_bytes: float
    written_bytes: float

    def with_scattered(self, steps: Sequence[Step]) -> Passed:
        """The same, and the scattered reads of these steps beside."""
        joined, moved, read = [], dict(self.moved), self.read_bytes
        for mine, other in zip(self.steps, steps, strict=True):
            joined.append(Step(mine.launch, other.scattered, mine.swept))
            there = sum(float(b.sum()) for b in other.scattered.values())
            moved[mine.launch] = moved.get(mine.launch, 0.0) + there
            read += there
        return Passed(self.asked, moved, tuple(joined), read, self.written_bytes)


def pass_level(level: LevelOfCost, size: Floats, steps: tuple[Step, ...], factor: float) -> Passed:
    """Take a frame's steps through a level.

    size: (fields, cells) bytes. factor: on all that it passes on.
    """
    window = _Window(level, size)
    passed: list[Step] = []
    asked: dict[int, float] = {}
    moved: dict[int, float] = {}
    read = written = 0.0
    for step in steps:
        demand = sum(float(b.sum()) for b in step.scattered.values())
        demand += sum(s.requests_bytes for s in step.swept if level.takes_stores or not s.is_store)
        following = window.take(step)
        following = _scaled(following, factor)
        reads = sum(float(b.sum()) for b in following.scattered.values())
        reads += sum(s.requests_bytes for s in following.swept if not s.is_store)
        writes = sum(s.requests_bytes for s in following.swept if s.is_store)
        asked[step.launch] = asked.get(step.launch, 0.0) + demand
        moved[step.launch] = moved.get(step.launch, 0.0) + reads + writes
        read, written = read + reads, written + writes
        passed.append(following)
    return Passed(asked, moved, tuple(passed), read, written)


def _scaled(step: Step, factor: float) -> Step:
    """A step with all its bytes times a factor."""
    scattered = {index: factor * there for index, there in step.scattered.items()}
    swept = [
        Swept(s.field, s.is_store, factor * s.requests_bytes, factor * s.distinct)
        for s in step.swept
    ]
    return Step(step.launch, scattered, swept)


class _Window:
    """The steps that a level remembers."""

    def __init__(self, level: LevelOfCost, size: Floats) -> None:
        self.level, self.size = level, np.maximum(size, 1e-9)
        self.capacity = float(level.lines)
        self.kept: list[tuple[Floats, Floats]] = []
        self.launch = -1
        self.oldest = 1.0  # share of the oldest step that is still remembered
        self.reads = np.zeros_like(size)
        self.sweeps = np.zeros_like(size)
        self.of_launch = np.zeros_like(size)
        self.dirty = np.zeros_like(size)

    def take(self, step: Step) -> Step:
        """Look up a step; what it passes on."""
        if step.launch != self.launch:
            self.launch, self.of_launch = step.launch, np.zeros_like(self.size)
            if self.level.flushed:
                self.kept, self.oldest = [], 1.0
                self.reads, self.sweeps = np.zeros_like(self.size), np.zeros_like(self.size)
        new_reads, new_sweeps = self._of(step)
        before = self.reads
        others = np.clip(self.sweeps - self.of_launch, 0.0, 1.0)
        self.kept.append((new_reads, new_sweeps))
        self.reads = self.reads + new_reads
        self.sweeps = self.sweeps + new_sweeps
        for swept in step.swept:
            if not swept.is_store:
                self.of_launch[swept.field] += swept.distinct / self.size[swept.field]
        self._forget()
        following = Step(step.launch)
        self._pass_scattered(step, new_reads, before, following)
        self._pass_swept(step, before, others, following)
        return following

    def _of(self, step: Step) -> tuple[Floats, Floats]:
        """(fields, cells) each: scattered reads of a sector, and the share of sectors swept."""
        reads, sweeps = np.zeros_like(self.size), np.zeros_like(self.size)
        for index, there in step.scattered.items():
            reads[index] += there
        for swept in step.swept:
            if self.level.takes_stores or not swept.is_store:
                sweeps[swept.field] += swept.distinct
        return reads / self.size, sweeps / self.size

    def _lines(self, reads: Floats, sweeps: Floats) -> float:
        g = self.level.sectors_per_line
        untouched = (1.0 - np.minimum(sweeps, 1.0)) * np.exp(-g * reads)
        return float(np.sum(self.size * (1.0 - untouched))) / self.level.line_bytes

    def _forget(self) -> None:
        """Drop the oldest steps until what is remembered fits."""
        while self._lines(self.reads, self.sweeps) > self.capacity:
            reads, sweeps = self.kept[0]
            without = self.reads - self.oldest * reads, self.sweeps - self.oldest * sweeps
            if len(self.kept) > 1 and self._lines(*without) >= self.capacity:
                self.reads, self.sweeps = (np.maximum(v, 0.0) for v in without)
                self.kept.pop(0)
                self.oldest = 1.0
                continue
            low, high = 0.0, self.oldest
            for _ in range(_SEARCH_STEPS):
                part = 0.5 * (low + high)
                held = without[0] + part * reads, without[1] + part * sweeps
                low, high = (part, high) if self._lines(*held) < self.capacity else (low, part)
            self.reads = np.maximum(without[0] + low * reads, 0.0)
            self.sweeps = np.maximum(without[1] + low * sweeps, 0.0)
            self.oldest = low
            return

    def _pass_scattered(
        self, step: Step, new_reads: Floats, before: Floats, following: Step
    ) -> None:
        g = self.level.sectors_per_line
        shorter_than_step = len(self.kept) == 1 and self.oldest < 1.0
        for index, there in step.scattered.items():
            seen = self.reads[index]
            unswept = 1.0 - np.minimum(self.sweeps[index], 1.0)
            earlier = 0.5 * (before[index] + np.maximum(seen - new_reads[index], 0.0))
            first = self.size[index] * -np.expm1(-new_reads[index])
            missed = np.minimum(first, there) * miss_probability(earlier, g)
            if shorter_than_step:
                # What the step reads again is forgotten within it.
                missed = np.maximum(missed, there * miss_probability(seen, g))
            following.scattered[index] = missed * unswept

    def _pass_swept(self, step: Step, before: Floats, others: Floats, following: Step) -> None:
        level, g = self.level, self.level.sectors_per_line
        for swept in step.swept:
            index = swept.field
            if swept.is_store:
                if level.takes_stores:
                    self.dirty[index] = np.minimum(
                        self.dirty[index] + swept.distinct, self.size[index]
                    )
                else:
                    following.swept.append(swept)
                continue
            found = 1.0 - (1.0 - others[index]) * miss_probability(before[index], g)
            missed = swept.distinct * (1.0 - found)
            # Neighbouring tiles that share a sector run on neighbouring SMs, mostly of the same
            # instance.
            again = max(swept.requests_bytes - float(swept.distinct.sum()), 0.0)
            again *= 1.0 / level.sms if level.instances > 1 else 0.0
            following.swept.append(Swept(index, False, float(missed.sum()) + again, missed))
        if not level.takes_stores:
            return
        kept = 1.0 - (1.0 - np.minimum(self.sweeps, 1.0)) * miss_probability(self.reads, g)
        held = np.minimum(self.dirty, self.size * kept)
        gone = self.dirty - held
        self.dirty = held
        for written in np.flatnonzero(gone.sum(axis=1) > 0.0):
            there = gone[written]
            following.swept.append(Swept(int(written), True, float(there.sum()), there))
