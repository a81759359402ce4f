"""Work by name in several processes at once, with its progress and its failures."""

from __future__ import annotations

import multiprocessing
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from traces.errors import InputError, WorkError

#: Progress: what is being done, and the share that is done, 0 to 1.
Tell = Callable[[str, float], None]
#: Does what a name stands for and returns a line on it. Processes import it by its own name.
Work = Callable[[str, Tell], str]

#: Seconds between two messages of progress, and for an interrupted process to leave.
_TELL_EVERY_S, _LEAVE_WITHIN_S = 0.5, 10.0
STARTED, PROGRESS, DONE, FAILED = "started", "progress", "done", "failed"


@dataclass(frozen=True)
class Event:
    """What became of a name. kind: one of STARTED, PROGRESS, DONE, FAILED. text: what is being
    done, the work's line, or why it failed. share: done so far.
    """

    name: str
    kind: str
    text: str = ""
    share: float = 0.0


def run_in_processes(names: Sequence[str], num_jobs: int, work: Work) -> Iterator[Event]:
    """Do the work of every name, in order of the names as processes are free.

    What fails, or dies with its process, does not keep the others from running. Where the caller
    stops or is interrupted, so are the processes, and they clean up behind themselves.
    """
    waiting, idle = list(names), list[_Worker]()
    busy: dict[Connection, _Worker] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < num_jobs:
                worker = idle.pop() if idle else _Worker(work)
                busy[worker.connection] = worker
                worker.give(waiting.pop(0))
                yield Event(worker.name, STARTED)
            # One at a time: the caller may stop at any event.
            connection = wait(list(busy))[0]
            assert isinstance(connection, Connection)
            worker = busy[connection]
            try:
                kind, text, share = connection.recv()
            except (EOFError, OSError):
                del busy[connection]
                kind, text, share = FAILED, f"its process died: {worker.leave()}", 1.0
            if kind in (DONE, FAILED) and busy.pop(connection, None) is not None:
                idle.append(worker)
            yield Event(worker.name, kind, text, share)
    finally:
        for worker in busy.values():
            worker.process.terminate()
        for worker in (*idle, *busy.values()):
            worker.leave()


class _Worker:
    """A process that does what it is given, one name after the other."""

    def __init__(self, work: Work) -> None:
        self.name = ""
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs, work))
        # Started with Ctrl-C blocked, it never sees one: the parent says when it is over. The
        # resource tracker unblocks it when it starts, which is why that comes first.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()

    def give(self, name: str) -> None:
        self.name = name
        # A process that died is found out when it is listened to.
        with suppress(OSError):
            self.connection.send(name)

    def leave(self) -> str:
        """Wait until the process has left; in words, how it did."""
        self.connection.close()
        self.process.join(_LEAVE_WITHIN_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        code = self.process.exitcode or 0
        return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


def _serve(connection: Connection, work: Work) -> None:
    """The life of a process: names come in, progress and results go out."""
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        while True:
            name = connection.recv()
            connection.send(_result(name, work, _teller(connection)))
    except (EOFError, OSError, KeyboardInterrupt):
        return  # The parent has left, or told us to.


def _result(name: str, work: Work, tell: Tell) -> tuple[str, str, float]:
    try:
        return DONE, work(name, tell), 1.0
    except (InputError, WorkError) as error:
        return FAILED, " ".join(str(error).split()), 1.0
    except Exception as error:
        # A mistake of ours: say where.
        traceback.print_exc(file=sys.stderr)
        return FAILED, " ".join(f"{type(error).__name__}: {error}".split()), 1.0


def _teller(connection: Connection) -> Tell:
    """Sends progress, but not more often than a person can read."""
    latest = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal latest
        now = time.monotonic()
        if now - latest >= _TELL_EVERY_S:
            latest = now
            with suppress(OSError):
                connection.send((PROGRESS, text, share))

    return tell


def _interrupt(signum: int, frame: Any) -> None:
    raise KeyboardInterrupt
