"""`cachesim layouts`: which texels share a sector and a line, as a table and as pictures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer


def command(
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Write the table and pictures there."),
    ] = None,
) -> None:
    """Print which texels share a sector and a line in each texel layout; with -o also draw it."""
    from experiments.console import progress, remark
    from experiments.output import output_folder, write_figure
    from experiments.tables import Column, Table, print_table, write_table

    folder = output_folder(output) if output is not None else None
    from traces.layout import LAYOUTS
    from traces.layout_picture import draw_layout, layout_table
    from traces.texture import FORMATS

    frame = layout_table()
    columns = [Column("layout", "layout"), Column("format", "format")]
    for name in frame.columns[2:]:
        size = re.search(r"\d+", name)
        columns.append(Column(name, f"in {size[0]} B" if size else "texel bytes"))
    table = Table(
        "Texels that share 32 B (a sector) to 256 B (width x height)",
        frame,
        tuple(columns),
        ('"32 of 16x4": not a full rectangle; the commonest piece is 32 texels out of 16x4.',),
    )
    print_table(table)
    if folder is None:
        return
    paths = write_table(table, folder / "layouts")
    # One format for each texel size: the order of texels depends on nothing else.
    formats = list({size: name for name, size in reversed(FORMATS.items())}.values())
    with progress("drawing layouts", len(LAYOUTS) * len(formats)) as bar:
        for layout in LAYOUTS:
            for texel_format in formats:
                path = folder / f"layout-{layout}-{texel_format}.png"
                write_figure(path, draw_layout(layout, texel_format))
                paths.append(path)
                bar.advance()
    remark(f"wrote {len(paths)} files to {folder}")
