"""`cachesim sweep`: count one trace over a grid of configurations, on all cores, and plot it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.options import FetchPathName, GpuName, LayoutName, Overrides, TracePath

AXIS_HELP = "A field and its values: l1.capacity=16KiB,32KiB. Several axes make a grid."


def command(
    trace: TracePath,
    gpu: GpuName,
    axis: Annotated[list[str], typer.Option("--axis", metavar="FIELD=V1,V2,…", help=AXIS_HELP)],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FILE.csv", help="The CSV; a PNG is put beside it."),
    ] = Path("sweep.csv"),
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    fetch_path: FetchPathName = None,
    layout: LayoutName = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes; all cores unless given.")
    ] = None,
) -> None:
    """Count a trace over a grid of configurations: `--axis l1.capacity=16KiB,32KiB,64KiB`."""
    import math

    from experiments.console import progress, remark
    from experiments.options import check_fetch_path
    from experiments.output import output_file, write_figure, write_text
    from experiments.plots import sweep_figure

    output_file(output, ".csv")
    check_fetch_path(fetch_path)
    from cachesim import presets, sweep
    from cachesim.first_use import compile_loops
    from traces.errors import InputError
    from traces.open import open_trace

    machine = presets.load(gpu, overrides)
    axes: dict[str, list[object]] = {}
    for text in axis:
        field, values = presets.parse_axis(text)
        if field in axes:
            raise InputError(f"--axis {text!r}: {field} has an axis already")
        axes[field] = values
    num_points = math.prod(len(values) for values in axes.values())
    done: list[dict[str, object]] = []
    with progress("compiling the simulator", num_points) as bar:
        # Once here, and not in every process.
        compile_loops(lane_address=open_trace(trace).is_lane_address)
        bar.describe(f"counting {num_points} configurations")
        try:
            frame = sweep(
                trace,
                machine,
                axes,
                fetch_path=fetch_path,
                layout=layout,
                num_workers=workers,
                progress=bar.update,
                on_row=done.append,
            )
        except KeyboardInterrupt:
            keep_finished(done, output)
            raise
    picture = output.with_suffix(".png")
    figure = sweep_figure(frame, list(axes), f"{trace.name} on {machine.name}")
    write_figure(picture, figure)
    write_text(output, frame.to_csv(index=False))
    remark(f"{num_points} configurations: wrote {output} and {picture}")


def keep_finished(rows: list[dict[str, object]], output: Path) -> None:
    """Write the rows of an interrupted sweep beside `output`, as NAME.partial.csv."""
    import pandas as pd

    from experiments.console import remark
    from experiments.output import write_text

    if rows:
        partial = output.with_suffix(".partial.csv")
        write_text(partial, pd.DataFrame(rows).to_csv(index=False))
        remark(f"kept the {len(rows)} finished configurations in {partial}")
