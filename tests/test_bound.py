"""Belady's OPT against an obvious one, and against what must hold of any bound."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import traces
from test_cache import POLICIES, level_of, line_misses

from cachesim import belady, presets, simulate
from cachesim.optimal import LineStream
from traces.errors import InputError
from traces.synthetic import gather, scatter, stream
from traces.texture import Texture
from traces.trace import Instruction, Launch, from_chunks

TEXTURE = Texture("t", "RGBA16F", 96, 64)


def opt_misses(lines: np.ndarray, sets: np.ndarray, num_sets: int, ways: int) -> int:
    """As `belady` calls it, in three pieces."""
    with LineStream() as stream:
        for line, cache_set in zip(
            np.array_split(lines.astype(np.uint64), 3), np.array_split(sets, 3), strict=True
        ):
            stream.append(line, cache_set.astype(np.uint32))
        assert stream.num_requests == len(lines)
        return stream.optimal_misses(num_sets, ways)


def obvious_opt_misses(lines: list[int], ways: int) -> int:
    """One set: look ahead for every resident, evict the one needed last."""
    resident: set[int] = set()
    misses = 0
    for now, line in enumerate(lines):
        if line in resident:
            continue
        misses += 1
        if len(resident) == ways:
            ahead = lines[now + 1 :]
            resident.remove(
                max(resident, key=lambda r: ahead.index(r) if r in ahead else now + 10**9)
            )
        resident.add(line)
    return misses


def fewest_misses(lines: tuple[int, ...], ways: int, resident: frozenset[int] = frozenset()) -> int:
    """The fewest misses of any way to evict: every choice is tried."""
    if not lines:
        return 0
    line, rest = lines[0], lines[1:]
    if line in resident:
        return fewest_misses(rest, ways, resident)
    if len(resident) < ways:
        return 1 + fewest_misses(rest, ways, resident | {line})
    return 1 + min(fewest_misses(rest, ways, (resident - {out}) | {line}) for out in resident)


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 3),
    st.integers(1, 12),
    st.sampled_from([3, 20, 200]),
)
def test_opt_equals_an_obvious_one_in_every_set(seed, num_sets, ways, num_lines) -> None:
    random = np.random.default_rng(seed)
    length = int(random.integers(0, 300))
    # Far apart, or alike in their low halves, so that the table of next uses sees all bits.
    pool = random.integers(0, 2**64, num_lines, dtype=np.uint64)
    if seed % 2:
        pool = np.arange(num_lines, dtype=np.uint64) << np.uint64(34)
    lines = random.choice(pool, length)
    sets = lines % np.uint64(num_sets)
    expected = sum(obvious_opt_misses(lines[sets == s].tolist(), ways) for s in range(num_sets))
    assert opt_misses(lines, sets, num_sets, ways) == expected


@settings(max_examples=40)
@given(st.lists(st.integers(0, 4), max_size=11), st.integers(1, 3))
def test_no_choice_of_victims_does_better(lines, ways) -> None:
    made = np.array(lines, np.uint64)
    assert opt_misses(made, np.zeros(len(made)), 1, ways) == fewest_misses(tuple(lines), ways)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_no_policy_of_ours_misses_less_and_at_infinite_capacity_all_miss_the_same(
    seed, ways
) -> None:
    random = np.random.default_rng(seed)
    lines = (random.random(800) ** 2 * 120).astype(np.uint64)
    nothing = np.zeros(len(lines))
    best = opt_misses(lines, nothing, 1, ways)
    for policy in POLICIES:
        assert best <= line_misses(level_of(1, ways, replacement=policy), lines), policy
    assert opt_misses(lines, nothing, 1, 120) == len(np.unique(lines))


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("level", ["l1", "l2"])
def test_the_bound_of_a_trace_lies_below_lru_and_its_own_policy(policy: str, level: str) -> None:
    gpu = presets.load("titan-x-pascal")
    small = {"l1.capacity": 2 * 4 * 8 * 128, "l1.ways": 16, "l2.capacity": 24 * 4 * 4 * 128}
    small |= {"l2.ways": 4, "l2.set_hash": "linear", f"{level}.replacement": policy}
    gpu = presets.with_fields(gpu, small)
    bound = belady(scatter(96, 64, 18.0, 8), gpu, level)
    assert (bound.level, bound.policy) == (level, policy)
    assert 0 < bound.misses < min(bound.lru_misses, bound.policy_misses)
    assert (bound.policy_misses == bound.lru_misses) == (policy == "lru")
    assert bound.miss_rate == bound.misses / bound.accesses
    assert bound.lru_miss_rate == bound.lru_misses / bound.accesses
    assert bound.policy_miss_rate == bound.policy_misses / bound.accesses


@pytest.mark.parametrize("name", ["titan-x-pascal", "rx-5700-xt", "rtx-2060-gpgpusim"])
def test_accesses_and_lru_misses_are_those_of_the_simulation(name: str) -> None:
    """Over loads: tag look-ups, and with whole-line sectors the line misses."""
    trace = gather(TEXTURE, 9, 4)
    whole = {f"{p}.sector_bytes": 128 for p in ("l1", "l2")}
    gpu = presets.with_fields(presets.load(name), whole)
    report = simulate(trace, gpu)
    for level in ("l1", "l2"):
        bound = belady(trace, gpu, level)
        counters = report.counters[level]
        assert bound.accesses == counters.requests
        assert bound.lru_misses == counters.line_misses
        assert bound.misses <= bound.lru_misses


def test_l1s_start_empty_at_each_launch_and_the_l2_does_not() -> None:
    one, two = (scatter(96, 64, 18.0, 4, frames=n) for n in (1, 2))
    l1 = [belady(trace, "titan-x-pascal", "l1") for trace in (one, two)]
    l2 = [belady(trace, "titan-x-pascal", "l2") for trace in (one, two)]
    # The second frame's samples are other ones, so its L1 misses about as often again.
    assert l1[1].misses > 1.8 * l1[0].misses
    assert l2[1].misses < 1.2 * l2[0].misses


@settings(max_examples=10)
@given(traces(max_rows_per_warp=4), st.sampled_from(["l1", "l2"]))
def test_any_trace_has_a_bound(trace, level) -> None:
    """Stores, atomics, several launches, either kind of lane."""
    bound = belady(trace, "titan-x-pascal", level)
    assert 0 <= bound.misses <= bound.lru_misses <= bound.accesses
    assert bound.lru_misses == bound.policy_misses


def test_stores_are_left_out() -> None:
    loads = stream(64, 2)
    chunks = list(loads.chunks())
    stores = from_chunks(
        chunks, (), [Instruction("import", -1, "store", access_bytes=8)], loads.launches
    )
    assert belady(stores, "titan-x-pascal", "l2").accesses == 0
    assert belady(stores, "titan-x-pascal", "l1").miss_rate is None
    assert belady(loads, "titan-x-pascal", "l1").misses == 64 * 2 * 2


def test_loads_that_go_around_the_l1_are_not_its_accesses() -> None:
    trace = gather(TEXTURE, 4, 2)
    bound = belady(trace, "titan-x-pascal", "l1", fetch_path="global")
    assert (bound.accesses, bound.misses) == (0, 0)
    assert belady(trace, "titan-x-pascal", "l2", fetch_path="global").accesses > 0


def test_an_empty_trace_has_an_empty_bound() -> None:
    trace = from_chunks(
        (), (), [Instruction("import", -1, access_bytes=4)], [Launch(0, "import", 0, 1)]
    )
    assert belady(trace, "titan-x-pascal").miss_rate is None


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"level": "l3"}, "unknown level 'l3'"),
        ({"fetch_path": "textur"}, "did you mean 'texture'"),
        ({"layout": "mortn"}, "did you mean 'morton'"),
        ({"gpu": "titan-x-pascl"}, "titan-x-pascal"),
    ],
)
def test_wrong_names_are_bad_input(wrong: dict[str, str], told: str) -> None:
    arguments = {"gpu": "titan-x-pascal"} | wrong
    with pytest.raises(InputError, match=told):
        belady(gather(TEXTURE, 4, 1), **arguments)


def test_progress_counts_lane_fetches() -> None:
    told: list[int] = []
    belady(stream(8192, 2), "titan-x-pascal", progress=told.append)
    assert told == sorted(told)
    assert 0 < told[-1] <= 8192 * 2 * 32
