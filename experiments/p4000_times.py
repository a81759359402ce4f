"""`cachesim p4000-times`: the times of the dissertation's chapter 5 beside the model's."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import DeviceName, Folder, Overrides, parse_names

if TYPE_CHECKING:
    from experiments.p4000_cases import Case
    from experiments.p4000_study import Cell, Counts

QUICK_SIZE = "480x270"
ONLY_HELP = (
    "Only these: scenes close, ear, front; methods fixed, adaptive, baseline, forced-8, forced-16, "
    "forced-32; scales legacy, physical; planes all, irradiance."
)


def command(
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="WxH", help="Frame size; 1920x1080 unless given."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help=f"At {QUICK_SIZE}: minutes.")] = False,
    only: Annotated[str | None, typer.Option("--only", metavar="LIST", help=ONLY_HELP)] = None,
    gpu: Annotated[
        str, typer.Option("--gpu", metavar="NAME|FILE.toml", help="What to time on.")
    ] = "quadro-p4000",
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    device: DeviceName = None,
    output: Folder = Path("out"),
) -> None:
    """Time close, ear and front per pass, fixed, adaptive and unaccelerated, beside the paper's
    milliseconds. Finished cases are kept in the folder: a run that was stopped goes on there.
    """
    from experiments.console import progress, remark
    from experiments.options import parse_image_size
    from experiments.output import output_folder
    from traces.errors import InputError

    if quick and size is not None:
        raise InputError(f"--size {size}: --quick has a size of its own, {QUICK_SIZE}")
    from experiments import p4000_cases

    width, height = parse_image_size(size or (QUICK_SIZE if quick else p4000_cases.PUBLISHED_SIZE))
    chosen = select(
        only,
        (
            p4000_cases.SCENES,
            tuple(p4000_cases.METHODS),
            p4000_cases.SCALES,
            tuple(p4000_cases.PLANE_SETS),
        ),
    )
    scenes = chosen[0]
    from cachesim import presets
    from cachesim.first_use import compile_loops

    machine = presets.load(gpu, overrides)
    from experiments import p4000_study as study
    from kernels.opencl.device import open_device
    from kernels.scene import load_scene

    folder = output_folder(output)
    kept = output_folder(folder / f"p4000-{width}x{height}")
    opened = open_device(device)
    with progress("rendering the scenes", 1.0) as bar:
        gbuffers = {name: load_scene(name, width, height, device=opened) for name in scenes}
        bar.describe("compiling the simulator")
        compile_loops(timing=True)
        bar.describe(f"timing on {machine.name}")

        def show_counts(case: Case, counts: Counts) -> None:
            write_counts(case, counts, folder)

        cells = study.run_cases(
            p4000_cases.list_cases(*chosen),
            gbuffers,
            machine,
            kept,
            device=opened,
            told=remark,
            progress=bar.update,
            show_counts=show_counts,
        )
    write_results(cells, machine.name, f"{width}x{height}", folder)


def select(only: str | None, kinds: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], ...]:
    """Of each kind the names that a list names; all of a kind of which it names none.

    Raises:
        InputError: a name of no kind.
    """
    from traces.errors import unknown

    names = parse_names(only, "--only") if only is not None else []
    known = tuple(name for kind in kinds for name in kind)
    for name in names:
        if name not in known:
            raise unknown("scene, method, scale or plane set", name, known, "--only")
    return tuple(tuple(n for n in kind if n in names) or kind for kind in kinds)


def write_counts(case: Case, counts: Counts, folder: Path) -> None:
    """The picture of an adaptive case's sample counts."""
    from experiments.output import write_figure
    from experiments.plots import count_map

    name = f"p4000-counts-{case.scene}-{case.scale}.png"
    title = f"{case.scene}, {case.scale} scale, frame {case.num_frames - 1}"
    write_figure(folder / name, count_map(counts, title))


def write_results(cells: list[Cell], gpu: str, size: str, folder: Path) -> None:
    """Print the tables and the explanations; write them and the figures."""
    from experiments import p4000_plots as plots
    from experiments import p4000_tables as tables
    from experiments import p4000_words as words
    from experiments.console import console, remark
    from experiments.output import write_figure, write_text
    from experiments.tables import print_table, write_table

    scale, planes = cells[0]["scale"], cells[0]["planes"]
    passes = tables.passes_frame(cells)
    ratios, counts = tables.ratios_frame(cells), tables.counts_frame(cells)
    shown = {
        "times": (tables.times_table(cells, gpu, size), passes),
        "traffic": (tables.traffic_table(cells, scale, planes), passes),
        "ratios": (tables.ratios_table(ratios), ratios),
        "counts": (tables.counts_table(counts), counts),
    }
    for name, (table, data) in shown.items():
        print_table(table)
        write_table(table, folder / f"p4000-{name}", data)
    sentences = [
        *tables.size_note(size),
        *words.explain(cells, scale, planes),
        *words.judge(counts),
        *words.UNKNOWN,
    ]
    for line in sentences:
        console().print(line, markup=False)
    write_text(folder / "p4000-explained.md", "\n\n".join(sentences) + "\n")
    for name, figure in (
        ("counts", plots.counts_figure(cells, gpu)),
        ("passes", plots.passes_figure(cells, scale, planes, gpu)),
    ):
        if figure is not None:
            write_figure(folder / f"p4000-{name}.png", figure)
            write_figure(folder / f"p4000-{name}.pdf", figure)
    remark(f"wrote tables, explanations and figures to {folder}")
