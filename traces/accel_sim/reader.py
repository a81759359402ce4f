"""The memory instructions of Accel-Sim's trace files as a lane-address Trace, a launch per kernel.

Files are read twice: once for the static instructions, when the trace is opened, and then, CTA by
CTA, for every pass over its chunks. Texture, shared and constant accesses have no place in a
lane-address trace: each counts as one integer instruction, and the manifest says how many there
were (`skipped_texture_instructions`, ...).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import reduce
from operator import or_
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from traces.accel_sim.addresses import decode, lanes_of
from traces.accel_sim.header import KernelHeader
from traces.accel_sim.lines import XZ_MAGIC, KernelFile, Line
from traces.accel_sim.opcodes import ACCESSES, GENERIC, KEPLER, LOCAL, SKIPPED, kind_of
from traces.accel_sim.warp import Access, Arithmetic, Warp
from traces.accel_sim.writer import LIST_NAME
from traces.check import ACCESS_BYTES, MAX_INSTRUCTIONS
from traces.errors import InputError
from traces.texture import INACTIVE_ADDRESS, WARP_SIZE
from traces.trace import WAIT, Chunk, Instruction, Launch, Trace

_ROWS_PER_CHUNK = 1 << 14
_CTAS_PER_CHUNK = 1 << 12
_INACTIVE = int(INACTIVE_ADDRESS)
#: Where we put local memory, and how far its addresses reach: far above any global address.
_LOCAL_BASE, _LOCAL_BITS = 1 << 60, 24
#: Bytes above the local base that a generic address may be local in, as in Accel-Sim.
_LOCAL_WINDOW_BYTES = 1 << 14


class _Row(NamedTuple):
    """An access of a warp. lanes: 32 addresses, `INACTIVE_ADDRESS` where inactive."""

    access: Access
    lanes: list[int]


class _Kernel(NamedTuple):
    """What the first reading of a kernel found. trailing: of most of its warps; num_others: warps
    with another; num_idle: warps at its end that run nothing but their exit.
    """

    header: KernelHeader
    trailing: Arithmetic
    num_others: int
    num_idle: int


def read_accel_sim(path: str | Path) -> Trace:
    """The trace of a `kernelslist.g`, of the folder that holds one, or of a single `.traceg`.

    Trace files may be compressed with xz. Copies to the device in a list are ignored, and counted
    in the manifest.

    Raises:
        InputError: a file that is missing, malformed or truncated, with its line; more than 65536
            different static instructions; later also from the chunks, when a file has changed.
    """
    path = Path(path)
    paths, ignored = _listed(path)
    skipped: Counter[str] = Counter()
    known: dict[tuple[str, Access], int] = {}
    kernels = [_scan(kernel, known, skipped) for kernel in paths]
    if len(known) > MAX_INSTRUCTIONS:
        raise InputError(
            f"{path}: {len(known)} different instructions: allowed are up to {MAX_INSTRUCTIONS}"
        )
    instructions = [
        Instruction(name, -1, access.operation, "point", *access[1:]) for name, access in known
    ]
    launches = [
        Launch(
            0,
            kernel.header.name,
            kernel.header.num_ctas,
            -(-kernel.header.num_threads // WARP_SIZE),
            kernel.header.registers,
            kernel.header.shared_bytes,
            kernel.trailing,
        )
        for kernel in kernels
    ]
    manifest = {
        "format": "accel-sim",
        "name": str(path),
        "kernels": [
            {"name": k.header.name, "id": k.header.id, "file": file.name}
            | {"binary_version": k.header.binary_version}
            for k, file in zip(kernels, paths, strict=True)
        ],
        **{
            f"skipped_{memory}_instructions": skipped[memory]
            for memory in ("texture", "shared", "constant", "bulk")
        },
        "ignored_commands": ignored,
        "warps_with_other_trailing_arithmetic": sum(kernel.num_others for kernel in kernels),
        "padding_warps": kernels[0].num_idle if len(kernels) == 1 else 0,
    }

    def chunks() -> Iterator[Chunk]:
        for launch, file in enumerate(paths):
            yield from _chunks(file, launch, launches[launch], known)

    return Trace(manifest, (), instructions, launches, chunks)


def _listed(path: Path) -> tuple[list[Path], int]:
    """The kernels' files in order, and how many other commands the list has."""
    if path.is_dir():
        path = path / LIST_NAME
    try:
        with path.open("rb") as file:
            if file.read(1) in (b"-", XZ_MAGIC[:1]):
                return [path], 0
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    commands = [line.strip() for line in lines if line.strip()]
    kernels = [path.parent / command for command in commands if command.startswith("kernel")]
    if not kernels:
        raise InputError(f"{path}: lists no kernel; need lines like kernel-1.traceg")
    return kernels, len(commands) - len(kernels)


def _scan(path: Path, known: dict[tuple[str, Access], int], skipped: Counter[str]) -> _Kernel:
    """Read a kernel for what is static: number its instructions in `known`, count `skipped`."""
    file = KernelFile(path)
    trailings: Counter[Arithmetic] = Counter()
    num_idle = 0
    with file.open() as header:
        warps_per_cta = -(-header.num_threads // WARP_SIZE)
        for cta, warps in enumerate(file.ctas()):
            last_active = -1
            for warp, lines in warps:
                thread = (cta * warps_per_cta + warp) * WARP_SIZE
                rows, trailing = _warp(file, lines, thread, skipped)
                for row in rows:
                    known.setdefault((header.name, row.access), len(known))
                if rows or trailing:
                    trailings[trailing] += 1
                    last_active = warp
            num_idle = warps_per_cta - 1 - last_active
    trailing, num_others = _common(trailings)
    return _Kernel(header, trailing, num_others, num_idle)


def _common(trailings: Counter[Arithmetic]) -> tuple[Arithmetic, int]:
    """The trailing arithmetic of most warps, and how many have another.

    A launch has one for all its warps. Those that differ in waits alone count as alike, with the
    waits of the one that has most: what a warp with fewer loads in flight lacks holds it up not.
    """
    alike: dict[Arithmetic, list[Arithmetic]] = {}
    for trailing in trailings:
        alike.setdefault(_issued(trailing), []).append(trailing)
    counts = {issued: sum(trailings[t] for t in found) for issued, found in alike.items()}
    if not counts:
        return (), 0
    issued = max(counts, key=lambda issued: counts[issued])
    return max(alike[issued], key=len), trailings.total() - counts[issued]


def _issued(arithmetic: Arithmetic) -> Arithmetic:
    """Arithmetic without its waits."""
    runs: list[tuple[str, int]] = []
    for kind, count in arithmetic:
        if runs and runs[-1][0] == kind:
            runs[-1] = kind, runs[-1][1] + count
        elif kind != WAIT:
            runs.append((kind, count))
    return tuple(runs)


def _chunks(
    path: Path, launch: int, described: Launch, known: dict[tuple[str, Access], int]
) -> Iterator[Chunk]:
    """The chunks of one kernel."""
    file = KernelFile(path)
    warps_per_cta = described.warps_per_cta
    first_cta, lengths = 0, [0]
    instruction: list[int] = []
    lanes: list[npt.NDArray[np.uint64]] = []

    def chunk() -> Chunk:
        held = np.concatenate(lanes) if lanes else np.empty((0, WARP_SIZE), np.uint64)
        offsets = np.cumsum(lengths, dtype=np.int64)
        return Chunk(launch, first_cta, offsets, np.array(instruction, np.uint16), held)

    with file.open() as header:
        if (header.name, header.num_ctas) != (described.pass_name, described.num_ctas):
            raise InputError(f"{path}: has changed since it was opened")
        for cta, warps in enumerate(file.ctas()):
            of_warp = [0] * warps_per_cta
            found: list[list[int]] = []
            for warp, lines in warps:
                thread = (cta * warps_per_cta + warp) * WARP_SIZE
                rows, _ = _warp(file, lines, thread, Counter())
                of_warp[warp] = len(rows)
                for row in rows:
                    index = known.get((header.name, row.access))
                    if index is None:
                        raise InputError(f"{path}: has changed since it was opened")
                    instruction.append(index)
                    found.append(row.lanes)
            lengths += of_warp
            if found:
                lanes.append(np.array(found, np.uint64))
            if len(instruction) >= _ROWS_PER_CHUNK or cta + 1 - first_cta >= _CTAS_PER_CHUNK:
                yield chunk()
                first_cta, lengths, instruction, lanes = cta + 1, [0], [], []
    if len(lengths) > 1:
        yield chunk()


def _warp(
    file: KernelFile, lines: Iterator[Line], thread: int, skipped: Counter[str]
) -> tuple[list[_Row], Arithmetic]:
    """The accesses of a warp whose first thread is number `thread` of the launch, and its trailing
    arithmetic.
    """
    warp = Warp()
    rows: list[_Row] = []
    opcode = ""
    for line in lines:
        opcode = line.opcode.partition(".")[0]
        operation = ACCESSES.get(opcode)
        if operation is None and opcode not in SKIPPED:
            if line.width == 0 and len(line.rest) > 1:
                raise file.fail(f"{opcode}: {len(line.rest)} fields after a memory width of 0")
            warp.other(line, opcode, kind_of(opcode))
            continue
        lanes = None
        if operation is not None:
            try:
                lanes = _lanes(line, opcode, file.header, thread)
            except ValueError as error:
                raise file.fail(f"{opcode}: {error}") from None
        if operation is not None and lanes is not None:
            rows.append(_Row(warp.access(line, operation), lanes))
        else:
            skipped[SKIPPED.get(opcode, "shared")] += 1
            warp.other(line, opcode, "int")
    return rows, warp.trailing(opcode)


def _lanes(line: Line, opcode: str, header: KernelHeader, thread: int) -> list[int] | None:
    """The lanes' addresses; None where a generic access goes to shared memory.

    Raises:
        ValueError: a width that no access has, or addresses that are malformed or not aligned.
    """
    if line.width not in ACCESS_BYTES:
        raise ValueError(f"memory width {line.width}: allowed are {ACCESS_BYTES}")
    lanes, num_used = decode(line.mask, line.rest)
    # Tracers before version 5 write no immediate.
    if len(line.rest) > num_used + 1:
        raise ValueError(f"{len(line.rest) - num_used} fields after the addresses: need 1")
    is_local = opcode in LOCAL
    if opcode in GENERIC and header.binary_version != KEPLER:
        memory = _memory_of(next((a for a in lanes if a != _INACTIVE), 0), header)
        if memory == "shared":
            return None
        is_local = memory == "local"
    if is_local:
        return _local(lanes, line, header, thread)
    active = lanes_of(line.mask)
    if reduce(or_, [lanes[lane] for lane in active], 0) & (line.width - 1):
        raise ValueError(f"addresses must be multiples of the memory width, {line.width}")
    return lanes


def _memory_of(address: int, header: KernelHeader) -> str:
    """Where a generic address leads, by Accel-Sim's rule."""
    if not header.shared_base or not header.local_base:
        return "shared"
    if header.shared_base <= address < header.local_base:
        return "shared"
    end = header.local_base + _LOCAL_WINDOW_BYTES
    return "local" if header.local_base <= address < end else "global"


def _local(lanes: list[int], line: Line, header: KernelHeader, thread: int) -> list[int]:
    """Addresses of local memory, in which the threads' words alternate.

    Every thread has the same local addresses; the hardware puts word w of thread t at
    w x threads + t, so that the threads of a warp share lines. A word is what the access is wide.
    """
    num_threads = header.num_ctas * -(-header.num_threads // WARP_SIZE) * WARP_SIZE
    size, made = line.width, list(lanes)
    for lane in lanes_of(line.mask):
        address = lanes[lane]
        if address >= header.local_base:
            address -= header.local_base
        word = (address & (1 << _LOCAL_BITS) - 1) // size
        made[lane] = _LOCAL_BASE + (word * num_threads + thread + lane) * size
    return made


__all__ = ["read_accel_sim"]
