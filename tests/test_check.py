"""The checker accepts every valid trace, and names the place of whatever is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from strategies import traces

from traces.check import Checker, check
from traces.errors import InputError
from traces.texture import INACTIVE_TEXEL, Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

TEXTURE = Texture("setup", "RGBA16F", 20, 10, 3)
INSTRUCTIONS = [Instruction("sampling", 0), Instruction("update", 0)]


def a_chunk(**changes: object) -> Chunk:
    """CTAs 0 and 1 of launch 0: two warps each, 2, 0, 1 and 1 rows, at texel (0, 0) of mip 0."""
    chunk = Chunk(
        0,
        0,
        np.array([0, 2, 2, 3, 4], np.int64),
        np.zeros(4, np.uint16),
        np.zeros((4, 32), np.uint32),
    )
    return replace(chunk, **changes)


def a_trace(*chunks: Chunk, **changes: object) -> Trace:
    launches = [Launch(0, "sampling", 2, 2), Launch(0, "update", 1, 1)]
    last = Chunk(
        1, 0, np.array([0, 1], np.int64), np.ones(1, np.uint16), np.zeros((1, 32), np.uint32)
    )
    trace = from_chunks([*chunks, last], [TEXTURE], INSTRUCTIONS, launches)
    return replace(trace, **changes)


def with_texel(mip: int, y: int, x: int) -> Chunk:
    lanes = np.full((4, 32), INACTIVE_TEXEL)
    lanes[3, 7] = pack_texel(mip, y, x)
    return a_chunk(lanes=lanes)


@given(trace=traces())
def test_valid_traces_pass_and_are_counted(trace: Trace) -> None:
    summary = check(trace)
    chunks = list(trace.chunks())
    assert summary.num_launches == len(trace.launches)
    assert summary.num_ctas == sum(launch.num_ctas for launch in trace.launches)
    assert summary.num_warps == sum(chunk.num_warps for chunk in chunks)
    assert summary.num_rows == sum(chunk.num_rows for chunk in chunks)
    assert summary.num_lane_fetches == sum(chunk.num_lane_fetches for chunk in chunks)


def test_the_trace_that_the_other_tests_break_is_valid() -> None:
    assert check(a_trace(a_chunk())).num_lane_fetches == 5 * 32


def test_edges_of_a_level_are_inside() -> None:
    check(a_trace(with_texel(0, 9, 19)))
    check(a_trace(with_texel(2, 1, 4)))


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (
            with_texel(0, 0, 20),
            "launch 0, CTA 1, warp 1, step 0, lane 7: texel x 20, y 0 of mip 0 of texture 'setup'",
        ),
        (with_texel(0, 10, 0), "texel x 0, y 10 of mip 0"),
        (with_texel(2, 2, 0), "allowed are x below 5, y below 2"),
        (with_texel(3, 0, 0), "mip 3 of texture 'setup': allowed are 0 to 2"),
        (with_texel(15, 0, 0), "mip 15"),
        (a_chunk(launch=2), "chunk of launch 2: allowed are 0 to 1"),
        (a_chunk(launch=-1), "chunk of launch -1"),
        (a_chunk(launch=1), "launch 0: CTAs 0 to 1 are missing"),
        (a_chunk(first_cta=1), "chunk starts at CTA 1: must be 0"),
        (a_chunk(warp_offsets=np.array([0, 2, 2, 3, 4], np.int32)), "warp_offsets int32"),
        (
            a_chunk(warp_offsets=np.array([0, 2, 1, 3, 4])),
            "must rise from 0 to the number of rows, 4",
        ),
        (a_chunk(warp_offsets=np.array([1, 2, 2, 3, 4])), "must rise from 0"),
        (a_chunk(warp_offsets=np.array([0, 2, 2, 3, 3])), "must rise from 0"),
        (a_chunk(warp_offsets=np.array([0, 2, 2, 4])), "3 warps: need whole CTAs of 2 warps"),
        (a_chunk(warp_offsets=np.array([0, 2, 2, 3, 4, 4, 4])), "6 warps: need whole CTAs of 2"),
        (a_chunk(warp_offsets=np.array([], np.int64)), "warp_offsets int64 of shape (0,)"),
        (a_chunk(instruction=np.zeros(4, np.int64)), "instruction int64"),
        (a_chunk(instruction=np.array([0, 0, 2, 0], np.uint16)), "warp 0, step 0: instruction 2"),
        (
            a_chunk(instruction=np.array([0, 1, 0, 0], np.uint16)),
            "step 1: instruction 1 is of pass",
        ),
        (a_chunk(lanes=np.zeros((4, 32), np.uint64)), "lanes uint64 of shape (4, 32): need uint32"),
        (a_chunk(lanes=np.zeros((4, 64), np.uint32)), "lanes uint32 of shape (4, 64)"),
        (a_chunk(lanes=np.zeros((3, 32), np.uint32)), "lanes uint32 of shape (3, 32)"),
    ],
)
def test_a_broken_chunk_is_named(chunk: Chunk, message: str) -> None:
    with pytest.raises(InputError) as caught:
        check(a_trace(chunk), "some.parquet")
    assert str(caught.value).startswith("some.parquet: ")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("instruction", "message"),
    [
        (Instruction("sampling", 1), "instruction 0: texture 1: allowed are 0 to 0"),
        (Instruction("sampling", -1), "texture -1"),
        (Instruction("sampling", 0, "fetch"), "operation 'fetch': allowed are load, store, atomic"),
        (Instruction("sampling", 0, footprint="trilinear"), "footprint 'trilinear'"),
        (Instruction("sampling", 0, access_bytes=4), "access_bytes 4: allowed are 0 and"),
        (Instruction("sampling", 0, num_outstanding=-2), "num_outstanding -2"),
        (Instruction("sampling", 0, arithmetic=(("int", -1),)), "counts must not be negative"),
    ],
)
def test_a_broken_instruction_is_named(instruction: Instruction, message: str) -> None:
    with pytest.raises(InputError) as caught:
        check(a_trace(a_chunk(), instructions=[instruction, INSTRUCTIONS[1]]))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("launch", "message"),
    [
        (Launch(0, "sampling", 3, 2), "launch 0: CTAs 2 to 2 are missing"),
        (Launch(0, "sampling", 1, 2), "at most 1 of them"),
        (Launch(0, "sampling", 2, 0), "launch 0: warps_per_cta 0: allowed are 1 to 32"),
        (Launch(0, "sampling", -2, 2), "launch 0: num_ctas -2"),
        (Launch(-1, "sampling", 2, 2), "launch 0: frame -1"),
        (Launch(0, "sampling", 2, 2, trailing_arithmetic=(("int", -1),)), "trailing_arithmetic"),
    ],
)
def test_a_broken_launch_is_named(launch: Launch, message: str) -> None:
    with pytest.raises(InputError) as caught:
        check(a_trace(a_chunk(), launches=[launch, Launch(0, "update", 1, 1)]))
    assert message in str(caught.value)


def test_a_trace_that_ends_early_is_incomplete() -> None:
    trace = a_trace(a_chunk())
    checker = Checker(trace)
    checker.chunk(a_chunk())
    with pytest.raises(InputError, match="launch 1: CTAs 0 to 0 are missing"):
        checker.finish()


def test_the_same_ctas_twice_are_too_many() -> None:
    with pytest.raises(InputError, match="launch 0: chunk starts at CTA 0: must be 2"):
        check(a_trace(a_chunk(), a_chunk()))


@pytest.mark.parametrize(
    ("instruction", "address", "message"),
    [
        (Instruction("p", -1, access_bytes=8), 4, "lane 3: address 0x4: allowed are multiples"),
        (Instruction("p", -1, access_bytes=3), 0, "access_bytes 3"),
        (Instruction("p", -1), 0, "access_bytes 0"),
        (Instruction("p", 0, access_bytes=8), 0, "texture 0"),
        (Instruction("p", -1, footprint="bilinear", access_bytes=8), 0, "footprint 'bilinear'"),
    ],
)
def test_a_broken_lane_address_trace_is_named(
    instruction: Instruction, address: int, message: str
) -> None:
    lanes = np.zeros((1, 32), np.uint64)
    lanes[0, 3] = address
    chunk = Chunk(0, 0, np.array([0, 1], np.int64), np.zeros(1, np.uint16), lanes)
    with pytest.raises(InputError) as caught:
        check(from_chunks([chunk], (), [instruction], [Launch(0, "p", 1, 1)]))
    assert message in str(caught.value)
