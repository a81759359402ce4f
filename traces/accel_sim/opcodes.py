"""SASS opcodes: what an imported one is to us, and what an exported access or unit is called."""

from __future__ import annotations

from traces.errors import InputError

KEPLER = 35
#: Binary versions for which Accel-Sim has a table of opcodes.
BINARY_VERSIONS = (KEPLER, 60, 61, 70, 75, 80, 86)
DEFAULT_BINARY_VERSION = 75

#: Accesses to global or local memory, by opcode; GENERIC ones by their address.
ACCESSES = {
    **dict.fromkeys(("LDG", "LDL", "LD", "LDGSTS"), "load"),
    **dict.fromkeys(("STG", "STL", "ST"), "store"),
    **dict.fromkeys(("ATOM", "ATOMG", "RED", "REDG"), "atomic"),
}
#: Except on Kepler, where these are the global ones.
GENERIC = frozenset(("LD", "ST"))
LOCAL = frozenset(("LDL", "STL"))
EXIT, NOP = "EXIT", "NOP"

#: Accesses that are not imported, by the memory they go to. Texture fetches carry no addresses.
_SKIPPED = {
    "texture": "TEX TLD TLD4 TXA TXD TXQ TMML TEXS TLDS TLD4S SULD SUST SURED SUATOM SUQUERY",
    "shared": "LDS STS ATOMS LDSM STSM",
    "constant": "LDC ULDC LDCU",
    "bulk": "UTMALDG UTMASTG UTMAPF UTMAREDG UBLKCP UBLKPF UBLKRED",
}
SKIPPED = {opcode: memory for memory, names in _SKIPPED.items() for opcode in names.split()}

_CONTROL = """BRA BRX BRXU JMP JMX JMXU CALL CAL JCAL RET PRET EXIT PEXIT KILL RTT BPT BREAK BRK
    PBK CONT PCNT SSY SYNC BSSY BSYNC WARPSYNC YIELD NANOSLEEP BAR B2R R2B MEMBAR ERRBAR FENCE
    DEPBAR NOP CCTL CCTLL CCTLT CCTLG BMOV RPCMOV PMTRIG SETCTAID SETLMEMBASE GETLMEMBASE LEPC"""
_SPECIAL = "MUFU RRO F2F F2I I2F FRND F2FP I2FP"
KINDS = dict.fromkeys(_CONTROL.split(), "control") | dict.fromkeys(_SPECIAL.split(), "sfu")

#: Unit -> opcode of the arithmetic that is exported.
_ARITHMETIC = {"int": "IADD3", "fp32": "FFMA", "sfu": "MUFU", "control": "BRA"}
#: Bytes per lane -> modifier, from which Accel-Sim takes the size.
_SIZES = {1: ".U8", 2: ".U16", 4: "", 8: ".64", 16: ".128"}


def kind_of(opcode: str) -> str:
    """The unit of an opcode (without modifiers) that is neither an access nor skipped.

    Halves, doubles and matrices of them count as "fp32"; what is unknown counts as "int".
    """
    known = KINDS.get(opcode)
    if known is not None:
        return known
    return "fp32" if opcode[:1] in ("F", "D", "H") and opcode not in ("FLO", "DP4A") else "int"


def check_binary_version(version: int) -> None:
    """Raises: InputError: Accel-Sim has no opcodes for this version."""
    if version not in BINARY_VERSIONS:
        allowed = ", ".join(str(known) for known in BINARY_VERSIONS)
        raise InputError(f"binary version {version}: allowed are {allowed}")


def arithmetic_opcode(kind: str, binary_version: int) -> str:
    """What a warp instruction of a unit (`ARITHMETIC_KINDS`) is written as."""
    if kind == "int" and binary_version == KEPLER:
        return "IADD"
    return _ARITHMETIC[kind]


def access_opcode(operation: str, access_bytes: int, binary_version: int) -> str:
    """What an access is written as. Volta and Turing name the scope of every access."""
    if operation == "atomic":
        name = "ATOMG.E.ADD" if binary_version >= 70 else "ATOM.E.ADD"
    elif operation == "store":
        name = "ST.E" if binary_version == KEPLER else "STG.E"
    else:
        name = "LDG.E"
    scope = ".SYS" if binary_version in (70, 75) else ""
    return name + _SIZES[access_bytes] + scope
