"""`cachesim silicon`: prepare pictures, measure this machine's GPU, put measurements together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.options import DeviceName

app = typer.Typer(
    name="silicon",
    help="Measure a real NVIDIA GPU; `validate silicon` shows the model beside it.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
Inputs = Annotated[
    Path | None,
    typer.Option("--inputs", metavar="DIR", help="Pictures of `silicon prepare`; made if absent."),
]
Pictures = Annotated[
    list[str],
    typer.Option("--picture", metavar="NAME", help="Only this picture: front_480x270, …"),
]


@app.command("measure")
def measure(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.csv")],
    inputs: Inputs = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="TASK", help="A task, or how some begin.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=10, max=36000, help="Begin nothing after these.")
    ] = 540.0,
    device: DeviceName = None,
) -> None:
    """Micro-measurements and the workload on this machine's NVIDIA GPU, as one tidy CSV.

    Leaves the card's settings as they are. Without ncu, or where its counters are blocked, times
    alone; without nvcc, from the committed PTX.
    """
    import tempfile

    from experiments.console import remark
    from experiments.output import output_file
    from experiments.silicon.measure import choose_tasks, pictures_of
    from experiments.silicon.measure import measure as run
    from experiments.silicon.tools import find_tools
    from traces.errors import WorkError

    path = output_file(output, ".csv")
    tools = find_tools()
    for line in tools.lines():
        remark(line)
    if not tools.gpu:
        raise WorkError("no NVIDIA GPU to measure")
    needed = pictures_of(choose_tasks(only or ()))
    with tempfile.TemporaryDirectory() as scratch:
        folder = inputs or Path(scratch)
        if inputs is None and needed:
            _prepare(folder, needed, device, effort=0)
        done = run(path, tools, str(folder.resolve()), only or (), seconds, remark)
    remark(f"{path}: {len(done.rows)} numbers, {len(done.failures)} failures")


@app.command("prepare")
def prepare(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to fill.")],
    picture: Pictures = [],  # noqa: B006
    device: DeviceName = None,
) -> None:
    """Render what `measure` needs, for a machine that has the GPU and no OpenCL."""
    from experiments.output import output_folder

    _prepare(output_folder(output), picture, device)


@app.command("merge")
def merge(
    files: Annotated[list[Path], typer.Argument(metavar="FILE.csv…")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.csv")],
) -> None:
    """Put several runs on one GPU together; of the same number the first counts."""
    from experiments.output import input_file, output_file
    from experiments.silicon.measure import merge as join
    from experiments.silicon.rows import read_measurements, write_measurements

    path = output_file(output, ".csv")
    parts = [read_measurements(input_file(file, ".csv")) for file in files]
    write_measurements(path, join(parts, [str(file) for file in files]))


def _prepare(folder: Path, names: list[str], device_name: str | None, effort: int = 6) -> None:
    from experiments.console import progress, remark
    from experiments.silicon.cases import PICTURES
    from experiments.silicon.inputs import write_picture
    from experiments.silicon.prepare import prepare as render
    from kernels.opencl.device import open_device
    from traces.errors import unknown

    known = {
        f"{scene}_{width}x{height}": (scene, width, height) for scene, width, height in PICTURES
    }
    for name in names:
        if name not in known:
            raise unknown("picture", name, known, "--picture")
    device = open_device(device_name)
    chosen = [known[name] for name in names] or list(PICTURES)
    with progress("rendering", len(chosen)) as bar:
        for number, (scene, width, height) in enumerate(chosen):
            bar.describe(f"rendering {scene} {width}x{height}")

            def show(share: float, number: int = number) -> None:
                bar.update(number + share)

            path = write_picture(folder, render(scene, width, height, device, show), effort)
            remark(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
