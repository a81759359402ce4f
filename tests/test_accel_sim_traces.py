"""Accel-Sim's trace files: what is written follows the format and says what the Trace says, what is
read comes from the format's description, and one undoes the other.
"""

from __future__ import annotations

import dataclasses
import lzma
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cachesim import simulate
from experiments.cli import run_command
from tests.strategies import lane_address_traces, texel_traces
from traces.accel_sim.accesses import MODES
from traces.accel_sim.addresses import decode, encode
from traces.accel_sim.code import LOAD_REGISTERS
from traces.accel_sim.opcodes import BINARY_VERSIONS
from traces.accel_sim.writer import Settings, estimate_size, write_accel_sim
from traces.check import check
from traces.errors import InputError, WorkError
from traces.footprint import texel_addresses
from traces.lane_address import lane_address_trace
from traces.open import open_trace
from traces.parquet import write_parquet
from traces.placement import place
from traces.synthetic import scatter
from traces.texture import INACTIVE_ADDRESS, Texture
from traces.trace import ARITHMETIC_KINDS, WAIT, Chunk, Instruction, Launch, Trace, from_chunks

SCALARS = {"warps_per_cta": 2, "loads_in_flight": 4, "compute_per_load": 3, "bytes_per_lane": 8}
MANY = settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
ARITHMETIC = st.lists(
    st.tuples(st.sampled_from([*ARITHMETIC_KINDS, WAIT]), st.integers(0, 5)), max_size=4
).map(tuple)


def exported(trace: Trace, folder: Path, **changes: Any) -> Path:
    """A new folder with the trace's files."""
    made = folder / f"export{len(list(folder.iterdir()))}"
    write_accel_sim(trace, made, Settings(**changes))
    return made


def rows_of(trace: Trace) -> tuple[list[Any], ...]:
    """(launch, warp, instruction, lanes) of every row; for comparison, as one list each."""
    launch, warp, instruction, lanes = [], [], [], []
    base: dict[int, int] = {}
    for chunk in trace.chunks():
        first = base.get(chunk.launch, 0)
        lengths = np.diff(chunk.warp_offsets)
        warp += np.repeat(first + np.arange(len(lengths)), lengths).tolist()
        base[chunk.launch] = first + len(lengths)
        launch += [chunk.launch] * chunk.num_rows
        instruction += chunk.instruction.tolist()
        lanes += chunk.lanes.tolist()
    return launch, warp, instruction, lanes


@st.composite
def lane_address_arguments(draw: Any) -> dict[str, Any]:
    """Arguments of `lane_address_trace`."""
    loads = draw(st.integers(0, 9))
    size = draw(st.sampled_from([1, 2, 4, 8, 16]))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bits = draw(st.sampled_from([6, 20, 50]))
    address = random.integers(1, 2**bits, (draw(st.integers(1, 7)), loads, 32), dtype=np.uint64)
    address[random.random(address.shape) < draw(st.sampled_from([0, 0.4, 1]))] = 0
    stores = np.array(draw(st.lists(st.booleans(), min_size=loads, max_size=loads)), bool)
    return {
        "addresses": address * np.uint64(size),
        "warps_per_cta": draw(st.integers(1, 4)),
        "loads_in_flight": draw(st.integers(1, 5)),
        "compute_per_load": draw(st.integers(0, 4)),
        "bytes_per_lane": size,
        "stores": stores if draw(st.booleans()) else None,
    }


@MANY
@given(arguments=lane_address_arguments(), version=st.sampled_from(BINARY_VERSIONS))
def test_a_lane_address_trace_comes_back_with_its_rows_arithmetic_and_waits(
    arguments: dict[str, Any], version: int, tmp_path: Path
) -> None:
    trace = lane_address_trace(**arguments)
    back = open_trace(exported(trace, tmp_path, binary_version=version))
    assert list(back.instructions) == list(trace.instructions)
    assert rows_of(back) == rows_of(trace)
    (launch,), (original,) = back.launches, trace.launches
    if back.manifest["padding_warps"] < arguments["addresses"].shape[0]:
        assert launch == original
    assert back.manifest["padding_warps"] == trace.manifest["padding_warps"]
    check(back)


def described_program(stores: list[bool], in_flight: int, compute: int) -> list[str]:
    """Destination, opcode and sources of a warp's lines, by the description of how the oracle's
    traces were written down.
    """
    lines = ["1 R4 IADD3 1 R4"]
    for begin in range(0, len(stores), in_flight):
        group = stores[begin : begin + in_flight]
        registers = [f"R{8 + k}" for k in range(group.count(False))]
        free = iter(registers)
        lines += [
            "0 STG.E.64.SYS 2 R2 R28" if store else f"1 {next(free)} LDG.E.64.SYS 1 R2"
            for store in group
        ]
        for register in registers:
            lines += [f"1 R{28 + c % 3} FFMA 2 {register} R{28 + c % 3}" for c in range(compute)]
    return [*lines, "0 EXIT 0"]


def instruction_lines(kernel: Path) -> list[list[str]]:
    """The fields of all instruction lines of a file, from the mask on."""
    lines = kernel.read_text().split("#traces", 1)[1].splitlines()[1:]
    return [line.split()[1:] for line in lines if line and line[0] not in "#tiw"]


# Without FMAs only loads wait, each for the one at its place in the group before; where stores make
# groups unlike each other, that is not to be had with registers that all start from R8.
@pytest.mark.parametrize(
    ("in_flight", "compute", "period"),
    [
        *(
            (in_flight, compute, p)
            for in_flight in (1, 4, 16)
            for compute in (1, 5)
            for p in (0, 3)
        ),
        (1, 0, 0),
        (4, 0, 0),
        (16, 0, 0),
        (4, 0, 4),
        (4, 3, 8),
    ],
)
def test_lane_address_lines_are_those_the_oracle_was_run_on(
    in_flight: int, compute: int, period: int, tmp_path: Path
) -> None:
    stores = [bool(period) and k % period == period - 1 for k in range(24)]
    address = np.arange(1, 24 * 32 + 1, dtype=np.uint64).reshape(1, 24, 32) * np.uint64(8)
    trace = lane_address_trace(
        address,
        warps_per_cta=1,
        loads_in_flight=in_flight,
        compute_per_load=compute,
        bytes_per_lane=8,
        stores=np.array(stores),
    )
    folder = exported(trace, tmp_path)
    found = []
    for fields in instruction_lines(folder / "kernel-1.traceg"):
        named = 1 + int(fields[1])
        sources = int(fields[named + 2])
        found.append(" ".join(fields[1 : named + 3 + sources]))
    assert found == described_program(stores, in_flight, compute)
    header = (folder / "kernel-1.traceg").read_text().splitlines()
    assert "-nregs = 32" in header and "-shmem = 0" in header and "-block dim = (32,1,1)" in header


@st.composite
def waiting_traces(draw: Any) -> Trace:
    """Lane-address traces whose instructions have any arithmetic and wait at any place."""
    trace = draw(lane_address_traces(address_bits=20))
    trace.instructions = [
        dataclasses.replace(
            i, arithmetic=draw(ARITHMETIC), num_outstanding=draw(st.integers(-1, 4))
        )
        for i in trace.instructions
    ]
    trace.launches = [
        dataclasses.replace(launch, trailing_arithmetic=draw(ARITHMETIC))
        for launch in trace.launches
        if launch.num_ctas
    ]
    kept = [chunk for chunk in trace.chunks() if chunk.num_warps]
    numbers = sorted({chunk.launch for chunk in kept})
    moved = [dataclasses.replace(chunk, launch=numbers.index(chunk.launch)) for chunk in kept]
    return from_chunks(moved, (), trace.instructions, trace.launches)


def warp_events(trace: Trace) -> list[list[Any]]:
    """What each warp issues, and how many of its first loads are back by then.

    (kind, loads back) per arithmetic instruction, (operation, bytes, loads back, lanes) per access.
    """
    warps = []
    for chunk in trace.chunks():
        trailing = trace.launches[chunk.launch].trailing_arithmetic
        for begin, end in zip(chunk.warp_offsets, chunk.warp_offsets[1:], strict=False):
            events: list[Any] = []
            issued = back = 0
            for row in range(begin, end):
                instruction = trace.instructions[chunk.instruction[row]]
                waits = ((WAIT, instruction.num_outstanding),)
                if instruction.num_outstanding < 0:
                    waits = ()
                for kind, count in (*instruction.arithmetic, *waits):
                    if kind == WAIT:
                        back = max(back, issued - count)
                    else:
                        events += [(kind, back)] * count
                events.append(
                    (
                        instruction.operation,
                        instruction.access_bytes,
                        back,
                        chunk.lanes[row].tolist(),
                    )
                )
                issued += instruction.operation != "store"
            for kind, count in trailing:
                if kind == WAIT:
                    back = max(back, issued - count)
                else:
                    events += [(kind, back)] * count
            warps.append(events)
    return warps


@MANY
@given(trace=waiting_traces())
def test_any_lane_address_trace_comes_back_meaning_the_same(trace: Trace, tmp_path: Path) -> None:
    if not trace.launches:
        return
    folder = exported(trace, tmp_path)
    back = open_trace(folder)
    check(back)
    assert warp_events(back) == warp_events(trace)
    assert [dataclasses.replace(x, trailing_arithmetic=(), frame=0) for x in trace.launches] == [
        dataclasses.replace(x, trailing_arithmetic=()) for x in back.launches
    ]


@MANY
@given(trace=st.one_of(waiting_traces(), texel_traces(max_side=64)), mode=st.sampled_from(MODES))
def test_every_file_keeps_to_the_format(trace: Trace, mode: str, tmp_path: Path) -> None:
    folder = exported(trace, tmp_path, mode=mode)
    numbers = [n for n, launch in enumerate(trace.launches, 1) if launch.num_ctas]
    listed = (folder / "kernelslist.g").read_text()
    assert listed == "".join(f"kernel-{number}.traceg\n" for number in numbers)
    for number in numbers:
        launch = trace.launches[number - 1]
        text = (folder / f"kernel-{number}.traceg").read_text()
        assert text.endswith("\n")
        lines = text.splitlines()
        assert text.count("#BEGIN_TB\n") == text.count("#END_TB\n") == launch.num_ctas
        assert f"-grid dim = ({launch.num_ctas},1,1)" in lines
        assert lines.count("warp = 0") == launch.num_ctas
        assert all(
            lines.count(f"warp = {w}") == launch.num_ctas for w in range(launch.warps_per_cta)
        )
        counts = [int(line.split("=")[1]) for line in lines if line.startswith("insts")]
        fields = instruction_lines(folder / f"kernel-{number}.traceg")
        assert sum(counts) == len(fields) and min(counts) >= 1
        last = np.cumsum(counts) - 1
        assert [f[2] == "EXIT" for f in fields] == [k in last for k in range(len(fields))]
        for mask, num_destinations, *rest in fields:
            assert len(mask) == 8 and num_destinations in "01"
            opcode, num_sources = rest[int(num_destinations) :][:2]
            assert int(num_sources) <= 4
            assert opcode.startswith(("LDG", "STG", "ATOM")) or mask == "ffffffff"


def expected_sectors(trace: Trace) -> list[set[int]]:
    """The distinct 32 B sectors of each row."""
    address_map = place(trace.textures, "morton")
    found = []
    for chunk in trace.chunks():
        for row, index in enumerate(chunk.instruction):
            instruction = trace.instructions[index]
            address = texel_addresses(
                chunk.lanes[row : row + 1],
                instruction.texture,
                instruction.footprint == "bilinear",
                address_map,
            )
            found.append(set((address[address != INACTIVE_ADDRESS] // np.uint64(32)).tolist()))
    return found


def lines_per_row(trace: Trace, mode: str, sectors: list[set[int]]) -> list[int]:
    index = [i for chunk in trace.chunks() for i in chunk.instruction]
    counts = []
    for number, needed in zip(index, sectors, strict=True):
        instruction = trace.instructions[number]
        if mode == "packed-sectors" and instruction.operation == "load":
            counts.append(max(1, -(-len(needed) // 32)))
        else:
            counts.append(4 if instruction.footprint == "bilinear" else 1)
    return counts


@MANY
@given(trace=texel_traces(max_side=64), mode=st.sampled_from(MODES))
def test_footprints_come_back_as_the_same_sectors_per_access(
    trace: Trace, mode: str, tmp_path: Path
) -> None:
    sectors = expected_sectors(trace)
    if not any(launch.num_ctas for launch in trace.launches):
        return
    back = open_trace(exported(trace, tmp_path, mode=mode, layout="morton"))
    check(back)
    lanes = np.concatenate([chunk.lanes for chunk in back.chunks()])
    index = np.concatenate([chunk.instruction for chunk in back.chunks()])
    at = 0
    for needed, count in zip(sectors, lines_per_row(trace, mode, sectors), strict=True):
        part = lanes[at : at + count]
        active = part[part != INACTIVE_ADDRESS]
        assert set((active // np.uint64(32)).tolist()) == needed
        if mode == "packed-sectors" and back.instructions[index[at]].operation == "load":
            assert len(active) == len(needed)
        at += count
    assert at == len(lanes)


def test_packed_sectors_are_the_traffic_of_the_recording(tmp_path: Path) -> None:
    """L1 accesses of the original, on its layout, and of the loads that Accel-Sim would run."""
    trace = scatter(64, 32, 6.0, 4)
    gpu = "titan-x-pascal"
    for mode in MODES:
        back = open_trace(exported(trace, tmp_path, mode=mode, layout="morton"))
        ours = simulate(trace, gpu, layout="morton", fetch_path="readonly").counters
        theirs = simulate(back, gpu, fetch_path="readonly").counters
        assert theirs["l1"].accesses == ours["l1"].accesses
        assert theirs["l2"].accesses == ours["l2"].accesses


def bilinear_trace(num_outstanding: int, arithmetic: tuple[tuple[str, int], ...]) -> Trace:
    """One warp, two bilinear loads in different levels."""
    texture = Texture("t", "RGBA8", 64, 64)
    lanes = np.arange(2 * 32, dtype=np.uint32).reshape(2, 32) % 32
    second = Instruction("p", 0, "load", "bilinear", 0, arithmetic, num_outstanding)
    chunk = Chunk(0, 0, np.array([0, 2]), np.array([0, 1], np.uint16), lanes)
    instructions = [Instruction("p", 0, "load", "bilinear"), second]
    return from_chunks([chunk], [texture], instructions, [Launch(0, "p", 1, 1)])


def test_a_wait_names_every_register_of_a_footprint(tmp_path: Path) -> None:
    folder = exported(bilinear_trace(-1, ((WAIT, 0), ("fp32", 1))), tmp_path)
    lines = [" ".join(f[1:]) for f in instruction_lines(folder / "kernel-1.traceg")]
    assert [line.split()[1] for line in lines[:4]] == ["R8", "R9", "R10", "R11"]
    assert lines[4] == "1 R28 FFMA 4 R8 R9 R10 R11 0 0"
    folder = exported(bilinear_trace(0, ()), tmp_path)
    lines = [" ".join(f[1:]) for f in instruction_lines(folder / "kernel-1.traceg")]
    assert lines[4].startswith("1 R11 LDG.E.SYS 4 R2 R8 R9 R10 4 ")


def test_waits_for_more_registers_than_a_line_can_name_take_lines_of_their_own(
    tmp_path: Path,
) -> None:
    address = np.arange(1, 12 * 32 + 1, dtype=np.uint64).reshape(1, 12, 32) * np.uint64(8)
    trace = lane_address_trace(
        address, warps_per_cta=1, loads_in_flight=12, compute_per_load=0, bytes_per_lane=8
    )
    trace.launches[0] = dataclasses.replace(
        trace.launches[0], trailing_arithmetic=((WAIT, 0), ("sfu", 1))
    )
    folder = exported(trace, tmp_path)
    lines = [" ".join(f[1:]) for f in instruction_lines(folder / "kernel-1.traceg")]
    assert lines[13:] == [
        "0 NOP 4 R8 R9 R10 R11 0 0",
        "0 NOP 4 R12 R13 R14 R15 0 0",
        "1 R32 MUFU 4 R16 R17 R18 R19 0 0",
        "0 EXIT 0 0 0",
    ]
    assert warp_events(open_trace(folder)) == warp_events(trace)


def test_more_loads_in_flight_than_registers_wait_for_the_oldest(tmp_path: Path) -> None:
    num = len(LOAD_REGISTERS)
    address = np.arange(1, (num + 9) * 32 + 1, dtype=np.uint64).reshape(1, -1, 32) * np.uint64(8)
    trace = lane_address_trace(
        address, warps_per_cta=1, loads_in_flight=num + 9, compute_per_load=0, bytes_per_lane=8
    )
    (chunk,) = (back := open_trace(exported(trace, tmp_path))).chunks()
    waits = [back.instructions[i].num_outstanding for i in chunk.instruction]
    assert waits == [-1] * num + [num - 1] * 9


@given(
    st.lists(
        st.lists(st.one_of(st.none(), st.integers(0, 2**64 - 2)), min_size=32, max_size=32),
        max_size=4,
    )
)
def test_addresses_come_back_from_their_fields(rows: list[list[int | None]]) -> None:
    inactive = int(INACTIVE_ADDRESS)
    addresses = [[inactive if a is None else a for a in row] for row in rows]
    masks, fields = encode(np.array(addresses, np.uint64).reshape(-1, 32))
    for row, mask, field in zip(addresses, masks, fields, strict=True):
        assert decode(int(mask, 16), [*field.split(), "0"]) == (row, len(field.split()))


def lanes_at(**addresses: int) -> npt.NDArray[np.uint64]:
    """A row with the addresses of lanes l0, l1, ..."""
    row = np.full((1, 32), INACTIVE_ADDRESS, np.uint64)
    for lane, address in addresses.items():
        row[0, int(lane[1:])] = address
    return row


@pytest.mark.parametrize(
    ("row", "mask", "field"),
    [
        (0x1000 + 8 * np.arange(32, dtype=np.uint64)[None], "ffffffff", "1 0x1000 8"),
        (lanes_at(l3=64, l4=32, l5=0), "00000038", "1 0x40 -32"),
        (lanes_at(l3=64, l5=32, l6=0), "00000068", "2 0x40 -32 -32"),
        (lanes_at(l0=0, l1=8, l2=24), "00000007", "2 0x0 8 16"),
        (lanes_at(l0=0, l1=2**31), "00000003", "2 0x0 2147483648"),
        (lanes_at(l0=0, l1=2**31 - 1), "00000003", "1 0x0 2147483647"),
        (lanes_at(l0=2**63, l1=0), "00000003", "2 0x8000000000000000 -9223372036854775808"),
        (lanes_at(l7=0x7F00), "00000080", "0 0x7f00"),
        (lanes_at(), "00000000", "0"),
    ],
)
def test_addresses_are_written_in_the_shortest_mode(
    row: npt.NDArray[np.uint64], mask: str, field: str
) -> None:
    assert encode(row) == ([mask], [field])


HEADER = """-kernel name = demo_fetch
-kernel id = 1
-grid dim = (1,1,1)
-block dim = (64,1,1)
-shmem = 512
-nregs = 16
-binary version = 75
-cuda stream id = 0
-shmem base_addr = 0x0000000000000000
-local mem base_addr = 0x0000000000000000
-nvbit version = 1.5.5
-accelsim tracer version = 5
-enable lineinfo = 0

#traces format = PC mask dest_num [reg_dests] opcode src_num [reg_srcs] mem_width

"""
WARP_0 = """0000 ffffffff 1 R4 LDG.E.64 1 R2 8 1 0x7f0000001000 8 0
0010 0000000f 1 R6 LDG.E.64 1 R2 8 2 0x7f0000002000 64 -32 512 0
0020 ffffffff 1 R8 FADD 2 R4 R6 0 0
0030 ffffffff 0 EXIT 0 0 0
"""
WARP_1 = """0000 00000101 1 R4 LDG.E 1 R2 4 0 0x00007f0000001100 0x00007f0000009000 0
0030 ffffffff 0 EXIT 0 0 0
"""


def body(*warps: str) -> str:
    """One CTA with the instruction lines of its warps."""
    parts = ["#BEGIN_TB\n\nthread block = 0,0,0\n\n"]
    for number, lines in enumerate(warps):
        parts.append(f"warp = {number}\ninsts = {lines.count(chr(10))}\n{lines}\n")
    return "".join([*parts, "#END_TB\n"])


def written(folder: Path, *warps: str, header: str = HEADER, name: str = "k.traceg") -> Path:
    path = folder / name
    path.write_text(header + body(*warps))
    return path


def test_a_trace_written_by_hand_is_read(tmp_path: Path) -> None:
    trace = open_trace(written(tmp_path, WARP_0, WARP_1))
    assert trace.launches == [Launch(0, "demo_fetch", 1, 2, 16, 512, ((WAIT, 0), ("fp32", 1)))]
    assert list(trace.instructions) == [
        Instruction("demo_fetch", -1, access_bytes=8),
        Instruction("demo_fetch", -1, access_bytes=4),
    ]
    (chunk,) = trace.chunks()
    assert chunk.warp_offsets.tolist() == [0, 2, 3]
    assert chunk.instruction.tolist() == [0, 0, 1]
    assert chunk.lanes[0].tolist() == [0x7F0000001000 + 8 * lane for lane in range(32)]
    assert chunk.lanes[1, :5].tolist() == [
        0x7F0000002000,
        0x7F0000002040,
        0x7F0000002020,
        0x7F0000002220,
        2**64 - 1,
    ]
    assert np.flatnonzero(chunk.active[2]).tolist() == [0, 8]
    assert chunk.lanes[2, 8] == 0x7F0000009000
    check(trace)


def with_prefix(lines: str, prefix: str) -> str:
    return "".join(f"{prefix}{line}\n" for line in lines.splitlines())


def test_older_tracers_and_source_lines_are_read_alike(tmp_path: Path) -> None:
    new = rows_of(open_trace(written(tmp_path, WARP_0, WARP_1)))
    old_header = HEADER.replace("tracer version = 5", "tracer version = 2")
    old = [with_prefix(w, f"0 0 0 {number} ") for number, w in enumerate((WARP_0, WARP_1))]
    assert rows_of(open_trace(written(tmp_path, *old, header=old_header, name="old.traceg"))) == new
    header = HEADER.replace("lineinfo = 0", "lineinfo = 1")
    lined = [with_prefix(w, "117 ") for w in (WARP_0, WARP_1)]
    assert rows_of(open_trace(written(tmp_path, *lined, header=header, name="n.traceg"))) == new
    both = [with_prefix(w, f"0 0 0 {n} 117 ") for n, w in enumerate((WARP_0, WARP_1))]
    header = old_header.replace("lineinfo = 0", "lineinfo = 1")
    assert rows_of(open_trace(written(tmp_path, *both, header=header, name="b.traceg"))) == new
    # Without the immediate that later tracers add.
    bare = [w.replace(" 0\n", "\n") for w in (WARP_0, WARP_1)]
    assert rows_of(open_trace(written(tmp_path, *bare, name="bare.traceg"))) == new


def instructions_of(folder: Path, lines: str, header: str = HEADER) -> list[Instruction]:
    """The static instructions of a warp's accesses, in order."""
    trace = open_trace(written(folder, lines, header=header))
    return [trace.instructions[i] for chunk in trace.chunks() for i in chunk.instruction]


LOAD = "0000 00000001 1 {} LDG.E 1 R2 4 0 0x1000 0\n"


def test_reading_a_loads_register_waits_for_it_and_all_before(tmp_path: Path) -> None:
    lines = "".join(LOAD.format(f"R{8 + k}") for k in range(3))
    lines += "0 ffffffff 1 R20 FADD 2 R20 R9 0 0\n0 ffffffff 1 R21 IADD3 2 R21 R8 0 0\n"
    lines += "0 ffffffff 0 BRA 0 0 0\n0 00000001 0 STG.E 2 R2 R10 4 0 0x1000 0\n"
    *_, store = instructions_of(tmp_path, lines)
    assert store.operation == "store"
    assert store.arithmetic == ((WAIT, 1), ("fp32", 1), ("int", 1), ("control", 1))
    assert store.num_outstanding == 0


def test_overwriting_a_loads_register_waits_for_it(tmp_path: Path) -> None:
    lines = LOAD.format("R8") + LOAD.format("R9") + LOAD.format("R8")
    assert [i.num_outstanding for i in instructions_of(tmp_path, lines)] == [-1, -1, 1]
    lines = LOAD.format("R8") + "0 ffffffff 1 R8 MUFU.RCP 1 R3 0 0\n" + LOAD.format("R9")
    assert instructions_of(tmp_path, lines)[1].arithmetic == ((WAIT, 0), ("sfu", 1))


def test_a_pointer_chase_waits_at_every_load(tmp_path: Path) -> None:
    lines = "".join("0 00000001 1 R8 LDG.E.64 1 R8 8 0 0x1000 0\n" for _ in range(4))
    assert [i.num_outstanding for i in instructions_of(tmp_path, lines)] == [-1, 0, 0, 0]


def test_the_zero_register_and_stores_are_never_waited_for(tmp_path: Path) -> None:
    lines = LOAD.format("R255") + "0 ffffffff 1 R4 IADD3 2 R255 R255 0 0\n"
    lines += "0 00000001 0 STG.E 2 R2 R8 4 0 0x1000 0\n0 ffffffff 1 R8 MOV 1 R3 0 0\n"
    lines += LOAD.format("R9")
    assert [i.num_outstanding for i in instructions_of(tmp_path, lines)] == [-1] * 3


def test_atomics_return_data(tmp_path: Path) -> None:
    lines = "0 00000001 1 R8 ATOMG.E.ADD 2 R2 R4 4 0 0x1000 0\n"
    lines += "0 00000001 0 RED.E.ADD 2 R2 R8 4 0 0x1000 0\n"
    first, second = instructions_of(tmp_path, lines)
    assert (first.operation, second.operation) == ("atomic", "atomic")
    assert second.num_outstanding == 0


def test_what_is_not_imported_is_counted_and_still_issues(tmp_path: Path) -> None:
    lines = "0 ffffffff 1 R4 TEX.SCR.LL 2 R0 R2 0 0\n0 ffffffff 1 R4 TLD4 2 R0 R2 0 0\n"
    lines += "0 ffffffff 1 R5 LDS 1 R0 4 1 0x0 4 0\n0 ffffffff 1 R5 LDC 1 R0 4 1 0x160 0 0\n"
    lines += "0 ffffffff 1 R5 LD.E 1 R0 4 1 0x0 4 0\n"
    lines += LOAD.format("R8") + "30 ffffffff 0 EXIT 0 0 0\n"
    trace = open_trace(written(tmp_path, lines))
    assert trace.manifest["skipped_texture_instructions"] == 2
    assert trace.manifest["skipped_shared_instructions"] == 2
    assert trace.manifest["skipped_constant_instructions"] == 1
    (instruction,) = trace.instructions
    assert instruction.arithmetic == (("int", 5),)


def test_generic_accesses_go_where_their_address_leads(tmp_path: Path) -> None:
    header = HEADER.replace(
        "shmem base_addr = 0x0000000000000000", "shmem base_addr = 0x7f0000000000"
    ).replace("local mem base_addr = 0x0000000000000000", "local mem base_addr = 0x7f1000000000")
    line = "0 00000001 1 R8 LD.E 1 R0 4 0 {} 0\n"
    lines = "".join(line.format(a) for a in ("0x7f0000000010", "0x7f2000000000", "0x7f1000000010"))
    trace = open_trace(written(tmp_path, lines, header=header))
    (chunk,) = trace.chunks()
    assert trace.manifest["skipped_shared_instructions"] == 1
    assert chunk.lanes[0, 0] == 0x7F2000000000
    # Thread 0 of 64, word 4 of 4 bytes each.
    assert chunk.lanes[1, 0] == (1 << 60) + 4 * 64 * 4


def test_threads_words_of_local_memory_alternate(tmp_path: Path) -> None:
    line = "0 ffffffff 1 R8 LDL.64 1 R1 8 1 0x10 0 0\n"
    trace = open_trace(written(tmp_path, line, line))
    (chunk,) = trace.chunks()
    word = (1 << 60) + 2 * 64 * 8
    assert chunk.lanes[0].tolist() == [word + 8 * lane for lane in range(32)]
    assert chunk.lanes[1].tolist() == [word + 8 * (32 + lane) for lane in range(32)]


def test_warps_may_end_differently(tmp_path: Path) -> None:
    header = HEADER.replace("block dim = (64,1,1)", "block dim = (96,1,1)")
    fma = "0 ffffffff 1 R28 FFMA 1 R28 0 0\n"
    leave = "0 ffffffff 0 EXIT 0 0 0\n"
    trace = open_trace(written(tmp_path, fma + leave, fma + leave, fma * 2 + leave, header=header))
    assert trace.launches[0].trailing_arithmetic == (("fp32", 1),)
    assert trace.manifest["warps_with_other_trailing_arithmetic"] == 1
    assert [chunk.num_warps for chunk in trace.chunks()] == [3]


def test_lists_folders_and_compressed_files_open(tmp_path: Path) -> None:
    folder = tmp_path / "traces"
    folder.mkdir()
    written(folder, WARP_0, WARP_1, name="kernel-1.traceg")
    packed = written(folder, WARP_1, name="plain").read_bytes()
    (folder / "kernel-2.traceg.xz").write_bytes(lzma.compress(packed))
    (folder / "kernelslist.g").write_text(
        "MemcpyHtoD,0x00007f0000000000,65536\nkernel-1.traceg\nkernel-2.traceg.xz\n"
        "kernel-1.traceg\n"
    )
    trace = open_trace(folder)
    assert [k["file"] for k in trace.manifest["kernels"]] == [
        "kernel-1.traceg",
        "kernel-2.traceg.xz",
        "kernel-1.traceg",
    ]
    assert trace.manifest["ignored_commands"] == 1
    assert rows_of(open_trace(folder / "kernelslist.g")) == rows_of(trace)
    assert rows_of(trace)[0] == [0, 0, 0, 1, 2, 2, 2]
    single = open_trace(folder / "kernel-2.traceg.xz")
    assert rows_of(single) == rows_of(open_trace(folder / "plain"))
    check(trace)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("-grid dim = (1,1,1)\n", "", "the header has no -grid dim"),
        ("(1,1,1)", "(1,1)", "line 3: -grid dim = '(1,1)': need (x,y,z)"),
        ("(1,1,1)", "(0,1,1)", "line 3: -grid dim = '(0,1,1)'"),
        ("(64,1,1)", "(2048,1,1)", "allowed are up to 1024 threads"),
        ("-nregs = 16", "-nregs = many", "line 6: -nregs = 'many': need an integer"),
        ("-nregs = 16", "nregs", "line 6: 'nregs': need a header line"),
        ("lineinfo = 0", "lineinfo = 2", "line 13: -enable lineinfo = '2': need 0 or 1"),
        ("#BEGIN_TB", "#BEGIN", "need #BEGIN_TB"),
        ("thread block = 0,0,0", "thread block = 0,0,1", "line 19: thread block = '0,0,1'"),
        ("warp = 1", "warp = 0", "line 28: warp = 0: allowed are 1 to 1"),
        ("warp = 1", "warp = 2", "warp = 2: allowed are 1 to 1"),
        ("warp = 1", "wrap = 1", "line 28: 'wrap = 1': need warp = ..."),
        ("insts = 4", "insts = 5", "line 28: 4 instructions where insts = 5"),
        ("insts = 4", "insts = 3", "need warp = ..."),
        ("insts = 4", "insts = -4", "insts = '-4': need an integer"),
        ("#END_TB", "", "the file ends inside a thread block"),
        ("(1,1,1)", "(2,1,1)", "the file ends after 1 thread blocks: the grid has 2"),
        ("#END_TB", "#END_TB\n#BEGIN_TB", "thread block 2: the grid has 1"),
        ("0010 0000000f", "0010 1ffffffff", "line 24: "),
        ("0010 0000000f", "0010 xyz", "invalid literal"),
        ("1 R6 LDG.E.64 1 R2 8 2", "1 6 LDG.E.64 1 R2 8 2", "registers '6'"),
        ("1 R6 LDG.E.64 1 R2 8 2", "1 R6 LDG.E.64 2 R2 8 2", "registers 'R2 8'"),
        ("1 R6 LDG.E.64 1 R2 8 2", "1 R6 LDG.E.64 1 R2 12 2", "memory width 12"),
        ("1 R6 LDG.E.64 1 R2 8 2", "1 R6 LDG.E.64 1 R2 8 3", "address mode 3: allowed are 0, 1"),
        ("8 2 0x7f0000002000 64 -32 512 0", "8 2 0x7f0000002000 64", "numbers in address mode 2"),
        ("64 -32 512 0", "64 -32 512 0 7", "2 fields after the addresses"),
        ("0x7f0000002000 64", "0x7f0000002004 64", "must be multiples of the memory width, 8"),
        ("0000000f 1 R6 LDG.E.64 1 R2 8 2", "00000015 1 R6 LDG.E.64 1 R2 8 1", "neighbouring"),
        ("0x00007f0000001100", "0x17f0000001100aabbc", "allowed are 0 to 2^64 - 2"),
        ("FADD 2 R4 R6 0 0", "FADD 2 R4 R6 0 0 0", "fields after a memory width of 0"),
        ("FADD 2 R4 R6 0 0", "FADD 2 R4 R6", "no memory width"),
        ("1 R8 FADD", "1 R8 0xFADD", "opcode '0xFADD': need a name"),
    ],
)
def test_malformed_files_are_one_line_with_the_place(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = written(tmp_path, WARP_0, WARP_1)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        open_trace(path)
    assert str(caught.value).startswith(f"{path}: line ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cut_file_is_bad_input_wherever_it_is_cut(tmp_path: Path) -> None:
    path = written(tmp_path, WARP_0, WARP_1)
    whole = path.read_text()
    packed = lzma.compress(whole.encode())
    for size in range(20, len(whole) - len("#END_TB\n"), 29):
        path.write_text(whole[:size])
        with pytest.raises(InputError, match=r"k\.traceg: line"):
            open_trace(path)
    for size in range(6, len(packed), 31):
        path.write_bytes(packed[:size])
        with pytest.raises(InputError, match=r"k\.traceg: line"):
            open_trace(path)


def test_missing_files_are_bad_input(tmp_path: Path) -> None:
    (tmp_path / "kernelslist.g").write_text("kernel-1.traceg\n")
    with pytest.raises(InputError, match=r"kernel-1\.traceg: no such file"):
        open_trace(tmp_path)
    (tmp_path / "kernelslist.g").write_text("MemcpyHtoD,0x0,4\n")
    with pytest.raises(InputError, match="lists no kernel"):
        open_trace(tmp_path)


def test_a_file_that_changes_after_it_was_opened_is_noticed(tmp_path: Path) -> None:
    path = written(tmp_path, WARP_0, WARP_1)
    trace = open_trace(path)
    path.write_text(path.read_text().replace("1 R6 LDG.E.64 1", "1 R6 ATOM.E.64 1"))
    with pytest.raises(InputError, match="has changed since it was opened"):
        list(trace.chunks())


def some_trace(num_warps: int = 200) -> Trace:
    random = np.random.default_rng(5)
    address = random.integers(1, 2**30, (num_warps, 9, 32), dtype=np.uint64) * np.uint64(8)
    return lane_address_trace(address, **SCALARS)


@pytest.mark.parametrize("mode", MODES)
def test_the_size_is_known_before(mode: str, tmp_path: Path) -> None:
    for trace in (some_trace(), scatter(96, 64, 6.0, 8, adaptive=True, frames=2)):
        size = estimate_size(trace, Settings(mode))
        folder = exported(trace, tmp_path, mode=mode)
        written = sum(path.stat().st_size for path in folder.glob("kernel-*.traceg"))
        assert size.num_bytes == pytest.approx(written, rel=0.1)
        assert size.num_kernels == len(trace.launches)
        assert size.num_lane_fetches == check(trace).num_lane_fetches


def test_a_long_launch_is_written_and_read_in_pieces(tmp_path: Path) -> None:
    trace = some_trace(2000)
    told: list[int] = []
    write_accel_sim(trace, tmp_path / "out", progress=told.append)
    back = open_trace(tmp_path / "out")
    assert len(list(back.chunks())) > 1
    assert rows_of(back) == rows_of(trace)
    assert told == sorted(told) and told[-1] == 2000 * 9 * 32


def test_output_replaces_nothing(tmp_path: Path) -> None:
    used = tmp_path / "used"
    used.mkdir()
    write_accel_sim(some_trace(4), used)
    with pytest.raises(InputError, match="used: is not empty"):
        write_accel_sim(some_trace(4), used)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: is a file"):
        write_accel_sim(some_trace(4), tmp_path / "file")
    with pytest.raises(InputError, match="does not exist"):
        write_accel_sim(some_trace(4), tmp_path / "none" / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "used"]


def broken(trace: Trace) -> Trace:
    """The trace with its last chunk missing."""
    chunks = list(trace.chunks())
    return from_chunks(chunks[:-1], (), trace.instructions, trace.launches)


def test_a_failed_export_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="are missing"):
        write_accel_sim(broken(some_trace()), tmp_path / "out")
    for changes, message in (
        ({"mode": "packed"}, "unknown export mode 'packed'"),
        ({"binary_version": 90}, "binary version 90: allowed are 35"),
        ({"layout": "mortn"}, "unknown layout 'mortn'"),
    ):
        with pytest.raises(InputError, match=message):
            write_accel_sim(scatter(16, 8, 6.0, 2), tmp_path / "out", Settings(**changes))

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(WorkError, match="out: cannot write: No space left on device"):
        write_accel_sim(some_trace(), tmp_path / "out")
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_unknown_arithmetic_cannot_be_exported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown kind of arithmetic 'fp16'"):
        write_accel_sim(bilinear_trace(0, (("fp16", 1),)), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_the_command_exports_what_then_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_parquet(scatter(64, 32, 6.0, 4), "t.parquet")
    arguments = ["export", "t.parquet", "--to", "accel-sim", "--mode", "packed-sectors"]
    assert run_command([*arguments, "-o", "out", "--binary-version", "61"]) == 0
    said = capsys.readouterr().err
    assert "1 kernels" in said and "MB" in said
    assert "-binary version = 61" in (tmp_path / "out" / "kernel-1.traceg").read_text()
    assert run_command(["run", "out", "--gpu", "titan-x-pascal"]) == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--to", "gem5", "-o", "out"], ["'gem5'", "accel-sim"]),
        (["-o", "out"], ["--to"]),
        (["--to", "accel-sim"], ["--output"]),
        (["--to", "accel-sim", "-o", "no/out"], ["no/out", "'no'"]),
        (["--to", "accel-sim", "-o", "out", "--mode", "packd"], ["'packd'", "'packed-sectors'"]),
        (["--to", "accel-sim", "-o", "out", "--binary-version", "90"], ["90", "75"]),
        (["--to", "accel-sim", "-o", "out", "--layout", "mortn"], ["'mortn'", "'morton'"]),
    ],
)
def test_bad_export_commands_are_one_line_and_leave_nothing(
    arguments: list[str],
    named: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_parquet(scatter(16, 8, 6.0, 2), "t.parquet")
    assert run_command(["export", "t.parquet", *arguments]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line]
    for words in named:
        assert words in line
    assert [path.name for path in tmp_path.iterdir()] == ["t.parquet"]
