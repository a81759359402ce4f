"""kernels.opencl.icd: the drivers of the machine and of the environment are seen together."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

from kernels.opencl import icd

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A made-up machine: its vendors folder, and an environment with Intel's wheels."""
    vendors = tmp_path / "vendors"
    vendors.mkdir()
    (vendors / "pocl.icd").write_text("libpocl.so.2\n")
    environment = tmp_path / "environment"
    (environment / "lib").mkdir(parents=True)
    (environment / "lib/libintelocl.so").touch()
    (environment / "etc/OpenCL/vendors").mkdir(parents=True)
    (environment / "etc/OpenCL/vendors/intel-cpu.icd").write_text("/built/elsewhere/libintelocl.so")
    monkeypatch.setenv("OPENCL_VENDOR_PATH", str(vendors))
    monkeypatch.setattr(icd, "_prefixes", lambda: [environment])
    monkeypatch.setattr(icd, "_LIBRARY_FOLDERS", ())
    return SimpleNamespace(vendors=vendors, environment=environment)


def test_drivers_of_the_machine_and_intels_wheel_are_found_together(machine):
    assert icd.driver_libraries() == {
        "system-pocl.icd": "libpocl.so.2",
        "environment-intel-cpu.icd": str(machine.environment / "lib/libintelocl.so"),
    }


def test_an_icd_file_of_the_environment_counts_only_if_its_library_exists(machine):
    library = machine.environment / "lib/libother.so"
    (machine.environment / "etc/OpenCL/vendors/other.icd").write_text(f"{library}\n")
    assert "environment-other.icd" not in icd.driver_libraries()
    library.touch()
    assert icd.driver_libraries()["environment-other.icd"] == str(library)


def test_intels_runtime_is_loaded_once_where_the_machine_has_its_own(machine):
    (machine.vendors / "intel.icd").write_text("/opt/intel/libintelocl.so")
    intel = [library for library in icd.driver_libraries().values() if "intelocl" in library]
    assert intel == ["/opt/intel/libintelocl.so"]


def test_the_vendor_folder_is_whole_however_many_processes_write_it_at_once(tmp_path):
    libraries = {f"{i}.icd": f"lib{i}.so" for i in range(20)}
    with ThreadPoolExecutor(8) as pool:
        folders = set(pool.map(lambda _: icd.write_vendor_folder(libraries, [tmp_path]), range(32)))
    (folder,) = folders
    assert {path.name: path.read_text().strip() for path in folder.iterdir()} == libraries
    assert list(tmp_path.iterdir()) == [folder]


def test_other_drivers_give_another_folder_and_an_unwritable_place_is_passed(tmp_path):
    (tmp_path / "file").touch()
    parents = [tmp_path / "file", tmp_path / "cache"]
    first = icd.write_vendor_folder({"a.icd": "a"}, parents)
    second = icd.write_vendor_folder({"a.icd": "b"}, parents)
    assert first.parent == second.parent == tmp_path / "cache" and first != second
    assert icd.write_vendor_folder({"a.icd": "a"}, parents[:1]) is None


def test_the_users_own_vendors_are_left_alone_and_ours_are_replaced(machine, monkeypatch):
    monkeypatch.setattr(icd, "_parents", lambda: [machine.environment])
    monkeypatch.setenv("OCL_ICD_VENDORS", "/of/the/user")
    icd.use_all_drivers()
    assert os.environ["OCL_ICD_VENDORS"] == "/of/the/user" == icd.user_vendors()
    monkeypatch.delenv("OCL_ICD_VENDORS")
    icd.use_all_drivers()
    first = os.environ["OCL_ICD_VENDORS"]
    assert icd.user_vendors() is None and Path(first).parent == machine.environment
    (machine.environment / "lib/libintelocl.so").unlink()
    icd.use_all_drivers()
    assert os.environ["OCL_ICD_VENDORS"] != first


def test_a_device_works_where_the_users_cache_cannot_be_written(device, tmp_path):
    (tmp_path / "file").touch()
    home = str(tmp_path / "file")
    code = (
        f"from kernels.opencl.device import open_device; print(open_device({device.name!r}).name)"
    )
    variables = ("OCL_ICD_VENDORS", "POCL_CACHE_DIR")
    environment = {name: value for name, value in os.environ.items() if name not in variables}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**environment, "HOME": home, "XDG_CACHE_HOME": home},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert (done.stdout.strip(), done.stderr) == (device.name, "")
