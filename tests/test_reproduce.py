"""The frame of `cachesim reproduce`: catalogue, command, finished parts, pages, index."""

from __future__ import annotations

import importlib
import json
import pkgutil

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import experiments.reproduce
from experiments.cli import run_command
from experiments.reproduce import catalogue, parts
from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings, compare
from experiments.reproduce.pages import write_index, write_outcome
from experiments.reproduce.parts import Parts
from experiments.tables import Column, Table
from traces.errors import InputError, WorkError


def an_experiment(name="toy", run=lambda settings: Outcome(), **fields):
    return Experiment(name=name, title=f"title of {name}", chapter="5", figure="Fig", run=run)


@pytest.fixture
def entries(monkeypatch):
    """A catalogue of the test's own."""
    listed = []
    monkeypatch.setattr(catalogue, "NAMES", [])
    monkeypatch.setattr(catalogue, "all_experiments", lambda: tuple(listed))

    def add(entry):
        listed.append(entry)
        if entry.run is not None:
            catalogue.NAMES.append(entry.name)

    return add


def test_every_module_that_offers_an_experiment_is_listed_under_its_name():
    found = set()
    for module in pkgutil.iter_modules(experiments.reproduce.__path__):
        path = f"{experiments.reproduce.__name__}.{module.name}"
        entry = getattr(importlib.import_module(path), "EXPERIMENT", None)
        if entry is not None:
            assert entry.name.replace("-", "_") == module.name
            found.add(entry.name)
    assert found == set(catalogue.NAMES)


def test_every_entry_says_where_it_stands_and_how_long_it_takes():
    for entry in catalogue.all_experiments():
        assert entry.title and entry.chapter and entry.figure, entry.name
        if entry.run is not None:
            assert 0 < entry.quick_minutes <= entry.minutes, entry.name


def test_what_the_sources_do_not_allow_is_listed_with_a_reason():
    names = {e.name for e in catalogue.all_experiments() if e.reason}
    assert {"single-draws", "dlss"} <= names
    with pytest.raises(ValueError, match="either run or reason"):
        Experiment(name="nothing", title="t", chapter="5", figure="f")


def test_all_is_what_runs_in_the_order_of_the_catalogue():
    assert [e.name for e in catalogue.select(["all"])] == list(catalogue.NAMES)
    first, second = catalogue.NAMES[:2]
    assert [e.name for e in catalogue.select([second, first, second])] == [first, second]


def test_an_unknown_name_is_bad_input_that_names_the_nearest(capsys, tmp_path):
    assert run_command(["reproduce", "cv-toi", "-o", str(tmp_path)]) == 2
    assert "did you mean 'cv-toy'?" in capsys.readouterr().err


@pytest.mark.parametrize("names", ([], ["list"]))
def test_list_names_every_experiment_and_every_reason(capsys, names):
    assert run_command(["reproduce", *names]) == 0
    told = capsys.readouterr().out
    for entry in catalogue.all_experiments():
        assert entry.name in told


def test_list_stands_alone(capsys):
    assert run_command(["reproduce", "list", "cv-toy"]) == 2
    assert "list: stands alone" in capsys.readouterr().err


def test_the_command_says_the_expected_time_before_and_writes_an_index(entries, capsys, tmp_path):
    order = []

    def run(settings):
        order.append("run")
        assert "about 2 s" in capsys.readouterr().err
        settings.progress("half", 0.5)
        return Outcome(words=("Said so.",), verdict="done")

    entry = Experiment("toy", "a toy", "5", "Fig 1", minutes=90, quick_minutes=2 / 60, run=run)
    entries(entry)
    assert run_command(["reproduce", "toy", "--quick", "-o", str(tmp_path / "new" / "out")]) == 0
    assert order == ["run"]
    assert "Said so." in (tmp_path / "new" / "out" / "toy.md").read_text()
    assert "| done" in (tmp_path / "new" / "out" / "index.md").read_text()


def test_a_failure_keeps_the_others_running_and_is_the_exit_code(entries, capsys, tmp_path):
    def fail(settings):
        raise WorkError("no device works here")

    entries(an_experiment("first", fail))
    entries(an_experiment("second"))
    assert run_command(["reproduce", "all", "-o", str(tmp_path)]) == 1
    assert "1 of 2 experiments failed: first: no device works here" in capsys.readouterr().err
    index = (tmp_path / "index.md").read_text()
    assert "failed: no device works here" in index
    assert (tmp_path / "second.md").exists() and not (tmp_path / "first.md").exists()


def test_an_interrupt_leaves_the_index_over_what_is_finished(entries, tmp_path):
    def interrupt(settings):
        raise KeyboardInterrupt

    entries(an_experiment("first"))
    entries(an_experiment("second", interrupt))
    assert run_command(["reproduce", "all", "-o", str(tmp_path)]) == 130
    index = (tmp_path / "index.md").read_text()
    assert "[first](first.md)" in index and "not run yet" in index


def test_a_later_run_keeps_the_verdicts_of_earlier_ones(entries, tmp_path):
    entries(an_experiment("first", lambda settings: Outcome(verdict="one holds")))
    entries(an_experiment("second", lambda settings: Outcome(verdict="two holds")))
    for name in ("first", "second"):
        assert run_command(["reproduce", name, "-o", str(tmp_path)]) == 0
    index = (tmp_path / "index.md").read_text()
    assert "one holds" in index and "two holds" in index


def test_a_finished_cell_is_read_back_and_not_computed_again(tmp_path):
    kept, calls = Parts(tmp_path / "cells"), []

    def compute():
        calls.append(1)
        return {"value": 0.1 + 0.2, "of": [1, 2]}

    first = kept.json("cell", {"n": 3}, compute)
    again = Parts(tmp_path / "cells").json("cell", {"n": 3}, compute)
    assert first == again == {"value": 0.1 + 0.2, "of": [1, 2]} and len(calls) == 1


@pytest.mark.parametrize("change", ("inputs", "sources", "damage"))
def test_a_cell_of_other_inputs_or_sources_is_computed_again(tmp_path, monkeypatch, change):
    (tmp_path / "source.py").write_text("x = 1\n")
    monkeypatch.setattr(parts, "_ROOT", tmp_path)
    for kind, value in (("json", [1]), ("arrays", {"a": np.arange(3)})):
        (tmp_path / "source.py").write_text("x = 1\n")
        parts._source_hash.cache_clear()
        inputs = {"n": 1}
        assert getattr(Parts(tmp_path, ["source"]), kind)("c", inputs, lambda value=value: value)
        if change == "inputs":
            inputs = {"n": 2}
        elif change == "sources":
            (tmp_path / "source.py").write_text("x = 2\n")
            parts._source_hash.cache_clear()
        else:
            stored = tmp_path / ("c.json" if kind == "json" else "c.npz")
            stored.write_bytes(stored.read_bytes()[:-20])
        calls = []
        getattr(Parts(tmp_path, ["source"]), kind)(
            "c", inputs, lambda calls=calls, value=value: calls.append(1) or value
        )
        assert calls == [1], kind
    parts._source_hash.cache_clear()


def test_arrays_come_back_as_they_were(tmp_path):
    picture = np.random.default_rng(1).random((4, 5, 3), np.float32)
    inputs = {"size": [5, 4]}
    Parts(tmp_path).arrays("p", inputs, lambda: {"picture": picture, "n": np.int64(3)})
    found = Parts(tmp_path).arrays("p", inputs, lambda: pytest.fail("computed again"))
    assert found["picture"].dtype == np.float32 and np.array_equal(found["picture"], picture)
    assert set(found) == {"picture", "n"} and found["n"] == 3


def test_nothing_is_kept_of_a_cell_that_failed(tmp_path):
    def fail():
        raise WorkError("stopped")

    with pytest.raises(WorkError):
        Parts(tmp_path / "cells").json("cell", {}, fail)
    with pytest.raises(TypeError, match="arrays of objects"):
        Parts(tmp_path / "cells").arrays("c", {}, lambda: {"o": np.array([object()])})
    assert not list(tmp_path.rglob("*.*"))


def test_a_source_that_is_not_there_is_a_mistake():
    assert len(Parts(None, ["kernels"]).fingerprint({})) == 64
    with pytest.raises(ValueError, match="no package or module 'kernel'"):
        Parts(None, ["kernel"]).fingerprint({})


def test_quick_and_full_runs_keep_their_cells_apart(tmp_path):
    for quick in (True, False):
        parts_of = Settings(quick, tmp_path).parts("toy")
        assert parts_of.json("cell", {}, lambda quick=quick: quick) is quick
    for quick in (True, False):
        parts_of = Settings(quick, tmp_path).parts("toy")
        assert parts_of.json("cell", {}, lambda: pytest.fail("computed again")) is quick


def test_a_page_shows_tables_figures_and_comparisons(tmp_path):
    frame = pd.DataFrame({"n": [1, 2], "error": [0.123456, 0.5]})
    long = pd.DataFrame({"n": range(100)})
    outcome = Outcome(
        tables={
            "shown": Table("Errors", frame, (Column("error", "error", ".2f"),), ("A note.",)),
            "long": long,
        },
        figures={"plot": Figure(), "picture": np.full((2, 3, 3), 7, np.uint8)},
        comparisons=(compare("c", 2.5715, 2.5716, relative=0.01),),
        words=("A paragraph.",),
        captions={"picture": "By somebody, CC BY 3.0."},
    )
    page = write_outcome(tmp_path, an_experiment(), outcome, quick=False, seconds=3.2)
    text = page.read_text()
    for part in ("A note.", "0.12", "2.5715", "agrees", "A paragraph.", "CC BY 3.0", "100 rows"):
        assert part in text
    assert text.count("\n|") < 30
    # Every link leads to a file that is there.
    for name in ("shown.csv", "long.csv", "plot.png", "picture.png"):
        assert f"(toy/{name})" in text and (tmp_path / "toy" / name).stat().st_size
    assert pd.read_csv(tmp_path / "toy" / "shown.csv").equals(frame)
    summary = json.loads((tmp_path / "toy" / "summary.json").read_text())
    assert summary["verdict"] == "1 of 1 comparisons agree" and not summary["quick"]


def test_the_index_holds_comparisons_and_reasons(tmp_path):
    refused = Experiment("refused", "t", "6", "f", reason="a closed binary")
    entry, waiting = an_experiment(), an_experiment("waiting")
    outcome = Outcome(comparisons=(Comparison("a quantity", "0.69", np.float64(0.7)),))
    write_outcome(tmp_path, entry, outcome, quick=True, seconds=1)
    text = write_index(tmp_path, (entry, waiting, refused)).read_text()
    for part in (
        "a quantity",
        "0.69",
        "not computed: a closed binary",
        "not run yet",
        "1 s, quick",
    ):
        assert part in text


def test_a_comparison_says_in_words_whether_it_agrees():
    assert compare("q", 2.0, 2.02, relative=0.02).verdict == "agrees: +1 %, within 2 %"
    far = compare("q", 2.0, 2.5, relative=0.02, note="why")
    assert far.verdict == "differs: +25 %, more than 2 %; why" and far.agrees is False
    assert compare("q", 1.0, 1.1, spread=0.1).agrees
    assert not compare("q", 1.0, 1.3, spread=0.1).agrees
    with pytest.raises(ValueError, match="one of"):
        compare("q", 1, 1)


def test_the_summary_counts_what_agrees_and_names_what_differs():
    outcome = Outcome(
        comparisons=(
            compare("a", 1.0, 1.0, relative=0.1),
            compare("b", 1.0, 3.0, relative=0.1),
            Comparison("c", None, 1.0),
        )
    )
    assert outcome.summary() == "1 of 2 comparisons agree; differing: b"
    assert "no number to compare" in Outcome().summary()


def test_bad_input_of_an_experiment_names_it(entries, capsys, tmp_path):
    def refuse(settings):
        raise InputError("device 'x': none has that name")

    entries(an_experiment("first", refuse))
    assert run_command(["reproduce", "first", "-o", str(tmp_path)]) == 1
    assert "device 'x': none has that name" in capsys.readouterr().err
