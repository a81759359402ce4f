"""The cost function against closed forms, brute force, the simulator, and made coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cachesim import presets
from cachesim.cost.dispatch import dispatch
from cachesim.cost.fit import Observation, fit
from cachesim.cost.frame import Step, Swept
from cachesim.cost.machine import LevelOfCost, Machine
from cachesim.cost.measure import measure_workload
from cachesim.cost.memory import Memory
from cachesim.cost.model import (
    COEFFICIENTS,
    SYMBOLS,
    Coefficient,
    CostModel,
    Prepared,
    coefficient_names,
    predict,
    predict_prepared,
)
from cachesim.cost.terms import frame_terms, sample_costs
from cachesim.cost.tiles import ScatterCost, cost_scatter
from cachesim.cost.window import miss_probability, pass_level
from cachesim.cost.workload import (
    LaunchWork,
    Optics,
    Read,
    Scatter,
    Sweep,
    Workload,
    taps_mm,
)
from kernels.profile import SKIN, inverse_cdf_approximate
from kernels.separable_taps import make_taps
from traces.errors import InputError
from traces.synthetic import stream
from traces.texture import Texture

GPU = "quadro-p4000"
WEIGHTS = {"issue": 0.7, "traffic": 1.3, "latency": 60.0}
OPTICS = Optics(SKIN.d_sampled_mm, SKIN.dmfp_max_mm, True, "eq-5.12", 6)
READS = (Read("setup", 8, True), Read("normal", 4, False), Read("profile_id", 1, False))


def made_workload(scale: float, count: int, across: int = 20, down: int = 12) -> Workload:
    """A frame whose tiles all scatter alike: sampling, then a pass that reads and writes it."""
    n, width, height = across * down, 8 * across, 8 * down
    scatter = Scatter(
        "sampling", "around", np.arange(n) % across, np.arange(n) // across,
        np.full((n, 64), count), np.full(n, scale), READS, (), 0, 64 * count * n,
    )  # fmt: skip
    rows, pixels = 2 * n, 64 * n
    sweeps = (
        Sweep("sampling", "scattered", 8, 0, width, height, "store", False, rows, pixels, 0),
        Sweep("combine", "scattered", 8, 0, width, height, "load", False, rows, pixels, 1),
        Sweep("combine", "output", 8, 0, width, height, "store", False, rows, pixels, 1),
    )
    launches = (
        LaunchWork(0, "sampling", n, 2, 48, 0, rows * 200 * count, rows * (3 * count + 1)),
        LaunchWork(1, "combine", n, 2, 20, 0, rows * 40, rows * 2),
    )
    textures = tuple(
        Texture(name, form, width, height, mips)
        for name, form, mips in (
            ("setup", "RGBA16F", 6), ("normal", "RGBA8", 1), ("profile_id", "R8", 1),
            ("scattered", "RGBA16F", 1), ("output", "RGBA16F", 1),
        )
    )  # fmt: skip
    return Workload("made", width, height, OPTICS, textures, (scatter,), sweeps, launches)


def made_model(**values: float) -> CostModel:
    names = coefficient_names(Machine.of(presets.load(GPU)))
    held = {n: values.get(n.replace(".", "_"), 1.0) for n in names}
    return CostModel(GPU, {n: Coefficient(v, v, v) for n, v in held.items()}, 2)


def test_every_symbol_has_a_unit_and_every_coefficient_a_meaning():
    assert all(len(row) == 4 and all(row) for row in SYMBOLS)
    for name in presets.names():
        for coefficient in coefficient_names(Machine.of(presets.load(name))):
            what = coefficient.partition(".")[2]
            assert COEFFICIENTS.get(coefficient) or COEFFICIENTS[f"{{level}}.{what}"]


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


@pytest.mark.parametrize("g", (1, 4))
@pytest.mark.parametrize("x", (0.05, 0.3, 1.0))
def test_the_probability_of_a_miss_is_that_of_lines_that_expire(g, x):
    """Brute force: a line of g sectors, reads at random times, gone when untouched for T = 1."""
    random = np.random.default_rng(3)
    times = np.cumsum(random.exponential(1 / (g * x), 60_000))
    sector = random.integers(0, g, len(times))
    held, last, misses = set(), -np.inf, 0
    for now, s in zip(times, sector, strict=True):
        if now - last > 1:
            held = set()
        misses += s not in held
        held.add(s)
        last = now
    assert miss_probability(x, g) == pytest.approx(misses / len(times), rel=0.06)


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


def window_level(lines: int) -> LevelOfCost:
    return LevelOfCost("l2", 1, 1, lines, 128, 32, flushed=False, takes_stores=True)


def swept_steps(size: np.ndarray, operations: str) -> tuple[Step, ...]:
    """Passes over a texture, l for a load and s for a store of all its sectors, in four steps."""
    steps = []
    for launch, operation in enumerate(operations):
        for part in range(4):
            there = np.zeros_like(size[0])
            there[part::4] = size[0, part::4]
            swept = Swept(0, operation == "s", float(there.sum()), there)
            steps.append(Step(launch, swept=[swept]))
    return tuple(steps)


@pytest.mark.parametrize("lines", (16, 64, 128))
def test_a_texture_is_found_again_where_it_fits(lines):
    size = np.full((1, 16), 512.0)  # 64 lines
    found = pass_level(window_level(lines), size, swept_steps(size, "ll"), 1.0)
    again = 0.0 if lines >= 64 else 64 * 128
    assert found.read_bytes == pytest.approx(64 * 128 + again, rel=0.02)
    assert sum(found.asked.values()) == pytest.approx(2 * 64 * 128)


def test_what_was_written_is_written_back_when_it_goes():
    size = np.full((1, 16), 512.0)
    fits = pass_level(window_level(128), size, swept_steps(size, "sl"), 1.0)
    assert fits.read_bytes == fits.written_bytes == 0.0
    small = pass_level(window_level(16), size, swept_steps(size, "sl"), 1.0)
    assert small.written_bytes == pytest.approx(64 * 128, rel=0.02)
    assert small.read_bytes == pytest.approx(64 * 128, rel=0.02)


@given(st.lists(st.floats(0.0, 5e4), min_size=2, max_size=8), st.integers(8, 96))
def test_a_level_passes_on_no_more_than_it_is_asked_and_less_where_it_is_larger(arrivals, lines):
    size = np.full((1, 12), 4096.0)
    steps = tuple(Step(k // 3, {0: np.full(12, amount / 12)}) for k, amount in enumerate(arrivals))
    small, large = (
        pass_level(window_level(n), size, steps, 1.0).read_bytes for n in (lines, 8 * lines)
    )
    assert large <= small * 1.02 + 1e-6
    assert small <= sum(arrivals) * (1 + 1e-9) + 1e-6


def test_adding_samples_costs_more_and_scattering_wider_costs_more():
    gpu, model = presets.load(GPU), made_model()
    finest = replace(OPTICS, mip_rule="mip0")
    few, many, wide = (
        predict(replace(made_workload(*args), optics=finest), gpu, model)
        for args in ((2.0, 4), (2.0, 16), (8.0, 4))
    )
    for level in ("l1", "l2"):
        assert few.demand_bytes[level] < many.demand_bytes[level]
        assert few.demand_bytes[level] < wide.demand_bytes[level]
    assert few.cycles < many.cycles


def test_the_terms_sum_to_the_frame():
    prepared, model = Prepared(made_workload(3.0, 8), Machine.of(presets.load(GPU))), made_model()
    predicted = predict_prepared(prepared, model)
    terms = frame_terms(prepared, model, predicted)
    assert terms["l2_bytes"].sum() == pytest.approx(predicted.by_launch["l2_bytes"].sum())
    assert terms["cycles"].sum() == pytest.approx(predicted.cycles)
    costs = sample_costs(prepared, model)
    assert costs.groupby("texture")["reads"].sum().to_numpy() == pytest.approx(1.0)
    near, far = (costs[costs["texture"] == "profile_id"].iloc[k] for k in (0, -1))
    assert near["distance_mm"] < far["distance_mm"] and near["l1_bytes"] < far["l1_bytes"] <= 34


def test_a_fit_recovers_the_coefficients_that_frames_were_made_with():
    gpu = presets.load(GPU)
    made = {
        "l2_passed": 1.08, **{f"cycles_{k}": v for k, v in WEIGHTS.items()},
    }  # fmt: skip
    truth = made_model(**made)
    observations, held_out = [], []
    for k, (scale, count) in enumerate(
        ((0.4, 8), (1.0, 16), (2.0, 8), (4.0, 12), (8.0, 4), (1.5, 32), (3.0, 6), (0.7, 24))
    ):
        workload = made_workload(scale, count, 60 if k % 2 else 20, 40 if k % 2 else 12)
        predicted = predict(workload, gpu, truth)
        cycles = dict(zip(predicted.by_launch["pass"], predicted.by_launch["cycles"], strict=True))
        held = Observation(workload, predicted.demand_bytes, cycles)
        (held_out if k == 5 else observations).append(held)
    fitted = fit(observations, gpu)
    for name, coefficient in fitted.coefficients.items():
        assert coefficient.value == pytest.approx(truth.value(name), rel=0.02), name
        assert coefficient.low <= coefficient.value <= coefficient.high
    (frame,) = held_out
    predicted = predict(frame.workload, gpu, fitted)
    for level, value in frame.demand_bytes.items():
        assert predicted.demand_bytes[level] == pytest.approx(value, rel=0.03)
    assert predicted.cycles == pytest.approx(sum(frame.pass_cycles.values()), rel=0.05)


def test_one_frame_is_too_few_and_byte_addresses_are_no_texels():
    with pytest.raises(InputError, match="1 frames: need two"):
        fit([Observation(made_workload(1.0, 4), {})], presets.load(GPU))
    with pytest.raises(InputError, match="needs texels"):
        measure_workload(stream(8))


@pytest.mark.parametrize("kind", ("fixed", "adaptive", "separable", "hybrid"))
def test_a_scenes_workload_is_that_of_its_recording(first_device, kind):
    from experiments.cost_frames import scene_workload
    from kernels.method import Method
    from kernels.record import record
    from kernels.scene import load_scene

    gbuffer = load_scene("front", 160, 90, device=first_device)
    method, frames = Method(kind=kind, num_samples=8, radius_threshold_px=0.8), 2
    if kind == "hybrid":
        method = replace(method, passthrough_px=0.0)
    trace = record(gbuffer, method, num_frames=frames, device=first_device, self_check=False)
    told, seen = (
        scene_workload(gbuffer, method, frames, first_device), measure_workload(trace)
    )  # fmt: skip
    assert told.lane_fetches == seen.lane_fetches and told.num_samples == seen.num_samples
    for a, b in zip(told.scatters, seen.scatters, strict=True):
        assert a.pass_name == b.pass_name and a.reads == b.reads
        for name in ("tile_x", "tile_y", "counts"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
        there = a.pixels > 16
        ratio = b.texels_per_mm[there] / a.texels_per_mm[there]
        assert np.median(ratio) == pytest.approx(1.0, abs=0.06)
    assert sum(w.accesses for w in told.launches) == sum(w.accesses for w in seen.launches)
    told_total, seen_total = (sum(w.instructions for w in v.launches) for v in (told, seen))
    # The classify pass has fewer in the warps of tiles that are sampled.
    assert told_total == pytest.approx(seen_total, rel=0 if kind != "hybrid" else 5e-3)


@pytest.mark.parametrize("gpu", (GPU, "h100-sxm"))
def test_the_model_is_near_the_simulator_before_anything_is_fitted(first_device, gpu):
    from cachesim import simulate
    from experiments.cost_frames import scene_workload
    from kernels.method import Method
    from kernels.record import record
    from kernels.scene import load_scene

    gbuffer = load_scene("close", 160, 90, device=first_device)
    method = Method(num_samples=8)
    trace = record(gbuffer, method, device=first_device, self_check=False)
    report = simulate(trace, gpu)
    predicted = predict(
        scene_workload(gbuffer, method, 1, first_device), presets.load(gpu), CostModel(gpu, {}, 0)
    )
    assert predicted.lane_fetches == report.lane_fetches
    for level, allowed in (("l1", 0.03), ("l2", 0.06)):
        simulated = report.counters[level].demand_bytes
        assert predicted.demand_bytes[level] == pytest.approx(simulated, rel=allowed)
    assert predicted.demand_bytes["dram"] == pytest.approx(report.dram.bytes, rel=0.15)
