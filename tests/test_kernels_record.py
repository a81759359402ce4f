"""The recorder: chunks, rows, instructions, manifest and what is traced."""

from __future__ import annotations

import dataclasses
import gc
import json

import numpy as np
import pytest

from kernels.lanes import LanePool
from kernels.method import Method
from kernels.record import estimate_rows, record
from kernels.selfcheck import small_gbuffer
from traces.errors import InputError
from traces.texture import INACTIVE_TEXEL, unpack_texel

FIXED = Method(num_samples=16)
ADAPTIVE = Method(kind="adaptive", b_max=32)


@pytest.fixture(scope="module")
def gbuffer():
    return small_gbuffer(60, 35)


def rows_of(trace):
    """(instruction, lanes, launch) of every row."""
    chunks = list(trace.chunks())
    launch = np.concatenate([np.full(c.num_rows, c.launch) for c in chunks])
    lanes = np.concatenate([c.lanes for c in chunks])
    return np.concatenate([c.instruction for c in chunks]), lanes, launch


@pytest.mark.parametrize("method", [FIXED, ADAPTIVE])
def test_chunks_joined_are_the_whole_whatever_their_size_and_run(device, gbuffer, method):
    options = {"num_frames": 3, "device": device, "self_check": False}
    small = record(gbuffer, method, chunk_bytes=1, **options)
    whole = record(gbuffer, method, chunk_bytes=1 << 28, **options)
    assert len(list(small.chunks())) > 3 * len(list(whole.chunks()))
    assert len(list(whole.chunks())) == len(whole.launches)
    expected = rows_of(whole)
    for again in (small, small, whole):
        for got, want in zip(rows_of(again), expected, strict=True):
            assert np.array_equal(got, want)


def test_chunks_cover_each_launch_in_order(device, gbuffer):
    trace = record(gbuffer, ADAPTIVE, num_frames=2, device=device, chunk_bytes=1)
    position = (0, 0)
    for chunk in trace.chunks():
        launch = trace.launches[chunk.launch]
        assert (chunk.launch, chunk.first_cta) == position
        end = chunk.first_cta + chunk.num_warps // launch.warps_per_cta
        position = (chunk.launch, end) if end < launch.num_ctas else (chunk.launch + 1, 0)
        assert chunk.warp_offsets[0] == 0 and chunk.warp_offsets[-1] == chunk.num_rows
    assert position == (len(trace.launches), 0)


def test_every_texel_lies_in_its_texture_and_every_row_has_a_lane(device, gbuffer):
    trace = record(gbuffer, ADAPTIVE, num_frames=2, traced_frames="all", device=device)
    instruction, lanes, launch = rows_of(trace)
    active = lanes != INACTIVE_TEXEL
    assert active.any(axis=1).all()
    for code in np.unique(instruction):
        texture = trace.textures[trace.instructions[code].texture]
        mine = instruction == code
        mip, y, x = unpack_texel(lanes[mine][active[mine]])
        assert (mip < texture.num_mips).all()
        width, height = np.array([texture.mip_size(k) for k in range(texture.num_mips)]).T
        assert (x < width[mip]).all() and (y < height[mip]).all()
    names = [trace.launches[k].pass_name for k in launch]
    assert all(
        trace.instructions[code].pass_name == name
        for code, name in zip(instruction, names, strict=True)
    )


def test_history_textures_swap_between_frames(device, gbuffer):
    trace = record(gbuffer, ADAPTIVE, num_frames=2, traced_frames="all", device=device)
    instruction, _, launch = rows_of(trace)
    stores = set()
    for code, number in set(zip(instruction.tolist(), launch.tolist(), strict=True)):
        access = trace.instructions[code]
        name = trace.textures[access.texture].name
        if name.startswith("history"):
            stores.add((trace.launches[number].frame, access.operation, name))
    assert stores == {
        (0, "load", "history_1"),
        (0, "store", "history_0"),
        (1, "load", "history_0"),
        (1, "store", "history_1"),
    }


def test_fixed_lane_fetches_on_paper(device, gbuffer):
    trace = record(gbuffer, FIXED, device=device)
    scattering = int(gbuffer.subsurface.sum())
    pixels = gbuffer.width * gbuffer.height
    per_pass = dict.fromkeys((launch.pass_name for launch in trace.launches), 0)
    for chunk in trace.chunks():
        per_pass[trace.launches[chunk.launch].pass_name] += chunk.num_lane_fetches
    mips = sum((60 >> k) * (35 >> k) for k in range(1, 6))
    assert per_pass == {
        "setup": 4 * pixels + scattering,
        "prefilter": 2 * mips,
        "sampling": 2 * pixels + scattering * (1 + 3 * 16),
        "combine": 3 * pixels + 2 * scattering,
    }


def test_estimated_rows(device, gbuffer):
    fixed = record(gbuffer, FIXED, device=device)
    assert sum(c.num_rows for c in fixed.chunks()) == estimate_rows(gbuffer, FIXED)
    adaptive = record(gbuffer, ADAPTIVE, num_frames=3, device=device)
    assert 0 < sum(c.num_rows for c in adaptive.chunks()) <= estimate_rows(gbuffer, ADAPTIVE)


def test_adaptive_reads_fewer_samples_than_fixed_once_its_history_has_settled(device):
    scene = small_gbuffer(60, 35)
    fixed, adaptive = Method(), Method(kind="adaptive")
    sampling = {"passes": ("sampling",)}
    counts = [
        sum(
            chunk.num_lane_fetches
            for chunk in record(
                scene, dataclasses.replace(method, **sampling), num_frames=8, device=device
            ).chunks()
        )
        for method in (fixed, adaptive)
    ]
    assert counts[1] < 0.7 * counts[0]


@pytest.mark.parametrize("plane", ["colour", "normal", "profile_id"])
def test_planes_are_switchable_and_leave_the_others_alone(device, gbuffer, plane):
    every = record(gbuffer, dataclasses.replace(FIXED, passes=("sampling",)), device=device)
    one = record(
        gbuffer, dataclasses.replace(FIXED, passes=("sampling",), planes=(plane,)), device=device
    )
    texture = {"colour": "setup"}.get(plane, plane)

    def lanes_of(trace):
        instruction, lanes, _ = rows_of(trace)
        wanted = [
            k
            for k, access in enumerate(trace.instructions)
            if trace.textures[access.texture].name == texture
        ]
        return lanes[np.isin(instruction, wanted)]

    assert np.array_equal(lanes_of(one), lanes_of(every))
    names = {one.textures[access.texture].name for access in one.instructions}
    assert names == {texture, "scattered"}


def test_manifest_is_json_and_names_what_made_the_trace(device, gbuffer):
    manifest = json.loads(json.dumps(record(gbuffer, ADAPTIVE, device=device).manifest))
    assert manifest["device"]["name"] == device.name
    assert manifest["method"]["kind"] == "adaptive"
    assert manifest["method"]["profile"]["name"] == "skin"
    assert len(manifest["kernel_source_sha256"]) == 64
    assert manifest["differing_fetches"] is not None
    assert {"python", "numpy", "pyopencl"} <= set(manifest["versions"])


def test_progress_rises_to_one(device, gbuffer):
    shares = []
    trace = record(
        gbuffer, ADAPTIVE, num_frames=3, device=device, progress=shares.append, chunk_bytes=1
    )
    list(trace.chunks())
    assert shares == sorted(shares) and shares[-1] == 1 and len(shares) > 5


def test_moving_scenes_are_rendered_frame_by_frame(device, gbuffer):
    dark = dataclasses.replace(gbuffer, depth_cm=gbuffer.depth_cm * np.float32(2))
    moving = record(
        lambda frame: dark if frame else gbuffer, FIXED, num_frames=2, traced_frames="all",
        device=device,
    )  # fmt: skip
    still = record(dark, FIXED, num_frames=2, device=device)
    assert np.array_equal(
        np.concatenate([c.lanes for c in moving.chunks() if moving.launches[c.launch].frame == 1]),
        rows_of(still)[1],
    )


def test_buffers_are_recycled_when_a_chunk_is_dropped_and_only_then(device):
    pool = LanePool(device, 4)
    first = pool.take()
    held = pool.lend(first, 3)
    part = held[1:2, :5]
    del held
    gc.collect()
    assert pool.take() is not first
    del part
    gc.collect()
    assert pool.take() is first


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_frames": 0}, "num_frames 0: allowed are 1"),
        ({"traced_frames": "first"}, "'last', 'all'"),
        ({"traced_frames": (1,)}, "1: allowed are 0 to 0"),
        ({"traced_frames": ()}, "'last', 'all'"),
    ],
)
def test_bad_frames_are_refused(gbuffer, options, message):
    with pytest.raises(InputError, match=message):
        record(gbuffer, FIXED, **options)


def test_frames_of_another_size_are_refused(device, gbuffer):
    other = small_gbuffer(30, 20)
    trace = record(lambda frame: other if frame else gbuffer, FIXED, num_frames=2, device=device)
    with pytest.raises(InputError, match="30x20: all frames must be 60x35"):
        list(trace.chunks())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "adaptve"}, "did you mean 'adaptive'"),
        ({"planes": ("color",)}, "did you mean 'colour'"),
        ({"num_samples": 0}, "num_samples 0: allowed are 1 to 2048"),
        ({"b_min": 65}, "b_min 65: allowed are 1 to b_max = 64"),
        ({"kappa": float("nan")}, "kappa nan: allowed are 0 to 1"),
        ({"alpha": 0.0}, "alpha 0.0"),
        ({"sigma0_sq": -1.0}, "sigma0_sq -1.0"),
    ],
)
def test_method_refuses_impossible_settings(options, message):
    with pytest.raises(InputError, match=message):
        Method(**options)
