"""Fully associative LRU, FIFO and OPT against libCacheSim, which shares no code with us."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_cache import level_of, line_misses

from cachesim.optimal import LineStream

libcachesim = pytest.importorskip(
    "libcachesim", reason="the outside oracle, PyPI's libcachesim, cannot be imported here"
)


def their_misses(policy: str, lines: np.ndarray, ways: int) -> int:
    """Misses of a libCacheSim cache of `ways` objects of one byte each."""
    cache = getattr(libcachesim, policy)(cache_size=ways)
    requests = (libcachesim.Request(obj_id=int(line), obj_size=1) for line in lines)
    return sum(not cache.get(request) for request in requests)


@st.composite
def streams(draw) -> np.ndarray:
    """Line numbers: some lines much more often than others."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    num_lines, length = draw(st.integers(1, 300)), draw(st.integers(1, 2000))
    skew = draw(st.sampled_from([1.0, 3.0]))
    return (random.random(length) ** skew * num_lines).astype(np.int64) + 1


@settings(max_examples=30)
@given(streams(), st.integers(1, 128), st.sampled_from(["lru", "fifo"]))
def test_fully_associative_misses_are_libcachesims(lines, ways, policy) -> None:
    ours = line_misses(level_of(1, ways, replacement=policy), lines)
    assert ours == their_misses(policy.upper(), lines, ways)


def test_the_two_policies_differ_on_such_streams() -> None:
    """Else the test above could not tell them apart."""
    lines = (np.random.default_rng(1).random(2000) ** 3 * 300).astype(np.int64) + 1
    assert their_misses("LRU", lines, 50) < their_misses("FIFO", lines, 50)


@settings(max_examples=10)
@given(streams(), st.integers(1, 64))
def test_opt_misses_no_more_than_any_policy_of_theirs(lines, ways) -> None:
    with LineStream() as stream:
        stream.append(lines.astype(np.uint64), np.zeros(len(lines), np.uint32))
        best = stream.optimal_misses(1, ways)
    for policy in ("LRU", "FIFO", "Sieve", "ARC", "LFU"):
        assert best <= their_misses(policy, lines, ways), policy
