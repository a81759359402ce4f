"""The cache against an obvious reference, bit for bit; its policies against closed forms."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_cache import ReferenceCache

from cachesim import cache
from cachesim.config import CacheLevel
from cachesim.stream import ATOMIC, GROUP_BITS, LOAD, STORE, Requests

POLICIES = ("lru", "fifo", "tree-plru", "random", "srrip")
WRITE_POLICIES = (
    "read-only",
    "write-through",
    "write-back",
    "write-evict",
    "local-write-back",
)
ALLOCATIONS = ("none", "write-allocate", "fetch-on-write", "lazy-fetch-on-read")
COUNTERS = (
    "requests",
    "accesses",
    "hits",
    "line_misses",
    "sector_misses",
    "writes",
    "write_misses",
    "stores_down",
    "write_fills",
    "bypasses",
    "bypassed_writes",
    "writebacks",
)
NUM_GROUPS = 3
#: Loads, stores and atomics among a batch's requests.
RATES = ((1, 0, 0), (0.7, 0.25, 0.05), (0.1, 0.9, 0), (0.03, 0.95, 0.02))


def level_of(num_sets: int, ways: int, **fields: object) -> CacheLevel:
    defaults = {
        "line_bytes": 128,
        "sector_bytes": 32,
        "replacement": "lru",
        "set_hash": "linear",
        "write_policy": "read-only",
        "write_allocate": "none",
    }
    fields = defaults | fields
    return CacheLevel(capacity=num_sets * ways * fields["line_bytes"], ways=ways, **fields)


def requests_of(
    line: np.ndarray,
    mask: np.ndarray | None = None,
    operation: np.ndarray | int = LOAD,
    group: np.ndarray | int = 0,
    bytes_written: np.ndarray | None = None,
    segments: np.ndarray | None = None,
    instance: np.ndarray | None = None,
) -> Requests:
    """A batch as the engine makes it; each request may have its own row of `bytes_written`."""
    n = len(line)
    segments = np.array([0, n]) if segments is None else segments
    meta = (
        np.broadcast_to(operation, n).astype(np.uint32) << np.uint32(GROUP_BITS)
    ) | np.broadcast_to(group, n).astype(np.uint32)
    return Requests(
        line=line.astype(np.uint64),
        mask=np.ones(n, np.uint8) if mask is None else mask.astype(np.uint8),
        meta=meta,
        written=np.arange(n, dtype=np.int32),
        bytes_written=np.zeros((n, 8), np.uint32) if bytes_written is None else bytes_written,
        segments=segments.astype(np.int64),
        instance=(np.zeros(len(segments) - 1) if instance is None else instance).astype(np.uint32),
        order=np.arange(len(segments) - 1),
    )


@st.composite
def cases(draw):
    """A level, its instances, bypasses and first line, and two batches of requests to it."""
    # A first line, up to 16 ways and LRU or FIFO make the sets small (`cachesim.lookup`).
    first_line = draw(st.sampled_from([None, 0, 2**40 + 7]))
    policy = draw(st.sampled_from(POLICIES if first_line is None else ("lru", "fifo", "srrip")))
    # Few sets where they have many ways, so that some hundred requests fill them.
    ways = draw(st.integers(1, 16) | st.integers(9, 64 if policy == "tree-plru" else 100))
    num_sets = draw(st.sampled_from([1, 2, 3, 7, 16] if ways <= 8 else [1, 2, 3]))
    line_bytes, sector_bytes = draw(
        st.sampled_from(
            [(128, 32), (128, 128), (64, 64), (256, 32), (128, 16), (16, 16), (4096, 512)]
        )
    )
    level = level_of(
        num_sets,
        ways,
        line_bytes=line_bytes,
        sector_bytes=sector_bytes,
        replacement=policy,
        write_policy=draw(st.sampled_from([*WRITE_POLICIES, "write-back", "write-back"])),
        write_allocate=draw(st.sampled_from(ALLOCATIONS)),
    )
    num_instances = draw(st.integers(1, 3))
    bypass_loads = draw(st.sampled_from([False, False, False, True]))
    bypass_stores = level.write_policy == "read-only" or draw(
        st.sampled_from([False, False, False, False, False, True])
    )
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    # From mostly hits to mostly misses; anywhere in the 64-bit range.
    num_lines = max(1, int(num_sets * ways * draw(st.sampled_from([0.5, 1.1, 1.5, 4]))))
    lowest, highest = (0, 2**64 - 1) if first_line is None else (first_line, first_line + 2**32 - 2)
    base = draw(st.sampled_from([lowest, highest - num_lines + 1]))
    pool = np.uint64(base) + np.arange(num_lines, dtype=np.uint64)
    if draw(st.booleans()):
        pool = random.integers(lowest, highest, num_lines, dtype=np.uint64, endpoint=True)
    rates = draw(st.sampled_from(RATES))
    batches = [
        batch_of(random, pool, level, num_instances, draw(st.sampled_from([500, 5, 0])), rates)
        for _ in range(2)
    ]
    return level, num_instances, bypass_loads, bypass_stores, first_line, batches


def batch_of(random, pool, level, num_instances, n, rates):
    sectors = level.sectors_per_line
    every_byte = (1 << min(32, level.sector_bytes)) - 1
    written = random.integers(1, every_byte, (n, 8), dtype=np.uint64, endpoint=True)
    # Halves that add up, and whole sectors, are what real stores write.
    shape = random.choice(4, (n, 8), p=[0.3, 0.1, 0.3, 0.3])
    low = max(1, every_byte & 0xFFFF)
    written = np.choose(shape, [written, every_byte, low, max(1, every_byte ^ low)])
    cuts = np.sort(random.integers(0, n + 1, random.integers(0, 6)))
    segments = np.concatenate([[0], cuts, [n]])
    return requests_of(
        random.choice(pool, n),
        random.integers(1, 1 << sectors, n),
        random.choice([LOAD, STORE, ATOMIC], n, p=rates),
        random.integers(0, NUM_GROUPS, n),
        written.astype(np.uint32),
        segments,
        random.integers(0, num_instances, len(segments) - 1),
    )


def sectors_in(mask: int) -> set[int]:
    return {s for s in range(8) if mask >> s & 1}


@settings(max_examples=250)
@given(cases())
def test_cache_equals_the_reference_bit_for_bit(case) -> None:
    level, num_instances, bypass_loads, bypass_stores, first_line, batches = case
    rules = cache.cache_rules(
        level,
        num_instances,
        bypass_loads=bypass_loads,
        bypass_stores=bypass_stores,
        first_line=first_line,
    )
    state = cache.empty_state(rules)
    counters = np.zeros((NUM_GROUPS, cache.NUM_COUNTERS), np.int64)
    reference = ReferenceCache(level, bypass_loads=bypass_loads, bypass_stores=bypass_stores)
    for requests in batches:
        # Any function of the line will do for a set.
        sets = (requests.line % np.uint64(1009) % np.uint64(level.num_sets)).astype(np.uint32)
        outcome = cache.empty_outcome(rules, len(sets))
        cache.access(state, rules, requests, sets, counters, outcome)
        compare_with_reference(reference, requests, sets, outcome)
        for column, name in enumerate(COUNTERS):
            expected = [reference.counters[group, name] for group in range(NUM_GROUPS)]
            assert counters[:, column].tolist() == expected, name
    dirty = Counter()
    if rules.can_be_dirty:
        flags = state.flags.reshape(len(state.owner), -1)
        for s in range(8):
            held = (flags[:, cache.DIRTY] >> s) & 1 == 1
            dirty.update(state.owner[held, s].tolist())
    assert dirty == reference.dirty_sectors()


def compare_with_reference(reference, requests, sets, outcome) -> None:
    instances = np.repeat(requests.instance, np.diff(requests.segments))
    for i in range(requests.num_requests):
        operation, group = int(requests.meta[i] >> GROUP_BITS), int(requests.meta[i] & 0xFFFFFF)
        expected = reference.access(
            int(instances[i]),
            int(sets[i]),
            int(requests.line[i]),
            sectors_in(int(requests.mask[i])),
            operation,
            group,
            dict(enumerate(requests.bytes_written[requests.written[i]].tolist())),
        )
        assert sectors_in(int(outcome.down[i])) == expected.down
        if operation != LOAD and len(outcome.fill):
            assert sectors_in(int(outcome.fill[i])) == expected.fill
        else:
            assert not expected.fill
        written_back = {}
        if len(outcome.evicted_owner):
            written_back = {
                s: (int(outcome.evicted_owner[i, s]) - 1, int(outcome.evicted_bytes[i, s]))
                for s in range(8)
                if outcome.evicted_owner[i, s]
            }
        assert written_back == expected.written_back
        if written_back:
            assert int(outcome.evicted_line[i]) == expected.evicted


def line_misses(level: CacheLevel, lines: np.ndarray, first_line: int | None = None) -> int:
    """Misses of whole-line loads, all in set 0 of one instance."""
    rules = cache.cache_rules(
        level, 1, bypass_loads=False, bypass_stores=True, first_line=first_line
    )
    counters = np.zeros((1, cache.NUM_COUNTERS), np.int64)
    requests = requests_of(lines)
    sets = np.zeros(len(lines), np.uint32)
    cache.access(
        cache.empty_state(rules),
        rules,
        requests,
        sets,
        counters,
        cache.empty_outcome(rules, len(lines)),
    )
    return int(counters[0, cache.LINE_MISSES])


FIRST_LINES = pytest.mark.parametrize("first_line", [None, 0], ids=["hashed", "small sets"])


@FIRST_LINES
@pytest.mark.parametrize("ways", [1, 4, 12, 16, 96])
def test_ways_plus_one_lines_in_a_circle_all_miss_under_lru_and_fifo(ways, first_line) -> None:
    circle = np.tile(np.arange(ways + 1), 5)
    for policy in ("lru", "fifo"):
        level = level_of(1, ways, replacement=policy)
        assert line_misses(level, circle, first_line) == len(circle)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("ways", [1, 3, 16, 48])
@FIRST_LINES
def test_a_working_set_that_fits_has_only_compulsory_misses(policy, ways, first_line) -> None:
    lines = np.random.default_rng(1).integers(0, ways, 500)
    level = level_of(1, ways, replacement=policy)
    assert line_misses(level, lines, first_line) == len(np.unique(lines))


@pytest.mark.parametrize(
    ("policy", "stream", "last_hits"),
    [
        # Filled 0 1 2 3, then 0 used: who is gone when 4 comes?
        ("lru", [0, 1, 2, 3, 0, 4, 1], False),
        ("lru", [0, 1, 2, 3, 0, 4, 0], True),
        ("fifo", [0, 1, 2, 3, 0, 4, 0], False),
        # The root points away from 0's half; in the other half, away from 3.
        ("tree-plru", [0, 1, 2, 3, 0, 4, 2], False),
        ("tree-plru", [0, 1, 2, 3, 0, 4, 1], True),
        # 0 was used again, so the first of those that were not goes.
        ("srrip", [0, 1, 2, 3, 0, 4, 1], False),
        ("srrip", [0, 1, 2, 3, 0, 4, 0], True),
    ],
)
@FIRST_LINES
def test_the_victim_is_the_policys(policy, stream, last_hits, first_line) -> None:
    level = level_of(1, 4, replacement=policy)
    before = line_misses(level, np.array(stream[:-1]), first_line)
    assert line_misses(level, np.array(stream), first_line) - before == (not last_hits)


@pytest.mark.parametrize("seed", range(3))
def test_sets_are_independent(seed: int) -> None:
    random = np.random.default_rng(seed)
    lines = random.integers(0, 60, 600)
    sets = lines % 3
    level = level_of(3, 5, replacement="srrip")
    rules = cache.cache_rules(level, 1, bypass_loads=False, bypass_stores=True)

    def misses(order: np.ndarray) -> int:
        counters = np.zeros((1, cache.NUM_COUNTERS), np.int64)
        outcome = cache.empty_outcome(rules, len(order))
        batch = requests_of(lines[order])
        where = sets[order].astype(np.uint32)
        cache.access(cache.empty_state(rules), rules, batch, where, counters, outcome)
        return int(counters[0, cache.LINE_MISSES])

    assert misses(np.argsort(sets, kind="stable")) == misses(np.arange(600))


@FIRST_LINES
def test_reset_forgets_everything(first_line: int | None) -> None:
    level = level_of(
        4, 3, replacement="lru", write_policy="write-back", write_allocate="fetch-on-write"
    )
    rules = cache.cache_rules(
        level, 2, bypass_loads=False, bypass_stores=False, first_line=first_line
    )
    lines = np.random.default_rng(2).integers(0, 40, 300)
    batch = requests_of(lines, operation=np.arange(300) % 2)
    sets = (lines % 4).astype(np.uint32)
    runs = []
    state = cache.empty_state(rules)
    for _ in range(2):
        counters = np.zeros((1, cache.NUM_COUNTERS), np.int64)
        cache.access(state, rules, batch, sets, counters, cache.empty_outcome(rules, 300))
        runs.append(counters)
        cache.reset(state, rules)
    np.testing.assert_array_equal(*runs)
