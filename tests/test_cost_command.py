"""`cachesim cost`, its model files, and the `cost-function` experiment."""

from __future__ import annotations

import json

import pandas as pd
import pytest

from cachesim import presets
from cachesim.cost.file import read_models, write_models
from cachesim.cost.machine import Machine
from cachesim.cost.model import Coefficient, CostModel, coefficient_names
from experiments.cli import run_command
from experiments.reproduce import cost_function_cells
from experiments.reproduce.cost_function_verdicts import LEVELS, judge, summarise
from traces.errors import InputError
from traces.parquet import write_parquet
from traces.synthetic import stream

GPU = "quadro-p4000"


def made_model(gpu: str = GPU) -> CostModel:
    names = coefficient_names(Machine.of(presets.load(gpu)))
    return CostModel(gpu, {name: Coefficient(0.9, 0.8, 1.1) for name in names}, 7)


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "model.json"
    write_models([made_model(), made_model("rx-6900-xt")], path)
    return path


def test_a_file_of_models_is_read_as_it_was_written(model_file):
    found = read_models(model_file)
    assert found == {GPU: made_model(), "rx-6900-xt": made_model("rx-6900-xt")}
    assert list(model_file.parent.iterdir()) == [model_file]


def change(path, edit):
    held = json.loads(path.read_text())
    edit(held)
    path.write_text(json.dumps(held))


def of_first(held):
    return held["models"][0]["coefficients"]


@pytest.mark.parametrize(
    ("edit", "told"),
    (
        (lambda h: h.update(version=2), "version"),
        (lambda h: h.update(format="another"), "format"),
        (lambda h: h.update(extra=1), "extra"),
        (lambda h: h.update(models=[]), "models"),
        (lambda h: h["models"].append(h["models"][0]), "twice"),
        (lambda h: of_first(h).pop("l2.passed"), "'l2.passed' is missing"),
        (lambda h: of_first(h).update({"l9.passed": of_first(h)["l2.passed"]}), "'l9.passed'"),
        (lambda h: of_first(h)["l2.passed"].update(value=5.0), "not in 0.8 to 1.1"),
        (lambda h: of_first(h)["l2.passed"].update(value=0.0, low=0.0), "above 0"),
        (lambda h: of_first(h)["l2.passed"].update(value="os.system"), "number"),
        (lambda h: of_first(h)["l2.passed"].update(value=-1.0), "greater than or equal"),
        (lambda h: of_first(h)["l2.passed"].update(value=float("nan")), "finite"),
    ),
)
def test_a_bad_model_is_one_line_that_names_the_field(model_file, capsys, edit, told):
    change(model_file, edit)
    code = run_command(["cost", "--model", str(model_file), "--scene", "front"])
    error = capsys.readouterr().err
    assert code == 2 and error.count("\n") == 1
    assert str(model_file) in error and told in error


def test_what_is_no_model_file_is_refused(tmp_path):
    path = tmp_path / "no.json"
    with pytest.raises(InputError, match="No such file"):
        read_models(path)
    for text in ("", "not json", "[1]", '"' + "x" * (1 << 20) + '"'):
        path.write_text(text)
        with pytest.raises(InputError, match=r"no\.json"):
            read_models(path)


@pytest.mark.parametrize(
    ("arguments", "told"),
    (
        (["cost"], "--fit"),
        (["cost", "--fit"], "no recordings"),
        (["cost", "--fit", "{trace}"], "-o is missing"),
        (["cost", "--fit", "{trace}", "-o", "{new}"], "need two or more"),
        (["cost", "--fit", "{trace}", "{trace}", "-o", "x.txt"], ".json"),
        (["cost", "--fit", "{trace}", "{trace}", "-o", "{new}", "--scene", "ear"], "--scene ear"),
        (["cost", "--fit", "{trace}", "{trace}", "-o", "{new}", "--gpu", "nope"], "nope"),
        (["cost", "--fit", "--model", "{model}"], "give one of"),
        (["cost", "--model", "{model}"], "--scene is missing"),
        (["cost", "--model", "{model}", "{trace}", "--scene", "ear"], "go with --fit"),
        (["cost", "--model", "{model}", "--scene", "ear", "--gpu", "h100-sxm"], "choose from"),
        (["cost", "--model", "{model}", "--scene", "ear", "--budget", "0"], "num_samples 0"),
        (["cost", "--model", "{model}", "--scene", "ear", "--frames", "0"], "--frames 0"),
        (["cost", "--model", "{model}", "--scene", "ear", "--size", "9"], "--size"),
    ),
)
def test_bad_arguments_are_one_line_and_exit_2(tmp_path, model_file, capsys, arguments, told):
    trace = tmp_path / "t.parquet"
    write_parquet(stream(8), trace)
    places = {"trace": trace, "model": model_file, "new": tmp_path / "new.json"}
    code = run_command([a.format(**places) for a in arguments])
    error = capsys.readouterr().err
    assert code == 2, error
    assert error.count("\n") == 1 and told in error
    assert not (tmp_path / "new.json").exists()


def test_a_trace_of_addresses_cannot_be_fitted_to(tmp_path, capsys):
    trace = tmp_path / "t.parquet"
    write_parquet(stream(8), trace)
    new = tmp_path / "new.json"
    code = run_command(["cost", "--fit", str(trace), str(trace), "-o", str(new), "--no-timing"])
    assert code == 2 and "needs texels" in capsys.readouterr().err
    assert not new.exists()


def test_a_model_is_fitted_to_recordings_and_predicts_a_scene(first_device, tmp_path, capsys):
    from cachesim import simulate
    from kernels.method import Method
    from kernels.record import record
    from kernels.scene import load_scene

    size, paths = (128, 72), []
    for scene, num in (("close", 8), ("ear", 4), ("ear", 12)):
        gbuffer = load_scene(scene, *size, device=first_device)
        method = Method(num_samples=num)
        path = tmp_path / f"{scene}-{num}.parquet"
        write_parquet(record(gbuffer, method, device=first_device, self_check=False), path)
        paths.append(str(path))
    model = tmp_path / "model.json"
    fitting = ["cost", "--fit", *paths, "-o", str(model), "--no-timing"]
    assert run_command(fitting) == 0
    assert "l2.passed" in capsys.readouterr().out
    shown = ["cost", "--model", str(model), "--scene", "close", "--size", "128x72"]
    assert run_command([*shown, "--budget", "16", "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    gbuffer = load_scene("close", *size, device=first_device)
    trace = record(gbuffer, Method(num_samples=16), device=first_device, self_check=False)
    report = simulate(trace, GPU)
    assert told["gpu"] == GPU and told["cycles"] is None and told["samples"] == 16 * 128 * 72
    for level, value in report.demand.items():
        assert told["demand"][level] == pytest.approx(value, rel=0.15), level
    assert run_command([*shown, "--method", "adaptive", "--frames", "2"]) == 0
    assert "DRAM demand" in capsys.readouterr().out


def test_what_is_held_out_was_not_fitted_to():
    for quick in (True, False):
        cells = cost_function_cells.list_cells(quick)
        fitted, held = ([c for c in cells if c.held_out == kind] for kind in (False, True))
        assert len(fitted) >= 4 and len(held) >= 4
        assert not {c.scene for c in fitted} & {c.scene for c in held}
        assert len({c.name for c in cells}) == len(cells)


def made_errors(model: float, per_n: float) -> pd.DataFrame:
    rows = []
    for held_out in (False, True):
        row: dict[str, object] = {"gpu": GPU, "frame": "made", "held_out": held_out}
        for level in (*LEVELS, "cycles"):
            row |= {f"{level}_simulated": 100.0, f"{level}_predicted": 100.0 * (1 + model)}
            row |= {f"{level}_per_n": 100.0 * (1 + per_n), f"{level}_32_bytes": 300.0}
        rows.append(row)
    return pd.DataFrame(rows)


def test_targets_and_baselines_are_judged():
    summary = summarise(made_errors(-0.15, 0.5))
    assert summary["model"].tolist() == pytest.approx([0.15] * 8)
    found = {c.quantity.split(":")[0] + str("baseline" in c.quantity): c.agrees
             for c in judge(summary)}  # fmt: skip
    assert found == {
        "L1 demandFalse": False, "L2 demandFalse": False, "DRAM demandFalse": False,
        "cyclesFalse": True, "L2 demandTrue": True, "DRAM demandTrue": True,
    }  # fmt: skip
    beaten = judge(summarise(made_errors(0.05, 0.01)))
    assert [c.agrees for c in beaten if "proportional" in c.quantity] == [False, False]
    assert all(c.agrees for c in beaten if "mean held-out" in c.quantity)
