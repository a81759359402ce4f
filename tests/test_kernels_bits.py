"""Every device computes the reference's trace and pictures bit for bit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from recordings import assert_launches_equal

from kernels import program
from kernels.frame import render
from kernels.method import Method
from kernels.record import record
from kernels.reference import render_reference
from kernels.resources import to_half
from kernels.selfcheck import count_differences, small_gbuffer

METHODS = {
    "fixed": Method(num_samples=24),
    "adaptive": Method(kind="adaptive", b_max=40),
    "engine": Method(kind="adaptive", rule="engine", sigma0_sq=1e-4, lane_map="quad2x2"),
    "exact textbook mean": Method(
        num_samples=12,
        inverse_cdf="exact",
        mip_rule="textbook",
        scale="legacy",
        weights="mean",
        hash="unreal",
        tile_order="morton",
        lane_map="morton8x8",
    ),
    "bare": Method(
        num_samples=9,
        centre_reweighting=False,
        bilateral=False,
        normal_weights=False,
        prefilter=False,
        weights="mean",
        planes=("profile_id",),
    ),
    "untraced colour": Method(
        kind="adaptive", mip_rule="mip0", planes=("normal",), passes=("sampling", "update")
    ),
}
NUM_FRAMES = 4


def moving_gbuffer():
    """A G-buffer whose surface moves, partly in from outside the frame."""
    still = small_gbuffer()
    y, x = np.mgrid[0 : still.height, 0 : still.width].astype(np.float32)
    velocity = np.stack([0.3 * x - 4, 1.5 * np.sin(y)], axis=-1).astype(np.float32)
    return dataclasses.replace(still, velocity=velocity)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("scene", [small_gbuffer, moving_gbuffer])
def test_trace_and_pictures_equal_the_reference(device, name, scene):
    method, gbuffer = METHODS[name], scene()
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
    launches = [
        (frame, launch)
        for frame, found in enumerate(expected)
        for launch in found.launches
        if launch[0].pass_name in method.passes
    ]
    assert [v.frame for v in trace.launches] == [frame for frame, _ in launches]
    assert_launches_equal(trace, [launch for _, launch in launches])

    last, textures = expected[-1], expected[-1].textures
    frame = render(gbuffer, method, NUM_FRAMES, device)
    assert np.array_equal(frame.counts, last.counts)
    assert np.array_equal(to_half(frame.combined), textures["output"][..., :3])
    assert np.array_equal(to_half(frame.scattered), textures["scattered"][..., :3])
    if method.adaptive:
        history = textures[f"history_{(NUM_FRAMES - 1) % 2}"]
        assert np.array_equal(to_half(frame.history), history)


@pytest.mark.parametrize("name", ["adaptive", "exact textbook mean"])
def test_one_lane_per_work_item_computes_the_same_bits(device, monkeypatch, name):
    """What GPUs run, on whatever device is here."""
    monkeypatch.setattr(program, "lanes_per_item", lambda device, kernel: 1)
    test_trace_and_pictures_equal_the_reference(device, name, moving_gbuffer)


def test_the_adaptive_frames_of_these_tests_do_adapt():
    counts = render_reference(small_gbuffer(), METHODS["adaptive"], NUM_FRAMES)[-1].counts
    assert len(np.unique(counts[counts > 0])) > 5


def test_self_check_counts_nothing_on_a_complying_device(device):
    if device.correctly_rounded:
        assert count_differences(device, Method(num_samples=5)) == 0


def test_self_check_notices_a_difference(device, monkeypatch):
    from kernels.passes import sampling

    monkeypatch.setattr(sampling, "_C", np.float32(2.6))
    assert count_differences(device, Method(num_samples=6)) > 0
