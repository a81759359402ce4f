"""Every experiment by name, in the order of the dissertation, and what the sources do not allow."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from experiments.reproduce.experiment import Experiment
from traces.errors import unknown

#: Each is a module of this folder, with underscores, that offers `EXPERIMENT`.
NAMES = (
    "taxonomy",
    "cost-function",
    "gpu-generations",
    "adaptive-o1",
    "global-accumulation",
    "disocclusion",
    "direct-distant",
    "cache-table",
    "p4000-times",
    "afis-vs-separable",
    "ground-truth",
    "sampling-function",
    "sampling-sequence",
    "cv-toy",
    "light-flash",
    "regular-lighting",
    "jittering",
    "quality-traffic",
    "gallery",
)

NOT_ALLOWED = (
    Experiment(
        name="single-draws",
        title="The standard control variate's single results 0.6841, 0.7061 and 0.6946",
        chapter="6",
        figure="slide: standard CV",
        reason="single draws of 16 samples whose seed is not known; cv-toy shows that the three "
        "belong together and how far such draws spread",
    ),
    Experiment(
        name="dlss",
        title="DLSS 2.0 as the global accumulation",
        chapter="4",
        figure="Fig. 2 (local guiding with DLSS)",
        reason="DLSS 2.0 is a closed binary with trained weights for NVIDIA's tensor cores; "
        "global-accumulation has the TAA, local guiding and Separable of the same figure",
    ),
    Experiment(
        name="mip0-pair",
        title="The printed pair Mip0: 91,541 vs 151,356",
        chapter="4",
        figure="slide: cycle-level analysis",
        reason="the slides give neither the quantity, its unit, the frame size nor which of the "
        "two is adaptive; cache-table shows the direction of every candidate",
    ),
)


def all_experiments() -> tuple[Experiment, ...]:
    """Every entry: the ones that run, then the ones that the sources do not allow."""
    return (*(_load(name) for name in NAMES), *NOT_ALLOWED)


def select(names: Sequence[str]) -> tuple[Experiment, ...]:
    """The experiments of these names, each once, in the catalogue's order; "all" is every one that
    runs.

    Raises:
        InputError: a name that the catalogue does not have.
    """
    entries = {e.name: e for e in all_experiments()}
    for name in names:
        if name != "all" and name not in entries:
            raise unknown("experiment", name, (*entries, "all", "list"))
    if "all" in names:
        names = [*names, *NAMES]
    return tuple(e for e in entries.values() if e.name in names)


def _load(name: str) -> Experiment:
    module = import_module(f"experiments.reproduce.{name.replace('-', '_')}")
    experiment = module.EXPERIMENT
    assert isinstance(experiment, Experiment) and experiment.name == name
    return experiment
