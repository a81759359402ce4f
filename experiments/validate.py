"""`cachesim validate`: the timing model beside other measurements and simulators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import DeviceName

if TYPE_CHECKING:
    from experiments.console import Progress

app = typer.Typer(
    name="validate",
    help="Hold the timing model to numbers from elsewhere.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.command("accel-sim")
def accel_sim(
    config: Annotated[
        list[str] | None, typer.Option("--config", metavar="NAME", help="Only this machine.")
    ] = None,
    trace: Annotated[
        list[str] | None, typer.Option("--trace", metavar="NAME", help="Only this trace.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Also the tables and the plot."),
    ] = None,
) -> None:
    """Cycles and counters beside what Accel-Sim printed: errors, correlation, bounds."""
    from experiments.accel_sim_oracle import CONFIGS, choose, read_results
    from experiments.console import progress
    from experiments.output import output_folder, write_figure
    from experiments.tables import print_table, write_table
    from traces.oracle_traces import ORACLE_TRACES

    configs = choose(config, CONFIGS, "config")
    traces = choose(trace, ORACLE_TRACES, "oracle trace")
    results = read_results()
    folder = output_folder(output) if output is not None else None
    from experiments import validate_accel_sim as study

    with progress("compiling the simulator", len(configs) * len(traces)) as bar:

        def step(text: str) -> None:
            bar.describe(text)
            bar.advance()

        frame = study.compare(results, configs, traces, step)
    cycles, counters = study.cycles_table(frame), study.counters_table(frame)
    summary = study.summary_table(study.summarise(frame))
    for table in (cycles, counters, summary):
        print_table(table)
    for line in study.verdicts(frame):
        print(line)
    if folder is not None:
        from experiments.validate_plots import correlation_figure

        write_table(cycles, folder / "accel-sim", data=frame)
        write_table(counters, folder / "accel-sim-counters")
        write_table(summary, folder / "accel-sim-summary")
        figure = correlation_figure(frame)
        for suffix in (".png", ".pdf"):
            write_figure(folder / f"accel-sim{suffix}", figure)


@app.command("silicon")
def silicon(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Of `silicon measure`, or `ncu --csv --page raw`."),
    ] = None,
    gpu: Annotated[
        str | None,
        typer.Option("--gpu", metavar="NAME|FILE.toml", help="The measured GPU's unless given."),
    ] = None,
    picture: Annotated[
        list[str] | None,
        typer.Option("--picture", metavar="NAME", help="Only this picture: front_480x270, …"),
    ] = None,
    cycles: Annotated[
        bool, typer.Option("--cycles/--no-cycles", help="Run the model with its clock too.")
    ] = True,
    device: DeviceName = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Also the tables and the plot."),
    ] = None,
) -> None:
    """The model beside a measured GPU: per launch and level, means, correlation."""
    from experiments.console import progress, remark
    from experiments.output import input_file, output_folder, write_figure
    from experiments.silicon import compare
    from experiments.silicon import validate as study
    from experiments.tables import print_table, write_table

    paths = [input_file(file)] if file is not None else compare.committed_files()
    if not paths:
        print(compare.NOT_MEASURED)
        return
    folder = output_folder(output) if output is not None else None
    for path in paths:
        chosen = study.choose_cases(compare.read_measured(path), picture or ())
        minutes = study.expect_minutes(chosen, cycles)
        remark(f"{path.name}: {len(chosen)} launches, up to about {minutes:.0f} minutes")
        with progress("compiling the simulator", len(chosen)) as bar:

            def step(text: str, bar: Progress = bar) -> None:
                bar.describe(text)
                bar.advance()

            found = study.run_comparison(path, gpu, picture or (), cycles, device, step)
        launches = compare.launches_table(found.frame, found.measured.notes)
        summary = compare.summary_table(found.summary)
        print_table(launches)
        print_table(summary)
        if folder is not None:
            from experiments.silicon.compare_plots import correlation_figure

            stem = f"silicon-{path.stem}"
            write_table(launches, folder / stem, data=found.frame)
            write_table(summary, folder / f"{stem}-summary", data=found.summary)
            figure = correlation_figure(found.frame, found.measured.device)
            for suffix in (".png", ".pdf"):
                write_figure(folder / f"{stem}{suffix}", figure)
