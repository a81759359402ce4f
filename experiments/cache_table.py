"""`cachesim cache-table`: the dissertation's chapter 4, fixed against adaptive in cycles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.method_options import Scale
from experiments.options import DeviceName, Folder, ImageSize, Overrides, SceneName


def command(
    scene: SceneName = "side",
    gpu: Annotated[
        str, typer.Option("--gpu", metavar="NAME|FILE.toml", help="What to time on.")
    ] = "titan-x-pascal-gpgpusim",
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    size: ImageSize = "480x270",
    scale: Scale = "legacy",
    frames: Annotated[
        int, typer.Option("--frames", metavar="N", min=2, help="Frames of the adaptive run.")
    ] = 32,
    device: DeviceName = None,
    output: Folder = Path("out"),
) -> None:
    """Cycles, L1 and L2 demand and miss rates of fixed and adaptive sampling, once per fetch path,
    in total and per mip.
    """
    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments import cache_table_plots as plots
    from experiments import cache_table_study as study
    from experiments.console import progress, remark
    from experiments.options import parse_image_size
    from experiments.output import output_folder, write_figure, write_text
    from experiments.tables import print_table, write_table
    from kernels.method import Method
    from kernels.opencl.device import open_device
    from kernels.scene import load_scene

    width, height = parse_image_size(size)
    machine = presets.load(gpu, overrides)
    shared = Method(scale=scale)
    folder = output_folder(output)
    opened = open_device(device)
    with progress("rendering the scene", study.NUM_RUNS) as bar:
        gbuffer = load_scene(scene, width, height, device=opened)
        bar.describe("compiling the simulator")
        compile_loops(timing=True)

        def step(text: str) -> None:
            bar.describe(text)
            bar.advance()

        runs = study.measure(gbuffer, machine, shared, num_frames=frames, device=opened, step=step)
    title = f"{gbuffer.name}, {width}x{height}, {machine.name}"
    totals, mips = study.totals_frame(runs), study.mips_frame(runs)
    shown = {
        "cache-table": (study.totals_table(totals, machine, title), totals),
        "cache-table-mips": (study.mips_table(mips, title), mips),
    }
    for name, (table, data) in shown.items():
        print_table(table)
        write_table(table, folder / name, data)
    for path in study.FETCH_PATHS:
        figure = plots.path_figure(totals, path, f"{title}, fetch path {path}")
        for suffix in (".png", ".pdf"):
            write_figure(folder / f"cache-table-{path}{suffix}", figure)
    if gbuffer.attribution:
        write_text(folder / "attribution.txt", gbuffer.attribution + "\n")
    remark(f"wrote the tables and the bar charts to {folder}")
