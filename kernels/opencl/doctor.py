"""OpenCL on this machine explained, and a CPU device installed where none works.

Every device is probed in a process of its own, so that a driver that crashes is a line of the
report and not the end of it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from kernels.opencl.device import (
    DEVICE_VARIABLE,
    DeviceError,
    Probe,
    device_names,
    is_named,
    probe_device,
)
from kernels.opencl.driver_noise import short_reason
from kernels.opencl.icd import driver_libraries, user_vendors

#: A CPU device for any x86-64 Linux; the `intel` extra of this project.
INTEL_WHEELS = ("intel-opencl-rt", "intel-cmplr-lib-rt")
INTEL_SIZE = "280 MB to download, 800 MB on disk"
_ROOT = Path(__file__).resolve().parents[2]
_PROBE_TIMEOUT_S = 120


@dataclass(frozen=True)
class Diagnosis:
    """What OpenCL offers here.

    drivers: .icd file to library, as found on the machine and in this environment. vendors: the
    user's own `OCL_ICD_VENDORS`, "" if unset; it replaces `drivers`. probes: every listed device,
    in the order in which they are tried. chosen: the name of the device that would be used, None if
    there is none. advice: what to do, one sentence each.
    """

    drivers: dict[str, str]
    vendors: str
    probes: tuple[Probe, ...]
    chosen: str | None
    advice: tuple[str, ...]


def diagnose() -> Diagnosis:
    """Probe every device that the drivers list."""
    listed = _in_fresh_process("list")
    probes = [_isolated_probe(i, name) for i, name in enumerate(listed.get("names", []))]
    if "failure" in listed:
        probes = [Probe("OpenCL loader", "", "other", False, listed["failure"])]
    wanted = os.environ.get(DEVICE_VARIABLE, "")
    usable = [probe for probe in probes if probe.works]
    named = [probe for probe in usable if is_named(wanted, probe.name, probe.version)]
    return Diagnosis(
        drivers=driver_libraries(),
        vendors=user_vendors() or "",
        probes=tuple(probes),
        chosen=named[0].name if named else None,
        advice=_advice(bool(usable), bool(named)),
    )


def install_fallback(progress: Callable[[str], None]) -> Diagnosis:
    """Install Intel's CPU runtime from wheels where no device works, and look again.

    Does nothing but diagnose where a device works.

    Args:
        progress: is told what happens, a line at a time.

    Raises:
        DeviceError: the installation failed, or no device works after it either.
    """
    diagnosis = diagnose()
    if any(probe.works for probe in diagnosis.probes):
        return diagnosis
    if diagnosis.vendors:
        raise DeviceError(
            f"OCL_ICD_VENDORS={diagnosis.vendors} hides what would be installed: unset it first"
        )
    progress(f"No OpenCL device works: installing Intel's CPU runtime ({INTEL_SIZE})")
    _pip_install(INTEL_WHEELS, progress)
    diagnosis = diagnose()
    if not any(probe.works for probe in diagnosis.probes):
        reasons = "; ".join(f"{probe.name}: {probe.reason}" for probe in diagnosis.probes)
        raise DeviceError(f"no OpenCL device works after installing Intel's either: {reasons}")
    return diagnosis


def print_diagnosis(diagnosis: Diagnosis, console: Console) -> None:
    """Print the drivers, the devices with what their probes said, and the advice."""
    drivers = Table("driver", "library", title="OpenCL drivers found", title_justify="left")
    for name, library in diagnosis.drivers.items():
        drivers.add_row(Text(name), Text(library))
    drivers.add_row("(in pyopencl)", "the PoCL wheel, where it is installed")
    if diagnosis.vendors:
        console.print(Text(f"OCL_ICD_VENDORS is set to {diagnosis.vendors}: only it is searched"))
    else:
        console.print(drivers)
    devices = Table("device", "kind", "probe", title="Devices, as tried", title_justify="left")
    for probe in diagnosis.probes:
        verdict = Text("works", "green") if probe.works else Text(probe.reason, "red")
        devices.add_row(Text(f"{probe.name}\n{probe.version}".strip()), probe.kind, verdict)
    if diagnosis.probes:
        console.print(devices)
    else:
        console.print(Text("The OpenCL loader lists no device."))
    if diagnosis.chosen:
        console.print(Text(f"Used: {diagnosis.chosen}"))
    for line in diagnosis.advice:
        console.print(Text(line))


def _advice(any_works: bool, named_works: bool) -> tuple[str, ...]:
    """What to do next; nothing where all is well."""
    if named_works:
        return ()
    if any_works:
        return (
            f"{DEVICE_VARIABLE}={os.environ[DEVICE_VARIABLE]} names no working device: "
            "name one that works, or unset it.",
        )
    return (
        "No OpenCL device works. Either of these gives a CPU device:",
        f"  without root, on x86-64: cachesim doctor --install  ({INTEL_SIZE})",
        "  with root, on Debian or Ubuntu: apt install pocl-opencl-icd",
    )


def _isolated_probe(index: int, name: str) -> Probe:
    """Probe one device in a fresh process; a crash or a hang is its reason for not working."""
    result = _in_fresh_process("probe", str(index))
    if "failure" in result:
        return Probe(name, "", "other", False, result["failure"])
    return Probe(**result["probe"])


def _in_fresh_process(*arguments: str) -> dict[str, Any]:
    """Run `_main` in a new process: its report, or {"failure": how it failed, in one line}."""
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(_ROOT), *filter(None, [environment.get("PYTHONPATH")])]
    )
    command = [sys.executable, "-m", "kernels.opencl.doctor", *arguments]
    try:
        done = subprocess.run(
            command,
            env=environment,
            cwd=_ROOT,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PROBE_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"failure": f"no answer in {_PROBE_TIMEOUT_S} s"}
    if done.returncode < 0:
        return {"failure": f"the driver crashed (signal {-done.returncode})"}
    if done.returncode:
        return {"failure": short_reason(done.stderr)}
    # The report is the last line: a driver may have printed before it.
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


def _pip_install(wheels: tuple[str, ...], progress: Callable[[str], None]) -> None:
    """Install into this environment, at the versions of constraints.txt where that file is found.

    Raises:
        DeviceError: with pip's own words.
    """
    constraints = _ROOT / "constraints.txt"
    pins = ["-c", str(constraints)] if constraints.exists() else []
    command = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
    environment = {**os.environ, "PIP_ROOT_USER_ACTION": "ignore", "PYTHONUNBUFFERED": "1"}
    said: list[str] = []
    with subprocess.Popen(
        [*command, *pins, *wheels],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    ) as pip:
        assert pip.stdout is not None
        for line in pip.stdout:
            said.append(line)
            if line.lstrip().startswith(("Downloading", "Using cached", "Installing")):
                progress(line.strip())
    if pip.returncode:
        raise DeviceError(f"installing {' and '.join(wheels)} failed: {short_reason(*said)}")


def _main(arguments: list[str]) -> None:
    """`list`: the devices' names. `probe INDEX`: the verdict on one. Both as one line of JSON."""
    if arguments[0] == "list":
        print(json.dumps({"names": device_names()}))
    else:
        print(json.dumps({"probe": asdict(probe_device(int(arguments[1])))}))


if __name__ == "__main__":
    _main(sys.argv[1:])
