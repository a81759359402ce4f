"""`cachesim import-config`: a GPGPU-Sim or Accel-Sim configuration as a preset file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    configs: Annotated[
        list[Path],
        typer.Argument(metavar="CONFIG…", help="Option files; later settings win."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.toml", help="The preset to write.")
    ],
    trace_config: Annotated[
        Path | None,
        typer.Option("--trace-config", metavar="FILE", help="Accel-Sim's trace.config, read last."),
    ] = None,
) -> None:
    """Turn gpgpusim.config into a preset that `--gpu FILE.toml` takes.

    A BookSim file is read where it stands beside the config that names it. Comment lines at the
    top of a preset that is there already are kept.
    """
    from cachesim.gpgpusim import group_remarks, import_config, leading_comments
    from experiments.console import remark
    from experiments.output import input_file, output_file, write_text

    files = [input_file(file) for file in (*configs, *([trace_config] if trace_config else []))]
    output_file(output, ".toml")
    imported = import_config(files, output.stem)
    old = output.read_text(encoding="utf-8", errors="replace") if output.is_file() else ""
    write_text(output, imported.to_toml(leading_comments(old)))
    for reason, settings in group_remarks(imported.ignored).items():
        remark(f"ignored ({reason}): {', '.join(settings)}")
    for reason, settings in group_remarks(imported.differing).items():
        remark(f"not modelled: {', '.join(settings)}; here {reason}")
    print(f"wrote {output}: {len(imported.fields)} fields; use it with --gpu {output}")
