"""Reads the machine code of NVIDIA GPUs as `nvdisasm -hex` prints it.

Where a result of variable latency is waited for stands in control bits beside the instructions: per
instruction 21 bits, of which 5 to 7 name the barrier that its result sets, 11 to 16 the barriers
that it waits for. Maxwell and Pascal keep those of three instructions in a word before them, Volta
and later at bit 105 of the instruction. [Jia18: Dissecting the NVIDIA Volta GPU architecture via
microbenchmarking, section 2]
"""

from __future__ import annotations

import re

from kernels.instruction_counts.machine import MEMORY, CountError, MachineCode, MachineInstruction

#: Where a kernel's arguments begin in constant bank 0.
ARGUMENT_BASE = {"sm_61": 0x140, "sm_75": 0x160, "sm_90": 0x210}

_KINDS = {
    # A conversion to or from half precision is one of the fp16 pipe's from Volta on.
    "fp32": "FADD FMUL FFMA FMNMX FSEL FSET FSETP FCMP FCHK FADD32I FMUL32I FFMA32I FSWZADD HADD2 "
    "HMUL2 HFMA2 HSET2 HSETP2 HMNMX2 HADD2_32I F2FP I2FP",
    # Rates of a quarter and below: transcendentals, conversions, bit counts, and double precision.
    "sfu": "MUFU RRO F2I I2F F2F I2I FRND POPC FLO BREV DADD DMUL DFMA DSETP DMNMX",
    "int": "IADD IADD3 IADD32I XMAD IMAD IMAD32I IMUL IMUL32I ISCADD ISCADD32I LEA ISETP ISET ICMP "
    "IMNMX VIMNMX IABS ISAD LOP LOP3 LOP32I PLOP3 SHL SHR SHF SEL MOV MOV32I BFE BFI BMSK SGXT "
    "PRMT PSETP PSET CSETP CSET R2P P2R VABSDIFF VADD VIADD VIADDMNMX IDP VOTE VOTEU SHFL R2UR "
    "USEL UMOV UIADD3 UIMAD ULEA ULOP3 UPLOP3 USHF UISETP UPRMT USGXT UBMSK UFLO UPOPC UP2UR UR2UP",
    # Branches and reconvergence; moves from special registers and from the constant bank.
    "control": "BRA BRX JMP EXIT RET CAL CALL SSY SYNC PBK BRK PCNT CONT BSSY BSYNC BREAK WARPSYNC "
    "NOP BAR DEPBAR BMOV S2R S2UR CS2R LDC ULDC YIELD NANOSLEEP KILL BPT",
    MEMORY: "LDG STG LD ST LDL STL LDS STS ATOM ATOMG ATOMS RED TEX TEXS TLD TLDS TLD4 TLD4S TXQ "
    "SULD SUST MEMBAR ERRBAR",
}
_KIND_OF = {opcode: kind for kind, opcodes in _KINDS.items() for opcode in opcodes.split()}
_LINE = re.compile(r"/\*([0-9a-f]{4,})\*/\s*(@!?U?P\w+)?\s*([A-Z][A-Z0-9_]*)((?:\.\w+)*)\s*(.*)")
_WORD = re.compile(r"/\* 0x([0-9a-f]{16}) \*/")
_REGISTER = re.compile(r"\b(U?R)(\d+)\b")
_ARGUMENT = re.compile(r"c\[0x0\]\s?\[0x([0-9a-f]+)\]")
_USED = re.compile(r"Compiling entry function '(\w+)'.*?Used (\d+) registers([^\n]*)", re.S)
_SHARED = re.compile(r"(\d+) bytes smem")
_STORES = ("STG", "ST", "STL", "STS", "RED")
#: Those of kind "control" that write a register.
_MOVES = ("S2R", "S2UR", "CS2R", "LDC", "ULDC")
#: Registers that are written, by modifier.
_WIDTHS = {".64": 2, ".128": 4, ".WIDE": 2}


def read_resources(messages: str) -> dict[str, tuple[int, int]]:
    """(registers per thread, shared bytes) by kernel, from what `ptxas -v` prints."""
    found = {}
    for name, registers, rest in _USED.findall(messages):
        shared = _SHARED.search(rest)
        found[name] = (int(registers), int(shared[1]) if shared else 0)
    return found


def read_code(disassembly: str, target: str, messages: str) -> dict[str, MachineCode]:
    """The kernels of a disassembled file, by name. messages: what `ptxas -v` printed.

    Raises:
        CountError: an opcode that is not in the table above.
    """
    resources = read_resources(messages)
    found = {}
    for section in re.split(r"^\.text\.", disassembly, flags=re.M)[1:]:
        name, _, body = section.partition(":")
        found[name] = _read_kernel(name, body, target, *resources[name])
    return found


def _read_kernel(
    name: str, body: str, target: str, registers: int, shared_bytes: int
) -> MachineCode:
    words: list[int] = []
    lines: list[tuple[int, re.Match[str], str]] = []
    labels: dict[str, int] = {}
    is_main = True
    for line in body.splitlines():
        words += [int(word, 16) for word in _WORD.findall(line)]
        text = _WORD.sub("", line)
        if text.startswith("$"):
            is_main = False  # Subroutines, such as a division's slow path, follow the kernel.
        elif text.startswith(".L"):
            if is_main:
                labels[text.split(":")[0]] = len(lines)
        elif is_main and (match := _LINE.search(re.sub(r"[{}]", " ", text))):
            lines.append((int(match[1], 16), match, text))
        elif text.startswith("."):
            break  # The next section.
    instructions = tuple(
        _decode(match, text, _control(words, address, target), target)
        for address, match, text in lines
    )
    return MachineCode(name, instructions, labels, registers, shared_bytes)


def _control(words: list[int], address: int, target: str) -> int:
    """The 21 control bits of the instruction at a byte offset."""
    if int(target.removeprefix("sm_")) >= 70:
        return words[address // 8 + 1] >> 41 & 0x1FFFFF
    return words[address // 32 * 4] >> 21 * (address % 32 // 8 - 1) & 0x1FFFFF


def _split(operands: str) -> list[str]:
    """Operands at the commas outside of brackets."""
    return [part.strip() for part in re.split(r",(?![^\[]*\])", operands) if part.strip()]


def _registers(text: str) -> tuple[str, ...]:
    return tuple(file + number for file, number in _REGISTER.findall(text))


def _written(opcode: str, modifiers: str, operands: list[str]) -> str:
    """The first register that an instruction writes, "" where it writes none but predicates."""
    if opcode in _STORES or not operands:
        return ""
    # A predicate may stand before the register.
    if re.match(r"!?U?P", operands[0]) and opcode not in ("LOP3", "SHFL"):
        return ""
    found = next((match for operand in operands[:2] if (match := _REGISTER.match(operand))), None)
    return found[0] if found else ""


def _span(register: str, opcode: str, modifiers: str) -> tuple[str, ...]:
    """The registers that an instruction writes, from the first on."""
    match = _REGISTER.fullmatch(register)
    if not match:
        return ()
    count = max((n for modifier, n in _WIDTHS.items() if modifier in modifiers), default=1)
    if opcode == "CS2R" and ".32" not in modifiers:
        count = 2
    return tuple(f"{match[1]}{int(match[2]) + k}" for k in range(count))


def _decode(match: re.Match[str], text: str, control: int, target: str) -> MachineInstruction:
    _, predicate, opcode, modifiers, rest = match.groups()
    if opcode not in _KIND_OF:
        raise CountError(f"{target}: unknown opcode {opcode} in {text.strip()!r}")
    kind = _KIND_OF[opcode]
    labels = re.findall(r"\.L_x_\d+", rest)
    operands = _split(re.sub(r"\(\*.*?\*\)|[`;]", "", rest))
    memory = re.findall(r"\[([^\]]*)\]", re.sub(r"desc\[\w+\]|c\[0x\w+\]\s?\[[^\]]*\]", "", rest))

    written = _written(opcode, modifiers, operands) if kind != "control" or opcode in _MOVES else ""
    writes = _span(written, opcode, modifiers)
    place = next((k for k, o in enumerate(operands[:2]) if written and o.startswith(written)), -1)
    read = [operand for k, operand in enumerate(operands) if k != place]
    base = ARGUMENT_BASE[target]
    constants = [int(offset, 16) - base for offset in _ARGUMENT.findall(rest)]
    arguments: list[tuple[str, int]] = []
    for offset in (c for c in constants if c >= 0):
        if opcode in ("LDC", "ULDC"):
            arguments += [(register, offset + 4 * k) for k, register in enumerate(writes)]
        else:
            arguments.append(("", offset))

    barrier = control >> 5 & 7
    waits = [(k, 0) for k in range(6) if control >> 11 & 1 << k]
    if opcode == "DEPBAR" and (limit := re.search(r"SB(\d), 0x(\w+)", rest)):
        waits.append((int(limit[1]), int(limit[2], 16)))
    branches = opcode in ("BRA", "SYNC", "BRK", "CONT") and bool(labels)
    conditional = bool(predicate) or (opcode == "BRA" and len(operands) > 1)
    return MachineInstruction(
        text=re.sub(r"\s+", " ", text).strip(),
        kind=kind,
        writes=writes,
        reads=_registers(", ".join(read)),
        access={"LDG": "load", "STG": "store"}.get(opcode, ""),
        address=_registers(memory[-1]) if memory else (),
        arguments=tuple(arguments),
        barrier=barrier if barrier < 6 else -1,
        waits=tuple(waits),
        target=labels[0] if branches else "",
        falls_through=conditional or opcode not in ("BRA", "SYNC", "BRK", "CONT", "EXIT", "RET"),
        is_call=opcode in ("CAL", "CALL"),
        is_exit=opcode == "EXIT",
    )
