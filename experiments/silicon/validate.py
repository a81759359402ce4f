"""The whole comparison: read what was measured, run the model on the same launches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from experiments.silicon import compare
from experiments.silicon.cases import Case
from experiments.silicon.compare import Measured, Values
from traces.errors import InputError, unknown

if TYPE_CHECKING:
    from cachesim.config import Gpu

#: Seconds per million samples of one lane that the model takes, with a clock and without: for the
#: remark about how long it will take.
_SECONDS_PER_MEGASAMPLE = {True: 1.6, False: 0.25}


@dataclass(frozen=True)
class Comparison:
    """What `validate silicon` shows. frame, summary: as `compare.compare` and `summarise`."""

    gpu: str
    measured: Measured
    frame: pd.DataFrame
    summary: pd.DataFrame


def choose_cases(measured: Measured, pictures: Sequence[str]) -> list[Case]:
    """The measured launches of some pictures, as "front_480x270"; all where none are named.

    Raises:
        InputError: a picture that was not measured.
    """
    names = list(dict.fromkeys(f"{case.scene}_{case.size}" for case in measured.cases))
    for picture in pictures:
        if picture not in names:
            raise unknown("picture", picture, names, "--picture")
    return [c for c in measured.cases if not pictures or f"{c.scene}_{c.size}" in pictures]


def run_comparison(
    path: Path,
    gpu: str | None,
    pictures: Sequence[str],
    with_cycles: bool,
    device_name: str | None,
    step: Callable[[str], None],
) -> Comparison:
    """Read, model and compare.

    gpu: a preset or a file; None takes the measured device's. step: told what is run next.

    Raises:
        InputError: a damaged file, an unknown picture or GPU. DeviceError: no OpenCL device.
    """
    from cachesim import presets
    from kernels.opencl.device import open_device

    measured = compare.read_measured(path)
    chosen = choose_cases(measured, pictures)
    name = gpu or compare.preset_of(measured.device)
    machine = presets.load(name)
    modelled = model_cases(chosen, machine, with_cycles, open_device(device_name), step)
    wanted = {case: measured.cases[case] for case in chosen}
    frame = compare.compare(wanted, modelled, lambda q: with_cycles or q.name != "cycles")
    if frame.empty:
        raise InputError(f"{path}: nothing to compare: no counters of the chosen launches")
    return Comparison(machine.name, measured, frame, compare.summarise(frame))


def model_cases(
    cases: Sequence[Case],
    gpu: Gpu,
    with_cycles: bool,
    device: object,
    step: Callable[[str], None],
) -> dict[Case, Values]:
    """What the model says of some launches."""
    from experiments.silicon.model import Group, simulate_group

    modelled: dict[Case, Values] = {}
    for group in dict.fromkeys(Group.of(case) for case in cases):
        wanted = [case for case in cases if Group.of(case) == group]
        reports = simulate_group(
            group,
            gpu,
            timing=with_cycles,
            device=device,  # type: ignore[arg-type]
            wanted=wanted,
            step=step,
        )
        modelled |= {case: compare.modelled_of(report) for case, report in reports.items()}
    return modelled


def expect_minutes(cases: Sequence[Case], with_cycles: bool) -> float:
    """About how long the model will take: by samples, were every pixel to scatter."""
    samples = sum(
        case.width * case.height * (16 if case.counts == "adaptive" else 64)
        for case in cases
        if case.pass_name == "sampling"
    )
    return samples / 1e6 * _SECONDS_PER_MEGASAMPLE[with_cycles] / 60
