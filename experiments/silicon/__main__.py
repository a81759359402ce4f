"""`python -m experiments.silicon`: measuring with no package but NumPy, on a machine that has the
GPU and nothing else of ours; and the processes that do the measuring.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from traces.errors import InputError, WorkError


def main() -> int:
    """Exit codes as of the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.silicon")
    commands = parser.add_subparsers(dest="command", required=True)
    measure = commands.add_parser("measure", help="measure this machine's NVIDIA GPU")
    measure.add_argument("-o", "--output", type=Path, required=True)
    measure.add_argument("--inputs", default="", help="folder of `cachesim silicon prepare`")
    measure.add_argument("--only", action="append", default=[], help="a task, or how some begin")
    measure.add_argument("--seconds", type=float, default=540.0, help="begin nothing after these")
    child = commands.add_parser("child", help="one task: for `measure`")
    child.add_argument("task")
    child.add_argument("--rows", type=Path, required=True)
    child.add_argument("--failures", type=Path, required=True)
    child.add_argument("--ptx", default="")
    child.add_argument("--inputs", default="")
    arguments = parser.parse_args()
    try:
        if arguments.command == "child":
            return _run_child(arguments)
        return _measure(arguments)
    except InputError as error:
        return _fail(2, error)
    except (WorkError, OSError) as error:
        return _fail(1, error)
    except KeyboardInterrupt:
        return _fail(130, "interrupted")


def _fail(code: int, what: object) -> int:
    print(f"cachesim: error: {' '.join(str(what).split())}", file=sys.stderr, flush=True)
    return code


def _measure(arguments: argparse.Namespace) -> int:
    from experiments.silicon.measure import measure
    from experiments.silicon.tools import find_tools

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    tools = find_tools()
    for line in tools.lines():
        say(line)
    run = measure(arguments.output, tools, arguments.inputs, arguments.only, arguments.seconds, say)
    say(f"{arguments.output}: {len(run.rows)} numbers, {len(run.failures)} failures")
    return 0


def _run_child(arguments: argparse.Namespace) -> int:
    from experiments.silicon.rows import RowWriter
    from experiments.silicon.session import Session
    from experiments.silicon.tasks import list_tasks

    with (
        arguments.rows.open("a", encoding="utf-8") as rows,
        arguments.failures.open("a", encoding="utf-8") as failures,
    ):
        session = Session(RowWriter(rows), failures, arguments.ptx, arguments.inputs)
        for task in list_tasks():
            if task.name == arguments.task:
                with session.attempt(task.name):
                    if not task.profiled:
                        session.warm_up()
                    task.measure(session, task.words)
                return 0
    raise InputError(f"task {arguments.task!r}: no such task")


if __name__ == "__main__":
    sys.exit(main())
