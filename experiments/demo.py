"""`cachesim demo`: fixed against adaptive per scene and GPU, in tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from experiments.options import AlbedoMap, DeviceName, Folder, NormalMap, parse_names

if TYPE_CHECKING:
    from cachesim.config import Gpu
    from experiments.adaptive_vs_fixed import SceneResult
    from kernels.gbuffer import GBuffer

SCENES = "close,ear,front"
GPUS = "titan-x-pascal,rtx-2080-ti,rx-5700-xt"
SIZE, FULL_SIZE = "960x540", "1920x1080"
#: Measured on two cores: seconds of a first run whatever its size, and per million scattering
#: pixels for rendering, for counting on each GPU, and for timing on each GPU.
FIRST_S, RENDER_S, COUNT_S, TIME_S = 15.0, 15.0, 15.0, 60.0
#: Which of --gpus are timed.
TIMED = ("none", "first", "all")
TIMING_HELP = "Which of the GPUs to time as well: none, first or all."
MESH_HELP = "A mesh instead of the procedural head; --scenes then names cameras."


def command(
    full: Annotated[bool, typer.Option("--full", help=f"The study at {FULL_SIZE}.")] = False,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help=f"Frame size; {SIZE} unless given.")
    ] = None,
    scenes: Annotated[str, typer.Option("--scenes", metavar="LIST", help="Scenes.")] = SCENES,
    gpus: Annotated[
        str, typer.Option("--gpus", metavar="LIST", help="Presets or TOML files.")
    ] = GPUS,
    mesh: Annotated[Path | None, typer.Option("--mesh", metavar="FILE", help=MESH_HELP)] = None,
    albedo_map: AlbedoMap = None,
    normal_map: NormalMap = None,
    frames: Annotated[
        int, typer.Option("--frames", metavar="N", min=2, help="Frames of the adaptive run.")
    ] = 8,
    timing: Annotated[str, typer.Option("--timing", metavar="WHICH", help=TIMING_HELP)] = "none",
    device: DeviceName = None,
    output: Folder = Path("out"),
) -> None:
    """Compare fixed with adaptive sampling: demand, miss rates and cycles, tables, pictures."""
    from experiments.console import StageClock, progress, remark
    from experiments.options import parse_image_size, scene_arguments
    from experiments.output import input_file, output_folder
    from traces.errors import InputError, unknown

    clock = StageClock()
    if full and size is not None:
        raise InputError(f"--size {size}: --full has a size of its own, {FULL_SIZE}")
    width, height = parse_image_size(size or (FULL_SIZE if full else SIZE))
    scene_names = parse_names(scenes, "--scenes")
    if timing not in TIMED:
        raise unknown("choice", timing, TIMED, "--timing")
    if mesh is not None:
        input_file(mesh)
    maps = scene_arguments(str(mesh or scene_names[0]), None, albedo_map, normal_map)
    from concurrent.futures import ThreadPoolExecutor

    from cachesim import presets
    from cachesim.first_use import compile_loops

    machines = [presets.load(name) for name in parse_names(gpus, "--gpus")]
    timed = machines_to_time(machines, timing)
    with clock.stage("loading the libraries"):
        from experiments import adaptive_vs_fixed as study
        from kernels.opencl.device import open_device
        from kernels.scene import load_scene

    def of_mesh(name: str) -> dict[str, Any]:
        return {} if mesh is None else maps | {"camera": name}

    folder = output_folder(output)
    opened = open_device(device)
    # The simulator compiles on its first use, while the OpenCL device draws the scenes.
    with ThreadPoolExecutor(1) as pool:
        compiling = pool.submit(compile_loops, timing=bool(timed))
        with progress("rendering the scenes"), clock.stage("scenes"):
            gbuffers = {
                name: load_scene(str(mesh or name), width, height, device=opened, **of_mesh(name))
                for name in scene_names
            }
        with progress("compiling the simulator"), clock.stage("compiling, beside the scenes"):
            compiling.result()
    seconds = estimate_s(list(gbuffers.values()), len(machines), len(timed))
    remark(f"{width}x{height} on {opened.name}: about {seconds:,.0f} s on two cores")
    results: list[SceneResult] = []
    with progress("starting", (7 if timed else 5) * len(scene_names)) as bar:

        def step(text: str) -> None:
            bar.describe(text)
            bar.advance()

        for name, gbuffer in gbuffers.items():
            results.append(
                study.compare(
                    name,
                    gbuffer,
                    machines,
                    num_frames=frames,
                    timed=timed,
                    device=opened,
                    clock=clock,
                    step=step,
                )
            )
    with clock.stage("tables and pictures"):
        write_results(results, machines, frames, f"{width}x{height}", folder)
    for line in clock.lines():
        remark(line)


def machines_to_time(machines: Sequence[Gpu], which: str) -> list[Gpu]:
    """Those of the GPUs that are timed, without those that the timing model cannot run.

    which: one of `TIMED`.
    """
    from experiments.console import remark
    from experiments.timing_tables import timing_refusal

    chosen = list(machines[: {"none": 0, "first": 1, "all": len(machines)}[which]])
    refusals = {machine.name: timing_refusal(machine) for machine in chosen}
    for told in filter(None, refusals.values()):
        remark(f"no cycles: {told}")
    return [machine for machine in chosen if refusals[machine.name] is None]


def estimate_s(gbuffers: Sequence[GBuffer], num_gpus: int, num_timed: int = 0) -> float:
    """Seconds on two cores, first compilation included."""
    megapixels = sum(float(g.subsurface.sum()) for g in gbuffers) / 1e6
    return FIRST_S + megapixels * (RENDER_S + num_gpus * COUNT_S + num_timed * TIME_S)


def write_results(
    results: list[SceneResult], machines: list[Gpu], num_frames: int, size: str, folder: Path
) -> None:
    """Print the tables; write them, the pictures, the sample-count maps and the plots."""
    from experiments import adaptive_tables as tables
    from experiments import adaptive_vs_fixed as study
    from experiments import plots
    from experiments.console import console, remark
    from experiments.output import write_figure, write_text
    from experiments.tables import csv, print_table, write_table
    from kernels.picture import preview, save_png, tone_map

    demand = study.demand_frame(results)
    ratios = study.ratio_frame(demand)
    mips = study.mip_frame(results)
    quality = study.quality_frame(results)
    title = f"Fixed 64 against adaptive at {size}"
    shown = {
        "quality": (tables.quality_table(quality, f"Scenes at {size}", num_frames), quality),
        "demand": (tables.demand_table(demand, ratios, title, size), demand),
        "mips": (tables.mip_table(mips, f"By mip at {size}"), mips),
    }
    for name, (table, data) in shown.items():
        print_table(table)
        write_table(table, folder / name, data)
    write_text(folder / "ratios.csv", csv(ratios))
    for result in results:
        attribution = result.gbuffer.attribution
        save_png(folder / f"{result.label}-unscattered.png", preview(result.gbuffer))
        for method, frame in result.frames.items():
            save_png(folder / f"{result.label}-{method}.png", tone_map(frame.combined))
        adaptive = result.frames["adaptive"]
        save_png(folder / f"{result.label}-adaptive-blended.png", tone_map(adaptive.accumulated))
        title = f"{result.label}, adaptive, frame {adaptive.index}"
        figure = plots.count_map(adaptive.counts, title, attribution)
        write_figure(folder / f"{result.label}-adaptive-counts.png", figure)
    whole = demand[demand["passes"] == "all"]
    megabytes = whole.assign(
        **{name.replace("bytes", "mb"): whole[name] / 1e6 for name in tables.DEMAND_NAMES}
    )
    demand_labels = {
        "l1_mb": "L1 demand (MB)",
        "l2_mb": "L2 demand (MB)",
        "dram_mb": "DRAM traffic (MB)",
    }
    rate_labels = {"l1_miss_rate": "L1 miss rate", "l2_miss_rate": "L2 miss rate"}
    figures = {
        "demand": plots.comparison_figure(megabytes, demand_labels),
        "miss-rates": plots.comparison_figure(whole, rate_labels),
        "mips": plots.mip_figure(
            tables.bar_frames(mips, machines[0].name), f"L1 demand on {machines[0].name} (MB)"
        ),
    }
    for name, figure in figures.items():
        write_figure(folder / f"{name}.png", figure)
        write_figure(folder / f"{name}.pdf", figure)
    if owed := tables.scene_lines([r.gbuffer.attribution for r in results]):
        write_text(folder / "attribution.txt", "\n".join(owed) + "\n")
        console().print("\n".join(owed), markup=False)
    remark(f"wrote tables, pictures and plots to {folder}")
