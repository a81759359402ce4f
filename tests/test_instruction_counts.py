"""Counts of the kernels' machine code: the committed data, where they go, and a recount."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from kernels import program
from kernels.grid import Grid
from kernels.instruction_counts.compile import Toolchain
from kernels.instruction_counts.count import accesses_of, count_kernel
from kernels.instruction_counts.data import INSTRUCTION_SETS, TARGETS, counts_of, read, split_target
from kernels.instruction_counts.machine import CHARGED_KINDS
from kernels.instruction_counts.segments import total
from kernels.instruction_counts.variants import KERNELS, all_variants, macros_of
from kernels.launches import PASSES, list_steps
from kernels.method import PLANES, Method
from kernels.record import record
from kernels.resources import TEXTURE_NAMES
from kernels.selfcheck import small_gbuffer
from traces.errors import InputError
from traces.trace import WAIT

# The data.


@pytest.mark.parametrize("target", TARGETS)
def test_every_kernel_and_variant_is_counted(target):
    content = read(target)
    assert content["target"] == target
    assert set(content["kernels"]) == set(KERNELS) >= set(PASSES)
    for kernel in KERNELS:
        assert set(content["kernels"][kernel]) == set(all_variants(kernel))
    assert {"clang", "libclc_sha256"} <= set(content["compilers"])
    assert ("ptxas" in content["compilers"]) == target.startswith("sm_")


@pytest.mark.parametrize("target", TARGETS)
def test_the_counts_are_those_of_the_present_kernels(target):
    """After a change of a .cl file: python -m kernels.instruction_counts.count."""
    _, native = split_target(target)
    assert read(target)["kernel_source_sha256"] == program.source_hash(native)


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_native_arithmetic_takes_fewer_instructions_but_more_of_the_special_function_units(
    instruction_set,
):
    for method in (Method(), Method(inverse_cdf="exact"), Method(kind="adaptive")):
        exact, native = (
            total(counts_of("sampling", method, target).loop)
            for target in (instruction_set, f"{instruction_set}-native")
        )
        assert sum(native.values()) < 0.7 * sum(exact.values())
        assert native["sfu"] > exact["sfu"]


@pytest.mark.parametrize("target", TARGETS)
def test_every_segment_holds_known_kinds_and_positive_counts(target):
    for kernel in KERNELS:
        for method in all_variants(kernel).values():
            counts = counts_of(kernel, method, target)
            accesses = accesses_of(kernel, method)
            outside = [a for a in accesses if not a.in_loop]
            in_loop = len(accesses) - len(outside)
            num_always = sum(not a.subsurface_only for a in outside)
            # The reduction over a tile: 16 bytes a thread; the patch: colour, normal and id.
            has_patch = kernel == "sampling" and method.lds
            texel_bytes = 8 + 4 * method.normal_weights + 1
            shared_bytes = 64 * 16 if kernel == "classify" else 100 * texel_bytes * has_patch
            assert counts.shared_bytes == shared_bytes
            assert 0 < counts.registers_per_thread <= 255
            assert len(counts.elsewhere) == num_always + 1
            assert len(counts.before) + max(0, len(counts.after) - 1) == len(outside) + 1
            assert len(counts.loop) == len(counts.first_turn) == (in_loop and in_loop + 1)
            parts = dataclasses.astuple(counts)[2:]
            for kind, count in (pair for part in parts for segment in part for pair in segment):
                assert (kind in CHARGED_KINDS and count > 0) or (kind == WAIT and count >= 0)


@pytest.mark.parametrize("target", TARGETS)
def test_the_turns_of_the_loop_differ_in_waits_alone(target):
    for method in all_variants("sampling").values():
        counts = counts_of("sampling", method, target)
        assert total(counts.first_turn) == total(counts.loop)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(
    "more", [{"inverse_cdf": "exact"}, {"mip_rule": "textbook"}, {"bilateral": True}]
)
def test_a_sample_costs_more_with_more_to_compute(target, more):
    less = Method(bilateral=False)
    least, most = (
        sum(total(counts_of("sampling", m, target).loop).values())
        for m in (less, dataclasses.replace(less, **more))
    )
    assert most > least


@pytest.mark.parametrize("target", TARGETS)
def test_a_warp_without_subsurface_executes_less(target):
    method = Method(kind="adaptive")
    for kernel in ("setup", "combine", "update", "sampling"):
        counts = counts_of(kernel, method, target)
        least = sum(total(counts.elsewhere).values())
        most = sum(total((*counts.before, *counts.first_turn, *counts.after)).values())
        # The compiler may have turned the short passes' conditions into predicates.
        assert least <= most if kernel in ("setup", "combine") else 3 * least < 2 * most


def test_an_unknown_target_is_an_input_error():
    with pytest.raises(InputError, match="sm_61"):
        counts_of("setup", Method(), "sm_16")


# Where they go.


def programs_of(method, target):
    grid = Grid(64, 64, method.tile_order, method.lane_map)
    return [step.program(method, 1, 5, target) for step in list_steps(method, grid, 3)]


def executed(passes_program, state):
    """The arithmetic that a warp with a state issues, in order."""
    states = np.array([state], np.int32)
    rows = passes_program.row_instructions(states, passes_program.row_offsets(states))
    instructions = passes_program.instructions(TEXTURE_NAMES)
    found = [instructions[row - 5].arithmetic for row in rows.tolist()]
    return [*found, passes_program.trailing_arithmetic]


def total_of(*parts):
    return total([segment for part in parts for segment in part])


@pytest.mark.parametrize("planes", [PLANES, ("colour",), ("profile_id", "normal")])
@pytest.mark.parametrize("target", ["sm_61", "gfx1030"])
@pytest.mark.parametrize("kind", ["fixed", "adaptive"])
def test_a_warp_executes_every_counted_instruction_once(kind, target, planes):
    method = Method(kind=kind, planes=planes)
    for passes_program in programs_of(method, target):
        name = passes_program.pass_name
        counts = counts_of(name, method, target)
        assert total(executed(passes_program, 0)) == total(counts.elsewhere)
        if name == "prefilter":
            continue
        num_turns = 7 if name == "sampling" else 1
        parts = [counts.before, counts.first_turn, *[counts.loop] * (num_turns - 1), counts.after]
        if name == "sampling" and method.adaptive:
            # What finds the pixel and its depth stands in both kernels.
            parts.append(counts_of("estimate", method, target).before[1:])
        assert total(executed(passes_program, num_turns)) == total_of(*parts)


def test_waits_count_the_recorded_loads_alone():
    for kind in ("fixed", "adaptive"):
        method = Method(kind=kind, planes=("colour",))
        for passes_program in programs_of(method, "gfx1010"):
            num_loads = 0
            states = np.array([5], np.int32)
            rows = passes_program.row_instructions(states, passes_program.row_offsets(states))
            instructions = passes_program.instructions(TEXTURE_NAMES)
            for row in rows.tolist():
                instruction = instructions[row - 5]
                for name, count in instruction.arithmetic:
                    assert name != WAIT or count <= num_loads
                num_loads += instruction.operation == "load"


def test_a_pass_waits_for_its_loads_before_it_stores():
    for target in TARGETS:
        for passes_program in programs_of(Method(), target):
            arithmetic = executed(passes_program, 3)
            assert (WAIT, 0) in [pair for segment in arithmetic for pair in segment]


@pytest.mark.opencl
def test_a_recording_carries_registers_and_the_compilers(device):
    method = Method(num_samples=4)
    for target in ("sm_61", "gfx1030"):
        trace = record(
            small_gbuffer(16, 16),
            method,
            device=device,
            self_check=False,
            instruction_target=target,
        )
        assert trace.manifest["instruction_counts"]["target"] == target
        for launch in trace.launches:
            counts = counts_of(launch.pass_name, method, target)
            assert launch.registers_per_thread == counts.registers_per_thread
            assert launch.trailing_arithmetic
        used = {int(i) for chunk in trace.chunks() for i in chunk.instruction}
        assert used <= set(range(len(trace.instructions)))


# With the tools.


@pytest.fixture(scope="module")
def toolchain():
    found = Toolchain.find()
    if found is None:
        pytest.skip("clang, libclc, ptxas or nvdisasm is missing")
    return found


@pytest.mark.parametrize("target", TARGETS)
def test_a_recount_gives_the_committed_counts(toolchain, target):
    content = read(target)
    if toolchain.versions(target) != content["compilers"]:
        pytest.skip(f"other compilers than the committed ones: {toolchain.versions(target)}")
    method = Method()
    _, native = split_target(target)
    for kernel in ("setup", "sampling"):
        text = program.source(KERNELS[kernel][0], native)
        compiled = toolchain.compile(text, target, macros_of(method))[kernel]
        (name,) = [n for n, m in all_variants(kernel).items() if macros_of(m) == macros_of(method)]
        entry = count_kernel(compiled, text, kernel, accesses_of(kernel, method))
        assert entry == content["kernels"][kernel][name]


def test_a_sample_is_what_stands_between_label_and_branch_back(toolchain):
    """The same count from the assembly text, without blocks and ways."""
    method = Method(normal_weights=False)
    text = program.source("sampling")
    compiled = toolchain.compile(text, "gfx1030", macros_of(method))["sampling"]
    lines = [instruction.text for instruction in compiled.instructions]
    (end,) = [
        i
        for i, instruction in enumerate(compiled.instructions)
        if instruction.target and compiled.labels[instruction.target] <= i
    ]
    body = lines[compiled.labels[compiled.instructions[end].target] : end + 1]
    issued = [line for line in body if not re.match(r"s_waitcnt|global_|buffer_", line)]
    assert sum(total(counts_of("sampling", method, "gfx1030").loop).values()) == len(issued)
