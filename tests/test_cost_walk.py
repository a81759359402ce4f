"""Drawn reads against closed forms, brute force and counting by hand; the order of the tiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cost_samples import GPU, OPTICS, made_workload

from cachesim import presets
from cachesim.cost.dispatch import dispatch
from cachesim.cost.machine import Machine
from cachesim.cost.memory import Memory
from cachesim.cost.tiles import ScatterCost, cost_scatter
from cachesim.cost.workload import (
    Read,
    Workload,
    taps_mm,
)
from kernels.maths.profile import SKIN, inverse_cdf_approximate
from kernels.passes.separable_taps import make_taps


def test_distances_are_the_samplers_and_none_lies_in_its_own_pixel():
    u = np.linspace(0, 0.999, 50)
    plain = replace(OPTICS, centre_reweighting=False)
    expected = inverse_cdf_approximate(u, SKIN.d_sampled_mm) * 3.0
    assert plain.radii(u, 3.0) == pytest.approx(expected, rel=1e-6)
    assert OPTICS.radii(np.array([0.0]), 0.4)[0] == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize(
    ("per_mm", "count", "expected"),
    # Facts sheet 2.6, rows UE-C at 20 and 50 cm and UE-A/B at 20 cm, rounded up to a level.
    ((17.91, 8, (1, 2, 4)), (17.91, 64, (0, 1, 2)), (7.165, 8, (0, 1, 3)), (59.71, 8, (3, 4, 5))),
)
def test_mips_are_those_of_the_worked_table(per_mm, count, expected):
    d = SKIN.d_sampled_mm
    radius = np.array([1.552, 6.062, 12.953]) * d * per_mm
    assert tuple(OPTICS.levels(radius, count, per_mm, 1920, 1080)) == expected
    assert not replace(OPTICS, mip_rule="mip0").levels(radius, count, per_mm, 1920, 1080).any()


def test_a_filters_taps_are_the_kernels():
    from kernels.method import Method

    for method in (Method(num_taps=27), Method(num_taps=13, separable_profile="skin")):
        offsets = [float(o) for o in make_taps(method)[:, 0] if o]
        assert sorted(taps_mm(method.as_dict())) == pytest.approx(sorted(offsets), rel=1e-5)


def walked(workload: Workload, gpu: str = GPU, **l1: int) -> ScatterCost:
    """What the made workload's reads cost on a GPU whose L1 is changed."""
    machine = presets.load(gpu)
    machine = machine.model_copy(update={"l1": machine.l1.model_copy(update=l1)})
    found = Machine.of(machine)
    return cost_scatter(workload, workload.scatters[0], found, Memory.of(workload, found))


def test_an_l1_is_asked_for_the_sectors_of_random_lanes():
    """Brute force: the distances' inverse cdf, a block-linear sector as the box that it is."""
    random = np.random.default_rng(7)
    workload = made_workload(1.5, 16, 80, 45)
    cost = walked(workload)
    total = sum(part.asked for part in cost.classes)
    rows = 2 * 16 * 80 * 45
    # A sector of 32 B is 4x2 texels of 4 B and 16x2 of 1 B.
    for k, wide, tall in ((1, 4, 2), (2, 16, 2)):
        distinct = []
        for _ in range(1500):
            r = OPTICS.radii(random.random(32), 1.5)
            turn = 2 * np.pi * random.random(32)
            x = 8 * random.integers(80) + np.arange(32) % 8 + 0.5 + r * np.cos(turn)
            y = 4 * random.integers(90) + np.arange(32) // 8 + 0.5 + r * np.sin(turn)
            x, y = np.floor(np.clip(x, 0, 639) / wide), np.floor(np.clip(y, 0, 359) / tall)
            distinct.append(len(set(zip(x, y, strict=True))))
        assert total[k].sum() / rows == pytest.approx(np.mean(distinct), rel=0.03)


def test_every_read_is_counted_once_and_no_level_misses_more_than_it_is_asked():
    workload = made_workload(2.0, 8)
    for gpu in (GPU, "rx-6900-xt"):
        cost = walked(workload, gpu)
        for part in cost.classes:
            assert part.lanes.sum(axis=(1, 2)) == pytest.approx(workload.num_samples)
            assert (part.missed <= part.asked).all() and (part.asked <= part.lanes).all()
            assert part.missed.sum() <= part.asked.sum() <= part.lanes.sum()
        passed = sum(part.passed.sum() for part in cost.classes)
        sector = presets.load(gpu).l1.sector_bytes
        assert passed <= cost.missed * sector
        assert (passed == cost.missed * sector) == (gpu == GPU)


def test_an_l1_that_holds_the_frame_misses_each_of_its_sectors_once():
    workload = made_workload(2.0, 64, 8, 6)
    huge = walked(workload, "h100-sxm", capacity=1 << 24, ways=1 << 17)
    machine = presets.load("h100-sxm")
    # 48 tiles go to 48 SMs; on each no more can be missed than the textures have sectors.
    whole = sum(64 * 48 * b * (1.34 if b == 8 else 1.0) for b in (8, 4, 1)) / 32
    assert machine.sm.count > 48 and huge.missed <= 48 * whole
    small = walked(workload, "h100-sxm", capacity=1 << 13, ways=16)
    assert huge.missed < 0.5 * small.missed <= 0.5 * small.asked
    assert huge.asked == pytest.approx(small.asked)


def test_a_filters_taps_are_read_where_they_fall():
    """One tile row, taps of whole texels along x: the sectors can be counted by hand."""
    workload = made_workload(1.0, 3, 30, 1)
    (scatter,) = workload.scatters
    reads = (Read("normal", 4, False, True),)
    scatter = replace(scatter, direction="x", taps_mm=(-16.0, 0.0, 16.0), reads=reads)
    workload = replace(workload, scatters=(scatter,))
    part = walked(workload).classes[0]
    # A tap reads nothing in the 2 tiles that it takes out of the frame.
    tiles = 30 + 2 * 28
    assert part.lanes.sum() == 64 * tiles
    # 8x4 pixels and the next column and row are 3x3 sectors of 4x2 texels; nothing is below the
    # tiles' second warps, nor to the right of the last tile, where one tap of each of 3 tiles ends
    # but the one that reads 16 texels to the left of it.
    assert part.asked.sum() == tiles * (3 * 3 + 3 * 2) - 2 * (3 + 2)


def test_ctas_share_an_sm_and_make_room_in_order():
    # Two places: pairs of CTAs of 2 x 5 accesses take 20 turns together, one after the other.
    plan = dispatch(np.full((6, 2), 5), 1, 2, 1)
    assert plan.end.tolist() == [18, 20, 38, 40, 58, 60]
    assert plan.start.tolist() == [0, 0, 18, 20, 38, 40]
    # Two SMs take turns; an idle CTA leaves its place to the next.
    plan = dispatch(np.array([[10], [1], [10], [10]]), 2, 1, 1)
    assert plan.unit.tolist() == [0, 1, 1, 0] and plan.start.tolist() == [0, 0, 1, 10]
    # Fewer CTAs than SMs.
    assert dispatch(np.full((2, 1), 5), 4, 3, 1).end.tolist() == [5, 5]
    # Units of an SM go by place.
    assert dispatch(np.full((4, 1), 5), 1, 4, 2).unit.tolist() == [0, 1, 0, 1]


def test_ctas_that_end_together_leave_room_for_those_of_all_sms_in_turn():
    plan = dispatch(np.full((12, 1), 7), 3, 2, 1)
    assert plan.unit.tolist() == [0, 1, 2] * 4
