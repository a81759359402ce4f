"""Coalescing against sets of bytes: the sectors that a row's bytes lie in, and no others."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import lane_address_traces, texel_traces

from cachesim import presets, simulate
from cachesim.coalesce import coalesce, new_scratch, placement_of, program_of
from cachesim.stream import GROUP_BITS, OPERATION_CODES, Requests
from traces.errors import InputError
from traces.placement import AddressMap, place
from traces.texture import INACTIVE_ADDRESS, INACTIVE_TEXEL, MAX_MIPS, Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

#: (line bytes, sector bytes) of every preset's first level, and three that no preset has.
PRESET_SHAPES = sorted(
    {
        (level.line_bytes, level.sector_bytes)
        for gpu in map(presets.load, presets.names())
        for level in (gpu.l1, gpu.l1_texture)
        if level is not None
    }
)
SHAPES = [*PRESET_SHAPES, (64, 64), (128, 16), (256, 64)]
LAYOUTS = sorted({presets.load(name).texture_layout for name in presets.names()} | {"row-major"})


@dataclass
class Request:
    """One line of a row: its sectors, the group, and the bytes written as offsets in the line."""

    line: int
    group: int
    sectors: set[int] = field(default_factory=set)
    written: set[int] = field(default_factory=set)


def run(
    trace: Trace,
    chunk: Chunk,
    address_map: AddressMap | None,
    shape: tuple[int, int],
    narrow: bool,
) -> tuple[list[list[Request]], np.ndarray]:
    """The requests of every row, in the engine's order, and the lane fetches by group."""
    line_bytes, sector_bytes = shape
    sector_shift = sector_bytes.bit_length() - 1
    rows, room = chunk.num_rows, chunk.num_rows * 128
    requests = Requests(
        np.empty(room, np.uint64),
        np.empty(room, np.uint8),
        np.empty(room, np.uint32),
        np.empty(room, np.int32),
        np.empty((room, 8), np.uint32),
        np.zeros(rows + 1, np.int64),
        np.zeros(rows, np.uint32),
        np.arange(rows),
    )
    fetches = np.zeros(len(trace.instructions) * MAX_MIPS, np.int64)
    first = address_map.base_address >> sector_shift if narrow and address_map else 0
    bad = coalesce(
        np.arange(rows),
        np.ascontiguousarray(chunk.lanes),
        chunk.instruction,
        program_of(trace),
        placement_of(address_map),
        np.uint64(sector_shift),
        np.uint64(line_bytes.bit_length() - 1),
        np.uint64(first),
        new_scratch(32, np.uint32 if narrow else np.uint64),
        requests,
        fetches,
    )
    assert bad == -1
    granule = max(1, sector_bytes // 32)
    made = []
    for row in range(rows):
        operation = trace.instructions[chunk.instruction[row]].operation
        made.append([])
        for i in range(requests.segments[row], requests.segments[row + 1]):
            meta, mask = int(requests.meta[i]), int(requests.mask[i])
            assert meta >> GROUP_BITS == OPERATION_CODES[operation]
            request = Request(int(requests.line[i]), meta & ((1 << GROUP_BITS) - 1))
            request.sectors = {s for s in range(8) if mask >> s & 1}
            if operation == "store":
                bits = requests.bytes_written[requests.written[i]].tolist()
                request.written = {
                    s * sector_bytes + bit * granule
                    for s in range(8)
                    for bit in range(32)
                    if bits[s] >> bit & 1
                }
            made[-1].append(request)
    return made, fetches


def expected_requests(
    trace: Trace, chunk: Chunk, address_map: AddressMap | None, shape: tuple[int, int]
) -> tuple[list[list[Request]], Counter[int]]:
    """The same, by walking over bytes."""
    line_bytes, sector_bytes = shape
    granule = max(1, sector_bytes // 32)
    pairs = list(dict.fromkeys((i.pass_name, i.texture) for i in trace.instructions))
    fetches: Counter[int] = Counter()
    made = []
    for row, index in enumerate(chunk.instruction):
        instruction = trace.instructions[index]
        pair = pairs.index((instruction.pass_name, instruction.texture)) * MAX_MIPS
        lines: dict[int, Request] = {}
        for lane in chunk.lanes[row][chunk.active[row]].tolist():
            mip, places = texels_of(trace, instruction, lane, address_map)
            fetches[pair + mip] += 1
            for corner, (start, num_bytes) in enumerate(places):
                for byte in range(start, start + num_bytes):
                    line, offset = divmod(byte, line_bytes)
                    request = lines.setdefault(line, Request(line, pair + mip))
                    request.sectors.add(offset // sector_bytes)
                    if instruction.operation == "store" and corner == 0:
                        request.written.add(offset // granule * granule)
        made.append([lines[line] for line in sorted(lines)])
    return made, fetches


def texels_of(
    trace: Trace, instruction: Instruction, lane: int, address_map: AddressMap | None
) -> tuple[int, list[tuple[int, int]]]:
    """The mip, and (address, bytes) of every texel that a lane asks for."""
    if address_map is None:
        return 0, [(lane, instruction.access_bytes)]
    texture = trace.textures[instruction.texture]
    mip, y, x = lane >> 28, lane >> 14 & 16383, lane & 16383
    corners = [(y, x)]
    if instruction.footprint == "bilinear":
        width, height = texture.mip_size(mip)
        x1, y1 = min(x + 1, width - 1), min(y + 1, height - 1)
        corners += [(y, x1), (y1, x), (y1, x1)]
    return mip, [
        (address_map.address(instruction.texture, mip, *corner), texture.texel_bytes)
        for corner in corners
    ]


def assert_coalesces(
    trace: Trace, address_map: AddressMap | None, shape: tuple[int, int], narrow: bool
) -> None:
    for chunk in trace.chunks():
        made, fetches = run(trace, chunk, address_map, shape, narrow)
        expected, expected_fetches = expected_requests(trace, chunk, address_map, shape)
        assert made == expected
        assert Counter({g: int(n) for g, n in enumerate(fetches) if n}) == expected_fetches


@settings(max_examples=30)
@given(
    texel_traces(max_rows_per_warp=2, max_side=300),
    st.sampled_from(SHAPES),
    st.sampled_from(LAYOUTS),
    st.booleans(),
)
def test_texel_rows_ask_for_the_sectors_of_their_bytes(trace, shape, layout, narrow) -> None:
    assert_coalesces(trace, place(trace.textures, layout), shape, narrow)


@settings(max_examples=20)
@given(lane_address_traces(max_rows_per_warp=3), st.sampled_from(SHAPES))
def test_address_rows_ask_for_the_sectors_of_their_bytes(trace, shape) -> None:
    assert_coalesces(trace, None, shape, narrow=False)


def lane_trace(lanes: np.ndarray, operation: str, access_bytes: int) -> Trace:
    """One warp's rows of addresses."""
    chunk = Chunk(0, 0, np.array([0, len(lanes)]), np.zeros(len(lanes), np.uint16), lanes)
    instruction = Instruction("import", -1, operation, access_bytes=access_bytes)
    return from_chunks([chunk], (), [instruction], [Launch(0, "import", 1, 1)])


@settings(max_examples=30)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1, 2, 4, 8, 16]),
    st.sampled_from(["load", "store", "atomic"]),
    st.sampled_from(SHAPES),
    st.sampled_from([64, 700, 1 << 20]),
)
def test_unaligned_accesses_over_a_sectors_end_ask_for_both(
    seed, access_bytes, operation, shape, window
) -> None:
    random = np.random.default_rng(seed)
    base = np.uint64(random.integers(0, 2**62))
    lanes = base + random.integers(0, window, (4, 32), dtype=np.uint64)
    lanes[random.random(lanes.shape) < 0.2] = INACTIVE_ADDRESS
    assert_coalesces(lane_trace(lanes, operation, access_bytes), None, shape, narrow=False)


def test_two_sectors_of_one_line_are_one_request_and_an_access_across_lines_is_two() -> None:
    inactive = [int(INACTIVE_ADDRESS)] * 30
    lanes = np.array([[4096, 4096 + 96, *inactive], [4096 + 120, *inactive, 4096]], np.uint64)
    trace = lane_trace(lanes, "load", 16)
    rows, _ = run(trace, next(iter(trace.chunks())), None, (128, 32), False)
    assert rows == [
        [Request(32, 0, {0, 3})],
        [Request(32, 0, {0, 3}), Request(33, 0, {0})],
    ]


@settings(max_examples=15)
@given(st.one_of(texel_traces(2, 200), lane_address_traces(2)), st.integers(0, 2**32 - 1))
def test_the_order_of_lanes_is_irrelevant(trace, seed) -> None:
    random = np.random.default_rng(seed)
    address_map = None if trace.is_lane_address else place(trace.textures)
    for chunk in trace.chunks():
        mixed = Chunk(
            chunk.launch,
            chunk.first_cta,
            chunk.warp_offsets,
            chunk.instruction,
            random.permuted(chunk.lanes, axis=1),
        )
        narrow = address_map is not None
        requests, fetches = run(trace, chunk, address_map, (128, 32), narrow)
        mixed_requests, mixed_fetches = run(trace, mixed, address_map, (128, 32), narrow)
        assert requests == mixed_requests
        np.testing.assert_array_equal(fetches, mixed_fetches)


TEXTURE = Texture("t", "RGBA16F", 64, 64, 4)


def texel_trace(lanes: np.ndarray, footprint: str = "point", operation: str = "load") -> Trace:
    chunk = Chunk(0, 0, np.array([0, len(lanes)]), np.zeros(len(lanes), np.uint16), lanes)
    instruction = Instruction("p", 0, operation, footprint)
    return from_chunks([chunk], [TEXTURE], [instruction], [Launch(0, "p", 1, 1)])


@pytest.mark.parametrize("footprint", ["point", "bilinear"])
@pytest.mark.parametrize("operation", ["load", "store", "atomic"])
def test_a_fully_masked_row_issues_and_asks_for_nothing(footprint: str, operation: str) -> None:
    trace = texel_trace(np.full((3, 32), INACTIVE_TEXEL, np.uint32), footprint, operation)
    rows, fetches = run(trace, next(iter(trace.chunks())), place([TEXTURE]), (128, 32), True)
    assert rows == [[], [], []]
    assert not fetches.any()
    report = simulate(trace, "titan-x-pascal")
    assert (report.num_rows, report.lane_fetches, report.dram.bytes) == (3, 0, 0)


def test_a_row_over_several_mips_is_attributed_to_each() -> None:
    mip = np.arange(32) % 4
    trace = texel_trace(pack_texel(mip, np.zeros(32), np.zeros(32))[None])
    rows, fetches = run(trace, next(iter(trace.chunks())), place([TEXTURE]), (128, 32), True)
    assert [request.group for request in rows[0]] == [0, 1, 2, 3]
    assert fetches[:4].tolist() == [8, 8, 8, 8]


@pytest.mark.parametrize(("mip", "y", "x"), [(4, 0, 0), (0, 64, 0), (0, 0, 64), (3, 0, 8)])
def test_a_texel_that_its_texture_does_not_have_is_bad_input(mip: int, y: int, x: int) -> None:
    lanes = np.full((2, 32), pack_texel(0, 5, 5), np.uint32)
    lanes[1, 7] = pack_texel(mip, y, x)
    with pytest.raises(InputError, match=rf"mip {mip}, y {y}, x {x}"):
        simulate(texel_trace(lanes), "titan-x-pascal")
