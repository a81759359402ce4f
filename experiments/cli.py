"""The `cachesim` command: one module per command, and one place for errors and exit codes.

Exit codes: 0 done, 2 bad input, 1 failed while working, 130 interrupted. Modules of commands
import what they use inside the function, so that `--help` is quick and commands on saved traces
never load OpenCL.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Sequence

import typer

from experiments import (
    bench,
    bound,
    cache_table,
    check,
    cost,
    demo,
    doctor,
    export,
    import_config,
    info,
    layouts,
    microbench,
    p4000_times,
    prefilter,
    presets,
    record,
    render,
    reproduce,
    run,
    sensitivity,
    sweep,
    validate,
)
from experiments.silicon import command as silicon
from traces.errors import InputError, WorkError

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

app = typer.Typer(
    name="cachesim",
    help="GPU caches under screen-space subsurface scattering: render, record, count, compare.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for module in (
    demo,
    cache_table,
    p4000_times,
    reproduce,
    prefilter,
    record,
    run,
    sweep,
    sensitivity,
    microbench,
    bound,
    cost,
    presets,
    layouts,
    info,
    check,
    render,
    bench,
    export,
    import_config,
    doctor,
):
    app.command(module.__name__.rpartition(".")[2].replace("_", "-"))(module.command)
app.add_typer(validate.app)
app.add_typer(silicon.app)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code."""
    sys.exit(run_command(arguments))


def run_command(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code; what went wrong is one line on stderr."""
    try:
        code = app(args=arguments, prog_name="cachesim", standalone_mode=False)
    except InputError as error:
        return _fail(BAD_INPUT, str(error))
    except typer.TyperException as error:
        return _fail(BAD_INPUT, describe_usage_error(error, arguments or sys.argv[1:]))
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except WorkError as error:
        return _fail(FAILED, str(error))
    except MemoryError:
        return _fail(FAILED, "out of memory")
    except OSError as error:
        return _fail(FAILED, describe_os_error(error))
    # Typer hands an interrupt inside a command on as an exit code.
    return _fail(INTERRUPTED, "interrupted") if code == INTERRUPTED else int(code or DONE)


def describe_usage_error(error: typer.TyperException, arguments: Sequence[str]) -> str:
    """Typer's message, with the value that it leaves out where an option's is refused."""
    message = error.format_message()
    param = error.param if isinstance(error, typer.BadParameter) else None
    for name in param.opts if param is not None else ():
        for argument, following in zip(arguments, [*arguments[1:], ""], strict=True):
            option, _, value = argument.partition("=")
            if option == name and argument.startswith("-"):
                return f"{name} {value or following!r}: {message}"
    return message


def describe_os_error(error: OSError) -> str:
    """One line: the file where one is known, and what the system says of it."""
    what = "no space left on the disk" if error.errno == errno.ENOSPC else error.strerror
    return f"{error.filename}: {what}" if error.filename else str(what or error)


def _fail(code: int, message: str) -> int:
    print(f"cachesim: error: {' '.join(message.split())}", file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    main()
