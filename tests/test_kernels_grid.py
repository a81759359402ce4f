"""Which pixel a lane works on, and which rows a warp gets."""

from __future__ import annotations

import numpy as np
import pytest

from kernels.access import Access, Program
from kernels.grid import OUTSIDE, PLAIN, Grid, lane_table

LANE_MAPS = ("linear", "quad2x2", "morton8x8")


@pytest.mark.parametrize("lane_map", LANE_MAPS)
@pytest.mark.parametrize("tile_order", ["raster", "morton"])
def test_every_pixel_belongs_to_one_lane(lane_map, tile_order):
    grid = Grid(45, 27, tile_order, lane_map)
    x, y = grid.lanes
    pixels = (y * 45 + x)[grid.inside]
    assert np.array_equal(np.sort(pixels), np.arange(45 * 27))
    assert grid.num_ctas == 6 * 4


@pytest.mark.parametrize("lane_map", LANE_MAPS)
def test_a_cta_is_one_tile(lane_map):
    x, y = Grid(64, 64, "raster", lane_map).lanes
    tile = (y // 8 * 8 + x // 8).reshape(-1, 64)
    assert np.array_equal(tile, np.broadcast_to(np.arange(64)[:, None], (64, 64)))


def test_lane_maps_on_paper():
    first = {name: [(v & 7, v >> 3) for v in lane_table(name)[:9].tolist()] for name in LANE_MAPS}
    assert first["linear"] == [*((x, 0) for x in range(8)), (0, 1)]
    quads = [(0, 0), (1, 0), (0, 1), (1, 1)]
    assert first["quad2x2"] == [*quads, *((x + 2, y) for x, y in quads), (4, 0)]
    assert first["morton8x8"] == [*quads, *((x + 2, y) for x, y in quads), (0, 2)]


def test_morton_tiles_on_paper():
    tiles = Grid(32, 16, "morton", "linear").tiles
    order = [(int(t) & 0xFFFF, int(t) >> 16) for t in tiles]
    assert order == [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (3, 0), (2, 1), (3, 1)]


def test_warp_states():
    grid = Grid(12, 10, "raster", "linear")
    mask = np.zeros((10, 12), bool)
    mask[5, 9] = True
    # Four tiles; the lower two reach 2 rows into the frame, so their second warps lie outside.
    assert grid.warp_states(mask).tolist() == [
        *(PLAIN, PLAIN, PLAIN, 1),
        *(PLAIN, OUTSIDE, PLAIN, OUTSIDE),
    ]


PROGRAM = Program(
    "sampling",
    (
        Access("a"),
        Access("b", subsurface_only=True),
        Access("c", in_loop=True),
        Access("d", in_loop=True),
        Access("e", "store"),
    ),
    first_instruction=10,
)


def test_rows_follow_from_state_and_step():
    states = np.array([OUTSIDE, PLAIN, 1, 3], np.int32)
    offsets = PROGRAM.row_offsets(states)
    assert offsets.tolist() == [0, 0, 2, 7, 16]
    assert PROGRAM.row_instructions(states, offsets).tolist() == [
        *(10, 14),
        *(10, 11, 12, 13, 14),
        *(10, 11, 12, 13, 12, 13, 12, 13, 14),
    ]


def test_placed_texels_stand_where_the_instructions_say():
    states = np.array([PLAIN, 2, OUTSIDE, 1], np.int32)
    texels = [np.full((4, 32), 100 + k, np.uint32) for k in range(5)]
    texels[2] = np.stack([np.full((4, 32), 200 + s, np.uint32) for s in range(2)])
    texels[3] = np.stack([np.full((4, 32), 300 + s, np.uint32) for s in range(2)])
    offsets, lanes = PROGRAM.place(states, texels)
    assert (lanes == lanes[:, :1]).all()
    assert lanes[:, 0].tolist() == [
        *(100, 104),
        *(100, 101, 200, 300, 201, 301, 104),
        *(100, 101, 200, 300, 104),
    ]
    instruction = PROGRAM.row_instructions(states, offsets)
    by_value = {1: {0, 1, 4}, 2: {2}, 3: {3}}
    for value, code in zip(lanes[:, 0].tolist(), instruction.tolist(), strict=True):
        assert code - 10 in by_value[value // 100]
