"""Analyses against obvious references: sets, lists and an LRU stack that is searched."""

from collections import Counter
from collections.abc import Iterator

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import lane_address_traces, texel_traces

from traces.analysis import footprint, lane_fetches, reuse_distance
from traces.errors import InputError
from traces.placement import AddressMap, place
from traces.synthetic import gather, pixel_pass, stream
from traces.texture import Texture, unpack_texel
from traces.trace import Trace


def accesses(trace: Trace, address_map: AddressMap | None) -> Iterator[list[tuple[int, int, int]]]:
    """Per row, the (texture, mip, byte address) of every texel, in lane order, one at a time."""
    for chunk in trace.chunks():
        for index, lanes, active in zip(chunk.instruction, chunk.lanes, chunk.active, strict=True):
            instruction = trace.instructions[index]
            row = []
            for value in lanes[active]:
                if address_map is None:
                    row.append((-1, -1, int(value)))
                    continue
                texture = instruction.texture
                mip, y, x = (int(v) for v in unpack_texel(value))
                width, height = trace.textures[texture].mip_size(mip)
                corners = [(y, x)]
                if instruction.footprint == "bilinear":
                    right, below = min(x + 1, width - 1), min(y + 1, height - 1)
                    corners += [(y, right), (below, x), (below, right)]
                row += [(texture, mip, address_map.address(texture, mip, v, u)) for v, u in corners]
            yield row


def stack_distances(trace: Trace, address_map: AddressMap | None, line_bytes: int) -> Counter[int]:
    """How often each distance occurs; -1 for first requests."""
    stack: list[int] = []
    distances: Counter[int] = Counter()
    for row in accesses(trace, address_map):
        for line in dict.fromkeys(address // line_bytes for _, _, address in row):
            if line in stack:
                distances[stack.index(line)] += 1
                stack.remove(line)
            else:
                distances[-1] += 1
            stack.insert(0, line)
    return distances


def assert_distances(trace: Trace, address_map: AddressMap | None, line_bytes: int) -> None:
    found = reuse_distance(trace, address_map, line_bytes)
    expected = stack_distances(trace, address_map, line_bytes)
    got = {distance: int(n) for distance, n in enumerate(found.histogram) if n}
    if found.num_cold:
        got[-1] = found.num_cold
    assert got == dict(expected)


@settings(max_examples=25)
@given(trace=texel_traces(max_rows_per_warp=3, max_side=64), line_bytes=st.sampled_from([32, 128]))
def test_reuse_distances_of_texels_are_those_of_a_searched_stack(
    trace: Trace, line_bytes: int
) -> None:
    assert_distances(trace, place(trace.textures), line_bytes)


@settings(max_examples=25)
@given(trace=lane_address_traces(max_rows_per_warp=3), line_bytes=st.sampled_from([16, 128]))
def test_reuse_distances_of_addresses_are_those_of_a_searched_stack(
    trace: Trace, line_bytes: int
) -> None:
    assert_distances(trace, None, line_bytes)


def test_reuse_distances_survive_renumbering_and_growth() -> None:
    # Long enough that the tree is renumbered and the hash table grown while distances are taken.
    trace = gather(Texture("a", "RGBA16F", 128, 96), 40, 12)
    assert_distances(trace, place(trace.textures, "row-major"), 512)


def test_misses_fall_with_capacity_to_the_compulsory_ones() -> None:
    trace = gather(Texture("a", "RGBA16F", 64, 64), 6, 4)
    found = reuse_distance(trace, place(trace.textures), 128)
    misses = [found.misses(capacity) for capacity in range(0, 300)]
    assert misses[0] == found.num_requests
    assert misses == sorted(misses, reverse=True)
    assert misses[-1] == found.num_cold == 64 * 64 * 8 // 128


def test_a_stream_has_no_reuse() -> None:
    found = reuse_distance(stream(32, 4), None, 128)
    assert found.num_requests == found.num_cold == 32 * 4 * 32 * 8 // 128


@settings(max_examples=25)
@given(trace=texel_traces(max_rows_per_warp=3, max_side=64), line_bytes=st.sampled_from([32, 128]))
def test_footprints_are_distinct_lines_and_sectors_per_level(trace: Trace, line_bytes: int) -> None:
    address_map = place(trace.textures)
    rows = [access for row in accesses(trace, address_map) for access in row]
    lines = Counter((t, m) for t, m, _ in {(t, m, a // line_bytes) for t, m, a in rows})
    sectors = Counter((t, m) for t, m, _ in {(t, m, a // 32) for t, m, a in rows})
    expected = [
        [trace.textures[level[0]].name, level[1], lines[level], sectors[level]]
        for level in sorted(sectors)
    ]
    assert footprint(trace, address_map, line_bytes).to_numpy().tolist() == expected


@settings(max_examples=25)
@given(trace=lane_address_traces(max_rows_per_warp=3))
def test_the_footprint_of_addresses_is_distinct_lines_and_sectors(trace: Trace) -> None:
    addresses = {address for row in accesses(trace, None) for _, _, address in row}
    lines, sectors = {a // 128 for a in addresses}, {a // 32 for a in addresses}
    assert footprint(trace, None, 128).to_numpy().tolist() == [["", -1, len(lines), len(sectors)]]


def test_a_full_pass_has_the_level_as_its_footprint() -> None:
    trace = pixel_pass(Texture("a", "RGBA16F", 64, 32, 2), mip=1)
    frame = footprint(trace, place(trace.textures, "row-major"), 128)
    assert frame.to_numpy().tolist() == [["a", 1, 32 * 16 * 8 // 128, 32 * 16 * 8 // 32]]


@settings(max_examples=25)
@given(trace=texel_traces(max_rows_per_warp=3))
def test_lane_fetches_are_counted_per_pass_texture_mip_and_operation(trace: Trace) -> None:
    fetches: Counter[tuple[str, str, int, str]] = Counter()
    rows: Counter[tuple[str, str, int, str]] = Counter()
    for chunk in trace.chunks():
        for index, lanes, active in zip(chunk.instruction, chunk.lanes, chunk.active, strict=True):
            i = trace.instructions[index]
            mips = [int(m) for m in unpack_texel(lanes[active])[0]]
            key = i.pass_name, trace.textures[i.texture].name
            fetches.update((*key, mip, i.operation) for mip in mips)
            rows.update((*key, mip, i.operation) for mip in set(mips))
    frame = lane_fetches(trace)
    got = {tuple(r[:4]): (r[4], r[5]) for r in frame.to_numpy().tolist()}
    assert got == {key: (rows[key], fetches[key]) for key in fetches}


def test_lane_fetches_of_a_lane_address_trace_have_neither_texture_nor_mip() -> None:
    frame = lane_fetches(stream(8, 5))
    expected = pd.DataFrame(
        [["import", "", -1, "load", 40, 40 * 32]],
        columns=["pass", "texture", "mip", "operation", "rows", "lane_fetches"],
    )
    pd.testing.assert_frame_equal(frame, expected)


@pytest.mark.parametrize(
    ("line_bytes", "sector_bytes", "message"),
    [
        (0, 32, "line_bytes 0"),
        (96, 32, "line_bytes 96"),
        (128, 8, "sector_bytes 8"),
        (32, 64, "divide"),
    ],
)
def test_bad_sizes_are_refused(line_bytes: int, sector_bytes: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        footprint(stream(8, 1), None, line_bytes, sector_bytes)


def test_an_address_map_of_other_textures_is_refused() -> None:
    trace = pixel_pass(Texture("a", "R8", 8, 8))
    with pytest.raises(InputError, match="address map"):
        reuse_distance(trace, None, 128)
    with pytest.raises(InputError, match="address map"):
        reuse_distance(trace, place([Texture("b", "R8", 8, 8)]), 128)
    with pytest.raises(InputError, match="address map"):
        footprint(stream(8, 1), place(trace.textures), 128)
