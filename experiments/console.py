"""What commands print: results on stdout, progress, remarks and times on stderr."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

#: Columns of a table where the output is no terminal.
PLAIN_WIDTH = 100


def console(stderr: bool = False) -> Console:
    """A console as wide as the terminal, or `PLAIN_WIDTH` columns in a file or pipe."""
    from rich.console import Console

    # `:m:` in a cache's string is no emoji.
    made = Console(stderr=stderr, highlight=False, emoji=False)
    if not made.is_terminal:
        made.width = PLAIN_WIDTH
    return made


def remark(text: str) -> None:
    """One remark to the person, on stderr."""
    console(stderr=True).print(text, markup=False)


class Progress:
    """A progress bar on stderr that shows itself once its work has taken two seconds.

    Nothing is shown where stderr is no terminal.
    """

    SHOW_AFTER_S = 2.0

    def __init__(self, text: str, total: float | None) -> None:
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        out = console(stderr=True)
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            console=out,
            transient=True,
            disable=not out.is_terminal,
        )
        self._task = self._bar.add_task(text, total=total)
        # A timer, since some work takes seconds before it first reports.
        self._timer = threading.Timer(self.SHOW_AFTER_S, self._bar.start)
        self._timer.daemon = True
        self._timer.start()

    def describe(self, text: str) -> None:
        """Say what is being done now."""
        self._bar.update(self._task, description=text)

    def advance(self, amount: float = 1) -> None:
        self._bar.advance(self._task, amount)

    def update(self, done: float) -> None:
        """Say how much of the total is done by now."""
        self._bar.update(self._task, completed=done)

    def remark(self, text: str) -> None:
        """One remark to the person, above the bar."""
        self._bar.console.print(text, markup=False)

    def close(self) -> None:
        self._timer.cancel()
        self._timer.join()
        self._bar.stop()


@contextmanager
def progress(text: str, total: float | None = None) -> Iterator[Progress]:
    """A `Progress` that is taken away at the end of the block, whatever ends it.

    text: what is being done. total: of what `update` is told; None where it is not known.
    """
    bar = Progress(text, total)
    try:
        yield bar
    finally:
        bar.close()


class StageClock:
    """Seconds of wall-clock time per named stage, in order of first use."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.monotonic()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        try:
            yield
        finally:
            self.add(name, time.monotonic() - start)

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds

    @property
    def total_s(self) -> float:
        """Seconds since the clock was made."""
        return time.monotonic() - self._start

    def lines(self) -> Iterator[str]:
        """One line per stage, then what the stages leave unnamed, then the total."""
        rest = self.total_s - sum(self.seconds.values())
        for name, seconds in [*self.seconds.items(), ("everything else", rest)]:
            yield f"{name:<44}{seconds:7.1f} s"
        yield f"{'total':<44}{self.total_s:7.1f} s"
