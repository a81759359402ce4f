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
from kernels.instruction_counts.data import split_target
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
#: What native.cl asks for, as each vendor's compiler makes of the built-in functions of a shader.
#: NVIDIA's unit takes radians.
_NATIVE_PRELUDE = {
    "sm": """
#define UNIT_LOG2 __nvvm_lg2_approx_ftz_f
#define UNIT_EXP2 __nvvm_ex2_approx_ftz_f
#define UNIT_COS(turns) __nvvm_cos_approx_ftz_f((turns) * 0x1.921fb6p+2f)
#define UNIT_SIN(turns) __nvvm_sin_approx_ftz_f((turns) * 0x1.921fb6p+2f)
""",
    "gf": """
#define UNIT_LOG2 __builtin_amdgcn_logf
#define UNIT_EXP2 __builtin_amdgcn_exp2f
#define UNIT_COS __builtin_amdgcn_cosf
#define UNIT_SIN __builtin_amdgcn_sinf
""",
}
_OPTIONS = (
    "-x cl -cl-std=CL1.2 -O3 -w -Xclang -cl-ext=+cl_khr_fp16 -Xclang -finclude-default-header "
    "-Xclang -fdeclare-opencl-builtins"
).split()
_EXACT_OPTIONS = ("-cl-fp32-correctly-rounded-divide-sqrt",)
#: Approximate quotients and roots, products and sums in one instruction, denormals flushed: what
#: shaders get.
_NATIVE_OPTIONS = ("-cl-fast-relaxed-math", "-cl-denorms-are-zero")
#: Clang's options for each instruction set, and libclc's library.
_INSTRUCTION_SETS = {
    "sm_61": ("-target nvptx64--nvidiacl -Xclang -target-cpu -Xclang sm_61", "nvptx64--nvidiacl"),
    "sm_75": ("-target nvptx64--nvidiacl -Xclang -target-cpu -Xclang sm_75", "nvptx64--nvidiacl"),
    "sm_90": ("-target nvptx64--nvidiacl -Xclang -target-cpu -Xclang sm_90", "nvptx64--nvidiacl"),
    "gfx1010": ("-target amdgcn-amd-amdhsa -mcpu=gfx1010 -nogpulib", "gfx1010-amdgcn--"),
    "gfx1030": ("-target amdgcn-amd-amdhsa -mcpu=gfx1030 -nogpulib", "gfx1030-amdgcn--"),
}
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
        instruction_set, _ = split_target(target)
        library = (self.libclc / f"{_INSTRUCTION_SETS[instruction_set][1]}.bc").read_bytes()
        found = {
            "clang": _version(self.clang, r"version (\S+)"),
            "libclc_sha256": hashlib.sha256(library).hexdigest(),
        }
        if target.startswith("sm_"):
            for tool in ("ptxas", "nvdisasm"):
                found[tool] = _version(getattr(self, tool), r"V([\d.]+)")
        return found

    def compile(self, text: str, target: str, macros: Sequence[str] = ()) -> dict[str, MachineCode]:
        """The machine code of every kernel in an OpenCL program. For a native target the text is
        that of `program.source(..., native=True)`.

        Raises:
            CountError: a tool failed, or its output is not understood.
        """
        instruction_set, native = split_target(target)
        options, library = _INSTRUCTION_SETS[instruction_set]
        prelude = _PRELUDE + _NATIVE_PRELUDE[target[:2]] if native else _PRELUDE
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            source, assembly, binary = (folder / f"kernels.{e}" for e in ("cl", "s", "cubin"))
            source.write_text(prelude + text)
            bitcode = str(self.libclc / f"{library}.bc")
            _run(
                self.clang,
                *_OPTIONS,
                *(_NATIVE_OPTIONS if native else _EXACT_OPTIONS),
                *options.split(),
                *("-Xclang", "-mlink-builtin-bitcode", "-Xclang", bitcode),
                *macros,
                *("-S", str(source), "-o", str(assembly)),
            )
            if not target.startswith("sm_"):
                return amd.read_code(assembly.read_text())
            messages = _run(
                self.ptxas,
                *(f"-arch={instruction_set}", "-O3", f"--fmad={str(native).lower()}"),
                *("-v", str(assembly), "-o", str(binary)),
            )
            disassembly = _run(self.nvdisasm, "-hex", str(binary))
            return nvidia.read_code(disassembly, instruction_set, messages)


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
