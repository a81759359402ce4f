"""Sensitivity: assumed numbers halved and doubled within bounds, the largest change first."""

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from pydantic import TypeAdapter, ValidationError
from timing_samples import one_pass, timing_result

from cachesim import presets
from cachesim.presets.fields import FIELDS, build_gpu, flatten_gpu
from experiments.cli import run_command
from experiments.sensitivity import (
    TIMING_SECTIONS,
    Variant,
    fields_to_vary,
    halved_and_doubled,
    is_timing_number,
    make_variants,
    sensitivity_frame,
    sensitivity_table,
    unvaried,
)
from experiments.tables import cells
from traces.errors import InputError
from traces.parquet import write_parquet
from traces.synthetic import scatter

CARD = "titan-x-pascal"


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A machine whose cycles follow from two fields; the sizes of the batches it was asked for."""
    batches: list[int] = []

    def simulate_all(trace: object, gpus: list, **options: object) -> list[SimpleNamespace]:
        assert options["timing"] is True
        batches.append(len(gpus))
        reports = []
        for gpu in gpus:
            cycles = 100 * gpu.l1_timing.num_mshrs + 10_000_000 // gpu.dram_timing.queue
            result = timing_result(one_pass(cycles=cycles))
            reports.append(SimpleNamespace(gpu=gpu.name, timing=result))
        return reports

    monkeypatch.setattr("cachesim.simulate_all", simulate_all)
    return batches


def frame_of(fields: list[str], step: Callable[[], None] = lambda: None) -> pd.DataFrame:
    gpu = presets.load(CARD)
    sources = dict.fromkeys(fields, "assumed: so")
    return sensitivity_frame(None, gpu, make_variants(gpu, fields), sources, step=step)  # type: ignore[arg-type]


def test_every_timing_section_is_one_of_the_gpus() -> None:
    sections = {f.partition(".")[0] for f in FIELDS if f.partition(".")[0].endswith("_timing")}
    assert sections | {"icnt"} == set(TIMING_SECTIONS)


@pytest.mark.parametrize("name", ["titan-x-pascal", "rx-6900-xt", "h100-sxm"])
def test_every_assumed_timing_field_is_varied_or_named_as_left_out(name: str) -> None:
    assumed = {
        field
        for field, entry in presets.sources(name).items()
        if field.partition(".")[0] in TIMING_SECTIONS and entry.confidence == "?"
    }
    varied, left_out = fields_to_vary(name, [], None), unvaried(name, [])
    assert set(varied) | set(left_out) == assumed and not set(varied) & set(left_out)
    values = flatten_gpu(presets.load(name))
    assert all(isinstance(values[f], int) and values[f] > 0 for f in varied)
    assert all(isinstance(values[f], str | bool) or values[f] == 0 for f in left_out)


def test_a_field_that_an_override_sets_is_assumed() -> None:
    known = [f for f, e in presets.sources(CARD).items() if is_timing_number(f)]
    sure = next(f for f in known if presets.sources(CARD)[f].confidence != "?")
    assert sure not in fields_to_vary(CARD, [], None)
    value = presets.sources(CARD)[sure].value
    assert sure in fields_to_vary(CARD, [f"{sure}={value}"], None)


@pytest.mark.parametrize("field", [f for f in FIELDS if is_timing_number(f)])
def test_halves_and_doubles_stay_within_the_fields_bounds(field: str) -> None:
    def is_allowed(value: int) -> bool:
        try:
            return TypeAdapter(FIELDS[field]).validate_python(value) == value
        except ValidationError:
            return False

    for value in filter(is_allowed, (1, 2, 3, 40, 64)):
        tried = halved_and_doubled(field, value)
        assert all(is_allowed(new) and new > 0 for new in tried.values()), "0 would lift a limit"
        assert value == 1 or tried["half"] == value // 2
        assert tried.get("double", value) in range(value, 2 * value + 1)


def test_a_value_at_its_bound_is_only_halved() -> None:
    assert halved_and_doubled("dram_timing.num_banks", 64) == {"half": 32}
    assert halved_and_doubled("sm_timing.issue_per_warp", 1) == {"double": 2}


def test_a_value_that_does_not_fit_the_other_fields_is_no_machine() -> None:
    # The address map names the banks.
    variants = make_variants(presets.load(CARD), ["dram_timing.num_banks"])
    assert [(v.factor, v.gpu) for v in variants] == [("half", None), ("double", None)]


def test_changes_are_those_of_the_cycles_largest_first(timed: list[int]) -> None:
    gpu = presets.load(CARD)
    mshrs, queue = gpu.l1_timing.num_mshrs, gpu.dram_timing.queue
    base = 100 * mshrs + 10_000_000 // queue
    fields = ["l1_timing.miss_queue", "l1_timing.num_mshrs", "dram_timing.queue"]
    frame = frame_of(fields).set_index("field")
    assert list(frame.index) == ["dram_timing.queue", "l1_timing.num_mshrs", "l1_timing.miss_queue"]
    assert set(frame["cycles"]) == {base}
    row = frame.loc["dram_timing.queue"]
    assert (row["value_half"], row["value_double"]) == (queue // 2, 2 * queue)
    assert row["cycles_half"] == 100 * mshrs + 10_000_000 // (queue // 2)
    assert row["change_half"] == pytest.approx(row["cycles_half"] / base - 1)
    assert row["largest"] == pytest.approx(row["change_half"])
    assert frame.loc["l1_timing.miss_queue", "largest"] == 0
    assert set(frame["source"]) == {"assumed: so"}


def test_machines_run_side_by_side_and_every_run_is_told(timed: list[int]) -> None:
    steps: list[int] = []
    frame_of(["l1_timing.num_mshrs", "dram_timing.queue"], lambda: steps.append(1))
    assert len(steps) == sum(timed) == 5
    assert max(timed) <= (os.cpu_count() or 1)


def test_the_table_shows_percent_and_what_was_not_varied(timed: list[int]) -> None:
    frame = frame_of(["dram_timing.num_banks", "dram_timing.queue"])
    table = sensitivity_table(frame, "t on gpu", ["sm_timing.scheduler"])
    shown = cells(table)
    assert shown[0][0] == "dram_timing.queue" and shown[0][3].startswith("+")
    assert shown[1][3] == shown[1][5] == "-"
    assert "1 of 2 fields" in table.notes[0] and "sm_timing.scheduler" in table.notes[1]


def test_a_gpu_without_assumed_numbers_has_an_empty_table(timed: list[int]) -> None:
    assert sensitivity_table(frame_of([]), "t").notes == ("No assumed number to vary.",)


@pytest.mark.parametrize(
    ("field", "told"),
    [
        ("l1_timing.num_mshr", ["num_mshr", "num_mshrs"]),
        ("l1.ways", ["l1.ways", "no number of the timing model"]),
        ("sm_timing.scheduler", ["sm_timing.scheduler", "no number"]),
        ("gl1_timing.port_bytes", ["gl1_timing", "titan-x-pascal"]),
    ],
)
def test_a_field_that_cannot_be_varied_is_refused(field: str, told: list[str]) -> None:
    with pytest.raises(InputError) as error:
        fields_to_vary(CARD, [], [field])
    assert all(word in str(error.value) for word in told)


def test_a_field_of_value_0_cannot_be_halved() -> None:
    zero = next(f for f in unvaried(CARD, []) if is_timing_number(f))
    with pytest.raises(InputError, match="is 0"):
        fields_to_vary(CARD, [], [zero])


def test_a_variant_differs_in_its_field_alone() -> None:
    gpu = presets.load(CARD)
    for variant in make_variants(gpu, ["l1_timing.num_mshrs"]):
        assert isinstance(variant, Variant) and variant.gpu is not None
        changed = flatten_gpu(variant.gpu)
        assert build_gpu(changed | {variant.field: gpu.l1_timing.num_mshrs}, "t") == gpu


def test_the_command_prints_the_table_and_writes_the_csv(
    tmp_path: Path,
    timed: list[int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("cachesim.first_use.compile_loops", lambda **_: None)
    trace, out = tmp_path / "t.parquet", tmp_path / "s.csv"
    write_parquet(scatter(64, 32, 6.0, 4), trace)
    fields = "l1_timing.num_mshrs,dram_timing.queue"
    arguments = ["sensitivity", str(trace), "--gpu", CARD, "--fields", fields, "-o", str(out)]
    assert run_command(arguments) == 0
    said = capsys.readouterr().out
    assert "Sensitivity of t.parquet on titan-x-pascal" in said and "…" not in said
    assert max(map(len, said.splitlines())) <= 100
    assert list(pd.read_csv(out)["field"]) == ["dram_timing.queue", "l1_timing.num_mshrs"]


def test_bad_options_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = ["sensitivity", str(tmp_path / "t.parquet"), "--gpu", CARD, "-o"]
    assert run_command([*bad, str(tmp_path / "s.txt")]) == 2
    assert run_command([*bad, str(tmp_path / "s.csv"), "--fields", "a,,b"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and ".csv" in lines[0] and "a,,b" in lines[1]
