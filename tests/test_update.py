"""The update pass: the moving mean and variance, and what happens where there is no history."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kernels.frame import render
from kernels.grid import Grid
from kernels.method import Method
from kernels.passes import update
from kernels.passes.constants import Constants
from kernels.selfcheck import small_gbuffer

F = np.float32
WIDTH, HEIGHT = 48, 40


def covered(depth_cm=20.0):
    """Everywhere skin at one depth, half of it in shadow."""
    gbuffer = small_gbuffer(WIDTH, HEIGHT)
    light = np.where(np.arange(HEIGHT) < HEIGHT // 2, 0.8, 0.1).astype(F)[:, None, None]
    return dataclasses.replace(
        gbuffer,
        irradiance=np.broadcast_to(light, (HEIGHT, WIDTH, 3)).copy(),
        profile_id=np.ones((HEIGHT, WIDTH), np.uint8),
        depth_cm=np.full((HEIGHT, WIDTH), depth_cm, F),
    )


def test_the_variance_of_independent_frames_is_eight_ninths_of_theirs():
    """[Finch 2009]: 2 (1 - alpha) / (2 - alpha) of the true variance in the long run."""
    grid, rng = Grid(64, 64, "raster", "linear"), np.random.default_rng(2)
    method = Method(kind="adaptive")
    gbuffer_constants = Constants.of(method, 64, 64, 3.7)
    empty = np.zeros((64, 64, 4), np.float16)
    textures = {"history_0": empty, "history_1": empty, "depth": np.full((64, 64), 20, F)}
    kept = []
    for frame in range(90):
        value = rng.normal(0.7, 0.05, (64, 64))
        grey = (value**2.2).astype(np.float16)
        count = np.full((64, 64), 8, np.float16)
        textures["scattered"] = np.stack([grey, grey, grey, count], axis=-1)
        update.reference(grid, textures, method, frame, gbuffer_constants)
        kept.append(textures[f"history_{frame % 2}"].astype(F))
    late = np.array(kept[30:])
    assert late[..., 2].mean() == pytest.approx(0.05**2 * 2 * 0.8 / 1.8, rel=0.03)
    assert late[..., 3].mean() == pytest.approx(0.7, rel=0.01)
    assert late[..., 0].mean() == pytest.approx(8, rel=0.01)


def moved_in(num_before=6):
    """A still scene whose last frame shows, on the left, what was off the screen before, and in the
    middle a surface twice as far.
    """
    near = covered()
    velocity = np.zeros((HEIGHT, WIDTH, 2), F)
    velocity[:, :12, 0] = -100
    depth = near.depth_cm.copy()
    depth[:, 20:28] = 40
    last = dataclasses.replace(near, velocity=velocity, depth_cm=depth)
    return (lambda frame: last if frame == num_before else near), num_before + 1


@pytest.mark.parametrize(
    ("disocclusion", "off_screen_is_new", "far_is_new", "variance"),
    [
        ("variance", True, True, 0.001),
        ("offscreen", True, False, 0.0),
        ("none", False, False, None),
    ],
)
def test_where_there_is_no_history(device, disocclusion, off_screen_is_new, far_is_new, variance):
    scene, num_frames = moved_in()
    method = Method(kind="adaptive", disocclusion=disocclusion, alpha=0.25, b_max=16)
    before = render(scene, method, num_frames - 1, device).history
    after = render(scene, method, num_frames, device)
    scalar = update.find_luminance(after.scattered)
    places = {"off screen": np.s_[:, :12], "far": np.s_[:, 20:28], "known": np.s_[:, 30:]}
    old = before.copy()
    old[places["off screen"]] = 0
    for name, is_new in (("off screen", off_screen_is_new), ("far", far_is_new), ("known", False)):
        at = places[name]
        if is_new:
            mean, count = scalar[at], after.counts[at].astype(F)
            spread = np.full(mean.shape, variance)
        else:
            mean = 0.75 * old[at][..., 3] + 0.25 * scalar[at]
            count = 0.75 * old[at][..., 0] + 0.25 * after.counts[at]
            spread = 0.75 * old[at][..., 2] + 0.1875 * (scalar[at] - old[at][..., 3]) ** 2
        found = after.history[at]
        assert np.allclose(found[..., 3], mean, rtol=2e-3), name
        assert np.allclose(found[..., 0], count, rtol=2e-3), name
        assert np.allclose(found[..., 2], spread, rtol=2e-3, atol=1e-6), name


def test_the_target_variance_spares_the_spike_behind_a_disocclusion(device):
    """The slides' claim: without a rule the count is overestimated and the mean comes slowly."""
    counts, means = {}, {}
    for disocclusion in ("variance", "offscreen", "none"):
        method = Method(kind="adaptive", disocclusion=disocclusion)
        scene, num_frames = moved_in(8)
        calm = covered()

        def longer(frame, scene=scene, num_frames=num_frames, calm=calm):
            return scene(frame) if frame < num_frames else calm

        flat = np.s_[2:12, 2:10]
        first = render(longer, method, num_frames + 1, device)
        later = render(longer, method, num_frames + 9, device)
        counts[disocclusion] = later.counts[flat].mean()
        scalar = update.find_luminance(first.scattered)
        means[disocclusion] = (first.history[..., 3] / scalar)[flat]
    assert counts["none"] == 64
    assert counts["offscreen"] == 8
    assert counts["variance"] < 10
    assert means["none"].max() < 0.5 < 0.95 < means["variance"].min()


def test_the_first_frame_without_a_rule_takes_the_least_samples(device):
    for disocclusion, count in (("variance", 64), ("offscreen", 8), ("none", 8)):
        method = Method(kind="adaptive", disocclusion=disocclusion)
        assert (render(covered(), method, 1, device).counts == count).all()


@pytest.mark.parametrize("rule", ["paper", "o1", "sliding", "engine"])
def test_every_rule_settles_in_even_light(device, rule):
    gbuffer = covered()
    method = Method(kind="adaptive", rule=rule)
    counts = render(gbuffer, method, 14, device).counts
    assert counts[2:8].mean() < 12
