"""A made-up frame for the tests of the cost function, and a model with chosen coefficients."""

from __future__ import annotations

import numpy as np

from cachesim import presets
from cachesim.cost.machine import Machine
from cachesim.cost.model import (
    Coefficient,
    CostModel,
    coefficient_names,
)
from cachesim.cost.workload import (
    LaunchWork,
    Optics,
    Read,
    Scatter,
    Sweep,
    Workload,
)
from kernels.maths.profile import SKIN
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
