"""Counts every kernel's instructions and writes the data files.

    python -m kernels.instruction_counts.count [target ...]

Needs clang, libclc, ptxas and nvdisasm: see `compile.Toolchain.find`.
"""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import replace
from typing import Any

from kernels import program
from kernels.access import Access
from kernels.instruction_counts.compile import TOOLCHAIN, Toolchain
from kernels.instruction_counts.data import TARGETS, data_file, split_target
from kernels.instruction_counts.flow import Flow, Way
from kernels.instruction_counts.machine import CountError, MachineCode
from kernels.instruction_counts.segments import Segment, Walk, to_text
from kernels.instruction_counts.variants import KERNELS, all_variants, macros_of
from kernels.launches import PASSES
from kernels.method import PLANES, Method
from kernels.passes import estimate

#: The kernel's name of a texture where it differs, by kernel and texture; "" = every kernel's.
_ARGUMENT = {
    ("", "setup"): "setup_texture",
    ("update", "history_1"): "old_history",
    ("update", "history_0"): "history",
    ("update", "covariance_1"): "old_covariance",
    ("update", "covariance_0"): "covariance",
    ("update", "past_counts_1"): "old_past_counts",
    ("update", "past_counts_0"): "past_counts",
    ("estimate", "history_1"): "history",
    ("estimate", "past_counts_1"): "past_counts",
    ("estimate", "pilot"): "history",
    ("pilot", "pilot"): "scattered",
    ("sampling", "history_0"): "history",
    ("combine", "resolved"): "scattered",
    ("overlay", "overlay"): "overlay_texture",
    ("taa", "taa_1"): "old_taa",
    ("taa", "taa_0"): "new_taa",
}


def argument_offsets(text: str, kernel: str) -> dict[int, str]:
    """The pointer arguments of a kernel by byte offset, from its declaration."""
    text = re.sub(r"\\\n", " ", re.sub(r"//[^\n]*", "", text))
    shared = re.search(r"#define WARP_ARGS (.*)", text)
    function = program.FUNCTIONS.get(kernel, kernel)
    declared = re.search(rf"(?:PASS_KERNEL|void)\s+{function}\s*\((.*?)\)\s*\{{", text, re.S)
    if not shared or not declared:
        raise CountError(f"{kernel}: its declaration is not found")
    arguments = declared[1].replace("WARP_ARGS", shared[1]).replace("TRACE_ARGS", "")
    offset, found = 0, {}
    for argument in arguments.split(","):
        size = 8 if "*" in argument else 4
        offset = -(-offset // size) * size
        if size == 8:
            found[offset] = argument.replace("*", " ").split()[-1]
        offset += size
    return found


def count_kernel(
    code: MachineCode, text: str, kernel: str, accesses: tuple[Access, ...]
) -> dict[str, Any]:
    """A variant's entry in the data file, see `data.Counts`.

    Raises:
        CountError: the code lacks an access, or is not understood.
    """
    flow, arguments = Flow(code), argument_offsets(text, kernel)
    way = flow.longest_way()
    touching = _touching(flow, way, arguments, {_key(kernel, a) for a in accesses})
    walk = Walk(code, touching)
    before, first = walk.take(way.before)
    loop, turn = walk.take(way.loop)
    steady, _ = walk.take(way.loop)
    after, last = walk.take(way.after)
    inside = [_key(kernel, a) for a in accesses if a.in_loop]
    outside = [_key(kernel, a) for a in accesses if not a.in_loop]
    if sorted(first + last) != sorted(outside) or sorted(turn) != sorted(inside):
        raise CountError(f"accesses {first}, {turn}, {last} are not those of the pass")

    always = [_key(kernel, a) for a in accesses if not (a.in_loop or a.subsurface_only)]
    outside_loop = {i: key for i, key in touching.items() if i not in way.loop}
    short = flow.shortest_way(
        [i for i, key in outside_loop.items() if key in always],
        [i for i, key in outside_loop.items() if key not in always],
    )
    seen = _touching(flow, short, arguments, set(always))
    elsewhere, visited = Walk(code, seen).take(short.before)
    if [key for key in always if "store" in key and key not in visited]:
        raise CountError(f"accesses {visited} where nothing scatters are not those of the pass")
    # A load that the compiler leaves out here comes first: nothing is computed for it.
    elsewhere = [()] * (len(always) - len(visited)) + elsewhere
    entry: dict[str, Any] = {
        "registers_per_thread": code.registers_per_thread,
        "shared_bytes": code.shared_bytes,
        "elsewhere": _texts(elsewhere),
        "before": _texts(before),
    }
    if inside:
        entry |= {"loop": _texts(steady), "after": _texts(after)}
    if loop != steady:
        entry["first_turn"] = _texts(loop)
    return entry


def _touching(flow: Flow, way: Way, arguments: dict[int, str], wanted: set[str]) -> dict[int, str]:
    """The access that each traced load and store on a way belongs to, by instruction."""
    instructions = flow.code.instructions
    found = {i: f"{instructions[i].access} {b}" for i, b in flow.buffers(way, arguments).items()}
    return {i: key for i, key in found.items() if key in wanted}


def _key(kernel: str, access: Access) -> str:
    texture = access.texture
    name = (
        access.argument or _ARGUMENT.get((kernel, texture)) or _ARGUMENT.get(("", texture), texture)
    )
    return f"{access.operation} {access.argument or name}"


def _texts(segments: list[Segment]) -> list[str]:
    return [to_text(segment) for segment in segments]


def accesses_of(kernel: str, method: Method) -> tuple[Access, ...]:
    """All accesses of a kernel, whether a recording holds them or not."""
    if kernel == "estimate":
        return (Access("setup"), *estimate.accesses(replace(method, kind="adaptive"), 0))
    # The recorder traces what the estimate reads as reads of the sampling pass.
    of_estimate = estimate.accesses(method, 0)
    found = PASSES[kernel].accesses(replace(method, planes=PLANES), 0)
    if kernel == "sampling":
        found = tuple(access for access in found if access not in of_estimate)
    return found


def count_target(toolchain: Toolchain, target: str) -> dict[str, Any]:
    """The content of a target's data file.

    Raises:
        CountError: a tool failed, or its output is not understood.
    """
    _, native = split_target(target)
    compiled: dict[tuple[str, tuple[str, ...]], dict[str, MachineCode]] = {}
    kernels: dict[str, dict[str, Any]] = {}
    for kernel, (name, _) in KERNELS.items():
        text = program.source(name, native)
        kernels[kernel] = {}
        for variant, method in all_variants(kernel).items():
            key = name, macros_of(method)
            if key not in compiled:
                compiled[key] = toolchain.compile(text, target, key[1])
            code = compiled[key][program.FUNCTIONS.get(kernel, kernel)]
            try:
                entry = count_kernel(code, text, kernel, accesses_of(kernel, method))
            except CountError as error:
                raise CountError(f"{target}, {kernel} {variant}: {error}") from None
            kernels[kernel][variant] = entry
    return {
        "target": target,
        "compilers": toolchain.versions(target),
        "kernel_source_sha256": program.source_hash(native),
        "kernels": kernels,
    }


def _write(content: dict[str, Any]) -> None:
    """One variant per line."""
    kernels = content.pop("kernels")
    lines = json.dumps(content, indent=1)[:-2] + ',\n "kernels": {\n'
    lines += ",\n".join(
        f'  "{kernel}": {{\n'
        + ",\n".join(f'   "{name}": {json.dumps(entry)}' for name, entry in variants.items())
        + "\n  }"
        for kernel, variants in kernels.items()
    )
    path = data_file(content["target"])
    beside = path.with_suffix(".tmp")
    beside.write_text(lines + "\n }\n}\n")
    os.replace(beside, path)


def main(targets: list[str]) -> int:
    """Count for the named targets, or for all. 2: no tools or unknown target, 1: a tool failed."""
    toolchain = Toolchain.find()
    if toolchain is None:
        print(
            "clang, ptxas, nvdisasm or libclc is missing: put them on the path and in /usr/lib/clc,"
            f" or into a folder that {TOOLCHAIN} names (libclc's .bc files into its folder clc)",
            file=sys.stderr,
        )
        return 2
    for target in targets or TARGETS:
        if target not in TARGETS:
            print(f"target {target!r}: allowed are {', '.join(TARGETS)}", file=sys.stderr)
            return 2
        try:
            _write(count_target(toolchain, target))
        except CountError as error:
            print(error, file=sys.stderr)
            return 1
        print(f"{target}: counted")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
