"""Methods and scenes on the command line: does a recording hold what the options say?"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from experiments import method_options
from experiments.cli import run_command
from kernels.launches import names_run
from kernels.method import PASSES, Method
from kernels.picture import preview
from kernels.record import record
from kernels.scenes.analytic import Circle
from kernels.scenes.motion import Overlaid, veil
from traces.errors import InputError
from traces.open import open_trace

SIZE = (48, 32)


def record_file(path: Path, *arguments: str) -> Any:
    """The trace that `cachesim record` makes of the circle, or of another scene, at `SIZE`."""
    scene = [] if "--scene" in arguments else ["--scene", "circle"]
    size = ["--size", f"{SIZE[0]}x{SIZE[1]}"]
    assert run_command(["record", "-o", str(path), *scene, *size, *arguments]) == 0
    return open_trace(path)


def passes_of(trace: Any) -> list[str]:
    return list(dict.fromkeys(launch.pass_name for launch in trace.launches))


def lanes_of(trace: Any) -> np.ndarray:
    return np.concatenate([np.asarray(chunk.lanes).ravel() for chunk in trace.chunks()])


def test_record_has_an_option_for_every_setting_with_the_methods_own_default(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: dict[str, Any] = {}
    make_method = method_options.make_method

    def catch(fields: dict[str, Any]) -> Method:
        asked.update(fields=fields, method=make_method(fields))
        raise InputError("that is all")

    monkeypatch.setattr(method_options, "make_method", catch)
    assert run_command(["record", "-o", str(tmp_path / "t.parquet")]) == 2
    assert {*asked["fields"]} == {field.name for field in dataclasses.fields(Method)} - {"profile"}
    assert asked["method"] == Method()


@pytest.mark.opencl
@pytest.mark.parametrize(
    ("arguments", "passes"),
    [
        ("--method fixed", "setup prefilter sampling combine"),
        ("--method adaptive", "setup prefilter sampling update combine"),
        ("--method adaptive --estimator two-pass", "setup prefilter pilot sampling combine"),
        ("--method separable", "setup separable_h separable_v combine"),
        (
            "--method hybrid --radius-threshold 4 --passthrough 0",
            "setup prefilter classify sampling separable_h separable_v update combine",
        ),
        (
            "--samples 4 --no-prefilter --overlay --taa --taa-weight 0.1",
            "setup sampling combine overlay taa",
        ),
    ],
)
def test_a_recording_holds_every_pass_that_the_method_runs(
    arguments: str, passes: str, tmp_path: Path
) -> None:
    trace = record_file(tmp_path / "t.parquet", *arguments.split())
    assert passes_of(trace) == passes.split()


def test_every_pass_is_run_by_some_method() -> None:
    methods = (
        Method(kind="hybrid", overlay=True, taa=True),
        Method(kind="adaptive", estimator="two-pass"),
    )
    assert {name for method in methods for name in names_run(method)} == {*PASSES}


@pytest.mark.opencl
def test_named_passes_alone_are_recorded(tmp_path: Path) -> None:
    trace = record_file(tmp_path / "t.parquet", "--passes", "sampling,combine", "--samples", "2")
    assert passes_of(trace) == ["sampling", "combine"]


def test_a_pass_that_the_method_does_not_run_is_refused_with_those_that_it_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "t.parquet"
    assert run_command(["record", "-o", str(path), "--passes", "sampling,taa"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "'taa'" in said and "setup, prefilter, sampling, combine" in said
    assert not path.exists()


@pytest.mark.opencl
def test_circle_moves_by_an_eightieth_of_the_width_and_the_veil_by_its_own_speed(
    tmp_path: Path,
) -> None:
    arguments = ["--method", "adaptive", "--frames", "3", "--overlay", "--taa"]
    trace = record_file(tmp_path / "t.parquet", *arguments)
    scene = Overlaid(Circle(*SIZE, speed_pixels=1.0), veil())
    method = Method(kind="adaptive", overlay=True, taa=True)
    expected = record(scene, method, num_frames=3)
    assert np.array_equal(lanes_of(trace), lanes_of(expected))
    still = record(Overlaid(Circle(*SIZE)(0), veil()), method, num_frames=3)
    assert not np.array_equal(lanes_of(trace), lanes_of(still)), "motion shows in the trace"


@pytest.mark.opencl
def test_render_shows_the_last_frame_of_a_scene_that_moves(tmp_path: Path) -> None:
    command = ["render", "--scene", "circle", "--size", "48x32", "--frames", "4"]
    assert run_command([*command, "-o", str(tmp_path), "--taa", "--method", "fixed"]) == 0
    shown = np.asarray(Image.open(tmp_path / "circle-preview.png"))
    scene = Circle(*SIZE, speed_pixels=1.0)
    assert np.array_equal(shown, preview(scene(3)))
    assert not np.array_equal(shown, preview(scene(0)))
