"""How machine code is read and counted: the two instruction sets, ways, buffers, waits."""

from __future__ import annotations

import pytest

from kernels import program
from kernels.instruction_counts import amd, nvidia
from kernels.instruction_counts.count import argument_offsets
from kernels.instruction_counts.flow import Flow
from kernels.instruction_counts.machine import CountError, MachineCode, MachineInstruction
from kernels.instruction_counts.segments import Walk, from_text, join, to_text, total
from traces.trace import WAIT


def test_segments_join_between_waits():
    joined = join((("int", 2), (WAIT, 3)), (), ((WAIT, 1), ("int", 1)), (("fp32", 1), ("int", 4)))
    assert joined == (("int", 2), (WAIT, 1), ("int", 5), ("fp32", 1))
    assert from_text(to_text(joined)) == joined
    assert total([joined]) == {"int": 7, "fp32": 1, "sfu": 0, "control": 0}


def op(kind="int", **fields):
    return MachineInstruction(kind, kind, **fields)


def code(*instructions, **labels):
    return MachineCode("kernel", instructions, labels, 32, 0)


END = op("control", falls_through=False, is_exit=True)


def branch(target, conditional=True):
    return op("control", target=target, falls_through=conditional)


def test_the_ways_of_the_two_kinds_of_warps():
    """0 branches over 1, 2; 4 calls a slow path; 6 turns back to 3; 7 stores."""
    kernel = code(
        branch("join"),
        op("memory", access="load"),
        op(),
        op(),
        branch("fast"),
        op("control", is_call=True),
        branch("loop"),
        op("memory", access="store"),
        END,
        join=7,
        loop=3,
        fast=6,
    )
    flow = Flow(kernel)
    way = flow.longest_way()
    assert (way.before, way.loop, way.after) == ((0, 1, 2), (3, 4, 6), (7, 8))
    assert flow.shortest_way([7], [1]).before == (0, 7, 8)
    # A load behind those to be avoided is left out.
    assert flow.shortest_way([2, 7], [1]).before == (0, 7, 8)


def test_of_two_alternatives_the_longer_and_of_two_loops_none():
    two = code(branch("b"), op(), branch("end", False), op(), op(), op(), END, b=3, end=6)
    assert Flow(two).longest_way().before == (0, 3, 4, 5, 6)
    loops = code(op(), branch("a"), op(), branch("b"), END, a=0, b=2)
    with pytest.raises(CountError, match="loop"):
        Flow(loops)


def test_buffers_are_found_through_the_registers():
    kernel = code(
        op(writes=("R2",), reads=("R0",), arguments=(("", 16),)),
        op(writes=("R4",), arguments=(("", 24),)),
        op("memory", writes=("R2",), access="load", address=("R2", "R3")),
        op(writes=("R5",), reads=("R2", "R4")),
        op("memory", access="store", address=("R5",)),
        END,
    )
    flow = Flow(kernel)
    names = {16: "source", 24: "target"}
    assert flow.buffers(flow.longest_way(), names) == {2: "source", 4: "target"}
    mixed = code(
        op(writes=("R2",), arguments=(("", 16), ("", 24))),
        op("memory", access="load", address=("R2",)),
        END,
    )
    flow = Flow(mixed)
    with pytest.raises(CountError, match="source"):
        flow.buffers(flow.longest_way(), names)


def test_waits_are_for_the_loads_behind_a_counter():
    load = {"kind": "memory", "access": "load"}
    kernel = code(
        op(**load, barrier=0),
        op(),
        op(**load, barrier=1),
        op(**load, barrier=1),
        op("fp32", waits=((0, 0),)),
        op("sfu", barrier=2),
        op(waits=((2, 0),)),
        op(waits=((1, 1),)),
        op(waits=((1, 0),)),
        op(waits=((1, 0),)),
    )
    walk = Walk(kernel, {0: "a", 2: "b", 3: "c"})
    segments, accesses = walk.take(range(10))
    assert accesses == ["a", "b", "c"]
    assert segments[:3] == [(), (("int", 1),), ()]
    assert segments[3] == (
        *((WAIT, 2), ("fp32", 1), ("sfu", 1), ("int", 1)),
        *((WAIT, 1), ("int", 1), (WAIT, 0), ("int", 2)),
    )


def test_an_access_in_parts_stands_at_the_first():
    kernel = code(
        op("memory", access="load", barrier=0),
        op(),
        op("memory", access="load", barrier=0),
        op("fp32", waits=((0, 0),)),
    )
    segments, accesses = Walk(kernel, {0: "a", 2: "a"}).take(range(4))
    assert accesses == ["a"]
    assert segments == [(), (("int", 1), (WAIT, 0), ("fp32", 1))]


def test_arguments_stand_at_their_natural_alignment():
    assert argument_offsets(program.source("other"), "prefilter") == {
        8: "warp_steps",
        16: "tiles",
        24: "lane_xy",
        40: "setup_texture",
    }
    sampling = argument_offsets(program.source("sampling"), "sampling")
    assert list(sampling.values())[3:] == [
        *("setup_texture", "normal", "profile_id", "counts", "velocity", "scattered", "ratio"),
        *("history", "patch_setup", "patch_normal", "patch_id"),
        *("rest_setup", "rest_normal", "rest_id"),
    ]


# Barrier 5 is set by the load (bits 5 to 7 of its 21), and waited for by the add (bit 16).
PASCAL = """
.text.kernel:
                                        /* {control:#018x} */
 /*0008*/       { IADD R2.CC, R0.reuse, c[0x0][0x148] ;   /* 0x0000000000000001 */
 /*0010*/   @!P0 LDG.E.64 R4, [R2+0x8]        }
                                        /* 0x0000000000000002 */
 /*0018*/       F2F.F32.F16 R6, R4.H1 ;  /* 0x0000000000000003 */
.L_x_1:
                                        /* 0x0000000000000000 */
 /*0028*/   @P0 SYNC (*"BRANCH_TARGETS .L_x_1"*) ; /* 0x0000000000000004 */
 /*0030*/       EXIT ;                   /* 0x0000000000000005 */
 /*0038*/       NOP ;                    /* 0x0000000000000006 */
$slow_path:
 /*0048*/       RET ;                    /* 0x0000000000000007 */
"""
PTXAS = "Compiling entry function 'kernel' for 'sm_61'\nUsed 40 registers, 96 bytes smem\n"


def test_pascal_code_is_read_with_its_control_words():
    control = 7 << 5 | (5 << 5) << 21 | (7 << 5 | 1 << 16) << 42
    text = PASCAL.replace("{control:#018x}", f"{control:#018x}")
    kernel = nvidia.read_code(text, "sm_61", PTXAS)["kernel"]
    assert (kernel.registers_per_thread, kernel.shared_bytes) == (40, 96)
    add, load, convert, sync, leave, _ = kernel.instructions
    assert (add.kind, add.writes, add.reads, add.arguments) == ("int", ("R2",), ("R0",), (("", 8),))
    assert (load.access, load.address, load.writes) == ("load", ("R2",), ("R4", "R5"))
    assert (add.barrier, load.barrier, convert.barrier) == (-1, 5, -1)
    assert (add.waits, load.waits, convert.waits) == ((), (), ((5, 0),))
    assert convert.kind == "sfu" and convert.reads == ("R4",)
    assert kernel.labels[sync.target] == 3 and sync.falls_through
    assert leave.is_exit and not leave.falls_through


def test_turing_code_is_read_with_its_control_bits():
    control = (2 << 5 | 0b000110 << 11) << 41
    text = (
        ".text.kernel:\n /*0000*/ LDG.E.SYS R0, [R2.64+UR8] ; /* 0x0000000000000001 */\n"
        f"  /* {control:#018x} */\n"
    )
    (load,) = nvidia.read_code(text, "sm_75", PTXAS)["kernel"].instructions
    assert (load.barrier, load.waits) == (2, ((1, 0), (2, 0)))
    assert load.address == ("R2", "UR8")


def test_an_unknown_opcode_is_an_error():
    word = "/* 0x0000000000000000 */"
    text = f".text.kernel:\n /*0000*/ FROB R0, R1 ; {word}\n{word}\n"
    with pytest.raises(CountError, match="FROB"):
        nvidia.read_code(text, "sm_75", PTXAS)


RDNA = """
kernel: ; @kernel
; %bb.0:
\ts_load_dwordx4 s[0:3], s[4:5], 0x8
\tv_mad_u64_u32 v[0:1], s1, v2, s8, v[0:1]
\tv_rcp_f32_e32 v4, v3
\ts_waitcnt vmcnt(1) lgkmcnt(0)
.LBB0_1:
\tglobal_load_dwordx2 v[4:5], v[0:1], s[2:3] offset:8
\tv_fma_f32 v7, -v3, v5, v6
\ts_cbranch_scc1 .LBB0_1
\tglobal_store_dword v[8:9], v7, off
\ts_endpgm
.Lfunc_end0:
\t.amdhsa_kernel kernel
\t\t.amdhsa_group_segment_fixed_size 64
\t\t.amdhsa_user_sgpr_private_segment_buffer 1
\t\t.amdhsa_user_sgpr_dispatch_ptr 0
\t\t.amdhsa_user_sgpr_queue_ptr 0
\t\t.amdhsa_next_free_vgpr 24
\t.end_amdhsa_kernel
"""


def test_rdna_code_is_read():
    kernel = amd.read_code(RDNA)["kernel"]
    assert (kernel.registers_per_thread, kernel.shared_bytes) == (24, 64)
    assert kernel.argument_registers == ("s4", "s5")
    kinds = [instruction.kind for instruction in kernel.instructions]
    assert kinds == ["control", "sfu", "sfu", "", "memory", "fp32", "control", "memory", "control"]
    argument, product, _, wait, load, _, branch_back, store, _ = kernel.instructions
    assert argument.arguments == (("s0", 8), ("s1", 12), ("s2", 16), ("s3", 20))
    # s1 takes the carry; of the addend only the low word decides the low word of the address.
    assert product.reads == ("v2", "s8", "v0")
    assert wait.waits == ((0, 1),)
    assert load.address == ("v0", "v1", "s2", "s3") and load.barrier == 0
    assert kernel.labels[branch_back.target] == 4
    assert store.access == "store" and store.address == ("v8", "v9")
