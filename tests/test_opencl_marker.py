"""The `opencl` marker: kernels can go untested only where that is said, and never in CI."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).with_name("conftest.py")
TESTS = """
import pytest

def test_with_fixture(device):
    pass

@pytest.mark.opencl
def test_with_marker():
    pass

def test_of_something_else():
    pass
"""


@pytest.fixture
def run_tests(tmp_path, without_opencl):
    """Run `TESTS` in a process without OpenCL: its exit code and output."""
    (tmp_path / "test_these.py").write_text(TESTS)
    shutil.copy(CONFTEST, tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = opencl\naddopts = --strict-markers\n")

    def run(*arguments, **variables):
        environment = {k: v for k, v in without_opencl.items() if k != "CACHESIM_REQUIRE_OPENCL"}
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider", *arguments],
            cwd=tmp_path,
            env={**environment, **variables},
            capture_output=True,
            text=True,
        )
        return done.returncode, done.stdout

    return run


def test_tests_that_need_opencl_are_skipped_with_a_reason_where_none_works(run_tests):
    code, output = run_tests()
    assert code == 0 and "1 passed, 2 skipped" in output
    assert "no OpenCL device works here" in output


def test_they_fail_where_opencl_is_required(run_tests):
    code, output = run_tests(CACHESIM_REQUIRE_OPENCL="1")
    # A failing set-up is an error to pytest.
    assert code == 1 and "1 passed" in output and "2 errors" in output
    assert "CACHESIM_REQUIRE_OPENCL is set" in output


def test_those_that_take_the_device_fixture_are_marked_by_themselves(run_tests):
    code, output = run_tests("-m", "not opencl")
    assert code == 0 and "1 passed, 2 deselected" in output
