"""Cache strings of GPGPU-Sim: `S:4:128:96,L:L:s:N:L,A:256:8,16:0,32` in, named fields out.

    <type>:<sets>:<line>:<ways>,<replacement>:<write>:<allocation>:<write allocate>:<index>,
    <mshr>:<entries>:<merge>,<miss queue>[:<result FIFO>][,<port bytes>]

as in facts sheet section 3.2. Files of GPGPU-Sim 3 lack the type (then N), older ones the index as
well (then L).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from cachesim.gpgpusim.syntax import Setting

SECTOR_BYTES = 32
_SECTORED_LINE_BYTES = 128

_TYPES = {"N": False, "S": True}
_REPLACEMENTS = {"L": "lru", "F": "fifo"}
_WRITES = {
    "R": "read-only",
    "B": "write-back",
    "T": "write-through",
    "E": "write-evict",
    "L": "local-write-back",
}
_ALLOCATIONS = {"m": "on-miss", "f": "on-fill", "s": "streaming"}
_WRITE_ALLOCATES = {
    "N": "none",
    "W": "write-allocate",
    "F": "fetch-on-write",
    "L": "lazy-fetch-on-read",
}
_SET_HASHES = {"L": "linear", "X": "xor", "H": "fermi", "P": "ipoly"}
_HASHED_SETS = {"fermi": (32, 64), "ipoly": (16, 32, 64)}
_Value = TypeVar("_Value")
_DATA_MSHRS, _TEXTURE_MSHRS = ("A", "S"), ("F", "T")


@dataclass(frozen=True)
class CacheString:
    """One cache as its string has it.

    letters: the string's own letters of type, replacement, write policy, allocation, write
        allocation and index, under the names of the fields they decide.
    entries, merge: MSHRs and requests per MSHR; of a texture cache the fragment and the request
        FIFO. miss_queue: of a texture cache the reorder buffer. result_fifo: of a texture cache.
    port_bytes: data moved in a cycle.
    """

    text: str
    letters: dict[str, str]
    num_sets: int
    line_bytes: int
    sector_bytes: int
    ways: int
    replacement: str
    write_policy: str
    allocation: str
    write_allocate: str
    set_hash: str
    entries: int
    merge: int
    miss_queue: int
    result_fifo: int
    port_bytes: int

    @property
    def capacity(self) -> int:
        """Bytes of one instance."""
        return self.num_sets * self.line_bytes * self.ways


def parse_cache_string(setting: Setting, texture: bool = False) -> CacheString | None:
    """The cache of an option's string; None for "none".

    texture: whether it is the texture L1, whose data pass FIFOs instead of MSHRs.

    Raises:
        InputError: the string is malformed, or combines what GPGPU-Sim refuses.
    """
    if setting.text.lower() == "none":
        return None
    groups = [group.strip().split(":") for group in setting.text.split(",")]
    shape = [len(group) for group in groups]
    if (
        len(groups) not in (4, 5)
        or shape[0] not in (3, 4)
        or shape[1] not in (4, 5)
        or shape[2] != 3
        or shape[3] not in (1, 2)
        or shape[4:] not in ([], [1])
    ):
        raise setting.refuse(
            "allowed is <type>:<sets>:<line>:<ways>,<rep>:<wr>:<alloc>:<wralloc>:<index>,"
            "<mshr>:<entries>:<merge>,<miss queue>[:<result FIFO>][,<port>], or none"
        )
    geometry, policy, mshr, queue, port = [*groups, ["0"]][:5]
    letters = {
        "sector_bytes": geometry[0] if len(geometry) == 4 else "N",
        "replacement": policy[0],
        "write_policy": policy[1],
        "allocation": policy[2],
        "write_allocate": policy[3],
        "set_hash": policy[4] if len(policy) == 5 else "L",
    }
    sectored = _letter(setting, "type", letters["sector_bytes"], _TYPES)
    if letters["set_hash"] == "C":
        raise setting.refuse("index C is not written in GPGPU-Sim; allowed are L, X, H, P")
    kinds = _TEXTURE_MSHRS if texture else _DATA_MSHRS
    if mshr[0] not in kinds:
        what = "the texture cache" if texture else "a data cache"
        raise setting.refuse(f"mshr {mshr[0]!r} of {what}; allowed are {', '.join(kinds)}")
    num_sets, line_bytes, ways = (
        _number(setting, what, text)
        for what, text in zip(("sets", "line", "ways"), geometry[-3:], strict=True)
    )
    cache = CacheString(
        text=setting.text,
        letters=letters,
        num_sets=num_sets,
        line_bytes=line_bytes,
        sector_bytes=SECTOR_BYTES if sectored else line_bytes,
        ways=ways,
        replacement=_letter(setting, "rep", letters["replacement"], _REPLACEMENTS),
        write_policy=_letter(setting, "wr", letters["write_policy"], _WRITES),
        allocation=_letter(setting, "alloc", letters["allocation"], _ALLOCATIONS),
        write_allocate=_letter(setting, "wralloc", letters["write_allocate"], _WRITE_ALLOCATES),
        set_hash=_letter(setting, "index", letters["set_hash"], _SET_HASHES),
        entries=_number(setting, "entries", mshr[1]),
        merge=_number(setting, "merge", mshr[2]),
        miss_queue=_number(setting, "miss queue", queue[0]),
        result_fifo=_number(setting, "result FIFO", [*queue, "0"][1], least=int(texture)),
        port_bytes=_number(setting, "port", port[0], least=0) or line_bytes,
    )
    _check_combination(cache, setting)
    return cache


def _check_combination(cache: CacheString, setting: Setting) -> None:
    """Refuse what each field allows but GPGPU-Sim does not allow together."""
    alloc = cache.letters["allocation"]
    if cache.letters["sector_bytes"] == "S" and cache.line_bytes != _SECTORED_LINE_BYTES:
        raise setting.refuse(
            f"type S with lines of {cache.line_bytes} B; allowed are {_SECTORED_LINE_BYTES} B"
        )
    for what, value in (("sets", cache.num_sets), ("line", cache.line_bytes)):
        if value & (value - 1):
            raise setting.refuse(f"{what} {value}; allowed are powers of two")
    if cache.line_bytes % cache.port_bytes:
        raise setting.refuse(
            f"port {cache.port_bytes}; allowed are divisors of the line's {cache.line_bytes} B"
        )
    sets = _HASHED_SETS.get(cache.set_hash)
    if sets and cache.num_sets not in sets:
        raise setting.refuse(
            f"index {cache.letters['set_hash']} over {cache.num_sets} sets; allowed are "
            f"{', '.join(map(str, sets))} sets"
        )
    if alloc != "m" and cache.write_policy == "write-back":
        raise setting.refuse(
            f"write-back (wr B) with alloc {alloc}: a fill could wait for its own write-back; "
            "allowed is alloc m"
        )
    if alloc != "m" and cache.write_allocate in ("fetch-on-write", "lazy-fetch-on-read"):
        raise setting.refuse(
            f"wralloc {cache.letters['write_allocate']} with alloc {alloc}; allowed is alloc m"
        )


def _letter(setting: Setting, what: str, text: str, allowed: dict[str, _Value]) -> _Value:
    if text not in allowed:
        raise setting.refuse(f"{what} {text!r}; allowed are {', '.join(allowed)}")
    return allowed[text]


def _number(setting: Setting, what: str, text: str, least: int = 1) -> int:
    number = text.strip()
    if not (number.isdecimal() and len(number) < 10 and int(number) >= least):
        raise setting.refuse(f"{what} {text!r}; allowed are whole numbers from {least}")
    return int(number)
