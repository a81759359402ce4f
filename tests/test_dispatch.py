"""Dispatch against a slow model of the order stated in the design: turns, SMs in index order, warps
round robin, CTAs in order.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cachesim.config import SM
from cachesim.dispatch import Dispatcher, join_warps, resident_ctas
from traces.errors import InputError
from traces.texture import INACTIVE_TEXEL
from traces.trace import Chunk, Launch

#: CTA, warp, step and L1 unit of every issued row.
Issue = list[tuple[int, int, int, int]]


def sm_of(count: int, max_warps: int = 64, max_ctas: int = 32, warp_size: int = 32) -> SM:
    return SM(
        count=count,
        max_warps=max_warps,
        max_ctas=max_ctas,
        warp_size=warp_size,
        registers=65536,
        shared=65536,
    )


def expected_issue(counts: np.ndarray, num_sms: int, places: int, units: int) -> Issue:
    """counts: (ctas, warps) accesses. places: CTAs that an SM holds."""
    waiting = [cta for cta in range(len(counts)) if counts[cta].any()]
    num_warps = counts.shape[1]
    # resident[sm][place] = CTA or None; done[cta, warp] = accesses issued.
    resident: list[list[int | None]] = [[None] * places for _ in range(num_sms)]
    done = np.zeros_like(counts)
    for place in range(places):
        for sm in range(num_sms):
            if waiting:
                resident[sm][place] = waiting.pop(0)
    turn_of = [0] * num_sms
    issued: Issue = []

    def has_access(sm: int, slot: int) -> bool:
        cta = resident[sm][slot // num_warps]
        return cta is not None and done[cta, slot % num_warps] < counts[cta, slot % num_warps]

    while any(cta is not None for places_of_sm in resident for cta in places_of_sm):
        for sm in range(num_sms):
            slots = [(turn_of[sm] + k) % (places * num_warps) for k in range(places * num_warps)]
            slot = next((slot for slot in slots if has_access(sm, slot)), None)
            if slot is None:
                continue
            cta, warp = resident[sm][slot // num_warps], slot % num_warps
            issued.append((cta, warp, int(done[cta, warp]), sm * units + slot // 2 % units))
            done[cta, warp] += 1
            turn_of[sm] = slot + 1
            if (done[cta] == counts[cta]).all():
                resident[sm][slot // num_warps] = waiting.pop(0) if waiting else None
    return issued


def chunks_of(counts: np.ndarray, cuts: list[int]) -> list[Chunk]:
    """Rows whose lane 0 says CTA, warp and step."""
    made = []
    for first, last in itertools.pairwise(cuts):
        flat = counts[first:last].ravel()
        names = [
            (cta << 20) | (warp << 10) | step
            for cta in range(first, last)
            for warp in range(counts.shape[1])
            for step in range(counts[cta, warp])
        ]
        lanes = np.zeros((len(names), 32), np.uint32)
        lanes[:, 0] = names
        offsets = np.concatenate([[0], np.cumsum(flat)]).astype(np.int64)
        made.append(Chunk(0, first, offsets, np.zeros(len(names), np.uint16), lanes))
    return made


def issue(dispatcher: Dispatcher, launch: Launch, chunks: list[Chunk]) -> Issue:
    """All rows of a launch, as `simulate` takes them out."""
    issued: Issue = []

    def take() -> None:
        while (rows := dispatcher.issue()) is not None:
            names = rows.lanes[rows.slot, 0].tolist()
            issued.extend(
                (name >> 20, name >> 10 & 1023, name & 1023, unit)
                for name, unit in zip(names, rows.instance.tolist(), strict=True)
            )

    dispatcher.begin(launch)
    for chunk in chunks:
        dispatcher.add(chunk)
        take()
    dispatcher.finish()
    take()
    return issued


@st.composite
def launches(draw):
    """Counts of accesses, an SM configuration and units per SM."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    num_ctas, num_warps = draw(st.integers(0, 40)), draw(st.integers(1, 5))
    most = draw(st.sampled_from([1, 3, 12]))
    counts = random.integers(0, most + 1, (num_ctas, num_warps))
    # CTAs without accesses, and now and then one that stays much longer than the rest.
    counts[random.random(num_ctas) < draw(st.sampled_from([0.0, 0.4]))] = 0
    if num_ctas and draw(st.booleans()):
        counts[random.integers(num_ctas), random.integers(num_warps)] = 200
    max_ctas = draw(st.integers(1, 6))
    max_warps = draw(st.integers(num_warps, 30))
    return counts, sm_of(draw(st.integers(1, 7)), max_warps, max_ctas), draw(st.integers(1, 3))


@settings(max_examples=60)
@given(launches(), st.integers(0, 2**32 - 1), st.sampled_from([8, 50, 4096]))
def test_order_is_that_of_the_design_however_the_trace_is_cut(case, seed, batch_rows) -> None:
    counts, sm, units = case
    num_ctas, num_warps = counts.shape
    launch = Launch(0, "p", num_ctas, num_warps)
    expected = expected_issue(counts, sm.count, min(sm.max_ctas, sm.max_warps // num_warps), units)
    cuts = np.random.default_rng(seed).integers(0, num_ctas + 1, 3)
    some = [0, *sorted(cuts.tolist()), num_ctas]
    dispatcher = Dispatcher(sm, units, np.uint32, batch_rows)
    for cut in ([0, num_ctas], list(range(num_ctas + 1)), some):
        # The same dispatcher, launch after launch, as in a simulation.
        assert issue(dispatcher, launch, chunks_of(counts, cut)) == expected


def test_the_store_of_rows_grows_and_wraps() -> None:
    counts = np.full((300, 2), 60)
    counts[0] = 900
    sm = sm_of(3, max_ctas=2)
    dispatcher = Dispatcher(sm, 1, np.uint32, 512)
    issued = issue(dispatcher, Launch(0, "p", 300, 2), chunks_of(counts, list(range(0, 301, 20))))
    assert issued == expected_issue(counts, 3, 2, 1)


def test_ctas_are_placed_one_per_sm_in_turn_and_then_where_one_left() -> None:
    counts = np.array([[2], [1], [1], [1], [1]])
    issued = issue(
        Dispatcher(sm_of(2, max_ctas=1), 1, np.uint32, 64),
        Launch(0, "p", 5, 1),
        chunks_of(counts, [0, 5]),
    )
    # CTA 1 leaves SM 1 in the first turn, so CTA 2 comes there and CTA 3 after it.
    assert [(cta, unit) for cta, _, _, unit in issued] == [
        (0, 0),
        (1, 1),
        (0, 0),
        (2, 1),
        (3, 0),
        (4, 1),
    ]


@pytest.mark.parametrize(
    ("warps_per_cta", "registers", "shared", "warp_size", "expected"),
    [
        (1, 0, 0, 32, 16),  # CTA slots
        (8, 0, 0, 32, 6),  # 48 warps
        (2, 32, 0, 32, 16),
        (8, 64, 0, 32, 4),  # 65536 registers of 64 x 256
        (2, 0, 20000, 32, 3),  # 65536 B of shared memory
        (8, 0, 0, 64, 12),  # four waves of 64
        (3, 0, 0, 64, 16),  # two waves
        (8, 128, 16384, 64, 2),
    ],
)
def test_residency_is_the_least_of_the_four_limits(
    warps_per_cta: int, registers: int, shared: int, warp_size: int, expected: int
) -> None:
    sm = sm_of(1, max_warps=48, max_ctas=16, warp_size=warp_size)
    launch = Launch(0, "p", 1, warps_per_cta, registers, shared)
    assert resident_ctas(sm, launch) == expected


@pytest.mark.parametrize(
    "launch",
    [Launch(0, "p", 1, 65), Launch(0, "p", 1, 32, 255), Launch(0, "p", 1, 1, 0, 65537)],
    ids=["warps", "registers", "shared"],
)
def test_a_cta_that_fits_no_sm_is_bad_input(launch: Launch) -> None:
    with pytest.raises(InputError, match="does not fit an SM"):
        resident_ctas(sm_of(1), launch)


def warps_of(programs: list[list[int]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets, lanes and instructions of warps; every lane of a row holds the row's number."""
    lengths = [len(program) for program in programs]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    instruction = np.array([i for program in programs for i in program], np.uint16)
    lanes = np.repeat(np.arange(len(instruction), dtype=np.uint32)[:, None], 32, axis=1)
    return offsets, lanes, instruction


def waves(
    programs: list[list[int]], warps_per_cta: int
) -> list[list[tuple[int, int | None, int | None]]]:
    """Per wave its rows: instruction, row number of the low half and of the high half."""
    offsets, lanes, instruction = join_warps(*warps_of(programs), warps_per_cta)
    numbers = [
        (int(i), *(None if half == INACTIVE_TEXEL else int(half) for half in (row[0], row[32])))
        for i, row in zip(instruction, lanes, strict=True)
    ]
    for row in lanes:
        assert len(set(row[:32])) == len(set(row[32:])) == 1
    return [numbers[a:b] for a, b in itertools.pairwise(offsets)]


def test_warps_with_the_same_program_issue_as_one_wave() -> None:
    assert waves([[0, 1, 2], [0, 1, 2]], 2) == [[(0, 0, 3), (1, 1, 4), (2, 2, 5)]]


def test_a_half_with_more_samples_issues_alone_at_the_end() -> None:
    assert waves([[0, 1, 1, 1], [0, 1]], 2) == [[(0, 0, 4), (1, 1, 5), (1, 2, None), (1, 3, None)]]
    assert waves([[0], [0, 1]], 2) == [[(0, 0, 1), (1, None, 2)]]


def test_where_halves_differ_the_earlier_instruction_issues_first() -> None:
    assert waves([[0, 2], [1, 2]], 2) == [[(0, 0, None), (1, None, 2), (2, 1, 3)]]


def test_an_odd_last_warp_is_a_wave_of_its_own_in_every_cta() -> None:
    joined = waves([[0], [0], [5], [1], [1], []], 3)
    assert joined == [[(0, 0, 1)], [(5, 2, None)], [(1, 3, 4)], []]


@settings(max_examples=40)
@given(st.lists(st.lists(st.integers(0, 4), max_size=6), min_size=4, max_size=4))
def test_a_wave_keeps_each_halfs_accesses_in_order_and_loses_none(programs) -> None:
    offsets, _, _ = warps_of(programs)
    for k, wave in enumerate(waves(programs, 4)):
        for half, warp in enumerate((2 * k, 2 * k + 1)):
            rows = [row[1 + half] for row in wave if row[1 + half] is not None]
            assert rows == list(range(offsets[warp], offsets[warp + 1]))
            program = [row[0] for row in wave if row[1 + half] is not None]
            assert program == programs[warp]


def test_a_wave64_sm_issues_joined_rows() -> None:
    dispatcher = Dispatcher(sm_of(1, warp_size=64), 1, np.uint32, 64)
    dispatcher.begin(Launch(0, "p", 1, 2))
    dispatcher.add(chunks_of(np.array([[2, 1]]), [0, 1])[0])
    dispatcher.finish()
    rows = dispatcher.issue()
    assert rows is not None
    assert rows.lanes[rows.slot][:, [0, 32]].tolist() == [[0, 1 << 10], [1, INACTIVE_TEXEL]]
