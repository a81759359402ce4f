"""What a measurement needs of the machine: the GPU's driver, `nvcc` and `ncu`."""

from __future__ import annotations

import glob
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from experiments.silicon.driver import Driver, DriverError

#: Where the tools stand when they are not on the PATH.
_FOLDERS = ("/usr/local/cuda/bin", "/opt/nvidia/nsight-compute/*")
_QUERY = (
    "name,driver_version,vbios_version,pstate,clocks.sm,clocks.mem,clocks.max.sm,clocks.max.mem,"
    "power.limit,persistence_mode,compute_mode,ecc.mode.current,mig.mode.current"
)


@dataclass(frozen=True)
class Tools:
    """What was found. An empty path means: missing, and `reasons` says why.

    gpu: its name, "" without a driver or GPU. driver: the newest CUDA that the driver runs. nvcc,
    ncu: paths; nvcc_version, ncu_version: what they say of themselves.
    """

    gpu: str
    driver: str
    nvcc: str
    nvcc_version: str
    ncu: str
    ncu_version: str
    reasons: tuple[str, ...]

    def lines(self) -> list[str]:
        """A line per tool, for people."""
        return [
            f"GPU: {self.gpu} (driver for CUDA {self.driver})" if self.gpu else "GPU: none",
            f"nvcc: {self.nvcc} ({self.nvcc_version})" if self.nvcc else "nvcc: none",
            f"ncu: {self.ncu} ({self.ncu_version})" if self.ncu else "ncu: none",
            *self.reasons,
        ]


def find_tools() -> Tools:
    """Look for the three; never fails."""
    reasons = []
    gpu = driver = ""
    try:
        found = Driver()
        gpu, driver = found.name, found.driver_version
    except DriverError as error:
        reasons.append(f"missing: an NVIDIA GPU and its driver: {error}")
    nvcc, nvcc_version = _find("nvcc", r"release ([\d.]+)")
    if not nvcc:
        reasons.append("missing: nvcc: the PTX that is committed is used instead")
    ncu, ncu_version = _find("ncu", r"Version ([\d.]+)")
    if not ncu:
        reasons.append("missing: ncu: no counters, times alone")
    return Tools(gpu, driver, nvcc, nvcc_version, ncu, ncu_version, tuple(reasons))


def _find(name: str, pattern: str) -> tuple[str, str]:
    """(path, version) of a program that runs; empty where there is none."""
    folders = [os.environ.get("PATH", "")]
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        if os.environ.get(variable):
            folders.append(str(Path(os.environ[variable]) / "bin"))
    for folder in _FOLDERS:
        folders += sorted(glob.glob(folder), reverse=True)
    path = shutil.which(name, path=os.pathsep.join(folders))
    if path is None:
        return "", ""
    try:
        told = subprocess.run(
            [path, "--version"], capture_output=True, text=True, timeout=60, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return "", ""
    match = re.search(pattern, told)
    return path, match[1] if match else "unknown"


def read_card() -> dict[str, str]:
    """The card's clocks and modes as `nvidia-smi` shows them, unchanged; empty without it."""
    path = shutil.which("nvidia-smi")
    if path is None:
        return {}
    names = _QUERY.split(",")
    try:
        told = subprocess.run(
            [path, f"--query-gpu={_QUERY}", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return {}
    values = [value.strip() for value in told.splitlines()[0].split(",")] if told.strip() else []
    return dict(zip(names, values, strict=True)) if len(values) == len(names) else {}
