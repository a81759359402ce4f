"""Measuring silicon without a GPU: the CUDA sources compiled, and the whole way run on a driver
that is a processor (tests/fake_cuda), whose kernels are the same sources.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.cli import run_command
from experiments.silicon import build, workload
from experiments.silicon.cases import NUM_SAMPLES, Case
from experiments.silicon.inputs import read_picture
from experiments.silicon.measure import choose_tasks, drop_unprepared, pictures_of
from experiments.silicon.rows import read_measurements
from experiments.silicon.tasks import list_tasks
from traces.errors import InputError, WorkError

ROOT = Path(__file__).resolve().parents[1]
FAKE = ROOT / "tests" / "fake_cuda"
PICTURE = "front_480x270"


@pytest.mark.parametrize("name", build.SOURCES)
def test_the_committed_ptx_was_made_from_the_sources_that_are_here(name):
    assert build.kernel_names(build.committed_ptx(name))


def test_ptx_of_other_sources_is_refused(tmp_path, monkeypatch):
    shutil.copytree(build.folder(), tmp_path / "cuda")
    monkeypatch.setattr(build, "folder", lambda: tmp_path / "cuda")
    header = tmp_path / "cuda" / "maths.h"
    header.write_text(header.read_text() + "// changed\n")
    with pytest.raises(WorkError, match=r"micro\.ptx: made from other sources"):
        build.committed_ptx("micro")


@pytest.mark.parametrize("name", build.SOURCES)
def test_nothing_of_the_kernels_lies_in_local_memory(name):
    # Its loads and stores would be counted among those of the texels.
    assert ".local" not in build.committed_ptx(name)


def test_structures_have_the_size_that_the_kernels_expect():
    ptx = build.committed_ptx("passes")
    sizes = dict(re.findall(r"\.param \.align \d+ \.b8 (\w+)\[(\d+)\]", ptx))
    assert int(sizes["setup_texture_param_0"]) == ctypes.sizeof(workload.Constants)
    assert int(sizes["setup_texture_param_1"]) == ctypes.sizeof(workload.Image)
    levels = re.search(r"^\.visible \.const .* setup_levels\[(\d+)\]", ptx, re.MULTILINE)
    assert int(levels[1]) == ctypes.sizeof(workload.Levels)


@pytest.mark.parametrize("name", build.SOURCES)
def test_the_sources_compile_with_nvcc(name):
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        pytest.skip("no nvcc here")
    ptx = build.compile_ptx(nvcc, name, "compute_90")
    assert sorted(build.kernel_names(ptx)) == sorted(build.kernel_names(build.committed_ptx(name)))
    assert ".local" not in ptx


@pytest.mark.parametrize("name", build.SOURCES)
def test_the_committed_ptx_assembles(name, tmp_path):
    ptxas = shutil.which("ptxas")
    if ptxas is None:
        pytest.skip("no ptxas here")
    path = tmp_path / "named.ptx"
    path.write_text(build.prefix_kernels(build.committed_ptx(name), "a__b"))
    command = [ptxas, "-arch=sm_90", str(path), "-o", str(tmp_path / "out.cubin")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_kernels_get_names_of_their_own():
    ptx = build.committed_ptx("micro")
    copies = build.copy_kernel(ptx, "footprint", ["a__1", "a__2"])
    assert build.kernel_names(copies) == ["a__1__footprint", "a__2__footprint"]
    assert copies.count(".version") == 1
    named = build.kernel_names(build.prefix_kernels(ptx, "p"))
    assert named == [f"p__{name}" for name in build.kernel_names(ptx)]
    with pytest.raises(WorkError, match="no kernel 'absent'"):
        build.copy_kernel(ptx, "absent", ["a"])


def test_without_a_gpu_it_says_what_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CACHESIM_CUDA_DRIVER", str(tmp_path / "libcuda.so"))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_HOME", raising=False)
    monkeypatch.setattr("experiments.silicon.tools._FOLDERS", ())
    assert run_command(["silicon", "measure", "-o", str(tmp_path / "out.csv")]) == 1
    told = capsys.readouterr().err
    for missing in ("an NVIDIA GPU and its driver", "nvcc", "ncu"):
        assert f"missing: {missing}" in told
    assert told.splitlines()[-1] == "cachesim: error: no NVIDIA GPU to measure"
    assert not (tmp_path / "out.csv").exists()


def test_measuring_needs_no_package_but_numpy():
    code = (
        "import sys, experiments.silicon.measure, experiments.silicon.__main__;"
        "found = {name.partition('.')[0] for name in sys.modules} - sys.stdlib_module_names;"
        "print(*sorted(name for name in found if not name.startswith('_')))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert set(done.stdout.split()) <= {"experiments", "numpy", "traces"}, done.stdout


def test_tasks_are_chosen_by_how_their_names_begin(tmp_path):
    chosen = choose_tasks(["chase", "times-ear"])
    assert pictures_of(chosen) == ["ear_1920x1080"]
    tasks, remarks = drop_unprepared(chosen, str(tmp_path))
    assert {task.name.split("-")[0] for task in tasks} == {"chase"}
    assert len(remarks) == 1 and "ear_1920x1080: not measured" in remarks[0]
    names = [task.name for task in list_tasks()]
    assert len(names) == len(set(names))
    with pytest.raises(InputError, match="--only 'nothing': choose from properties"):
        choose_tasks(["nothing"])


@pytest.fixture(scope="module")
def fake_machine(tmp_path_factory):
    """The environment of a machine whose GPU, and whose profiler, are those of tests/fake_cuda."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler here")
    folder = tmp_path_factory.mktemp("machine")
    library = folder / "libcuda.so"
    command = [
        *(compiler, "-std=c++17", "-O2", "-ffp-contract=off", "-fno-strict-aliasing"),
        *("-shared", "-fPIC", "-DSILICON_ON_HOST", "-Wno-unknown-pragmas", "-w"),
        *("-I", str(FAKE), "-I", str(build.folder())),
        *(str(FAKE / "fake_driver.cpp"), "-o", str(library)),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    profiler = folder / "ncu"
    profiler.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{FAKE / "fake_ncu.py"}" "$@"\n')
    profiler.chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("CUDA")}
    return environment | {
        "CACHESIM_CUDA_DRIVER": str(library),
        "PATH": f"{folder}{os.pathsep}/usr/bin{os.pathsep}/bin",
    }


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A folder with the small picture."""
    folder = tmp_path_factory.mktemp("pictures")
    assert run_command(["silicon", "prepare", "-o", str(folder), "--picture", PICTURE]) == 0
    return folder


def measure(environment, path, *arguments):
    """`python -m experiments.silicon measure` on the fake machine."""
    command = [sys.executable, "-m", "experiments.silicon", "measure", "-o", str(path), *arguments]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return read_measurements(path)


@pytest.fixture(scope="module")
def measured(fake_machine, prepared, tmp_path_factory):
    """A measurement of the fake machine with the workload's small picture: (path, content)."""
    path = tmp_path_factory.mktemp("measured") / "fake.csv"
    tasks = ["properties", f"times-{PICTURE}", f"counters-{PICTURE}", "near-far", "scan-l1"]
    tasks += ["chase-load", "chase-past", "chase-readonly", "chase-texture-linear", "neighbours"]
    only = [word for task in tasks for word in ("--only", task)]
    return path, measure(fake_machine, path, "--inputs", str(prepared), *only)


def values_of(content, measurement, quantity):
    """{case: value} of one quantity."""
    return {
        row.case: row.value
        for row in content.rows
        if row.measurement == measurement and row.quantity == quantity
    }


@pytest.mark.opencl
def test_the_manifest_says_how_it_was_measured(measured):
    manifest = measured[1].manifest
    assert manifest["device"].startswith("NVIDIA H100 80GB HBM3")
    assert manifest["compiler"].startswith("committed PTX") and manifest["counters"] == "ncu"
    assert manifest["sources"]["passes"] == build.source_hash("passes")
    # The fake GPU's memory does not hold the largest textures; that is no reason to end.
    assert {failure["task"] for failure in manifest["failures"]} <= {"neighbours"}


@pytest.mark.opencl
def test_the_kernels_make_the_pictures_of_the_opencl_kernels_bit_for_bit(measured):
    identical = values_of(measured[1], "picture", "identical")
    assert len(identical) == 2 * (2 + 6 + 4)
    assert set(identical.values()) == {1.0}, {c for c, v in identical.items() if v != 1}


@pytest.mark.opencl
def test_chases_and_clocks_read_what_the_machine_was_given(measured):
    content = measured[1]
    latency = values_of(content, "chase", "latency")
    for path, cycles in (("load", 33), ("past_l1", 280), ("readonly", 33)):
        found = [v for c, v in latency.items() if f"path={path} stride_bytes=128" in c]
        assert len(found) > 20 and found == pytest.approx([cycles] * len(found), rel=1e-3)
    textures = [v for c, v in latency.items() if "path=texture" in c]
    assert len(textures) > 20 and textures == pytest.approx([90] * len(textures), rel=1e-3)
    near_far = values_of(content, "near_far", "latency")
    assert len(near_far) == 4 * 16
    assert set(values_of(content, "scan", "hit_rate").values()) == {1.0}
    clocks = values_of(content, "properties", "sm_clock")
    assert list(clocks.values()) == pytest.approx([2e9] * 5)


@pytest.mark.opencl
def test_every_launch_of_the_workload_is_timed_and_profiled(measured):
    content = measured[1]
    timed = {Case.of_words({**row.words}) for row in content.rows if row.quantity == "time"}
    profiled = {
        Case.of_words(row.words)
        for row in content.rows
        if row.measurement == "workload" and row.source == "ncu"
    }
    assert timed == profiled and len(timed) == 17 and None not in timed


@pytest.mark.opencl
def test_the_models_l1_sectors_are_those_of_the_kernels(measured, tmp_path, capsys):
    import pandas as pd

    arguments = ["validate", "silicon", str(measured[0]), "--no-cycles", "-o", str(tmp_path)]
    assert run_command(arguments) == 0
    frame = pd.read_csv(tmp_path / "silicon-fake.csv")
    sectors = frame[frame["quantity"] == "l1_sectors"]
    assert len(sectors) == 17 and (sectors["measured"] > 100).all()
    assert (sectors["error"] == 0).all(), sectors[sectors["error"] != 0]
    told = capsys.readouterr().out
    assert "Agreement with silicon" in told and "L1 sectors" in told
    assert (tmp_path / "silicon-fake.png").stat().st_size > 10_000


@pytest.mark.opencl
def test_where_counters_are_blocked_times_are_measured_and_that_is_said(
    fake_machine, prepared, tmp_path
):
    environment = fake_machine | {"FAKE_NCU_BLOCKED": "1"}
    only = ["--only", "properties", "--only", f"counters-{PICTURE}"]
    content = measure(environment, tmp_path / "a.csv", "--inputs", str(prepared), *only)
    assert "ERR_NVGPUCTRPERM" in content.manifest["counters"]
    assert "times alone" in content.manifest["counters"]
    assert not any(row.source == "ncu" for row in content.rows)


def test_a_task_that_dies_loses_nothing_of_the_others(fake_machine, tmp_path):
    # No folder of pictures has this file: the task of its picture fails, the next goes on.
    (tmp_path / f"{PICTURE}.npz").write_text("damaged")
    only = ["--only", f"times-{PICTURE}", "--only", "properties"]
    content = measure(fake_machine, tmp_path / "a.csv", "--inputs", str(tmp_path), *only)
    assert values_of(content, "properties", "num_sms") == {"": 4.0}
    (failure,) = (f for f in content.manifest["failures"] if f["task"] == f"times-{PICTURE}")
    assert "no prepared picture" in failure["why"]


def test_nothing_is_begun_after_the_time_is_up(fake_machine, tmp_path):
    path = tmp_path / "a.csv"
    command = [sys.executable, "-m", "experiments.silicon", "measure", "--seconds", "0"]
    done = subprocess.run(
        [*command, "-o", str(path), "--only", "properties", "--only", "chase-load"],
        cwd=ROOT,
        env=fake_machine,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "nothing was measured: not begun: the 0 s were used up" in done.stderr
    failures = json.loads(path.read_text().split("\n")[0][2:])["failures"]
    assert [failure["task"] for failure in failures][:2] == ["properties", "chase-load"]


@pytest.mark.opencl
def test_a_prepared_picture_holds_the_count_map_that_made_it(prepared):
    picture = read_picture(prepared / f"{PICTURE}.npz")
    assert picture.constants["fixed64"]["fixed_count"] == NUM_SAMPLES
    counts, scatters = picture.arrays["counts"], picture.arrays["gbuffer_id"] > 0
    assert (counts[scatters] >= 8).all() and (counts[~scatters] == 0).all()
    assert (picture.arrays["old_history"][scatters] != 0).any()
