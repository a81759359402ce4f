"""Reads the machine code of AMD's RDNA GPUs as clang's assembly text.

A vector unit takes a wave32 instruction per cycle; transcendentals and 32-bit products take four.
[RDNA 1.0 and RDNA 2 instruction set architecture; LLVM's scheduling model of GFX10] The scalar unit
works beside it: its instructions count as "control", so that they take issue slots and no vector
unit. Loads answer in order, and `s_waitcnt vmcnt(n)` waits until n are pending.
"""

from __future__ import annotations

import re

from kernels.instruction_counts.machine import MEMORY, CountError, MachineCode, MachineInstruction

_QUARTER_RATE = re.compile(
    r"v_(rcp|rsq|sqrt|exp|log|sin|cos)_|v_mul_(lo|hi)_[iu]32|v_mad_[iu]64_|v_\w+_f64"
)
_FP32 = re.compile(r"v_\w*(f32|f16)")
_REGISTER = re.compile(r"\b([vs])(?:(\d+)|\[(\d+):(\d+)\])")
#: Those whose second operand is a carry that they write.
_CARRIES = re.compile(r"v_(mad_[iu]64|div_scale|(add|sub|subrev)_co)_")
_FIELD = re.compile(r"vmcnt\((\d+)\)")
#: User registers that come before the address of the arguments, and their number.
_BEFORE_ARGUMENTS = {
    "amdhsa_user_sgpr_private_segment_buffer": 4,
    "amdhsa_user_sgpr_dispatch_ptr": 2,
    "amdhsa_user_sgpr_queue_ptr": 2,
}


def read_code(assembly: str) -> dict[str, MachineCode]:
    """The kernels of an assembly file, by name.

    Raises:
        CountError: an instruction that is not one of the vector, scalar or memory units'.
    """
    found = {}
    for name in re.findall(r"^\s*\.amdhsa_kernel (\w+)", assembly, flags=re.M):
        body = assembly.split(f"\n{name}:", 1)[1].split(".Lfunc_end", 1)[0]
        header = assembly.split(f".amdhsa_kernel {name}\n", 1)[1].split(".end_amdhsa_kernel", 1)[0]
        fields = {k: int(v) for k, v in re.findall(r"\.(amdhsa_\w+) (\d+)\s", header)}
        found[name] = _read_kernel(name, body, fields)
    return found


def _read_kernel(name: str, body: str, fields: dict[str, int]) -> MachineCode:
    instructions: list[MachineInstruction] = []
    labels: dict[str, int] = {}
    for line in body.splitlines()[1:]:
        text = line.split(";")[0].strip()
        if match := re.fullmatch(r"(\.?\w+):", text):
            labels[match[1]] = len(instructions)
        elif text and not text.startswith("."):
            instructions.append(_decode(text))
    first = sum(count * fields[field] for field, count in _BEFORE_ARGUMENTS.items())
    return MachineCode(
        name,
        tuple(instructions),
        labels,
        fields["amdhsa_next_free_vgpr"],
        fields["amdhsa_group_segment_fixed_size"],
        (f"s{first}", f"s{first + 1}"),
    )


def _kind(opcode: str) -> str:
    if opcode.startswith(("global_", "flat_", "scratch_", "buffer_", "ds_", "image_")):
        return MEMORY
    if opcode.startswith("s_waitcnt"):
        return ""
    if opcode.startswith("s_"):
        return "control"
    if not opcode.startswith("v_"):
        raise CountError(f"amdgcn: unknown instruction {opcode}")
    if _QUARTER_RATE.match(opcode):
        return "sfu"
    return "fp32" if _FP32.match(opcode) else "int"


def _registers(text: str) -> tuple[str, ...]:
    found = []
    for file, single, first, last in _REGISTER.findall(text):
        numbers = (int(single),) if single else range(int(first), int(last) + 1)
        found += [f"{file}{number}" for number in numbers]
    return tuple(found)


def _decode(text: str) -> MachineInstruction:
    opcode, _, rest = text.partition(" ")
    operands = [part.strip() for part in rest.split(",")]
    kind = _kind(opcode)
    is_store = kind == MEMORY and "_store" in opcode
    is_load = kind == MEMORY and "_load" in opcode
    # The others write a mask, which may stand in a scalar register.
    compares = re.match(r"v_cmpx|s_cmp|s_bitcmp", opcode)
    writes_nothing = is_store or compares or opcode.startswith(("s_cbranch", "s_branch"))
    written = () if writes_nothing else _registers(operands[0])
    num_written = bool(written) + bool(_CARRIES.match(opcode))
    arguments: tuple[tuple[str, int], ...] = ()
    if opcode.startswith("s_load_"):
        offset = int(operands[2], 0)
        arguments = tuple((register, offset + 4 * k) for k, register in enumerate(written))
    if opcode.startswith("v_mad_u64"):
        # The result's low word has nothing of the addend's high one, which may be left over.
        operands[-1] = (*_registers(operands[-1]), operands[-1])[0]
    limit = _FIELD.search(rest) if opcode == "s_waitcnt" else None
    target = operands[0] if opcode.startswith(("s_cbranch", "s_branch")) else ""
    address: list[str] = (
        operands[1:] if is_load else operands[:1] + operands[2:] if is_store else []
    )
    return MachineInstruction(
        text=text,
        kind=kind,
        writes=written,
        reads=_registers(", ".join(operands[num_written:])),
        access="load" if is_load else "store" if is_store else "",
        address=_registers(", ".join(address)),
        arguments=arguments,
        barrier=0 if is_load else -1,
        waits=((0, int(limit[1])),) if limit else (),
        target=target,
        falls_through=opcode not in ("s_branch", "s_endpgm", "s_setpc_b64"),
        is_call=opcode.startswith("s_swappc"),
        is_exit=opcode == "s_endpgm",
    )
