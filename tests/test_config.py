"""The GPU model refuses what cannot be a machine, and sizes keep every byte."""

import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from cachesim import presets
from cachesim.config import GL1, L1, L2, CacheLevel, Gpu
from cachesim.presets import with_fields
from cachesim.units import format_size, parse_size
from traces.errors import InputError

LEVEL: dict[str, Any] = {
    "capacity": 32768,
    "line_bytes": 128,
    "sector_bytes": 32,
    "ways": 4,
    "replacement": "lru",
    "set_hash": "linear",
    "write_policy": "write-back",
    "write_allocate": "lazy-fetch-on-read",
}
SLICED = LEVEL | {"num_channels": 4, "channel_interleave": 256, "partition_hash": "linear"}


@given(st.integers(min_value=0, max_value=1 << 60))
def test_a_printed_size_reads_back_as_the_same_number_of_bytes(size_bytes: int) -> None:
    assert parse_size(format_size(size_bytes)) == size_bytes


@given(
    st.integers(min_value=1, max_value=1 << 52),
    st.sampled_from([("KiB", 10), ("MiB", 20), ("GiB", 30)]),
)
def test_a_size_with_a_unit_is_the_shifted_number(count: int, unit: tuple[str, int]) -> None:
    name, shift = unit
    assert parse_size(f"{count}{name}") == parse_size(f" {count} {name} ") == count << shift


@pytest.mark.parametrize(
    ("text", "size_bytes"),
    [("49152", 49152), (49152, 49152), ("5.5MiB", 5767168), ("48 KiB", 49152), ("7 B", 7)],
)
def test_sizes_as_people_write_them(text: str | int, size_bytes: int) -> None:
    assert parse_size(text) == size_bytes


@pytest.mark.parametrize(
    ("size_bytes", "text"),
    [(49152, "48 KiB"), (5767168, "5.5 MiB"), (127, "127 B"), (1234567 << 10, "1234567 KiB")],
)
def test_sizes_are_printed_in_the_largest_unit_that_loses_nothing(
    size_bytes: int, text: str
) -> None:
    assert format_size(size_bytes) == text


@pytest.mark.parametrize("text", ["48 KB", "48k", "", "-1", "KiB", "0.3 B", "1e3", True, 4.5, None])
def test_what_is_not_a_size_is_refused_with_its_value(text: Any) -> None:
    with pytest.raises(ValueError, match=re.escape(repr(text))):
        parse_size(text)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sector_bytes": 48}, "sector_bytes = 48: allowed are powers of two"),
        ({"sector_bytes": 256}, "sector_bytes = 256 does not divide line_bytes = 128"),
        ({"sector_bytes": 8}, "sector_bytes = 8: allowed are powers of two from 16 to 4096"),
        ({"line_bytes": 256, "sector_bytes": 16}, "16 sectors per line; allowed are up to 8"),
        ({"line_bytes": 96}, "line_bytes = 96: allowed are powers of two"),
        ({"capacity": 32769}, "capacity = 32769 B is not a multiple of .* = 512 B"),
        ({"ways": 40000, "capacity": 40000 * 128}, "ways = 40000, 1 sets: too large"),
        ({"replacement": "tree-plru", "ways": 128}, "tree-plru: allowed are up to 64"),
        ({"set_hash": "ipoly", "ways": 2}, "'ipoly' with 128 sets: allowed are 16, 32, 64"),
        ({"set_hash": "fermi", "ways": 16}, "'fermi' with 16 sets: allowed are 32, 64"),
        ({"set_hash": "xor", "capacity": 3 * 512}, "'xor' with 3 sets: needs a power of two"),
        ({"replacement": "mru"}, "replacement"),
        ({"ways": 0}, "ways"),
        ({"ways": True}, "True is not a whole number"),
        ({"capacity": 0}, "capacity"),
        ({"capacity": 1 << 50}, "capacity"),
        ({"banks": 4}, "banks"),
    ],
)
def test_a_level_that_cannot_be_built_is_refused(change: dict[str, Any], message: str) -> None:
    CacheLevel(**LEVEL)
    with pytest.raises(ValidationError, match=message):
        CacheLevel(**(LEVEL | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channel_interleave": 384}, "runs of 384 B; allowed are powers of two"),
        ({"channel_interleave": 64}, "at least line_bytes = 128"),
        ({"slices_per_channel": 4}, "runs of 64 B"),
        ({"slices_per_channel": 3, "capacity": 49152}, "each of 3 slices runs of 85 B"),
        ({"num_channels": 3, "capacity": 49152, "partition_hash": "xor"}, "num_channels = 3"),
        ({"num_channels": 3}, "not a multiple"),
        ({"num_channels": 5000}, "num_channels"),
    ],
)
def test_slices_that_cannot_share_addresses_are_refused(
    change: dict[str, Any], message: str
) -> None:
    L2(**SLICED)
    with pytest.raises(ValidationError, match=message):
        L2(**(SLICED | change))


def test_the_capacity_of_a_sliced_level_is_that_of_all_slices() -> None:
    level = L2(**(SLICED | {"slices_per_channel": 2}))
    assert level.num_slices == 8
    assert level.num_sets == 32768 // 8 // 128 // 4
    assert level.sectors_per_line == 4


def test_sets_and_slices_need_not_be_powers_of_two() -> None:
    level = L2(**(SLICED | {"num_channels": 11, "capacity": 11 * 7 * 4 * 128}))
    assert (level.num_slices, level.num_sets) == (11, 7)


def test_changing_the_capacity_scales_the_sets() -> None:
    for factor in (1, 2, 3, 8):
        level = L1(**(LEVEL | {"capacity": factor * 32768}))
        assert (level.num_sets, level.ways) == (factor * 64, 4)


def test_a_gpu_checks_its_levels_against_each_other() -> None:
    gpu = presets.load("rx-6900-xt")
    with pytest.raises(InputError, match=r"gl1\.write_policy: a GL1 is read-only"):
        with_fields(gpu, {"gl1.write_policy": "write-back"})
    with pytest.raises(InputError, match=r"dram\.sector_bytes = 128 does not divide"):
        with_fields(gpu, {"dram.sector_bytes": 128})
    assert with_fields(gpu, {"dram.sector_bytes": 128, "llc": None}).dram.sector_bytes == 128
    with pytest.raises(InputError, match="lines in 16 instances; allowed are up to"):
        with_fields(gpu, {"llc.capacity": 16 << 30, "llc.ways": 32})


def test_configurations_are_immutable() -> None:
    gpu = presets.load("rtx-2060")
    with pytest.raises(ValidationError, match="frozen"):
        gpu.name = "other"  # type: ignore[misc]
    with pytest.raises(ValidationError, match="frozen"):
        gpu.l1.ways = 1  # type: ignore[misc]


@pytest.mark.parametrize("name", presets.names())
def test_a_gpu_survives_its_own_json(name: str) -> None:
    gpu = presets.load(name)
    assert Gpu.model_validate_json(gpu.model_dump_json()) == gpu


def test_gl1_needs_its_sharing() -> None:
    with pytest.raises(ValidationError, match="sms_per_instance"):
        GL1(**(LEVEL | {"write_policy": "read-only"}))
