"""`cachesim doctor`: which OpenCL devices were tried, why each failed, and what to install."""

from __future__ import annotations

from typing import Annotated

import typer

INSTALL_HELP = "Install a CPU device into this environment where none works (225 MB to download)."


def command(
    install: Annotated[bool, typer.Option("--install", help=INSTALL_HELP)] = False,
) -> None:
    """Explain OpenCL on this machine; exits with 1 where no device works."""
    from experiments.console import console, remark
    from kernels.opencl.doctor import diagnose, install_fallback, print_diagnosis

    diagnosis = install_fallback(remark) if install else diagnose()
    print_diagnosis(diagnosis, console())
    if diagnosis.chosen is None:
        raise typer.Exit(1)
