"""Belady's OPT: how few line misses any replacement policy could reach at one level.

    trace ──► dispatch ──► coalesce ──► levels above ──► line stream ──► next uses ──► OPT

OPT evicts the line whose next use is farthest away [Belady 1966]. Every missed line is inserted:
bypassing the cache, which could miss less still, is not considered. Counted are loads at line
granularity: one access per request to a line, whatever its sectors. Stores and atomics at the
bounded level are left out of its stream, for OPT and for the policies beside it; the levels above
run as configured, so that the L2's stream is what the configured L1 passes down, fetches for stores
included.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cachesim import cache, presets
from cachesim.config import Gpu
from cachesim.level import Level
from cachesim.optimal import LineStream
from cachesim.stages import Stages
from cachesim.stream import GROUP_BITS, LOAD, Outcome, Requests
from traces.errors import WorkError, unknown
from traces.trace import Trace

LEVELS = ("l1", "l2")
_U32 = np.uint32


@dataclass(frozen=True)
class Bound:
    """Line misses of one level under OPT, LRU and its own policy, over the same loads.

    level: "l1" or "l2". accesses: load requests looked up there. misses: OPT's, the bound.
    lru_misses: LRU's. policy: the level's own `replacement`; policy_misses: its misses.
    """

    level: str
    accesses: int
    misses: int
    lru_misses: int
    policy: str
    policy_misses: int

    @property
    def miss_rate(self) -> float | None:
        """OPT's misses / accesses; None where nothing was asked."""
        return self.misses / self.accesses if self.accesses else None

    @property
    def lru_miss_rate(self) -> float | None:
        """LRU's misses / accesses; None where nothing was asked."""
        return self.lru_misses / self.accesses if self.accesses else None

    @property
    def policy_miss_rate(self) -> float | None:
        """The level's own policy's misses / accesses; None where nothing was asked."""
        return self.policy_misses / self.accesses if self.accesses else None


def belady(
    trace: Trace,
    gpu: Gpu | str,
    level: str = "l1",
    *,
    fetch_path: str | None = None,
    layout: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Bound:
    """Bound the line misses of a trace's loads at one level of a GPU.

    The trace is read once. Its line stream (the L1's of one launch at a time, as L1s start empty at
    each; the L2's whole) lies in temporary files, 20 bytes per request. In memory are the caches,
    and for the busiest set up to 105 bytes per request.

    Args:
        level: "l1" or "l2".
        fetch_path, layout: as in `simulate`.
        progress: called with the number of lane fetches read so far.

    Raises:
        InputError: an unknown GPU, level, fetch path or layout, or a trace that does not fit.
        WorkError: no room for the temporary files.
    """
    gpu = presets.load(gpu) if isinstance(gpu, str) else gpu
    if level not in LEVELS:
        raise unknown("level", level, LEVELS)
    recorded: list[_RecordedLevel] = []

    def up_to_recorded(levels: list[Level]) -> list[Level]:
        index = [above.name for above in levels].index(level)
        recorded.append(_RecordedLevel(levels[index], stream))
        return [*levels[:index], recorded[0]]

    def at_launch_end() -> None:
        if level == "l1":
            recorded[0].end_stream()

    try:
        with LineStream() as stream:
            stages = Stages(
                trace,
                gpu,
                fetch_path,
                layout,
                levels_of=up_to_recorded,
                at_launch_end=at_launch_end,
            )
            try:
                for chunk in trace.chunks():
                    stages.add(chunk)
                    if progress is not None:
                        progress(stages.num_lane_fetches)
                stages.finish()
            finally:
                stages.close()
            recorded[0].end_stream()
    except OSError as error:
        raise WorkError(f"temporary files of the line stream: {error.strerror}") from error
    return recorded[0].bound()


class _RecordedLevel(Level):
    """The bounded level: it writes down its stream of loads instead of caching, and counts the
    misses of whole lines under LRU and under its own policy.
    """

    def __init__(self, level: Level, stream: LineStream) -> None:
        caches = 1 if level.partition is not None else level.rules.num_instances
        skips = bool(level.rules.bypass_loads)
        super().__init__(
            level.name, level.config, caches, 1, is_last=level.by_slice, bypass_loads=skips
        )
        whole_lines = {"sector_bytes": level.config.line_bytes, "write_policy": "read-only"}
        self._policies = {
            name: Level(
                level.name,
                level.config.model_copy(update={**whole_lines, "replacement": name}),
                caches,
                1,
                is_last=level.by_slice,
            )
            for name in dict.fromkeys(("lru", level.config.replacement))
        }
        self._stream = stream
        self._accesses = self._misses = 0

    def access(self, requests: Requests, sets: npt.NDArray[np.uint32], outcome: Outcome) -> None:
        if self.rules.bypass_loads:
            return
        loads = requests.meta[: requests.num_requests] >> _U32(GROUP_BITS) == LOAD
        before = np.concatenate([[0], np.cumsum(loads)])
        lengths = np.diff(requests.segments)
        kept_sets = sets[: len(loads)][loads]
        kept = requests._replace(
            line=requests.line[: len(loads)][loads],
            mask=np.ones(before[-1], np.uint8),
            meta=np.full(before[-1], LOAD << GROUP_BITS, np.uint32),
            segments=before[requests.segments],
        )
        for level in self._policies.values():
            level.access(kept, kept_sets, cache.empty_outcome(level.rules, len(kept_sets)))
        instance = np.repeat(requests.instance, lengths)[loads]
        self._stream.append(kept.line, instance * _U32(self.rules.num_sets) + kept_sets)

    def end_stream(self) -> None:
        """Bound what was written down since the last call; the level starts empty again."""
        num_sets = self.rules.num_instances * self.rules.num_sets
        self._accesses += self._stream.num_requests
        self._misses += self._stream.optimal_misses(num_sets, self.rules.ways)
        for level in self._policies.values():
            cache.reset(level.state, level.rules)

    def bound(self) -> Bound:
        """The sums over all streams."""
        misses = {
            name: int(level.counters[:, cache.LINE_MISSES].sum())
            for name, level in self._policies.items()
        }
        own = self.config.replacement
        return Bound(self.name, self._accesses, self._misses, misses["lru"], own, misses[own])
