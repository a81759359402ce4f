"""The experiments of whole frames: diagrams, demand maps, judgements, and one run on a device."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cachesim import presets
from cachesim.units import format_size
from experiments.reproduce import (
    block_diagram,
    cache_table,
    demand_maps,
    gpu_generations,
    p4000_times,
    taxonomy,
)
from experiments.reproduce.experiment import Settings
from traces.texture import INACTIVE_TEXEL, Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, from_chunks


def drawn_text(figure):
    return "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)


@pytest.mark.parametrize("name", presets.names())
def test_a_diagram_shows_the_levels_that_the_preset_has(name):
    gpu = presets.load(name)
    text = drawn_text(block_diagram.block_diagram(gpu, name))
    assert f"{gpu.l2.num_slices} slices" in text and format_size(gpu.l2.capacity) in text
    assert format_size(gpu.l1.capacity) in text
    assert (gpu.gl1 is not None) == ("GL1" in text)
    assert (gpu.llc is not None) == ("Infinity Cache" in text)
    assert (gpu.l1_texture is not None) == ("texture L1" in text)
    last = f"SM {gpu.sm.count - 1}" if gpu.gl1 is None else f"to {gpu.sm.count - 1}:"
    assert last in text


def test_a_diagram_follows_an_override():
    gpu = presets.load("rtx-2080-ti", ["l1.capacity=128KiB"])
    assert "128 KiB" in drawn_text(block_diagram.block_diagram(gpu, "changed"))


@pytest.mark.parametrize(
    ("name", "gb_per_s"), (("titan-x-pascal", 480), ("rx-5700-xt", 448), ("rx-6900-xt", 512))
)
def test_the_memorys_peak_is_the_vendors(name, gb_per_s):
    assert block_diagram.memory_gb_per_s(presets.load(name)) == pytest.approx(gb_per_s)


def made_trace():
    """Two warps of an 8x8 frame: the first samples (one lane twice, at mips 1 and 2), the second
    is filtered; pixels of a row of four lanes, the rest inactive.
    """
    textures = [Texture("setup", "RGBA16F", 8, 8, 3), Texture("scattered", "RGBA16F", 8, 8)]
    textures.append(Texture("normal", "RGBA8", 8, 8))
    instructions = [
        Instruction("sampling", 0),
        Instruction("sampling", 2),
        Instruction("sampling", 1, "store"),
        Instruction("separable_h", 0),
        Instruction("separable_h", 1, "store"),
    ]

    def row(mips, y):
        lanes = np.full(32, INACTIVE_TEXEL, np.uint32)
        for lane, mip in mips.items():
            lanes[lane] = pack_texel(mip, y, lane)
        return lanes

    own = {0: 0, 1: 0, 2: 0}
    first = [row(own, 1), row({0: 1, 1: 1}, 0), row({0: 2}, 0), row({0: 0}, 3), row(own, 1)]
    second = [row(own, 4), row({0: 0, 1: 0}, 5), row(own, 4)]
    chunks = [
        Chunk(0, 0, np.array([0, 5]), np.array([0, 0, 0, 1, 2], np.uint16), np.array(first)),
        Chunk(1, 0, np.array([0, 3]), np.array([3, 3, 4], np.uint16), np.array(second)),
    ]
    launches = [Launch(0, "sampling", 1, 1), Launch(0, "separable_h", 1, 1)]
    return from_chunks(chunks, textures, instructions, launches, {"width": 8, "height": 8})


def test_a_demand_map_gives_each_fetch_to_the_pixel_whose_lane_made_it():
    maps = demand_maps.map_demand(made_trace())
    # A pixel that reads its own texel alone does not scatter; normals are no light.
    assert maps.light_fetches[1].tolist() == [3, 2, 0, 0, 0, 0, 0, 0]
    assert maps.light_fetches[4].tolist() == [2, 2, 0, 0, 0, 0, 0, 0]
    assert maps.light_fetches.sum() == 9
    assert maps.technique[1, :3].tolist() == [demand_maps.AFIS, demand_maps.AFIS, demand_maps.NONE]
    assert maps.technique[4, 0] == demand_maps.SEPARABLE
    assert maps.mean_level[1, :2] == pytest.approx([1.0, 0.5])
    assert np.isnan(maps.mean_level[1, 2]) and np.isnan(maps.mean_level[0]).all()
    figure = demand_maps.demand_figure({"made": maps, "again": maps}, "made")
    assert figure.axes[0].get_title() == "technique"


def ratios_of(cycles, l1):
    return pd.DataFrame(
        [
            {"fetch_path": p, "mips": "Eq 5.12", "passes": "sampling", "cycles": cycles,
             "l1_accesses": l1, "l2_accesses": 0.3}
            for p in ("texture", "global")
        ]
    )  # fmt: skip


def test_the_direction_of_the_cycles_is_no_claim_of_a_small_frame():
    found = cache_table.directions(ratios_of(0.9, 0.2), small=False)
    assert [c.agrees for c in found] == [True, True, True]
    found = cache_table.directions(ratios_of(1.1, 0.2), small=True)
    assert [c.agrees for c in found] == [None, True, True]
    found = cache_table.directions(ratios_of(1.1, 1.2), small=False)
    assert [c.agrees for c in found] == [False, False, True]


def test_the_printed_pair_is_never_claimed():
    totals = pd.DataFrame(
        [
            {"fetch_path": "texture", "mips": "mip 0 only", "passes": "sampling", "method": m,
             "cycles": n, "l2_misses": 0}
            for m, n in (("fixed", 200), ("adaptive", 121))
        ]
    )  # fmt: skip
    mips = pd.DataFrame(
        [
            {"fetch_path": "texture", "part": "mip 0", "method": m, "l1_accesses": 4,
             "l2_accesses": 4, "l1_misses": 2, "l2_misses": 1}
            for m in ("fixed", "adaptive")
        ]
    )  # fmt: skip
    found = cache_table.pair_candidates(totals, mips)
    assert all(c.agrees is None and c.paper == "0.605" for c in found)
    assert found[0].ours == "0.605 to 0.605" and found[1].ours == "-"


def test_times_of_a_smaller_frame_are_no_claim():
    cell = {
        "scene": "close", "scale": "legacy", "planes": "all", "method": "fixed", "time_ms": 11.5,
        "passes": [{"pass": "sampling", "time_ms": 30.0}],
    }  # fmt: skip
    sampling, total = p4000_times.compare_times([cell], same_size=True)
    assert sampling.agrees is False and "2.80 of the published" in sampling.verdict
    assert total.agrees is True
    assert all(c.agrees is None for c in p4000_times.compare_times([cell], same_size=False))


def test_the_generations_verdict_counts_where_it_holds():
    ratios = pd.DataFrame(
        {"passes": ["sampling", "sampling", "all"], "l1_bytes": [0.2, 1.1, 9.0],
         "l2_bytes": [0.5, 0.4, 9.0], "dram_bytes": [0.9, 0.9, 9.0], "l1_miss_rate": [1.0] * 3,
         "l2_miss_rate": [2.0] * 3, "cycles": [np.nan] * 3}
    )  # fmt: skip
    judged = gpu_generations.judge(ratios, ratios, "640x360")
    found = {c.quantity.split(",")[0]: c for c in judged}
    assert found["L1 demand"].verdict == "lower in 1 of 2 views and GPUs"
    assert found["L1 demand"].ours == "0.200 to 1.100"
    assert not any("cycles" in name for name in found)
    timed = ratios.assign(cycles=[0.4, 0.6, 9.0])
    (cycles,) = (
        c for c in gpu_generations.judge(ratios, timed, "640x360") if "cycles" in c.quantity
    )
    assert "640x360" in cycles.quantity and cycles.ours == "0.400 to 0.600"


@pytest.mark.opencl
def test_the_taxonomy_lowers_samples_and_levels_rise(tmp_path):
    from kernels.opencl.device import open_device
    from kernels.scene import load_scene

    device = open_device()
    gbuffer = load_scene("front", 64, 36, device=device)
    methods = taxonomy.list_methods()
    plain = taxonomy.measure_maps(gbuffer, methods[taxonomy.HOMOGENEOUS], 1, device)
    hybrid = taxonomy.measure_maps(gbuffer, methods[taxonomy.HETEROGENEOUS], 4, device)
    scatters = gbuffer.subsurface
    # 64 samples and the pixel's own texel, all at mip 0.
    assert (plain.light_fetches[scatters] <= 65).all()
    assert np.nanmax(plain.mean_level) == 0
    assert ((plain.technique == demand_maps.AFIS) == scatters).all()
    assert (hybrid.technique[~scatters] == demand_maps.NONE).all()
    assert hybrid.light_fetches.sum() < plain.light_fetches.sum()


@pytest.mark.opencl
@pytest.mark.parametrize("module", (taxonomy, cache_table, p4000_times, gpu_generations))
def test_a_run_that_goes_on_finds_its_cells_finished(module, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "QUICK_SIZE", (32, 18))
    if hasattr(module, "QUICK_FRAMES"):
        monkeypatch.setattr(module, "QUICK_FRAMES", 3)
    if module is gpu_generations:
        monkeypatch.setattr(module, "GPUS", {"rx-6900-xt": "Navi 21"})
        monkeypatch.setattr(module, "QUICK_TIMED_SIZE", (16, 16))
    settings = Settings(True, tmp_path)
    first = module.EXPERIMENT.run(settings)

    def refuse(*arguments, **named):
        pytest.fail("measured again")

    import cachesim
    from experiments import cache_table_study, p4000_study

    for owner in (cachesim, cache_table_study, p4000_study):
        monkeypatch.setattr(owner, "simulate", refuse)
    again = module.EXPERIMENT.run(settings)
    assert again.comparisons == first.comparisons and set(again.figures) == set(first.figures)
    assert first.tables and first.words
