"""The patch of each tile in local memory: which samples fetch nothing, what filling it costs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from recordings import assert_launches_equal

from kernels import pipeline as pipelines
from kernels import program
from kernels.access import scattering_tiles
from kernels.frame import render
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes.patch import patch_texels
from kernels.record import estimate_rows, record
from kernels.reference import render_reference
from kernels.resources import to_half
from kernels.selfcheck import count_differences, small_gbuffer
from traces.check import check
from traces.errors import InputError
from traces.texture import INACTIVE_TEXEL, unpack_texel

METHODS = {
    "fixed": Method(num_samples=16, lds=True),
    "adaptive": Method(kind="adaptive", b_max=24, lds=True, lane_map="quad2x2"),
    "mip0": Method(
        num_samples=9, mip_rule="mip0", normal_weights=False, lds=True, planes=("colour",)
    ),
    "hybrid": Method(
        kind="hybrid",
        hybrid_count="fixed",
        num_samples=8,
        num_taps=3,
        hybrid_rules=("radius",),
        radius_threshold_px=1.2,
        tile_order="morton",
        lds=True,
    ),
}


def assert_equals_reference(gbuffer, method, device, num_frames=2):
    expected = render_reference(gbuffer, method, num_frames)
    trace = record(
        gbuffer,
        method,
        num_frames=num_frames,
        traced_frames="all",
        device=device,
        chunk_bytes=1 << 16,
        self_check=False,
    )
    assert_launches_equal(trace, [found for frame in expected for found in frame.launches])
    check(trace)
    frame = render(gbuffer, method, num_frames, device)
    assert np.array_equal(to_half(frame.combined), expected[-1].textures["output"][..., :3])


@pytest.mark.parametrize("name", METHODS)
def test_trace_and_pictures_equal_the_reference(device, name):
    assert_equals_reference(small_gbuffer(), METHODS[name], device)


@pytest.mark.parametrize("name", METHODS)
def test_one_lane_per_work_item_takes_the_patch_from_local_memory(first_device, name, monkeypatch):
    """As on GPUs, where the two warps of a tile are one work-group."""
    monkeypatch.setattr(program, "lanes_per_item", lambda device, kernel: 1)
    monkeypatch.setattr(pipelines.program, "lanes_per_item", lambda device, kernel: 1)
    assert_equals_reference(small_gbuffer(), METHODS[name], first_device)


@pytest.mark.parametrize("name", METHODS)
def test_the_picture_does_not_depend_on_the_patch(first_device, name):
    method = METHODS[name]
    with_patch, without = (
        render(small_gbuffer(), dataclasses.replace(method, lds=lds), 3, first_device)
        for lds in (True, False)
    )
    assert np.array_equal(with_patch.combined, without.combined)
    assert np.array_equal(with_patch.counts, without.counts)


def test_the_self_check_finds_no_difference(first_device):
    assert count_differences(first_device, METHODS["fixed"]) == 0


def sampling_fetches(method, device):
    """(fetches outside the patch's filling, fetches that fill it, texels of the samples' fetches of
    profile ids) of a frame of the sampling pass.
    """
    gbuffer = small_gbuffer()
    trace = record(gbuffer, method, device=device, self_check=False)
    (step, _, _) = next(
        found
        for found in render_reference(gbuffer, method)[0].launches
        if found[0].pass_name == "sampling"
    )
    accesses = step.program(method, 0).accesses
    fills = {i for i, access in enumerate(accesses) if access.of_tile}
    first = min(i for i, v in enumerate(trace.instructions) if v.pass_name == "sampling")
    others = filled = 0
    held = []
    for chunk in trace.chunks():
        if trace.launches[chunk.launch].pass_name != "sampling":
            continue
        active = chunk.active.sum(axis=1)
        is_fill = np.isin(chunk.instruction - first, list(fills))
        filled += int(active[is_fill].sum())
        others += int(active[~is_fill].sum())
        is_id = [trace.textures[trace.instructions[i].texture].name for i in chunk.instruction]
        held.append(chunk.lanes[(np.array(is_id) == "profile_id") & ~is_fill])
    return others, filled, np.concatenate(held)


def test_each_texel_of_a_tile_and_its_border_is_loaded_once(first_device):
    gbuffer = small_gbuffer()
    _, filled, _ = sampling_fetches(METHODS["fixed"], first_device)
    height, width = gbuffer.subsurface.shape
    expected = 0
    for top in range(0, height, 8):
        for left in range(0, width, 8):
            if gbuffer.subsurface[top : top + 8, left : left + 8].any():
                rows = min(height, top + 9) - max(0, top - 1)
                expected += rows * (min(width, left + 9) - max(0, left - 1))
    assert filled == 3 * expected  # colour, normal, profile id


def test_samples_in_the_patch_fetch_nothing_and_all_others_do(first_device):
    method = dataclasses.replace(METHODS["mip0"], planes=("colour", "profile_id"))
    without = dataclasses.replace(method, lds=False)
    others, _, ids = sampling_fetches(method, first_device)
    all_fetches, filled, all_ids = sampling_fetches(without, first_device)
    assert filled == 0 and len(ids) == len(all_ids)
    # Only lanes are masked, and each of them for both planes.
    masked = (ids != all_ids) & (ids == INACTIVE_TEXEL)
    assert np.array_equal(np.where(masked, all_ids, ids), all_ids)
    assert masked.any() and all_fetches - others == 2 * masked.sum()


def test_a_finer_level_is_what_the_patch_holds(first_device):
    """Samples at coarser levels are fetched though their texel lies in the patch."""
    gbuffer = small_gbuffer(depth_cm=8.0)
    method = Method(num_samples=8, scale="legacy", lds=True)
    trace = record(gbuffer, method, device=first_device, self_check=False)
    levels = set()
    for chunk in trace.chunks():
        if trace.launches[chunk.launch].pass_name == "sampling":
            names = [trace.textures[trace.instructions[i].texture].name for i in chunk.instruction]
            level, _, _ = unpack_texel(chunk.lanes[np.array(names) == "setup"])
            levels |= set(np.unique(level[level < 15]).tolist())
    assert max(levels) > 0


def test_the_patch_of_a_tile_is_ten_by_ten():
    grid = Grid(24, 24, "raster", "linear")
    parts = patch_texels(grid)
    middle = [part.reshape(-1, 64)[4] for part in parts]
    texels = np.concatenate(middle)
    texels = texels[texels != INACTIVE_TEXEL]
    _, y, x = unpack_texel(texels)
    assert len(texels) == len(np.unique(texels)) == 100
    assert (y.min(), y.max(), x.min(), x.max()) == (7, 16, 7, 16)
    corner = np.concatenate([part.reshape(-1, 64)[0] for part in parts])
    assert (corner != INACTIVE_TEXEL).sum() == 81


def test_warps_of_a_tile_fill_the_patch_together():
    states = np.array([-1, 5, 0, 0, 3, 0, -1, -1], np.int32)
    assert scattering_tiles(states).tolist() == [True, True, False, False, True, True, False, False]


def test_the_estimate_of_rows_is_exact_for_the_fixed_method(first_device):
    gbuffer, method = small_gbuffer(), METHODS["fixed"]
    trace = record(gbuffer, method, device=first_device, self_check=False)
    assert sum(chunk.num_rows for chunk in trace.chunks()) == estimate_rows(gbuffer, method)


@pytest.mark.parametrize(
    "unusual",
    [{"inverse_cdf": "exact"}, {"weights": "mean"}, {"bilateral": False}],
)
def test_unusual_estimators_have_no_patch(unusual):
    with pytest.raises(InputError, match="lds"):
        Method(lds=True, **unusual)
