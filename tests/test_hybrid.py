"""The hybrid method: classes of tiles, lists, launches over them, and the pictures they make."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from recordings import assert_launches_equal

from kernels.frame import advance, render
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes.classify import radius_at_cm
from kernels.passes.constants import Constants
from kernels.pipeline import Pipeline
from kernels.record import estimate_rows, record
from kernels.reference import render_reference
from kernels.resources import TEXTURE_NAMES, to_half
from kernels.scenes.capture import load_exr, load_npz, save_exr, save_npz
from kernels.selfcheck import count_differences, small_gbuffer
from kernels.tiles import (
    CLASS_OF_PASS,
    EMPTY,
    PASSTHROUGH,
    SAMPLED,
    SEPARABLE,
    ListedGrid,
    count_tiles,
)
from tests.test_separable import plate
from traces.check import check
from traces.errors import InputError
from traces.texture import unpack_texel

METHODS = {
    "adaptive": Method(kind="hybrid", b_max=24, num_taps=13, sigma0_sq=1e-5),
    "radius": Method(
        kind="hybrid",
        hybrid_count="fixed",
        num_samples=12,
        num_taps=11,
        hybrid_rules=("radius",),
        radius_threshold_px=1.24,
        passthrough_px=1.2,
        tile_order="morton",
        lane_map="quad2x2",
    ),
    "painted": Method(
        kind="hybrid",
        num_taps=3,
        b_max=16,
        hybrid_rules=("count", "painted"),
        importance_threshold=0.7,
        planes=("colour",),
        lane_map="morton8x8",
    ),
    "none": Method(kind="hybrid", num_taps=5, hybrid_rules=(), passthrough_px=0.0),
}
NUM_FRAMES = 3


def painted_gbuffer():
    """The small check scene with a patch of importance."""
    gbuffer = small_gbuffer()
    y, x = np.mgrid[0 : gbuffer.height, 0 : gbuffer.width]
    importance = np.where((x > 12) & (x < 20), 0.6 + 0.01 * y, 0.0)
    return dataclasses.replace(gbuffer, importance=importance.astype(np.float32))


def classes_of(gbuffer, method, device, num_frames=1):
    """(tiles down, tiles across) classes of the last frame."""
    import pyopencl as cl

    pipeline = Pipeline(method, gbuffer.width, gbuffer.height, device)
    for frame in range(num_frames):
        advance(pipeline, gbuffer, frame)
    across, down = count_tiles(gbuffer.width, gbuffer.height)
    classes = np.empty((down, across), np.uint8)
    cl.enqueue_copy(device.queue, classes, pipeline.buffers["tile_class"])
    return classes


def per_pixel(classes, gbuffer):
    return classes.repeat(8, axis=0).repeat(8, axis=1)[: gbuffer.height, : gbuffer.width]


@pytest.mark.parametrize("name", METHODS)
def test_trace_and_pictures_equal_the_reference(device, name):
    method, gbuffer = METHODS[name], painted_gbuffer()
    expected = render_reference(gbuffer, method, NUM_FRAMES)
    trace = record(
        gbuffer,
        method,
        num_frames=NUM_FRAMES,
        traced_frames="all",
        device=device,
        chunk_bytes=1 << 16,
        self_check=False,
    )
    assert_launches_equal(trace, [found for frame in expected for found in frame.launches])
    check(trace)
    last = expected[-1]
    frame = render(gbuffer, method, NUM_FRAMES, device)
    assert np.array_equal(frame.counts, last.counts)
    assert np.array_equal(to_half(frame.scattered), last.textures["scattered"][..., :3])
    assert np.array_equal(to_half(frame.combined), last.textures["output"][..., :3])


@pytest.mark.parametrize("name", ["adaptive", "radius"])
def test_the_self_check_finds_no_difference(first_device, name):
    assert count_differences(first_device, METHODS[name]) == 0


def test_the_methods_meet_every_class(first_device):
    found = {
        (name, int(value))
        for name in ("adaptive", "radius")
        for value in np.unique(classes_of(painted_gbuffer(), METHODS[name], first_device, 12))
    }
    assert {value for _, value in found} == {EMPTY, PASSTHROUGH, SEPARABLE, SAMPLED}
    assert {("adaptive", SEPARABLE), ("adaptive", SAMPLED)} <= found


def test_each_pass_is_launched_over_the_tiles_of_its_class_alone(first_device):
    gbuffer, method = painted_gbuffer(), METHODS["radius"]
    classes = classes_of(gbuffer, method, first_device)
    trace = record(gbuffer, method, device=first_device, self_check=False)
    chunks = list(trace.chunks())
    for number, launch in enumerate(trace.launches):
        mine = [chunk for chunk in chunks if chunk.launch == number]
        if launch.pass_name not in CLASS_OF_PASS:
            continue
        assert launch.num_ctas == (classes == CLASS_OF_PASS[launch.pass_name]).sum() > 0
        for chunk in mine:
            stores = [trace.instructions[i].operation == "store" for i in chunk.instruction]
            texels = chunk.lanes[np.array(stores)]
            _, y, x = unpack_texel(texels[texels != 0xFFFFFFFF])
            assert (classes[y // 8, x // 8] == CLASS_OF_PASS[launch.pass_name]).all()


def test_a_launch_over_a_list_reads_its_entries_in_order(first_device):
    trace = record(painted_gbuffer(), METHODS["radius"], device=first_device, self_check=False)
    across, _ = count_tiles(44, 27)
    for chunk in trace.chunks():
        if trace.launches[chunk.launch].pass_name not in CLASS_OF_PASS:
            continue
        for warp, row in enumerate(chunk.warp_offsets[:-1]):
            if row == chunk.warp_offsets[warp + 1]:
                continue  # a warp outside the frame
            instruction = trace.instructions[chunk.instruction[row]]
            assert TEXTURE_NAMES[instruction.texture] == "tile_list"
            _, y, x = unpack_texel(chunk.lanes[row])
            assert (y * across + x == chunk.first_cta + warp // 2).all()
            # What follows waits for the entry.
            after = trace.instructions[chunk.instruction[row + 1]]
            assert after.arithmetic[0] == ("wait", 0)


@pytest.mark.parametrize("tile_order", ["raster", "morton"])
def test_lists_keep_the_order_of_the_tiles(tile_order):
    grid = Grid(100, 60, tile_order, "linear")
    across, down = count_tiles(100, 60)
    classes = np.random.default_rng(3).integers(0, 4, (down, across), dtype=np.uint8)
    lists = [ListedGrid.of(grid, classes, c) for c in range(4)]
    assert sum(listed.num_ctas for listed in lists) == grid.num_ctas
    place = {int(tile): k for k, tile in enumerate(grid.tiles)}
    for tile_class, listed in enumerate(lists):
        places = [place[int(tile)] for tile in listed.tiles]
        assert places == sorted(places)
        assert (classes[listed.tiles >> 16, listed.tiles & 0xFFFF] == tile_class).all()
    if tile_order == "raster":
        assert (np.diff(lists[3].tiles.astype(np.int64)) > 0).all()


# The rules.


def test_the_radius_rule_compares_the_mean_radius_at_the_nearest_pixel(first_device):
    depth = np.where(np.arange(48) < 24, 10.0, 40.0)
    gbuffer = plate(np.full((32, 48), 0.5), depth, projection_x=2.0)
    method = Method(
        kind="hybrid",
        hybrid_count="fixed",
        hybrid_rules=("radius",),
        radius_threshold_px=1.5,
        passthrough_px=0.5,
    )
    constants = Constants.of(method, 48, 32, 2.0)
    radius = float(radius_at_cm(method, constants)) / np.array([10.0, 40.0])
    # 2.5 d = 4.5 mm at 0.05 x 48 x 2 / z pixels per mm.
    assert radius == pytest.approx(2.5 * 1.7998 * 4.8 / np.array([10, 40]), rel=1e-4)
    assert radius[0] > 1.5 > radius[1] > 0.5
    classes = classes_of(gbuffer, method, first_device)
    assert (classes[:, :3] == SAMPLED).all() and (classes[:, 3:] == SEPARABLE).all()
    wider = dataclasses.replace(method, radius_threshold_px=10.0, passthrough_px=1.0)
    classes = classes_of(gbuffer, wider, first_device)
    assert (classes[:, :3] == SEPARABLE).all() and (classes[:, 3:] == PASSTHROUGH).all()


def test_the_count_rule_samples_what_needs_many_samples(first_device):
    """Noise keeps the tiles of a soft shadow's edge sampled; even light is soon filtered."""
    light = np.full((40, 64), 0.9)
    light[:, :40] = 0.02
    gbuffer = plate(light, depth_cm=20.0, projection_x=8.0)
    method = Method(kind="hybrid", hybrid_rules=("count",), sigma0_sq=5e-5)
    first = classes_of(gbuffer, method, first_device, 1)
    assert (first == SAMPLED).all()  # no history: the largest count
    later = classes_of(gbuffer, method, first_device, 24)
    assert (later[:, 5] == SAMPLED).all() or (later[:, 4] == SAMPLED).all()
    assert (later[:, 0] == SEPARABLE).all()
    assert 0 < (later == SAMPLED).mean() < 0.7


def test_a_tile_is_sampled_again_when_its_light_changes(first_device):
    def scene(frame):
        return bright if frame >= 30 else dark

    dark, bright = (
        plate(np.full((24, 24), value), depth_cm=20.0, projection_x=20.0) for value in (0.1, 1.0)
    )
    method = Method(kind="hybrid", hybrid_rules=("count",))
    assert (classes_of(dark, method, first_device, 30) == SEPARABLE).all()
    import pyopencl as cl

    pipeline = Pipeline(method, 24, 24, first_device)
    classes = np.empty((3, 3), np.uint8)
    for frame in range(32):
        advance(pipeline, scene(frame), frame)
    cl.enqueue_copy(first_device.queue, classes, pipeline.buffers["tile_class"])
    assert (classes == SAMPLED).all()


def test_the_painted_rule_samples_the_tiles_that_touch_the_paint(first_device):
    gbuffer = plate(np.full((32, 48), 0.5), projection_x=40.0)
    importance = np.zeros((32, 48), np.float32)
    importance[9, 17] = 0.5
    importance[25, 40] = 0.4
    gbuffer = dataclasses.replace(gbuffer, importance=importance)
    method = Method(kind="hybrid", hybrid_count="fixed", hybrid_rules=("painted",))
    classes = classes_of(gbuffer, method, first_device)
    expected = np.full((4, 6), SEPARABLE)
    expected[1, 2] = SAMPLED
    assert np.array_equal(classes, expected)


def test_the_painted_rule_needs_paint(first_device):
    method = Method(kind="hybrid", hybrid_rules=("painted",))
    with pytest.raises(InputError, match="importance"):
        render(small_gbuffer(), method, device=first_device)


@pytest.mark.parametrize("value", [-0.1, 1.5, np.nan])
def test_importance_out_of_range_is_an_input_error(value):
    with pytest.raises(InputError, match="importance"):
        dataclasses.replace(small_gbuffer(), importance=np.full((27, 44), value, np.float32))


@pytest.mark.parametrize("suffix", ["npz", "exr"])
def test_importance_is_stored_with_a_captured_gbuffer(tmp_path, suffix):
    save, load = {"npz": (save_npz, load_npz), "exr": (save_exr, load_exr)}[suffix]
    path = tmp_path / f"g.{suffix}"
    save(path, painted_gbuffer())
    assert np.array_equal(load(path).importance, painted_gbuffer().importance)
    save(path, small_gbuffer())
    assert load(path).importance is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("hybrid_rules", ("luck",)),
        ("hybrid_count", "some"),
        ("count_threshold", -1.0),
        ("importance_threshold", 1.5),
        ("passthrough_px", -1.0),
        ("estimator", "two-pass"),
    ],
)
def test_settings_out_of_range_are_input_errors(field, value):
    with pytest.raises(InputError, match=field):
        Method(kind="hybrid", **{field: value})


# The pictures.


def test_all_tiles_sampled_is_the_fixed_method(first_device):
    gbuffer = small_gbuffer()
    hybrid = Method(
        kind="hybrid",
        hybrid_count="fixed",
        num_samples=20,
        hybrid_rules=("count",),
        passthrough_px=0.0,
    )
    frame = render(gbuffer, hybrid, device=first_device)
    fixed = render(gbuffer, Method(num_samples=20), device=first_device)
    assert np.array_equal(frame.combined, fixed.combined)
    assert np.array_equal(frame.counts, fixed.counts)


def test_no_tile_sampled_is_the_separable_method(first_device):
    gbuffer = small_gbuffer()
    hybrid = dataclasses.replace(METHODS["none"], hybrid_count="fixed")
    frame = render(gbuffer, hybrid, device=first_device)
    separable = render(gbuffer, Method(kind="separable", num_taps=5), device=first_device)
    assert np.array_equal(frame.combined, separable.combined)
    assert np.array_equal(frame.counts, separable.counts)


def test_sampled_tiles_are_those_of_the_fixed_method_bit_for_bit(first_device):
    gbuffer, method = painted_gbuffer(), METHODS["radius"]
    frame = render(gbuffer, method, device=first_device)
    fixed = render(gbuffer, dataclasses.replace(method, kind="fixed"), device=first_device)
    sampled = per_pixel(classes_of(gbuffer, method, first_device), gbuffer) == SAMPLED
    assert sampled.any()
    assert np.array_equal(frame.scattered[sampled], fixed.scattered[sampled])


def test_light_that_scatters_less_than_a_pixel_stays(first_device):
    gbuffer = dataclasses.replace(small_gbuffer(depth_cm=30.0))
    method = Method(kind="hybrid", passthrough_px=100.0)
    frame = render(gbuffer, method, device=first_device)
    light = to_half(np.where(gbuffer.subsurface[..., None], gbuffer.irradiance, 0))
    assert np.array_equal(to_half(frame.scattered), light)
    assert np.array_equal(frame.counts, gbuffer.subsurface)


def test_constant_light_comes_back_constant_through_every_class(first_device):
    depth = np.geomspace(5, 300, 96)
    gbuffer = plate(np.full((40, 96), 0.7), depth, projection_x=4.0)
    method = Method(
        kind="hybrid",
        hybrid_count="fixed",
        hybrid_rules=("radius",),
        radius_threshold_px=4.0,
    )
    classes = classes_of(gbuffer, method, first_device)
    assert set(np.unique(classes)) == {PASSTHROUGH, SEPARABLE, SAMPLED}
    frame = render(gbuffer, method, device=first_device)
    assert np.abs(frame.scattered / np.float32(np.float16(0.7)) - 1).max() <= 2**-9


def test_what_left_the_skin_leaves_the_picture(first_device):
    """Tiles that turn empty, or change their class, show nothing of the frame before."""
    whole, half = small_gbuffer(), small_gbuffer()
    mask = np.arange(44) < 15
    half = dataclasses.replace(half, profile_id=half.profile_id * mask.astype(np.uint8))
    for method in (METHODS["radius"], dataclasses.replace(METHODS["none"], hybrid_count="fixed")):
        moved = render(lambda frame: (whole, half)[frame], method, 2, first_device)
        assert np.array_equal(
            moved.combined, render(lambda _: half, method, 2, first_device).combined
        )
        assert (moved.scattered[~half.subsurface] == 0).all()


def test_a_repeat_is_bit_identical(first_device):
    first, second = (
        render(painted_gbuffer(), METHODS["adaptive"], NUM_FRAMES, first_device) for _ in range(2)
    )
    assert np.array_equal(first.combined, second.combined)


def test_the_estimate_of_rows_is_an_upper_bound(first_device):
    for name in ("adaptive", "radius", "none"):
        gbuffer, method = painted_gbuffer(), METHODS[name]
        trace = record(gbuffer, method, device=first_device, self_check=False)
        assert sum(c.num_rows for c in trace.chunks()) <= estimate_rows(gbuffer, method)
