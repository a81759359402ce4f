"""`cachesim prefilter`: what the mip chain does to misses, per scene, count, plane and scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.options import DeviceName, Folder, ImageSize, Overrides, parse_names


def command(
    scenes: Annotated[
        str, typer.Option("--scenes", metavar="LIST", help="Scenes or files.")
    ] = "close,ear,front",
    gpu: Annotated[
        str, typer.Option("--gpu", metavar="NAME|FILE.toml", help="What to count on.")
    ] = "titan-x-pascal",
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    size: ImageSize = "960x540",
    counts: Annotated[
        str, typer.Option("--counts", metavar="LIST", help="Samples per pixel.")
    ] = "8,16,64",
    device: DeviceName = None,
    output: Folder = Path("out"),
) -> None:
    """Compare mip 0 with Eq 5.12: miss rates per scene, sample count, planes and scale."""
    from cachesim.first_use import compile_loops
    from experiments.console import progress, remark
    from experiments.options import parse_image_size
    from experiments.output import output_folder
    from experiments.tables import print_table, write_table
    from traces.errors import InputError

    width, height = parse_image_size(size)
    names = parse_names(scenes, "--scenes")
    numbers = []
    for text in parse_names(counts, "--counts"):
        if not text.isdecimal() or not 1 <= int(text) <= 2048:
            raise InputError(f"--counts {counts!r}: {text!r}: allowed are whole numbers, 1 to 2048")
        numbers.append(int(text))
    import pandas as pd

    from cachesim import presets
    from experiments import prefilter_effect as study
    from kernels.opencl.device import open_device
    from kernels.scene import load_scene

    machine = presets.load(gpu, overrides)
    folder = output_folder(output)
    opened = open_device(device)
    gbuffers = [load_scene(name, width, height, device=opened) for name in names]
    seconds = study.estimate_s(gbuffers, numbers)
    remark(f"{size} on {opened.name}: about {seconds:,.0f} s on two cores")
    frames = []
    num_cases = len(list(study.cases(numbers)))
    with progress("compiling the simulator", len(names) * num_cases) as bar:
        compile_loops()

        def step(text: str) -> None:
            bar.advance()
            bar.describe(text)

        for gbuffer in gbuffers:
            name = gbuffer.name
            frames.append(
                study.measure(name, gbuffer, machine, counts=numbers, device=opened, step=step)
            )
    table = study.effect_table(pd.concat(frames, ignore_index=True), machine.name, size)
    print_table(table)
    paths = write_table(table, folder / "prefilter")
    remark(f"wrote {', '.join(str(path) for path in paths)}")
