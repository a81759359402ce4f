"""Tables say the same on the console, in CSV, in Markdown and in LaTeX."""

import csv as csv_module
import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.tables import (
    Column,
    Table,
    cells,
    latex,
    markdown,
    print_table,
    show_value,
    write_table,
)


@pytest.fixture
def table() -> Table:
    frame = pd.DataFrame(
        {
            "scene": ["close", "close", "ear"],
            "gpu": ["a_b", "c|d", "50% & more"],
            "accesses": np.array([1234567, 8, 0], np.int64),
            "miss_rate": [0.87654, 0.5, np.nan],
        }
    )
    columns = (
        Column("scene", "scene"),
        Column("gpu", "GPU"),
        Column("accesses", "accesses"),
        Column("miss_rate", "miss rate", ".3f"),
    )
    return Table("A title_with 100%", frame, columns, ("A note.",))


@pytest.mark.parametrize(
    ("value", "specification", "shown"),
    [
        (1234567, "", "1,234,567"),
        (None, ".3f", "-"),
        (float("nan"), ".3f", "-"),
        (0.87654, ".3f", "0.877"),
        (0.87654, "", "0.8765"),
        (2.0, "", "2"),
        ("text", ".3f", "text"),
        (True, "", "True"),
    ],
)
def test_a_value_is_shown_by_its_kind(value: object, specification: str, shown: str) -> None:
    assert show_value(value, specification) == shown


def test_cells_are_rows_of_the_shown_columns(table: Table) -> None:
    assert cells(table)[0] == ["close", "a_b", "1,234,567", "0.877"]
    assert cells(table)[2][3] == "-"


def test_markdown_has_one_pipe_table_with_escaped_pipes(table: Table) -> None:
    lines = markdown(table).splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert len(rows) == 2 + len(table.frame)
    assert len({line.replace(r"\|", "").count("|") for line in rows}) == 1
    assert rows[1].split("|")[3].strip().endswith(":"), "numbers stand to the right"
    assert r"c\|d" in rows[3]
    assert lines[0] == "**A title_with 100%**"


def test_latex_escapes_what_latex_reads_as_commands(table: Table) -> None:
    text = latex(table)
    assert r"a\_b" in text and r"50\% \& more" in text and r"title\_with 100\%" in text
    assert r"\begin{tabular}{llrr}" in text
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert all(line.replace(r"\&", "").count("&") == 3 for line in body)
    assert text.count(r"\begin{") == text.count(r"\end{") == 2


def test_csv_keeps_full_precision_and_leaves_missing_cells_empty(
    table: Table, tmp_path: Path
) -> None:
    paths = write_table(table, tmp_path / "t")
    assert [p.name for p in paths] == ["t.csv", "t.md", "t.tex"]
    rows = list(csv_module.DictReader(io.StringIO(paths[0].read_text())))
    assert float(rows[0]["miss_rate"]) == 0.87654
    assert rows[2]["miss_rate"] == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.csv", "t.md", "t.tex"]


def test_csv_may_hold_other_data_than_what_is_shown(table: Table, tmp_path: Path) -> None:
    data = pd.DataFrame({"other": [1]})
    paths = write_table(table, tmp_path / "t", data)
    assert paths[0].read_text() == "other\n1\n"
    assert "close" in paths[1].read_text()


def test_console_table_fits_a_hundred_columns_and_blanks_repeated_words(
    table: Table, capsys: pytest.CaptureFixture[str]
) -> None:
    print_table(table)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert sum("close" in line for line in lines) == 1
    assert any("1,234,567" in line for line in lines)
    assert "A note." in lines


def test_nothing_is_cut_short_however_narrow_the_terminal(
    table: Table, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("experiments.console.PLAIN_WIDTH", 20)
    monkeypatch.setattr("experiments.tables.PLAIN_WIDTH", 20)
    print_table(table)
    said = capsys.readouterr().out
    for words in ("1,234,567", "50% & more", "0.877"):
        assert any(words in line for line in said.splitlines())
    assert "…" not in said


def test_a_missing_whole_number_is_shown_as_missing() -> None:
    frame = pd.DataFrame({"halved": pd.array([None, 4096], "Int64")})
    assert cells(Table("Sensitivity", frame, (Column("halved", "halved"),))) == [["-"], ["4,096"]]
