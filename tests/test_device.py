"""kernels.opencl.device: which device is chosen, what is built on it, how failures are told."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.opencl import device as device_module
from kernels.opencl.device import CORRECT_ROUNDING, DeviceError, Probe, open_device
from kernels.opencl.driver_noise import noise_kept, short_reason
from traces.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
ADD_ONE = "kernel void add_one(global uint *value) { value[get_global_id(0)] += STEP; }"


def test_a_device_runs_a_kernel_built_with_options_and_included_files(device, tmp_path):
    import pyopencl as cl

    (tmp_path / "add_one.cl").write_text(ADD_ONE)
    program = device.build('#include "add_one.cl"', ["-D", "STEP=3u"], [tmp_path])
    value = np.arange(8, dtype=np.uint32)
    buffer = cl.Buffer(device.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=value)
    program.add_one(device.queue, value.shape, None, buffer)
    result = np.empty_like(value)
    cl.enqueue_copy(device.queue, result, buffer)
    assert result.tolist() == (value + 3).tolist()


def test_a_build_warns_of_nothing_and_prints_nothing(device, capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        device.build(ADD_ONE, ["-D", "STEP=1u"])
    assert capfd.readouterr() == ("", "")


def test_a_build_that_fails_is_a_device_error_with_the_compilers_words(device):
    with pytest.raises(DeviceError, match="undeclared_name"):
        device.build("kernel void f(global int *p) { *p = undeclared_name; }")


def test_division_and_square_root_are_correctly_rounded_where_the_device_promises_it(device):
    import pyopencl as cl

    if not device.correctly_rounded:
        pytest.skip(f"{device.name} does not offer {CORRECT_ROUNDING}")
    generator = np.random.default_rng(5)
    a, b = (generator.uniform(0.01, 1000, 50_000).astype(np.float32) for _ in range(2))
    source = """kernel void f(global float *a, global float *b) {
      size_t i = get_global_id(0); float q = a[i] / b[i]; b[i] = sqrt(b[i]); a[i] = q; }"""
    buffers = [
        cl.Buffer(device.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=array) for array in (a, b)
    ]
    device.build(source).f(device.queue, a.shape, None, *buffers)
    results = [np.empty_like(a), np.empty_like(b)]
    for result, buffer in zip(results, buffers, strict=True):
        cl.enqueue_copy(device.queue, result, buffer)
    np.testing.assert_array_equal(results[0], a / b)
    np.testing.assert_array_equal(results[1], np.sqrt(b))


def test_a_device_is_opened_by_words_of_its_name_in_any_case(device):
    assert open_device(device.name.upper()) is device


@pytest.mark.opencl
def test_the_environment_names_the_device_and_the_argument_goes_before_it(monkeypatch):
    devices = device_module.all_devices()
    monkeypatch.setenv("CACHESIM_DEVICE", devices[-1].name)
    assert open_device() is devices[-1]
    assert open_device(devices[0].name) is devices[0]


@pytest.mark.opencl
def test_an_unknown_device_name_is_bad_input_that_lists_the_devices(monkeypatch):
    with pytest.raises(InputError, match=r"--device: unknown OpenCL device 'abacus'.*choose from"):
        open_device("abacus")
    monkeypatch.setenv("CACHESIM_DEVICE", "abacus")
    with pytest.raises(InputError, match=r"^CACHESIM_DEVICE: unknown"):
        open_device()


def fake_device(name, platform_version, kinds):
    from pyopencl import device_type

    bits = sum(getattr(device_type, kind) for kind in kinds)
    platform = SimpleNamespace(name="platform", version=platform_version)
    return SimpleNamespace(
        name=name, version="OpenCL", driver_version="1", type=bits, platform=platform
    )


def test_candidates_are_tried_gpu_first_then_newest_pocl_then_cpus_then_the_rest(monkeypatch):
    listed = (
        fake_device("fpga", "OpenCL 1.2", ["ACCELERATOR"]),
        fake_device("other cpu", "OpenCL 3.0", ["CPU"]),
        fake_device("pocl 3.1", "OpenCL 3.0 PoCL 3.1+debian  Linux", ["CPU"]),
        fake_device("pocl 10.0", "OpenCL 3.0 PoCL 10.0-rc2  Linux", ["CPU"]),
        fake_device("gpu", "OpenCL 3.0", ["GPU"]),
    )
    monkeypatch.setattr(device_module, "_listed_devices", lambda: listed)
    assert [name.split(": ")[1] for name in device_module.device_names()] == [
        "gpu",
        "pocl 10.0",
        "pocl 3.1",
        "other cpu",
        "fpga",
    ]


def test_the_first_device_that_works_is_taken_and_the_failures_before_it_are_passed(monkeypatch):
    broken = fake_device("broken", "OpenCL 3.0", ["GPU"])
    good = fake_device("good", "OpenCL 3.0", ["CPU"])
    opened = device_module.Device("good", "1", "cpu", None, None, ())
    verdicts = {"broken": Probe("broken", "1", "gpu", False, "no compiler"), "good": opened}
    monkeypatch.setattr(device_module, "_listed_devices", lambda: (good, broken))
    monkeypatch.setattr(device_module, "_probe", lambda device: verdicts[device.name])
    monkeypatch.delenv("CACHESIM_DEVICE", raising=False)
    assert open_device() is opened
    with pytest.raises(device_module.NoDeviceError, match=r"named 'broken'(.|\n)*no compiler"):
        open_device("broken")


def test_a_driver_that_lists_a_device_but_cannot_compile_is_named_with_its_reason(without_opencl):
    code = "from kernels.opencl.device import open_device; open_device()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=without_opencl, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 1 and done.stdout == ""
    assert "NoDeviceError: no OpenCL device works" in done.stderr
    assert "cachesim doctor --install" in done.stderr
    if "tried nothing" not in done.stderr:  # the PoCL wheel is installed
        assert "tried PoCL" in done.stderr and "failed to build" in done.stderr


def test_a_probe_with_wrong_results_does_not_pass(device, monkeypatch):
    wrong = device_module._PROBE_SOURCE.replace("747796405u", "747796407u")
    monkeypatch.setattr(device_module, "_PROBE_SOURCE", wrong)
    with pytest.raises(DeviceError, match="wrong results"):
        device_module._run_probe(device)


def test_what_c_code_prints_is_kept_from_the_terminal(capfd):
    lines = []
    with noise_kept(lines):
        os.write(1, b"to stdout\n")
        os.write(2, b"to stderr\n")
    os.write(1, b"after\n")
    assert lines == ["to stdout", "to stderr"]
    assert capfd.readouterr() == ("after\n", "")


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        (("warming up\nerror: unknown target CPU 'generic'\n", "build failed"), None),
        (("", "build failed: X\n\n(options: -I /a)\n(source saved as b)"), "build failed: X"),
        (("", ""), "no reason given"),
    ],
)
def test_the_short_reason_is_the_line_that_says_most(texts, reason):
    assert short_reason(*texts) == (reason or "error: unknown target CPU 'generic'")
