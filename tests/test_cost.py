"""The cost function against closed forms, brute force, the simulator, and made coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cost_samples import GPU, OPTICS, WEIGHTS, made_model, made_workload
from hypothesis import given
from hypothesis import strategies as st

from cachesim import presets
from cachesim.cost.fit import Observation, fit
from cachesim.cost.frame import Step, Swept
from cachesim.cost.machine import LevelOfCost, Machine
from cachesim.cost.measure import measure_workload
from cachesim.cost.model import (
    COEFFICIENTS,
    SYMBOLS,
    CostModel,
    Prepared,
    coefficient_names,
    predict,
    predict_prepared,
)
from cachesim.cost.terms import frame_terms, sample_costs
from cachesim.cost.window import miss_probability, pass_level
from traces.errors import InputError
from traces.synthetic import stream


def test_every_symbol_has_a_unit_and_every_coefficient_a_meaning():
    assert all(len(row) == 4 and all(row) for row in SYMBOLS)
    for name in presets.names():
        for coefficient in coefficient_names(Machine.of(presets.load(name))):
            what = coefficient.partition(".")[2]
            assert COEFFICIENTS.get(coefficient) or COEFFICIENTS[f"{{level}}.{what}"]


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
