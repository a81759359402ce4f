"""`cachesim export`: a trace in the files of another simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.options import TracePath

FORMATS = ("accel-sim",)
MODE_HELP = "Footprints: a load per texel, or a load of a warp's distinct 32 B sectors."
VERSION_HELP = "Which opcodes Accel-Sim reads: 35, 60, 61, 70, 75, 80 or 86."


def command(
    trace: TracePath,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="A new or empty folder.")
    ],
    to: Annotated[str, typer.Option("--to", metavar="accel-sim", help="The files' format.")],
    mode: Annotated[
        str, typer.Option("--mode", metavar="per-texel|packed-sectors", help=MODE_HELP)
    ] = "per-texel",
    binary_version: Annotated[
        int, typer.Option("--binary-version", metavar="NUMBER", help=VERSION_HELP)
    ] = 75,
    layout: Annotated[
        str, typer.Option("--layout", metavar="NAME", help="Texel layout (see `cachesim layouts`).")
    ] = "block-linear-turing",
) -> None:
    """Write a trace as Accel-Sim's kernelslist.g and kernel-N.traceg."""
    from experiments.console import progress, remark
    from traces.accel_sim.writer import Settings, estimate_size, write_accel_sim
    from traces.errors import unknown
    from traces.files import check_new_folder
    from traces.open import open_trace

    if to not in FORMATS:
        raise unknown("format", to, FORMATS, "--to")
    check_new_folder(output)
    settings = Settings(mode, binary_version, layout)
    opened = open_trace(trace)
    with progress(f"measuring {trace.name}") as bar:
        size = estimate_size(opened, settings, progress=bar.update)
    remark(
        f"{trace}: {size.num_kernels:,} kernels, {size.num_rows:,} accesses, "
        f"{size.num_lane_fetches:,} lane fetches: about {size.num_bytes / 1e6:,.1f} MB"
    )
    with progress(f"exporting {trace.name}", size.num_lane_fetches) as bar:
        write_accel_sim(opened, output, settings, progress=bar.update)
    written = sum(path.stat().st_size for path in output.iterdir())
    remark(f"wrote {output}: {written / 1e6:,.1f} MB, {settings.mode}")
