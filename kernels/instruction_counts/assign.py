"""Puts the counts to a pass's accesses, in program order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from kernels.access import Access
from kernels.instruction_counts.data import Counts, counts_of
from kernels.instruction_counts.segments import Segment, join
from kernels.method import Method
from kernels.passes import classify
from traces.trace import WAIT


@dataclass(frozen=True)
class CountedPass:
    """A pass with its counts. accesses: with their arithmetic. trailing: after the last of them.
    registers_per_thread, shared_bytes: of a launch.
    """

    accesses: tuple[Access, ...]
    trailing: Segment
    registers_per_thread: int
    shared_bytes: int


def count_pass(
    pass_name: str,
    method: Method,
    accesses: tuple[Access, ...],
    is_recorded: tuple[bool, ...],
    target: str,
) -> CountedPass:
    """The recorded accesses of a pass with the arithmetic before each.

    accesses: all of the kernel's, in the trace's order. is_recorded: whether the trace holds each;
        the arithmetic of one that it does not hold goes to the next that it does.

    Raises:
        InputError: an unknown target.
    """
    counts = counts_of(pass_name, method, target)
    places = list(enumerate(accesses))
    outside = [i for i, a in places if not a.in_loop]
    loop = [i for i, a in places if a.in_loop]
    first = [i for i in outside if not loop or i < loop[0]]
    last = [i for i in outside if i not in first]
    before = counts.before
    reads_estimate = pass_name == "sampling" and method.adaptive
    if reads_estimate or (pass_name == "classify" and classify.reads_history(method)):
        place = len(before) - 1 if pass_name == "sampling" else 1
        before = _insert_estimate(before, place, method, target)

    always = [i for i in outside if not accesses[i].subsurface_only]
    stream = _Stream(accesses, is_recorded)
    stream.follow(counts.elsewhere, always)
    elsewhere = dict(stream.arithmetic)

    stream = _Stream(accesses, is_recorded)
    stream.follow(before, first)
    stream.follow(counts.first_turn, loop)
    first_turn = dict(stream.arithmetic)
    stream.follow(counts.loop, loop)
    stream.follow(counts.after, last)

    counted = []
    for i, access in places:
        if not is_recorded[i]:
            continue
        if access.in_loop:
            access = replace(access, arithmetic=stream.arithmetic[i], first=first_turn[i])
        elif access.subsurface_only:
            access = replace(access, arithmetic=stream.arithmetic[i])
        else:
            access = replace(access, arithmetic=elsewhere[i], scattering=stream.arithmetic[i])
        counted.append(access)
    return CountedPass(
        tuple(counted), stream.carried, counts.registers_per_thread, counts.shared_bytes
    )


def _insert_estimate(
    before: tuple[Segment, ...], place: int, method: Method, target: str
) -> tuple[Segment, ...]:
    """A pass's segments with those of the estimate, whose reads the trace holds behind the first
    `place` of the pass's own. What both do to find the pixel and its depth counts once.
    """
    estimate: Counts = counts_of("estimate", method, target)
    _, *between, rest = estimate.before
    return (*before[:place], *between, join(rest, before[place]), *before[place + 1 :])


class _Stream:
    """What a warp issues, in order, cut at the recorded accesses.

    arithmetic: before the latest execution of each access. carried: since the last of them.
    """

    def __init__(self, accesses: tuple[Access, ...], is_recorded: tuple[bool, ...]) -> None:
        self._accesses = accesses
        self._is_recorded = is_recorded
        self._loads: list[bool] = []
        self.arithmetic: dict[int, Segment] = {}
        self.carried: Segment = ()

    def follow(self, segments: Iterable[Segment], accesses: list[int]) -> None:
        """One segment before each access, and one after the last; nothing where there is none."""
        for segment, access in zip(segments, [*accesses, None], strict=bool(accesses)):
            self.carried = join(self.carried, self._adjust(segment))
            if access is None:
                return
            if self._is_recorded[access]:
                self.arithmetic[access] = self.carried
                self.carried = ()
            if self._accesses[access].operation == "load":
                self._loads.append(self._is_recorded[access])

    def _adjust(self, segment: Segment) -> Segment:
        """Waits count the recorded loads alone."""
        return tuple(
            (kind, sum(self._loads[-count:]) if kind == WAIT and count else count)
            for kind, count in segment
        )
