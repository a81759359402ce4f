"""`cachesim reproduce`: the dissertation's results, each with the paper's number beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import DeviceName

if TYPE_CHECKING:
    from collections.abc import Callable

    from experiments.reproduce.experiment import Experiment
    from experiments.reproduce.jobs import Tell

OUT = Path("out") / "reproduce"


def command(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME ...|all|list]", help="Which experiments; list names them."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small sizes: seconds to a minute each.")
    ] = False,
    jobs: Annotated[
        int, typer.Option("--jobs", metavar="N", min=1, help="Experiments that run at once.")
    ] = 1,
    device: DeviceName = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="DIR", help=f"{OUT}, or {OUT / 'quick'} with --quick."
        ),
    ] = None,
) -> None:
    """Compute the dissertation's figures and numbers: a CSV, a picture and a page each, and an
    index with verdicts. Finished parts are kept in the folder: a run that was stopped goes on
    there.
    """
    from experiments.reproduce import catalogue
    from traces.errors import InputError

    chosen = catalogue.select([n for n in names or () if n != "list"])
    if not names or "list" in names:
        if chosen or quick or output is not None:
            raise InputError("list: stands alone; name experiments to run them")
        print_list(catalogue.all_experiments())
        return
    run_experiments(chosen, quick, output or (OUT / "quick" if quick else OUT), device, jobs)


def print_list(experiments: tuple[Experiment, ...]) -> None:
    """Every experiment with its place and its minutes, and why some are not computed."""
    import pandas as pd

    from experiments.tables import Column, Table, print_table

    rows = [
        (e.name, e.chapter, e.figure, e.minutes, e.quick_minutes, e.title)
        for e in experiments
        if e.run is not None
    ]
    columns = (
        Column("name", "name"),
        Column("chapter", "ch."),
        Column("figure", "figure", wraps=True),
        Column("minutes", "min", ",.4g"),
        Column("quick_minutes", "quick", ".2g"),
        Column("title", "shows", wraps=True),
    )
    notes = [
        "min, quick: expected minutes on four cores, in full and with --quick.",
        *(f"{e.name} (not computed): {e.reason}." for e in experiments if e.run is None),
    ]
    frame = pd.DataFrame(rows, columns=[c.name for c in columns])
    print_table(Table("Experiments of `cachesim reproduce`", frame, columns, tuple(notes)))


def run_experiments(
    experiments: tuple[Experiment, ...], quick: bool, out: Path, device: str | None, jobs: int = 1
) -> None:
    """Run each, write its page and the index; what fails does not keep the others from running.

    jobs: how many run at once, each in a process of its own, those that take longest first.

    Raises:
        WorkError: some of them failed; the index says which and why.
    """
    from experiments.console import remark
    from experiments.output import output_folder
    from experiments.reproduce import catalogue, pages
    from traces.errors import WorkError

    folder = output_folder(out)
    failures: dict[str, str] = {}
    running = [e for e in experiments if e.run is not None]
    for entry in experiments:
        if entry.run is None:
            remark(f"{entry.name}: not computed: {entry.reason}")
    minutes = sum(e.expected_minutes(quick) for e in running)
    at_once = f", {jobs} at once" if jobs > 1 else ""
    remark(f"{_count(len(running))}, {_minutes(minutes)} in all{at_once}, into {folder}")
    together = [e for e in running if jobs > 1 and not e.after_others]
    together.sort(key=lambda e: -e.expected_minutes(quick))
    started = 0

    def begin(entry: Experiment) -> str:
        nonlocal started
        started += 1
        expected = _minutes(entry.expected_minutes(quick))
        return f"[{started}/{len(running)}] {entry.name}: {entry.title}; {expected}"

    def end(entry: Experiment, failure: str = "") -> None:
        if failure:
            failures[entry.name] = failure
        # After each, so that an interrupted run leaves an index over what is finished.
        pages.write_index(folder, catalogue.all_experiments(), failures)

    _run_together(together, quick, folder, device, jobs, begin, end)
    for entry in running:
        if entry not in together:
            remark(begin(entry))
            end(entry, _run_alone(entry, quick, folder, device))
    index = pages.write_index(folder, catalogue.all_experiments(), failures)
    remark(f"wrote {index}")
    if failures:
        told = "; ".join(f"{name}: {why}" for name, why in failures.items())
        raise WorkError(f"{len(failures)} of {len(running)} experiments failed: {told}")


def _run_together(
    entries: list[Experiment],
    quick: bool,
    folder: Path,
    device: str | None,
    jobs: int,
    begin: Callable[[Experiment], str],
    end: Callable[[Experiment, str], None],
) -> None:
    """Run experiments in processes, with one bar over all of them."""
    from functools import partial

    from experiments.console import progress
    from experiments.reproduce.jobs import DONE, FAILED, STARTED, run_in_processes

    if not entries:
        return
    by_name = {e.name: e for e in entries}
    minutes = {e.name: e.expected_minutes(quick) for e in entries}
    shares: dict[str, float] = {}
    going: dict[str, str] = {}
    work = partial(run_named, quick=quick, folder=folder, device=device)
    with progress("starting", sum(minutes.values())) as bar:
        for event in run_in_processes(list(by_name), jobs, work):
            entry = by_name[event.name]
            shares[event.name] = event.share
            going[event.name] = f"{event.name} {event.share:.0%}"
            if event.kind == STARTED:
                bar.remark(begin(entry))
            elif event.kind in (DONE, FAILED):
                failed = event.kind == FAILED
                bar.remark(f"{entry.name}: failed: {event.text}" if failed else event.text)
                del going[event.name]
                end(entry, event.text if failed else "")
            bar.describe(", ".join(going.values()))
            bar.update(sum(minutes[name] * share for name, share in shares.items()))


def run_named(name: str, tell: Tell, *, quick: bool, folder: Path, device: str | None) -> str:
    """Run the experiment of a name and write its page; returns a line on what it found."""
    from experiments.reproduce import catalogue

    return _run_one(catalogue.select([name])[0], quick, folder, device, tell)


def _run_alone(entry: Experiment, quick: bool, folder: Path, device: str | None) -> str:
    """Run an experiment in this process, with a bar of its own; returns why it failed, or ""."""
    from experiments.console import progress, remark
    from traces.errors import InputError, WorkError

    try:
        with progress(entry.name, 1.0) as bar:

            def tell(text: str, share: float) -> None:
                bar.describe(f"{entry.name}: {text}")
                bar.update(share)

            line = _run_one(entry, quick, folder, device, tell)
    except (InputError, WorkError) as error:
        failure = " ".join(str(error).split())
        remark(f"{entry.name}: failed: {failure}")
        return failure
    remark(line)
    return ""


def _run_one(entry: Experiment, quick: bool, folder: Path, device: str | None, tell: Tell) -> str:
    """Run an experiment and write its page; returns a line on what it found."""
    from time import monotonic

    from experiments.reproduce import pages
    from experiments.reproduce.experiment import Settings

    assert entry.run is not None
    start = monotonic()
    outcome = entry.run(Settings(quick, folder, tell, device))
    took = monotonic() - start
    page = pages.write_outcome(folder, entry, outcome, quick=quick, seconds=took)
    return f"{entry.name}: {outcome.summary()} ({page}, {took:,.0f} s)"


def _count(number: int) -> str:
    return "1 experiment" if number == 1 else f"{number} experiments"


def _minutes(minutes: float) -> str:
    if minutes < 1.5:
        return f"about {max(1, round(60 * minutes))} s"
    return f"about {minutes:,.0f} min" if minutes < 90 else f"about {minutes / 60:,.1f} h"
