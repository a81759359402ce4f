"""The pages of experiments: CSV and PNG files, one Markdown page each, and the index over all.

<out>/index.md, <out>/<name>.md, <out>/<name>/<table>.csv, <figure>.png, summary.json
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.output import output_folder, write_figure, write_text
from experiments.reproduce.experiment import Comparison, Experiment, Outcome, as_plain
from experiments.tables import Column, Table, csv, markdown, plain_table
from traces.files import replacing, writing

if TYPE_CHECKING:
    import pandas as pd

    from experiments.reproduce.experiment import Image

SUMMARY = "summary.json"
#: A longer table stands in its CSV alone.
MAX_SHOWN_ROWS = 40
_COMPARISON_COLUMNS = (
    Column("quantity", "quantity"),
    Column("paper", "paper", numeric=True),
    Column("ours", "ours", numeric=True),
    Column("unit", "unit"),
    Column("verdict", "verdict", wraps=True),
)


def comparison_table(comparisons: Sequence[Comparison], title: str) -> Table:
    """The paper's numbers beside ours."""
    import pandas as pd

    rows = [(c.quantity, _number(c.paper), _number(c.ours), c.unit, c.verdict) for c in comparisons]
    frame = pd.DataFrame(rows, columns=[c.name for c in _COMPARISON_COLUMNS], dtype=object)
    return Table(title, frame, _COMPARISON_COLUMNS)


def _number(value: str | float | None) -> str | None:
    """Up to six digits: what the paper prints stays as it is."""
    return value if value is None or isinstance(value, str) else f"{value:.6g}"


def write_outcome(
    out: Path, experiment: Experiment, outcome: Outcome, *, quick: bool, seconds: float
) -> Path:
    """Write an experiment's files and its page; returns the page's path.

    out: exists. The page and the summary come last: where they are, the rest is.
    """
    from matplotlib.figure import Figure

    name = experiment.name
    folder = output_folder(out / name)
    lines = [f"# {experiment.title}", "", _place(experiment, quick, seconds), ""]
    lines += [f"**{outcome.summary()}.**".replace("..**", ".**"), ""]
    if outcome.comparisons:
        table = comparison_table(outcome.comparisons, "The paper's numbers beside ours")
        write_text(folder / "comparisons.csv", csv(table.frame))
        lines += [markdown(table)]
    for paragraph in outcome.words:
        lines += [paragraph, ""]
    for key, figure in outcome.figures.items():
        path = folder / f"{key}.png"
        if isinstance(figure, Figure):
            write_figure(path, figure)
        else:
            _write_image(path, figure)
        caption = outcome.captions.get(key, "")
        lines += [f"![{key}]({name}/{path.name})", "", *([caption, ""] if caption else [])]
    for key, shown in outcome.tables.items():
        table = shown if isinstance(shown, Table) else plain_table(key, _flat(shown))
        write_text(folder / f"{key}.csv", csv(table.frame))
        if len(table.frame) <= MAX_SHOWN_ROWS:
            lines += [markdown(table)]
        lines += [f"[{key}.csv]({name}/{key}.csv), {len(table.frame)} rows", ""]
    page = out / f"{name}.md"
    write_text(page, "\n".join(lines))
    summary = {
        "name": name,
        "quick": quick,
        "seconds": round(seconds, 1),
        "verdict": outcome.summary(),
        "comparisons": [
            {k: as_plain(v) for k, v in vars(comparison).items()}
            for comparison in outcome.comparisons
        ],
    }
    write_text(folder / SUMMARY, json.dumps(summary, indent=1) + "\n")
    return page


def _flat(frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with its index, where that has a name, as columns."""
    return frame.reset_index() if any(n is not None for n in frame.index.names) else frame


def _place(experiment: Experiment, quick: bool, seconds: float) -> str:
    size = "quick: small sizes, so numbers are coarse" if quick else "full size"
    return (
        f"Chapter {experiment.chapter}, {experiment.figure}. `cachesim reproduce {experiment.name}"
        f"{' --quick' if quick else ''}`, {size}; it took {seconds:,.0f} s."
    )


def _write_image(path: Path, pixels: Image) -> None:
    from PIL import Image as Picture

    drawn = BytesIO()
    Picture.fromarray(pixels).save(drawn, "PNG")
    with replacing(path) as part, writing(path):
        part.write_bytes(drawn.getbuffer())


def write_index(
    out: Path, experiments: Sequence[Experiment], failures: dict[str, str] | None = None
) -> Path:
    """Write the index over every experiment of which `out` holds a page; returns its path.

    experiments: the whole catalogue. failures: name to what went wrong, in this run.
    """
    failures = failures or {}
    summaries = {e.name: _read_summary(out, e.name) for e in experiments}
    overview = _overview(experiments, summaries, failures)
    lines = ["# The dissertation's results, reproduced", "", markdown(overview)]
    for entry in experiments:
        found = summaries[entry.name]
        if found and found["comparisons"]:
            comparisons = [Comparison(**c) for c in found["comparisons"]]
            heading = f"[{entry.name}]({entry.name}.md)"
            lines += [f"## {heading}", "", markdown(comparison_table(comparisons, entry.title))]
    index = out / "index.md"
    write_text(index, "\n".join(lines))
    return index


def _overview(
    experiments: Sequence[Experiment],
    summaries: dict[str, dict[str, Any] | None],
    failures: dict[str, str],
) -> Table:
    import pandas as pd

    rows = []
    for entry in experiments:
        found = summaries[entry.name]
        shown, took = f"[{entry.name}]({entry.name}.md)", "-"
        if entry.run is None:
            shown, verdict = entry.name, f"not computed: {entry.reason}"
        elif entry.name in failures:
            shown, verdict = entry.name, f"failed: {failures[entry.name]}"
        elif found is None:
            shown, verdict = entry.name, "not run yet"
        else:
            verdict = found["verdict"]
            took = f"{found['seconds']:,.0f} s{', quick' if found['quick'] else ''}"
        rows.append((shown, entry.chapter, entry.title, verdict, took))
    columns = ("experiment", "chapter", "shows", "verdict", "took")
    return plain_table("Every experiment", pd.DataFrame(rows, columns=list(columns)))


def _read_summary(out: Path, name: str) -> dict[str, Any] | None:
    try:
        found = json.loads((out / name / SUMMARY).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return found if isinstance(found, dict) else None
