"""Hypothesis strategies for traces: small, valid, and as awkward as the Trace contract allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from traces.texture import FORMATS, INACTIVE_ADDRESS, INACTIVE_TEXEL, MAX_MIPS, Texture, pack_texel
from traces.trace import FOOTPRINTS, OPERATIONS, Chunk, Instruction, Launch, Trace, from_chunks

PASSES = ("sampling", "update")
_SIDES = st.one_of(st.integers(1, 40), st.sampled_from([64, 255, 1080, 16384]))
_ARITHMETIC = st.lists(
    st.tuples(st.sampled_from(["int", "fp32", "sfu"]), st.integers(0, 9)), max_size=2
).map(tuple)


def textures(max_side: int | None = None) -> st.SearchStrategy[Texture]:
    """Textures of any format, with sides up to `max_side` texels."""
    sides = _SIDES if max_side is None else st.integers(1, max_side)
    return st.builds(
        Texture,
        name=st.sampled_from(["setup", "normal", "id"]),
        format=st.sampled_from(sorted(FORMATS)),
        width=sides,
        height=sides,
        num_mips=st.integers(1, MAX_MIPS),
    )


@st.composite
def texel_traces(
    draw: Any, max_rows_per_warp: int = 8, max_side: int | None = None, bilinear: bool = True
) -> Trace:
    """Traces of packed texels: several launches, passes and textures; local and scattered
    coordinates, any masks.
    """
    held = draw(st.lists(textures(max_side), min_size=1, max_size=3))
    footprints = FOOTPRINTS if bilinear else ("point",)
    instructions = [
        Instruction(
            PASSES[index % len(PASSES)],
            draw(st.integers(0, len(held) - 1)),
            draw(st.sampled_from(OPERATIONS)),
            draw(st.sampled_from(footprints)),
            arithmetic=draw(_ARITHMETIC),
            num_outstanding=draw(st.integers(-1, 4)),
        )
        for index in range(draw(st.integers(2, 5)))
    ]
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    # How far a row strays from its warp's place, in texels; 0 also gives rows that are all alike.
    spread = draw(st.sampled_from([0, 1, 8, 300, 1 << 14]))

    def lanes(index: npt.NDArray[np.int64], place: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        made = np.empty((len(index), 32), np.uint32)
        for row, instruction in enumerate(index):
            texture = held[instructions[instruction].texture]
            mip = random.integers(0, texture.num_mips, 32)
            width, height = np.array([texture.mip_size(m) for m in range(texture.num_mips)]).T[
                :, mip
            ]
            x, y = (place[row] + random.integers(0, spread + 1, 32) for _ in range(2))
            made[row] = pack_texel(mip, y % height, x % width)
        return made

    return _trace(draw, random, held, instructions, lanes, INACTIVE_TEXEL, max_rows_per_warp)


@st.composite
def lane_address_traces(
    draw: Any, max_rows_per_warp: int = 8, address_bits: int | None = None
) -> Trace:
    """Traces of byte addresses, in a window of `address_bits` bits (any, if None) anywhere in the
    64-bit space.
    """
    access_bytes = draw(st.sampled_from([1, 2, 4, 8, 16]))
    instructions = [
        Instruction(
            PASSES[index % len(PASSES)],
            -1,
            draw(st.sampled_from(OPERATIONS)),
            access_bytes=access_bytes,
            arithmetic=draw(_ARITHMETIC),
        )
        for index in range(draw(st.integers(2, 5)))
    ]
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bits = draw(st.sampled_from([4, 10, 20, 64])) if address_bits is None else address_bits
    base = draw(st.sampled_from([0, 0x7F40_0000_0000, 2**64 - 2**bits]))

    def lanes(index: npt.NDArray[np.int64], _: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        offset = random.integers(0, 2**bits, (len(index), 32), dtype=np.uint64)
        address = (np.uint64(base) + offset) & ~np.uint64(access_bytes - 1)
        # The highest byte is the mark of an inactive lane.
        return np.where(address == INACTIVE_ADDRESS, address - np.uint64(1), address)

    return _trace(draw, random, [], instructions, lanes, INACTIVE_ADDRESS, max_rows_per_warp)


def traces(max_rows_per_warp: int = 8) -> st.SearchStrategy[Trace]:
    """Traces of either kind."""
    return st.one_of(texel_traces(max_rows_per_warp), lane_address_traces(max_rows_per_warp))


def _trace(
    draw: Any,
    random: np.random.Generator,
    held: list[Texture],
    instructions: list[Instruction],
    lanes: Callable[[npt.NDArray[np.int64], npt.NDArray[np.int64]], npt.NDArray[Any]],
    inactive: Any,
    max_rows_per_warp: int,
) -> Trace:
    """Launches with CTAs cut into chunks at random, rows masked at random, sometimes whole warps or
    launches empty.
    """
    launches: list[Launch] = []
    chunks: list[Chunk] = []
    active_rate = draw(st.sampled_from([1.0, 0.9, 0.3, 0.0]))
    for number in range(draw(st.integers(1, 3))):
        name = draw(st.sampled_from(PASSES))
        num_ctas, warps_per_cta = draw(st.integers(0, 6)), draw(st.integers(1, 4))
        launches.append(
            Launch(number // 2, name, num_ctas, warps_per_cta, 32, 0, draw(_ARITHMETIC))
        )
        cuts = {0, num_ctas} | draw(st.sets(st.integers(0, num_ctas), max_size=2))
        for first, last in zip(sorted(cuts), sorted(cuts)[1:], strict=False):
            lengths = random.integers(0, max_rows_per_warp + 1, (last - first) * warps_per_cta)
            offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
            own = [i for i, instruction in enumerate(instructions) if instruction.pass_name == name]
            index = random.choice(own, offsets[-1])
            place = np.repeat(random.integers(0, 1 << 14, len(lengths)), lengths)
            made = lanes(index, place)
            made[random.random(made.shape) >= active_rate] = inactive
            chunks.append(Chunk(number, first, offsets, index.astype(np.uint16), made))
    manifest = {"scene": "random", "seed": 1}
    return from_chunks(chunks, held, instructions, launches, manifest)


__all__ = ["PASSES", "lane_address_traces", "texel_traces", "textures", "traces"]
