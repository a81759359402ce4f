"""kernels.opencl.doctor: OpenCL explained, and a CPU device installed where none works."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from kernels.opencl import device as device_module
from kernels.opencl import doctor
from kernels.opencl.device import DeviceError, Probe, open_device

ROOT = Path(__file__).resolve().parents[1]
POPEN = subprocess.Popen
WORKS = Probe("PoCL 3.1: cpu", "OpenCL 3.0", "cpu", True, "")
FAILS = Probe("PoCL 3.0: cpu", "OpenCL 3.0", "cpu", False, "unknown target CPU 'generic'")


def shown(diagnosis):
    console = Console(file=io.StringIO(), width=200)
    doctor.print_diagnosis(diagnosis, console)
    return console.file.getvalue()


@pytest.mark.opencl
def test_the_diagnosis_names_every_device_and_the_one_that_open_device_takes(monkeypatch):
    monkeypatch.delenv("CACHESIM_DEVICE", raising=False)
    diagnosis = doctor.diagnose()
    assert [probe.name for probe in diagnosis.probes] == device_module.device_names()
    working = [device.name for device in device_module.all_devices()]
    assert [probe.name for probe in diagnosis.probes if probe.works] == working
    assert diagnosis.chosen == open_device().name and not diagnosis.advice
    assert f"Used: {diagnosis.chosen}" in shown(diagnosis)


def test_the_diagnosis_says_what_to_do_where_nothing_works(without_opencl, monkeypatch):
    for name in ("OCL_ICD_VENDORS", "POCL_CACHE_DIR"):
        monkeypatch.setenv(name, without_opencl[name])
    diagnosis = doctor.diagnose()
    assert diagnosis.chosen is None
    text = shown(diagnosis)
    assert "cachesim doctor --install" in text and "pocl-opencl-icd" in text
    assert "OCL_ICD_VENDORS is set to" in text
    with pytest.raises(DeviceError, match="unset it first"):
        doctor.install_fallback(print)


def test_a_driver_that_crashes_is_a_line_of_the_diagnosis(monkeypatch):
    crash = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
    run = subprocess.run

    def run_stub(command, **kwargs):
        listing = 'print(\'{"names": ["bad driver: gpu"]}\')'
        return run([sys.executable, "-c", listing if "list" in command else crash], **kwargs)

    monkeypatch.setattr(doctor.subprocess, "run", run_stub)
    (probe,) = doctor.diagnose().probes
    assert (probe.name, probe.works) == ("bad driver: gpu", False)
    assert probe.reason == "the driver crashed (signal 11)"


def test_a_named_device_that_does_not_work_is_pointed_out(monkeypatch):
    monkeypatch.setenv("CACHESIM_DEVICE", "abacus")
    monkeypatch.setattr(doctor, "_in_fresh_process", lambda *_: {"names": ["a"]})
    monkeypatch.setattr(doctor, "_isolated_probe", lambda *_: WORKS)
    diagnosis = doctor.diagnose()
    assert diagnosis.chosen is None and "CACHESIM_DEVICE=abacus" in diagnosis.advice[0]


@pytest.fixture
def pip(monkeypatch):
    """Stands for pip: records its command; `says` and `returns` are what it does."""
    pip = SimpleNamespace(commands=[], says="Downloading intel.whl (225 MB)\n", returns=0)

    def popen(command, **kwargs):
        pip.commands.append(command)
        code = f"import sys; sys.stdout.write({pip.says!r}); sys.exit({pip.returns})"
        return POPEN([sys.executable, "-c", code], **kwargs)

    monkeypatch.setattr(doctor.subprocess, "Popen", popen)
    return pip


def diagnoses(monkeypatch, *probes):
    """Let `diagnose` see these probes, one a call."""
    results = iter(probes)
    monkeypatch.setattr(
        doctor, "diagnose", lambda: doctor.Diagnosis({}, "", (next(results),), None, ())
    )


def test_nothing_is_installed_where_a_device_works(pip, monkeypatch):
    diagnoses(monkeypatch, WORKS)
    assert doctor.install_fallback(print).probes == (WORKS,)
    assert pip.commands == []


def test_where_none_works_intels_wheels_are_installed_at_the_pinned_versions(pip, monkeypatch):
    diagnoses(monkeypatch, FAILS, WORKS)
    told = []
    assert doctor.install_fallback(told.append).probes == (WORKS,)
    (command,) = pip.commands
    assert command[:4] == [sys.executable, "-m", "pip", "install"]
    assert command[-4:] == ["-c", str(ROOT / "constraints.txt"), *doctor.INTEL_WHEELS]
    pins = (ROOT / "constraints.txt").read_text()
    assert all(f"\n{wheel}==" in pins for wheel in doctor.INTEL_WHEELS)
    assert "Downloading intel.whl (225 MB)" in told


def test_without_a_constraints_file_the_wheels_are_not_pinned(pip, monkeypatch, tmp_path):
    diagnoses(monkeypatch, FAILS, WORKS)
    monkeypatch.setattr(doctor, "_ROOT", tmp_path)
    doctor.install_fallback(print)
    assert "-c" not in pip.commands[0]


def test_an_installation_that_fails_or_does_not_help_is_a_device_error(pip, monkeypatch):
    diagnoses(monkeypatch, FAILS, FAILS)
    with pytest.raises(DeviceError, match=r"after installing.*unknown target CPU"):
        doctor.install_fallback(print)
    pip.says, pip.returns = "ERROR: no matching distribution\nnote\n", 1
    diagnoses(monkeypatch, FAILS)
    with pytest.raises(DeviceError, match="failed: ERROR: no matching distribution"):
        doctor.install_fallback(print)
