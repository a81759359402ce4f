"""Every preset's traffic reaches every set of every level and every slice, about evenly; the hashes
are those of the facts sheet.

A set index that shares bits with the slice, or with what chooses the SM, can leave most sets of a
cache unused, and nothing but the miss rate would show it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cachesim import presets, simulate
from cachesim.address import index_of, ipoly_columns, partition_of, set_hash, slice_and_line
from cachesim.config import L2, CacheLevel
from cachesim.level import Level
from traces.synthetic import gather, pixel_pass, stream
from traces.texture import Texture

#: Level name -> requests to each (instance or slice, set).
Reached = dict[str, np.ndarray]


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> Iterator[Reached]:
    """Requests per set, as the levels see them, of what a test simulates."""
    counts: Reached = {}
    access = Level.access

    def counting_access(level, requests, sets, outcome) -> None:
        rules = level.rules
        instance = np.repeat(requests.instance, np.diff(requests.segments)).astype(np.int64)
        place = instance * rules.num_sets + sets[: requests.num_requests]
        found = np.bincount(place, minlength=rules.num_instances * rules.num_sets)
        shape = (-1, level.config.num_sets)
        counts[level.name] = counts.get(level.name, 0) + found.reshape(shape)
        access(level, requests, sets, outcome)

    monkeypatch.setattr(Level, "access", counting_access)
    return counts


def dispersion(counts: np.ndarray) -> float:
    """Variance over mean: 0 where all are alike, 1 for places drawn at random."""
    return float(counts.var() / counts.mean())


@pytest.mark.parametrize("name", presets.names())
def test_a_stream_reaches_every_set_of_every_cache_evenly(name: str, reached: Reached) -> None:
    """32 MiB, every lane its own 16 bytes, through the L1."""
    report = simulate(stream(8192, 8, 16), name, fetch_path="readonly")
    assert tuple(reached) == report.levels
    for level, counts in reached.items():
        assert counts.min() > 0, level
        assert dispersion(counts) < 3, level
        if level in ("l2", "llc"):
            assert dispersion(counts.sum(axis=1)) < 4, f"slices of {level}"


@pytest.mark.parametrize("name", presets.names())
def test_a_texture_pass_reaches_every_set_and_every_slice_evenly(
    name: str, reached: Reached
) -> None:
    """Every texel of a 32 MiB texture once, in the preset's own layout.

    An SM that takes every 28th tile may well see half of the sets only, where these are indexed
    linearly (`titan-x-pascal-gpgpusim` does); so the sets of an L1 are summed over its instances.
    """
    simulate(pixel_pass(Texture("t", "RGBA16F", 2048, 2048)), name)
    for level, counts in reached.items():
        sliced = level in ("l2", "llc")
        counts = counts if sliced else counts.sum(axis=0)
        assert counts.min() > 0, level
        assert dispersion(counts) < 4, level
        if sliced:
            assert dispersion(counts.sum(axis=1)) < 5, f"slices of {level}"


@pytest.mark.parametrize("name", presets.names())
def test_scattered_fetches_reach_every_set_of_every_l1(name: str, reached: Reached) -> None:
    simulate(gather(Texture("t", "RGBA16F", 1024, 512), 16, 1), name)
    for level in set(reached) - {"l2", "llc"}:
        assert reached[level].min() > 0, level


def divide(number: int, polynomial: int) -> int:
    """The remainder of a long division over GF(2)."""
    degree = polynomial.bit_length() - 1
    for bit in range(number.bit_length() - 1, degree - 1, -1):
        if number >> bit & 1:
            number ^= polynomial << (bit - degree)
    return number


def level_of(num_sets: int, ways: int, set_hash: str = "linear") -> CacheLevel:
    return CacheLevel(
        capacity=num_sets * ways * 128,
        line_bytes=128,
        sector_bytes=32,
        ways=ways,
        replacement="lru",
        set_hash=set_hash,
        write_policy="read-only",
        write_allocate="none",
    )


# Bytes, because Hypothesis's large integers are mostly small; and every single bit below.
NUMBERS = st.binary(min_size=7, max_size=7).map(lambda b: int.from_bytes(b, "big"))
BITS = [1 << k for k in range(57)]


def set_index(level: CacheLevel, number: int) -> int:
    hashed = set_hash(level)
    return int(index_of(np.uint64(number), hashed.kind, hashed.size, hashed.table))


@settings(max_examples=30)
@given(NUMBERS, st.sampled_from([(16, 0b10011, 16), (32, 0b100101, 19), (64, 0b1000011, 24)]))
def test_ipoly_is_the_remainder_of_a_polynomial_division(number: int, case) -> None:
    """Facts sheet 3.2: block number mod P(x), bits up to 16, 19, 24."""
    num_sets, polynomial, last_bit = case
    level = level_of(num_sets, 2, set_hash="ipoly")
    for value in (number, *BITS):
        assert set_index(level, value) == divide(value & ((2 << last_bit) - 1), polynomial)


@settings(max_examples=100)
@given(NUMBERS, st.sampled_from([32, 64]))
def test_fermi_is_the_facts_sheets_list_of_bits(number: int, num_sets: int) -> None:
    """Facts sheet 3.2: low5 = a[11:7] XOR a{13, 14, 15, 17, 19}; 64 sets append a12."""
    address = number << 7
    bit = lambda k: address >> k & 1  # noqa: E731
    pairs = ((7, 13), (8, 14), (9, 15), (10, 17), (11, 19))
    expected = sum((bit(low) ^ bit(high)) << k for k, (low, high) in enumerate(pairs))
    if num_sets == 64:
        expected += bit(12) << 5
    assert set_index(level_of(num_sets, 2, set_hash="fermi"), number) == expected


@settings(max_examples=60)
@given(NUMBERS, st.integers(1, 200), st.sampled_from([1, 2, 8, 64, 1024]))
def test_linear_and_xor_sets(number: int, num_sets: int, power: int) -> None:
    assert set_index(level_of(num_sets, 2), number) == number % num_sets
    folded = (number % power) ^ (number // power % power)
    assert set_index(level_of(power, 2, set_hash="xor"), number) == folded


def sliced(channels: int, per_channel: int, interleave: int, partition_hash: str) -> L2:
    return L2(
        capacity=channels * per_channel * 16 * 128,
        line_bytes=128,
        sector_bytes=32,
        ways=4,
        replacement="lru",
        set_hash="linear",
        write_policy="write-back",
        write_allocate="lazy-fetch-on-read",
        num_channels=channels,
        slices_per_channel=per_channel,
        channel_interleave=interleave,
        partition_hash=partition_hash,
    )


def slice_of(level: L2, address: int) -> tuple[int, int]:
    p = partition_of(level)
    u = np.uint64
    where, line = slice_and_line(
        u(address),
        u(p.num_channels),
        u(p.slices_per_channel),
        u(p.run_shift),
        p.hash.kind,
        p.hash.size,
        p.hash.table,
        p.xor,
        u(7),
    )
    return int(where), int(line)


ADDRESSES = st.one_of(
    st.binary(min_size=8, max_size=8).map(lambda b: int.from_bytes(b, "big")),
    # Around multiples of a row of twelve channels, where a rounded quotient would be off by one.
    st.builds(
        lambda row, off: max(0, row * 3072 + off), st.integers(0, 2**52), st.integers(-256, 256)
    ),
)


@settings(max_examples=150)
@given(ADDRESSES)
def test_twelve_channels_of_two_slices_as_the_facts_sheet_decodes_them(address: int) -> None:
    """Facts sheet 3.4: chip = (a >> 8) mod 12; rest = (a >> 8) div 12, a[7:0]; its bit 7: slice."""
    chip, rest = (address >> 8) % 12, ((address >> 8) // 12) << 8 | (address & 255)
    where, line = slice_of(sliced(12, 2, 256, "linear"), address)
    assert where == chip * 2 + (rest >> 7 & 1)
    # What is left of the address without channel and slice bits.
    assert line == rest >> 8


@settings(max_examples=60)
@given(ADDRESSES, st.sampled_from([(16, 1, 256), (8, 2, 1024), (5, 4, 2048)]))
def test_plain_and_xor_interleave_keep_every_address_apart(address: int, shape) -> None:
    channels, per_channel, interleave = shape
    level = sliced(channels, per_channel, interleave, "linear")
    where, line = slice_of(level, address)
    run = interleave // per_channel
    assert where == address // interleave % channels * per_channel + address % interleave // run
    assert line == address // (interleave * channels) * (run // 128) + address % run // 128
    if channels & (channels - 1) == 0:
        row = address // (interleave * channels)
        where, same = slice_of(sliced(channels, per_channel, interleave, "xor"), address)
        channel = (address // interleave % channels) ^ (row % channels)
        assert (where, same) == (channel * per_channel + address % interleave // run, line)


@settings(max_examples=60)
@given(ADDRESSES)
def test_ipoly_partition_hashes_over_the_next_power_of_two(address: int) -> None:
    """Facts sheet 3.4, mode 2: 12 channels of 2 slices hash over 16 x 2 entries, then modulo 24."""
    run = address >> 7
    expected = divide(run & ((1 << 20) - 1), 0b100101) % 24
    assert slice_of(sliced(12, 2, 256, "ipoly"), address)[0] == expected


@pytest.mark.parametrize("degree", range(1, 9))
def test_every_ipoly_polynomial_reaches_every_value(degree: int) -> None:
    """The columns span the whole space, so that no slice is left out."""
    reached = {0}
    for column in ipoly_columns(degree):
        reached |= {value ^ column for value in reached}
    assert reached == set(range(1 << degree))
