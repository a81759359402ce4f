"""Compiles the kernels' text for a GPU and reads the machine code.

NVIDIA: clang's nvptx64 target with libclc, then `ptxas`, then `nvdisasm`. AMD: clang's amdgcn
target with libclc, read from its assembly text.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kernels.instruction_counts import amd, nvidia
from kernels.instruction_counts.machine import CountError, MachineCode

#: libclc converts to and from half precision with integer instructions; every GPU here, and so its
#: vendor's OpenCL, has an instruction for it. Texels are read and written whole.
_PRELUDE = """
#pragma OPENCL EXTENSION cl_khr_fp16 : enable
typedef half half_texel __attribute__((ext_vector_type(4)));
float4 load_texel(size_t index, __global const half *memory)
{
    const half_texel texel = ((__global const half_texel *)memory)[index];
    return (float4)(texel.x, texel.y, texel.z, texel.w);
}
void store_texel(float4 value, size_t index, __global half *memory)
{
    ((__global half_texel *)memory)[index] =
        (half_texel)((half)value.x, (half)value.y, (half)value.z, (half)value.w);
}
#define vload_half4 load_texel
#define vstore_half4_rte store_texel
"""
_OPTIONS = (
    "-x cl -cl-std=CL1.2 -O3 -w -Xclang -cl-ext=+cl_khr_fp16 -Xclang -finclude-default-header "
    "-Xclang -fdeclare-opencl-builtins -cl-fp32-correctly-rounded-divide-sqrt"
).split()
#: Clang's options for each target, and libclc's library.
_TARGETS = {
    "sm_61": ("-target nvptx64--nvidiacl -Xclang -target-cpu -Xclang sm_61", "nvptx64--nvidiacl"),
    "sm_75": ("-target nvptx64--nvidiacl -Xclang -target-cpu -Xclang sm_75", "nvptx64--nvidiacl"),
    "sm_90": ("-target nvptx64--nvidiacl -Xclang -target-cpu -Xclang sm_90", "nvptx64--nvidiacl"),
    "gfx1010": ("-target amdgcn-amd-amdhsa -mcpu=gfx1010 -nogpulib", "gfx1010-amdgcn--"),
    "gfx1030": ("-target amdgcn-amd-amdhsa -mcpu=gfx1030 -nogpulib", "gfx1030-amdgcn--"),
}
TARGETS = tuple(_TARGETS)
#: The environment variable that names a folder with the tools.
TOOLCHAIN = "CACHESIM_TOOLCHAIN"


@dataclass(frozen=True)
class Toolchain:
    """Paths of the compilers. libclc: the folder of its .bc files."""

    clang: str
    ptxas: str
    nvdisasm: str
    libclc: Path

    @staticmethod
    def find() -> Toolchain | None:
        """The tools in the folder that `TOOLCHAIN` names (clang, ptxas, nvdisasm, and clc with the
        .bc files), else those on the path; None where one is missing.
        """
        folder = os.environ.get(TOOLCHAIN)
        tools = [shutil.which(name, path=folder) for name in ("clang", "ptxas", "nvdisasm")]
        libclc = Path(folder) / "clc" if folder else Path("/usr/lib/clc")
        if not all(tools) or not libclc.is_dir():
            return None
        clang, ptxas, nvdisasm = (tool or "" for tool in tools)
        return Toolchain(clang, ptxas, nvdisasm, libclc)

    def versions(self, target: str) -> dict[str, str]:
        """The version of each tool that takes part."""
        library = (self.libclc / f"{_TARGETS[target][1]}.bc").read_bytes()
        found = {
            "clang": _version(self.clang, r"version (\S+)"),
            "libclc_sha256": hashlib.sha256(library).hexdigest(),
        }
        if target.startswith("sm_"):
            for tool in ("ptxas", "nvdisasm"):
                found[tool] = _version(getattr(self, tool), r"V([\d.]+)")
        return found

    def compile(self, text: str, target: str, macros: Sequence[str] = ()) -> dict[str, MachineCode]:
        """The machine code of every kernel in an OpenCL program.

        Raises:
            CountError: a tool failed, or its output is not understood.
        """
        options, library = _TARGETS[target]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            source, assembly, binary = (folder / f"kernels.{e}" for e in ("cl", "s", "cubin"))
            source.write_text(_PRELUDE + text)
            bitcode = str(self.libclc / f"{library}.bc")
            _run(
                self.clang,
                *_OPTIONS,
                *options.split(),
                *("-Xclang", "-mlink-builtin-bitcode", "-Xclang", bitcode),
                *macros,
                *("-S", str(source), "-o", str(assembly)),
            )
            if not target.startswith("sm_"):
                return amd.read_code(assembly.read_text())
            messages = _run(
                self.ptxas,
                *(f"-arch={target}", "-O3", "--fmad=false", "-v", str(assembly)),
                *("-o", str(binary)),
            )
            disassembly = _run(self.nvdisasm, "-hex", str(binary))
            return nvidia.read_code(disassembly, target, messages)


def _run(*command: str) -> str:
    """What a tool prints.

    Raises:
        CountError: it failed.
    """
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        last = (result.stderr or result.stdout).strip().splitlines()[:1]
        raise CountError(f"{Path(command[0]).name} failed: {' '.join(last)}")
    return result.stdout + result.stderr


def _version(tool: str, pattern: str) -> str:
    match = re.search(pattern, _run(tool, "--version"))
    return match[1] if match else "unknown"
