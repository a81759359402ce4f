"""Layouts, placement and footprints against the published bit tables, written out again here."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from traces.errors import InputError
from traces.footprint import texel_addresses
from traces.layout import LAYOUTS, block_height_log2, layout_function
from traces.layout_picture import draw_layout, granule_shape, layout_table
from traces.placement import TEXTURE_ALIGNMENT_BYTES, place
from traces.texture import FORMATS, INACTIVE_ADDRESS, INACTIVE_TEXEL, Texture, pack_texel

TEXEL_BYTES = (1, 2, 4, 8, 16)
DISJOINT = [name for name in LAYOUTS if name != "gpgpusim"]

# Bits of a 64 KiB block from bit 0 up, as AMD's address library lists them; "0" is a byte within
# the texel, P and Q are the pipe bits of the two chips.
AMD_BITS = {
    ("amd-64k-s", 1): "X0 X1 X2 X3 Y0 Y1 Y2 Y3 | Y4 X4 Y5 X5 | Y6 X6 Y7 X7",
    ("amd-64k-s", 2): "0 X0 X1 X2 Y0 Y1 Y2 X3 | Y3 X4 Y4 X5 | Y5 X6 Y6 X7",
    ("amd-64k-s", 4): "0 0 X0 X1 Y0 Y1 Y2 X2 | Y3 X3 Y4 X4 | Y5 X5 Y6 X6",
    ("amd-64k-s", 8): "0 0 0 X0 Y0 Y1 X1 X2 | Y2 X3 Y3 X4 | Y4 X5 Y5 X6",
    ("amd-64k-s", 16): "0 0 0 0 Y0 Y1 X0 X1 | Y2 X2 Y3 X3 | Y4 X4 Y5 X5",
    ("amd-64k-rx-navi10", 1): "X0 X1 X2 Y1 Y0 Y2 X3 Y4 | P | Y6 X6 Y7 X7",
    ("amd-64k-rx-navi10", 2): "0 X0 X1 X2 Y0 Y1 Y2 X3 | P | Y4 X6 Y6 X7",
    ("amd-64k-rx-navi10", 4): "0 0 X0 X1 Y0 Y1 Y2 X2 | P | Y3 X4 Y6 X6",
    ("amd-64k-rx-navi10", 8): "0 0 0 X0 Y0 X1 X2 Y1 | P | Y2 X3 Y4 X6",
    ("amd-64k-rx-navi10", 16): "0 0 0 0 X0 Y0 X1 Y1 | P | Y2 X2 Y3 X4",
    ("amd-64k-rx-navi21", 1): "X0 X1 X2 X3 Y0 Y1 Y2 Y3 | Q | X6^X8^Y8 Y6 X7 Y7^X8",
    ("amd-64k-rx-navi21", 2): "0 X0 X1 X2 Y0 Y1 Y2 X3 | Q | X6^X8^Y8 Y3 Y6 X7^Y7",
    ("amd-64k-rx-navi21", 4): "0 0 X0 X1 Y0 Y1 X2 Y2 | Q | X6^X8^Y8 X3 Y3 Y6^X7",
    ("amd-64k-rx-navi21", 8): "0 0 0 X0 Y0 X1 X2 Y1 | Q | X6^X8^Y8 Y2 X3 Y3^X7",
    ("amd-64k-rx-navi21", 16): "0 0 0 0 X0 Y0 X1 Y1 | Q | X3^X8^Y8 X2 Y2 Y3^X6",
}
AMD_PIPES = {"P": "X3^Y3 X4^Y4 Y5^X6 X5^Y6", "Q": "Y4^X7^Y7 X4^Y4 Y5^X6 X5^Y6"}
AMD_BLOCK_SIDES = {1: (256, 256), 2: (256, 128), 4: (128, 128), 8: (128, 64), 16: (64, 64)}
GPGPUSIM_BLOCKS = {1: (16, 8), 2: (16, 4), 4: (8, 4), 8: (8, 2), 16: (4, 2)}


def reference(layout, width, height, texel_bytes):
    """(height, width) byte offsets by the published formula, texel by texel."""
    y, x = np.indices((height, width))
    x_bytes = x * texel_bytes
    if layout == "row-major":
        return y * (-(-width * texel_bytes // 256) * 256) + x_bytes
    if layout == "morton":
        sides = (2 ** int(np.ceil(np.log2(side))) for side in (width, height))
        return z_order(*sides)[:height, :width] * texel_bytes
    if layout == "gpgpusim":
        block_width, block_height = GPGPUSIM_BLOCKS[texel_bytes]
        block = (y // block_height) * width // block_width + x // block_width
        row = (y % block_height) * block_width * texel_bytes
        return block * 64 + row + x % block_width * texel_bytes
    if layout.startswith("amd"):
        block_width, block_height = AMD_BLOCK_SIDES[texel_bytes]
        block = y // block_height * -(-width // block_width) + x // block_width
        text = AMD_BITS[layout, texel_bytes].replace("|", " ")
        for name, pipes in AMD_PIPES.items():
            text = text.replace(name, pipes)
        inside = 0
        for bit, term in enumerate(text.split()):
            coordinates = [
                (x if v[0] == "X" else y) >> int(v[1:]) for v in term.split("^") if v != "0"
            ]
            inside = inside + sum(coordinates) % 2 * 2**bit
        return block * 65536 + inside
    gobs_high = 32
    while gobs_high > 1 and 8 * gobs_high >= 2 * height:
        gobs_high //= 2
    gobs_per_row = -(-width * texel_bytes // 64)
    block = (
        y // (8 * gobs_high) * 512 * gobs_high * gobs_per_row
        + x_bytes // 64 * 512 * gobs_high
        + y % (8 * gobs_high) // 8 * 512
    )
    if layout == "block-linear-turing":
        gob = y % 8 // 4 * 128 + x_bytes % 32 // 16 * 64 + y % 4 // 2 * 32
    else:
        gob = y % 8 // 2 * 64 + x_bytes % 32 // 16 * 32
    return block + x_bytes % 64 // 32 * 256 + gob + y % 2 * 16 + x_bytes % 16


def z_order(width, height):
    """Z-order by its recursive definition: halves along the longer side, else quadrants."""
    if width == height == 1:
        return np.zeros((1, 1), np.int64)
    if width > height:
        half = z_order(width // 2, height)
        return np.hstack([half, half + half.size])
    if height > width:
        half = z_order(width, height // 2)
        return np.vstack([half, half + half.size])
    quarter = z_order(width // 2, height // 2)
    upper = np.hstack([quarter, quarter + quarter.size])
    return np.vstack([upper, upper + upper.size])


def all_offsets(layout, width, height, texel_bytes):
    tables = LAYOUTS[layout](width, height, texel_bytes)
    y, x = np.indices((height, width))
    return tables.offset(y, x), tables


@pytest.mark.parametrize("texel_bytes", TEXEL_BYTES)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("width", "height"), [(200, 100), (67, 33), (3, 600), (600, 1), (1, 1)])
def test_every_texel_lies_where_the_published_formula_says(layout, texel_bytes, width, height):
    offsets, _ = all_offsets(layout, width, height, texel_bytes)
    np.testing.assert_array_equal(offsets, reference(layout, width, height, texel_bytes))


@pytest.mark.parametrize("texel_bytes", TEXEL_BYTES)
@pytest.mark.parametrize("layout", DISJOINT)
@pytest.mark.parametrize(("width", "height"), [(67, 33), (1, 1), (1, 300), (300, 2), (257, 129)])
def test_no_two_texels_share_a_byte_and_all_lie_in_the_level(layout, texel_bytes, width, height):
    offsets, tables = all_offsets(layout, width, height, texel_bytes)
    assert not (offsets % np.uint64(texel_bytes)).any()
    assert len(np.unique(offsets)) == width * height
    assert int(offsets.max()) + texel_bytes <= tables.size_bytes
    assert tables.alignment_bytes >= 256


@pytest.mark.parametrize("texel_bytes", TEXEL_BYTES)
@pytest.mark.parametrize("layout", DISJOINT)
def test_texels_sampled_from_a_full_hd_level_share_no_byte(layout, texel_bytes):
    rng = np.random.default_rng(7)
    texels = np.unique(rng.integers(0, (1080, 1920), (20_000, 2)), axis=0)
    tables = LAYOUTS[layout](1920, 1080, texel_bytes)
    offsets = tables.offset(texels[:, 0], texels[:, 1])
    assert len(np.unique(offsets // np.uint64(texel_bytes))) == len(texels)
    assert int(offsets.max()) + texel_bytes <= tables.size_bytes


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_largest_texture_still_fits_32_bit_tables(layout):
    side = 1 << 14
    tables = LAYOUTS[layout](side, side, 16)
    corners = tables.offset(
        np.array([0, side - 1, 0, side - 1]), np.array([0, 0, side - 1, side - 1])
    )
    assert len(np.unique(corners)) == 4
    assert int(corners.max()) + 16 <= tables.size_bytes <= 1 << 32


@pytest.mark.parametrize("texel_bytes", TEXEL_BYTES)
def test_gpgpusim_overlaps_each_block_with_the_first_half_of_the_next(texel_bytes):
    width, height = GPGPUSIM_BLOCKS[texel_bytes]
    offsets, tables = all_offsets("gpgpusim", 4 * width, height, texel_bytes)
    first, second = offsets[:, :width], offsets[:, width : 2 * width]
    np.testing.assert_array_equal(first[height // 2 :], second[: height // 2])
    assert np.unique(offsets, return_counts=True)[1].max() == 2
    assert tables.size_bytes == 3 * 64 + 128


@pytest.mark.parametrize(
    ("height", "k"),
    [(1, 0), (8, 0), (9, 1), (16, 1), (17, 2), (128, 4), (129, 5), (1080, 5), (16384, 5)],
)
def test_block_height_shrinks_until_the_block_is_less_than_twice_the_level(height, k):
    assert block_height_log2(height) == k


# Texels that share 32, 128 and 512 B (a sector, a line, a GOB), for 1, 2, 4, 8 and 16 B texels.
NVIDIA_SHAPES = {
    32: ("16x2", "8x2", "4x2", "2x2", "1x2"),
    128: ("32x4", "16x4", "8x4", "4x4", "2x4"),
    512: ("64x8", "32x8", "16x8", "8x8", "4x8"),
}


@pytest.mark.parametrize("layout", ["block-linear-turing", "block-linear"])
@pytest.mark.parametrize("granule_bytes", NVIDIA_SHAPES)
def test_nvidia_sectors_lines_and_gobs_hold_the_known_rectangles(layout, granule_bytes):
    shapes = tuple(granule_shape(layout, size, granule_bytes) for size in TEXEL_BYTES)
    assert shapes == NVIDIA_SHAPES[granule_bytes]


@pytest.mark.parametrize(
    ("layout", "granule_bytes", "shapes"),
    [
        ("amd-64k-s", 256, ("16x16", "16x8", "8x8", "8x4", "4x4")),
        ("amd-64k-s", 128, ("16x8", "8x8", "4x8", "4x4", "2x4")),
        ("amd-64k-s", 64, ("16x4", "8x4", "4x4", "2x4", "1x4")),
        ("amd-64k-rx-navi10", 128, ("128 of 16x16", "8x8", "4x8", "8x2", "4x2")),
        ("amd-64k-rx-navi10", 64, ("8x8", "8x4", "4x4", "4x2", "2x2")),
        ("amd-64k-rx-navi21", 256, ("16x16", "16x8", "8x8", "8x4", "4x4")),
        ("amd-64k-rx-navi21", 128, ("16x8", "8x8", "8x4", "8x2", "4x2")),
        ("amd-64k-rx-navi21", 64, ("16x4", "8x4", "4x4", "4x2", "2x2")),
    ],
)
def test_amd_micro_tiles_lines_and_half_lines_hold_the_known_rectangles(
    layout, granule_bytes, shapes
):
    assert tuple(granule_shape(layout, size, granule_bytes) for size in TEXEL_BYTES) == shapes


def test_row_major_and_morton_lines_hold_a_row_and_a_square_or_domino():
    assert [granule_shape("row-major", size, 128) for size in (1, 4, 16)] == [
        "128x1",
        "32x1",
        "8x1",
    ]
    assert [granule_shape("morton", size, 128) for size in (1, 2, 4, 8)] == [
        "16x8",
        "8x8",
        "8x4",
        "4x4",
    ]


def test_gpgpusim_lines_hold_texels_of_three_blocks():
    assert granule_shape("gpgpusim", 4, 128) == "64 of 24x4"


textures_strategy = st.lists(
    st.builds(
        Texture,
        name=st.sampled_from(["colour", "normal", "profile id"]),
        format=st.sampled_from(sorted(FORMATS)),
        width=st.integers(1, 300),
        height=st.integers(1, 300),
        num_mips=st.integers(1, 15),
    ),
    max_size=4,
)


@settings(max_examples=60, deadline=None)
@given(textures_strategy, st.sampled_from(sorted(LAYOUTS)), st.integers(0, 1 << 20))
def test_levels_ascend_never_overlap_and_are_aligned(textures, layout, base_units):
    base_address = base_units * TEXTURE_ALIGNMENT_BYTES
    address_map = place(textures, layout, base_address)
    end = base_address
    for index, texture in enumerate(textures):
        assert int(address_map.base[index, 0]) % TEXTURE_ALIGNMENT_BYTES == 0
        for mip in range(15):
            width, height = int(address_map.width[index, mip]), int(address_map.height[index, mip])
            if mip >= texture.num_mips:
                assert (width, height, address_map.size_bytes[index, mip]) == (0, 0, 0)
                continue
            tables = LAYOUTS[layout](width, height, texture.texel_bytes)
            base = int(address_map.base[index, mip])
            assert (width, height) == texture.mip_size(mip)
            assert base >= end
            assert base % tables.alignment_bytes == 0
            end = base + tables.size_bytes
            last = address_map.address(index, mip, height - 1, width - 1)
            assert last == base + int(tables.offset(height - 1, width - 1))
    assert address_map.footprint_bytes == end - base_address


def test_equal_levels_share_their_tables_and_overrides_change_one_texture():
    colour = Texture("colour", "RGBA16F", 64, 64)
    twins = place([colour, colour], "morton")
    assert len(twins.x_tables) == 64
    assert twins.x_start[0, 0] == twins.x_start[1, 0]
    buffer = Texture("counts", "R8", 64, 64)
    mixed = place([colour, buffer], "amd-64k-rx-navi21", overrides={"counts": "row-major"})
    assert mixed.layouts == ("amd-64k-rx-navi21", "row-major")
    assert mixed.low_mask.tolist() == [0xFFFF, 0]
    assert mixed.address(1, 0, 3, 5) - mixed.address(1, 0, 0, 0) == 3 * 256 + 5


@pytest.mark.parametrize("layout", LAYOUTS)
def test_point_addresses_are_those_of_the_address_map_and_inactive_lanes_stay_inactive(layout):
    textures = [Texture("id", "R8", 50, 20), Texture("colour", "RGBA16F", 133, 70, 8)]
    address_map = place(textures, layout)
    rng = np.random.default_rng(3)
    mip = rng.integers(0, 8, (6, 32))
    width, height = np.maximum(133 >> mip, 1), np.maximum(70 >> mip, 1)
    x, y = (rng.random((6, 32)) * width).astype(int), (rng.random((6, 32)) * height).astype(int)
    lanes = pack_texel(mip, y, x)
    lanes[rng.random((6, 32)) < 0.3] = INACTIVE_TEXEL
    addresses = texel_addresses(lanes, 1, False, address_map)
    for row, lane in np.ndindex(lanes.shape):
        if lanes[row, lane] == INACTIVE_TEXEL:
            assert addresses[row, lane] == INACTIVE_ADDRESS
        else:
            where = (int(v[row, lane]) for v in (mip, y, x))
            assert addresses[row, lane] == address_map.address(1, *where)


@pytest.mark.parametrize("layout", ["block-linear-turing", "amd-64k-rx-navi21"])
def test_a_bilinear_footprint_is_two_by_two_and_clamped_to_the_edge(layout):
    address_map = place([Texture("colour", "RGBA8", 40, 24, 3)], layout)
    lanes = np.full((1, 32), INACTIVE_TEXEL, np.uint32)
    lanes[0, :4] = pack_texel([0, 0, 0, 2], [10, 10, 23, 5], [7, 39, 39, 9])
    addresses = texel_addresses(lanes, 0, True, address_map).reshape(32, 4)
    corners = [
        (0, [(10, 7), (10, 8), (11, 7), (11, 8)]),
        (0, [(10, 39), (10, 39), (11, 39), (11, 39)]),
        (0, [(23, 39)] * 4),
        (2, [(5, 9)] * 4),
    ]
    for lane, (mip, texels) in enumerate(corners):
        expected = [address_map.address(0, mip, y, x) for y, x in texels]
        assert addresses[lane].tolist() == expected
    assert (addresses[4:] == INACTIVE_ADDRESS).all()


def test_bad_input_is_named_in_one_line():
    colour = Texture("colour", "RGBA8", 40, 24, 3)
    address_map = place([colour])
    with pytest.raises(InputError, match=r"unknown layout 'mortn'; did you mean 'morton'\?"):
        layout_function("mortn")
    with pytest.raises(InputError, match=r"texture 'colour': unknown layout 'linear'"):
        place([colour], overrides={"colour": "linear"})
    with pytest.raises(InputError, match=r"layout overrides: unknown texture 'color'"):
        place([colour], overrides={"color": "morton"})
    for base_address in (-65536, 100):
        with pytest.raises(InputError, match=r"base address .*allowed are multiples of 0x10000"):
            place([colour], base_address=base_address)
    with pytest.raises(InputError, match=r"ends above 2\^63"):
        place([colour], base_address=(1 << 63) - 65536, layout="amd-64k-s")
    for where, message in [
        ((1, 0, 0, 0), "texture 1: allowed are 0 to 0"),
        ((0, 3, 0, 0), "mip 3: allowed are 0 to 2"),
        ((0, 1, 0, 20), "x 20: allowed are 0 to 19"),
        ((0, 1, 12, 0), "y 12: allowed are 0 to 11"),
    ]:
        with pytest.raises(InputError, match=message):
            address_map.address(*where)


@pytest.mark.parametrize(("mip", "y", "x"), [(3, 0, 0), (15, 0, 0), (0, 24, 0), (1, 0, 20)])
def test_a_lane_outside_its_texture_is_refused_with_its_row_and_lane(mip, y, x):
    address_map = place([Texture("colour", "RGBA8", 40, 24, 3)])
    lanes = np.full((3, 32), INACTIVE_TEXEL, np.uint32)
    lanes[2, 9] = pack_texel(mip, y, x)
    message = rf"row 2, lane 9: texture 'colour' has no texel \(mip {mip}, y {y}, x {x}\)"
    with pytest.raises(InputError, match=message):
        texel_addresses(lanes, 0, False, address_map)
    with pytest.raises(InputError, match="texture 1: allowed are 0 to 0"):
        texel_addresses(lanes, 1, False, address_map)


def test_the_table_has_every_layout_and_format_and_the_shapes_of_its_granules():
    table = layout_table().set_index(["layout", "format"])
    assert len(table) == len(LAYOUTS) * len(FORMATS)
    assert table.index.is_unique
    row = table.loc["block-linear-turing", "RGBA16F"]
    assert row.tolist() == [8, "2x2", "2x4", "4x4", "4x8"]


def test_a_picture_borders_sectors_and_lines_and_numbers_every_line():
    axes = draw_layout("block-linear-turing", "RGBA8").axes[0]
    sectors, lines = axes.collections
    # 32 x 16 texels: lines of 8x4 have 3 inner borders a way, sectors of 4x2 have 7.
    assert len(lines.get_segments()) == 3 * 16 + 3 * 32
    assert len(sectors.get_segments()) == 7 * 16 + 7 * 32
    assert sorted(int(text.get_text()) for text in axes.texts) == list(range(16))
    assert "(texels)" in axes.get_xlabel() and "(texels)" in axes.get_ylabel()
    title = axes.get_title()
    assert "RGBA8 (4 B per texel)" in title and "8x4 texels" in title and "4x2 texels" in title


def test_a_picture_says_where_texels_share_bytes_and_numbers_both_pieces_of_a_split_line():
    assert "share bytes" in draw_layout("gpgpusim", "R32F").axes[0].get_title()
    split = draw_layout("amd-64k-rx-navi10", "R8").axes[0]
    assert "share bytes" not in split.get_title()
    assert sorted(int(text.get_text()) for text in split.texts) == sorted(2 * list(range(16)))
    with pytest.raises(InputError, match="unknown texel format 'RGB8'"):
        draw_layout("morton", "RGB8")
