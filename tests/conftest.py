"""Fixtures shared by all tests: every working OpenCL device, and Hypothesis's profiles."""

from __future__ import annotations

import functools
import os

import hypothesis
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")

REQUIRE_OPENCL = "CACHESIM_REQUIRE_OPENCL"

# The first example of many tests compiles numba code, which no deadline fits.
hypothesis.settings.register_profile("default", deadline=None)
hypothesis.settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "default")


@functools.cache
def working_devices():
    """Every device that runs the probe kernel, opened once for the whole session."""
    from kernels.opencl.device import all_devices

    return tuple(all_devices())


def pytest_generate_tests(metafunc):
    """Run a test that takes `device` once for every working device, named after it."""
    if "device" in metafunc.fixturenames:
        # No device: still one test, which `pytest_runtest_setup` skips or fails.
        devices = working_devices() or (None,)
        names = [device.name if device else "no device" for device in devices]
        metafunc.parametrize("device", devices, ids=names, scope="session")


def pytest_collection_modifyitems(items):
    """Mark what takes `device` as `opencl`, so that `-m 'not opencl'` leaves it out."""
    for item in items:
        if {"device", "first_device"} & set(getattr(item, "fixturenames", ())):
            item.add_marker("opencl")


def pytest_runtest_setup(item):
    """Skip what needs OpenCL where no device works; fail it where CI promises that one does."""
    if item.get_closest_marker("opencl") and not working_devices():
        reason = "no OpenCL device works here; `cachesim doctor` says why"
        if os.environ.get(REQUIRE_OPENCL):
            pytest.fail(f"{reason}, and {REQUIRE_OPENCL} is set", pytrace=False)
        pytest.skip(reason)


@pytest.fixture(scope="session")
def first_device():
    """The device that runs where none is named, for what the comparisons with the reference hold
    every device to.
    """
    from kernels.opencl.device import open_device

    return open_device()


@pytest.fixture
def without_opencl(tmp_path):
    """The environment of a process in which every driver lists or compiles nothing.

    PoCL then loads but cannot compile, as its wheel does on CPUs that its LLVM does not know.
    """
    empty = tmp_path / "no-drivers"
    empty.mkdir()
    # PoCL stores what it compiles in its cache; a file where that folder should be fails the build.
    return {**os.environ, "OCL_ICD_VENDORS": str(empty), "POCL_CACHE_DIR": os.devnull}
