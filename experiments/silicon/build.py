"""PTX of the CUDA sources: made by `nvcc` for the GPU at hand, or the committed one; and kernels
under names of their own, by which the profiler's rows are told apart.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import tempfile
from collections.abc import Iterable
from importlib import resources
from pathlib import Path

from traces.errors import WorkError

#: The two sources, without their suffix.
SOURCES = ("micro", "passes")
#: What both ways of compiling ask for: no contraction, so that sums and products round as OpenCL's;
#: relocatable code, so that the driver finds the variable in constant memory by its name.
OPTIONS = ("-fmad=false", "-rdc=true", "-std=c++17")
#: The committed PTX is for this and every later GPU.
COMMITTED_TARGET = "compute_60"
_HASH_LINE = re.compile(r"^// sources sha256: ([0-9a-f]{64})$", re.MULTILINE)
_ENTRY = re.compile(r"^\.visible \.entry (\w+)\(", re.MULTILINE)


def folder() -> Path:
    """Where the CUDA sources stand."""
    return Path(str(resources.files("experiments.silicon"))) / "cuda"


def source_hash(name: str) -> str:
    """SHA-256 over a source and all headers."""
    digest = hashlib.sha256()
    for path in (folder() / f"{name}.cu", *sorted(folder().glob("*.h"))):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def stamp(name: str, ptx: str) -> str:
    """PTX with the hash of its sources on top, as it is committed."""
    command = " ".join(("nvcc -ptx", f"-arch={COMMITTED_TARGET}", *OPTIONS))
    return f"// sources sha256: {source_hash(name)}\n// {command} {name}.cu\n{ptx}"


def committed_ptx(name: str) -> str:
    """The committed PTX.

    Raises:
        WorkError: it was made from other sources.
    """
    path = folder() / f"{name}.ptx"
    ptx = path.read_text(encoding="utf-8")
    match = _HASH_LINE.search(ptx)
    if match is None or match[1] != source_hash(name):
        raise WorkError(f"{path.name}: made from other sources than {name}.cu and its headers")
    return ptx


def compile_ptx(nvcc: str, name: str, target: str) -> str:
    """PTX by `nvcc`. target: as "compute_90".

    Raises:
        WorkError: it does not compile, or nvcc does not run.
    """
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / f"{name}.ptx"
        command = [nvcc, "-ptx", f"-arch={target}", *OPTIONS, "-o", str(path), f"{name}.cu"]
        try:
            done = subprocess.run(
                command, cwd=folder(), capture_output=True, text=True, timeout=180, check=False
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise WorkError(f"nvcc: {error}") from error
        if done.returncode or not path.is_file():
            told = " ".join((done.stderr or done.stdout).split())[:400]
            raise WorkError(f"nvcc does not compile {name}.cu: {told}")
        return path.read_text(encoding="utf-8")


def kernel_names(ptx: str) -> list[str]:
    """The kernels of a PTX text."""
    return _ENTRY.findall(ptx)


def prefix_kernels(ptx: str, prefix: str) -> str:
    """The same PTX, each kernel K named `prefix__K`."""
    return _ENTRY.sub(rf".visible .entry {prefix}__\1(", ptx)


def copy_kernel(ptx: str, kernel: str, prefixes: Iterable[str]) -> str:
    """PTX that holds copies of one kernel, named `prefix__kernel`, and the constants.

    Raises:
        WorkError: there is no such kernel.
    """
    starts = [match.start() for match in _ENTRY.finditer(ptx)]
    for start in starts:
        match = _ENTRY.match(ptx, start)
        if match is None or match[1] != kernel:
            continue
        body = ptx[start : ptx.index("\n}", start) + 2]
        version = re.search(
            r"^\.version .*$\n^\.target .*$\n^\.address_size .*$", ptx, re.MULTILINE
        )
        if version is None:
            break
        constants = re.findall(r"^\.visible \.const .*;$", ptx, re.MULTILINE)
        copies = [prefix_kernels(body, prefix) for prefix in prefixes]
        return "\n\n".join((version[0], *constants, *copies)) + "\n"
    raise WorkError(f"the PTX holds no kernel {kernel!r}")
