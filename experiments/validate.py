"""`cachesim validate`: the timing model beside other measurements and simulators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
