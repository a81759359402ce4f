"""Tables for people and papers: a DataFrame printed, and written as CSV, Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from experiments.console import PLAIN_WIDTH, console
from experiments.output import write_text

if TYPE_CHECKING:
    import pandas as pd

MISSING = "-"
_LATEX = str.maketrans(
    {
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "\\": r"\textbackslash{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
    }
)


@dataclass(frozen=True)
class Column:
    """How a column of a frame is shown.

    name: of the frame's column. heading: what people read. format: a format specification for
    numbers, such as ",.1f"; an integer needs none. numeric: whether it stands to the right; None
    asks the column's type. wraps: whether long text may take several lines on the console.
    """

    name: str
    heading: str
    format: str = ""
    numeric: bool | None = None
    wraps: bool = False


@dataclass(frozen=True, eq=False)
class Table:
    """A frame with what a reader needs beside it.

    columns: which columns are shown, in this order; the CSV has all of the frame's. notes:
    sentences under the table.
    """

    title: str
    frame: pd.DataFrame
    columns: tuple[Column, ...]
    notes: tuple[str, ...] = ()


def plain_table(title: str, frame: pd.DataFrame, notes: Sequence[str] = ()) -> Table:
    """A table that shows every column under its own name."""
    return Table(title, frame, tuple(Column(str(n), str(n)) for n in frame.columns), tuple(notes))


def show_value(value: Any, specification: str = "") -> str:
    """One cell: "-" for None and NaN, "1,234" for integers, `specification` for other numbers."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    if isinstance(value, str | bool):
        return str(value)
    if specification:
        return format(value, specification)
    if isinstance(value, float) and not value.is_integer():
        return f"{value:.4g}"
    return f"{int(value):,}"


def three_digits(value: float) -> str:
    """A number to three digits and at most two decimals: "1,234", "17.3", "0.95"."""
    return (
        f"{value:,.0f}" if value >= 99.95 else f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"
    )


def cells(table: Table) -> list[list[str]]:
    """The shown cells, row by row."""
    shown = [[show_value(_scalar(v), c.format) for v in table.frame[c.name]] for c in table.columns]
    return [list(row) for row in zip(*shown, strict=True)]


def _scalar(value: Any) -> Any:
    """A number of Python's own; None for the missing whole number of pandas, which is no float."""
    from pandas import NA

    if value is NA:
        return None
    return value.item() if hasattr(value, "item") else value


def _is_number(table: Table, column: Column) -> bool:
    from pandas.api.types import is_numeric_dtype

    if column.numeric is not None:
        return column.numeric
    return bool(is_numeric_dtype(table.frame[column.name]))


def print_table(table: Table) -> None:
    """Print to stdout: words left, numbers right, repeated leading words blank, notes under it."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as RichTable

    out = console()
    shown = cells(table)
    # A terminal folds a line that is too long for it; rich would cut numbers short.
    out.width = max(out.width, PLAIN_WIDTH, _narrowest(table, shown))
    made = RichTable(
        title=table.title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        padding=(0, 1),
        collapse_padding=True,
        pad_edge=False,
    )
    for column, heading in zip(table.columns, _headings(table, shown, out.width), strict=True):
        made.add_column(
            heading,
            justify="right" if _is_number(table, column) else "left",
            no_wrap=not column.wraps,
            # A long word of wrapping text goes on in the next line; it is not cut.
            overflow="fold" if column.wraps else "ellipsis",
        )
    num_words = next(
        (i for i, c in enumerate(table.columns) if _is_number(table, c)), len(table.columns)
    )
    previous: list[str] = []
    for row in shown:
        made.add_row(*_blank_repeats(row, previous, num_words - 1))
        previous = row
    out.print(made)
    for note in table.notes:
        out.print(note, markup=False)
    if table.notes:
        out.print()


def _widths(table: Table, shown: list[list[str]]) -> list[int]:
    """The least width of each column: its longest cell or word of its heading."""
    return [
        max([len(row[i]) for row in shown] + [len(word) for word in column.heading.split()])
        for i, column in enumerate(table.columns)
    ]


def _narrowest(table: Table, shown: list[list[str]]) -> int:
    """The least width of the table without the columns that wrap."""
    pairs = zip(table.columns, _widths(table, shown), strict=True)
    return sum(width + 2 for column, width in pairs if not column.wraps)


def _headings(table: Table, shown: list[list[str]], width: int) -> list[str]:
    """The headings, in several lines where the table would be wider than the console.

    Only headings and long text may take several lines; a number in two lines would be two numbers.
    """
    words = [c.heading for c in table.columns]
    least = _widths(table, shown)
    full = sum(max(n, len(w)) + 2 for n, w in zip(least, words, strict=True))
    if full <= width or any(c.wraps for c in table.columns):
        return words
    return [
        "\n".join(wrap(w, n, break_on_hyphens=False)) for n, w in zip(least, words, strict=True)
    ]


def _blank_repeats(row: list[str], previous: list[str], num_columns: int) -> list[str]:
    """`row` with those of its first `num_columns` cells emptied that repeat `previous`."""
    shown = list(row)
    for i in range(num_columns):
        if not previous or row[i] != previous[i]:
            break
        shown[i] = ""
    return shown


def markdown(table: Table) -> str:
    """The table in GitHub's Markdown, its notes as paragraphs."""
    rows = [[c.replace("|", r"\|") for c in row] for row in cells(table)]
    heads = [c.heading.replace("|", r"\|") for c in table.columns]
    widths = [max(len(h), 3, *(len(r[i]) for r in rows)) for i, h in enumerate(heads)]
    numeric = [_is_number(table, c) for c in table.columns]

    def line(values: Sequence[str]) -> str:
        padded = (
            v.rjust(w) if n else v.ljust(w) for v, w, n in zip(values, widths, numeric, strict=True)
        )
        return f"| {' | '.join(padded)} |"

    rule = [("-" * (w - 1) + ":") if n else "-" * w for w, n in zip(widths, numeric, strict=True)]
    parts = [f"**{table.title}**", "", line(heads), line(rule), *map(line, rows), ""]
    for note in table.notes:
        parts += [note, ""]
    return "\n".join(parts)


def latex(table: Table) -> str:
    """A `table` environment that needs no package, with the notes under the tabular."""
    numeric = "".join("r" if _is_number(table, c) else "l" for c in table.columns)
    heads = " & ".join(c.heading.translate(_LATEX) for c in table.columns)
    body = [" & ".join(c.translate(_LATEX) for c in row) + r" \\" for row in cells(table)]
    lines = [
        r"\begin{table}",
        rf"\caption{{{table.title.translate(_LATEX)}}}",
        rf"\begin{{tabular}}{{{numeric}}}",
        r"\hline",
        rf"{heads} \\",
        r"\hline",
        *body,
        r"\hline",
        r"\end{tabular}",
        *(rf"\par\footnotesize {note.translate(_LATEX)}" for note in table.notes),
        r"\end{table}",
        "",
    ]
    return "\n".join(lines)


def csv(frame: pd.DataFrame) -> str:
    """The whole frame, full precision, empty cells where a value is missing."""
    text: str = frame.to_csv(index=False)
    return text


def write_table(table: Table, stem: Path, data: pd.DataFrame | None = None) -> list[Path]:
    """Write `stem`.csv, .md and .tex; returns their paths.

    data: what the CSV holds where it is not the shown frame.
    """
    texts = {
        ".csv": csv(table.frame if data is None else data),
        ".md": markdown(table),
        ".tex": latex(table),
    }
    paths = [stem.with_name(stem.name + suffix) for suffix in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_text(path, text)
    return paths
