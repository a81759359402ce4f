"""Lane-address files: what the Trace says equals what the format's description says, and bad files
are told apart.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from traces.check import check
from traces.errors import InputError, WorkError
from traces.lane_address import lane_address_trace, read_lane_address, write_lane_address
from traces.open import open_trace
from traces.parquet import write_parquet
from traces.synthetic import stream
from traces.texture import INACTIVE_ADDRESS
from traces.trace import WAIT, Trace

SCALARS = {"warps_per_cta": 2, "loads_in_flight": 4, "compute_per_load": 3, "bytes_per_lane": 8}


def some_addresses(warps: int = 4, loads: int = 6) -> np.ndarray:
    """Distinct multiples of 8, with every third lane inactive."""
    addresses = np.arange(1, warps * loads * 32 + 1, dtype=np.uint64).reshape(warps, loads, 32) * 8
    addresses[..., ::3] = 0
    return addresses


def warp_programs(trace: Trace) -> list[list[str]]:
    """What each warp issues, in order: "int", "fp32", "load", "store", and "back n" where it waits
    until its first n loads are back.
    """
    programs = []
    for chunk in trace.chunks():
        for begin, end in zip(chunk.warp_offsets, chunk.warp_offsets[1:], strict=False):
            issued: list[str] = []
            for index in chunk.instruction[begin:end]:
                instruction = trace.instructions[index]
                issue(issued, instruction.arithmetic)
                if instruction.num_outstanding >= 0:
                    issue(issued, ((WAIT, instruction.num_outstanding),))
                issued.append(instruction.operation)
            issue(issued, trace.launches[0].trailing_arithmetic)
            programs.append(issued)
    return programs


def issue(issued: list[str], arithmetic: tuple[tuple[str, int], ...]) -> None:
    for kind, count in arithmetic:
        if kind == WAIT:
            issued.append(f"back {issued.count('load') - count}")
        else:
            issued += [kind] * count


@given(
    stores=st.lists(st.booleans(), max_size=12),
    loads_in_flight=st.integers(1, 5),
    compute_per_load=st.integers(1, 3),
)
def test_a_warp_issues_what_the_format_describes(
    stores: list[bool], loads_in_flight: int, compute_per_load: int
) -> None:
    expected, num_loads = ["int"], 0
    for begin in range(0, len(stores), loads_in_flight):
        group = stores[begin : begin + loads_in_flight]
        expected += ["store" if store else "load" for store in group]
        for _ in range(group.count(False)):
            # Each load's FMAs use that load's result.
            num_loads += 1
            expected += [f"back {num_loads}"] + ["fp32"] * compute_per_load
    trace = lane_address_trace(
        some_addresses(4, len(stores)),
        **SCALARS | {"loads_in_flight": loads_in_flight, "compute_per_load": compute_per_load},
        stores=np.array(stores, bool),
    )
    assert warp_programs(trace) == [expected] * 4
    check(trace)


def test_without_fmas_a_load_waits_for_its_register() -> None:
    """At place p of its group it takes the register of the load at place p of the group before."""
    scalars = SCALARS | {"loads_in_flight": 3, "compute_per_load": 0}
    (program, *_) = warp_programs(lane_address_trace(some_addresses(4, 8), **scalars))
    later = [word for k in range(1, 6) for word in (f"back {k}", "load")]
    assert program == ["int", "load", "load", "load", *later]
    stores = np.arange(8) % 4 == 1
    scalars |= {"loads_in_flight": 4}
    (program, *_) = warp_programs(
        lane_address_trace(some_addresses(4, 8), **scalars, stores=stores)
    )
    first = ["int", "load", "store", "load", "load"]
    assert program == [*first, "back 1", "load", "store", "back 2", "load", "back 3", "load"]


def test_a_thread_has_32_registers() -> None:
    assert lane_address_trace(some_addresses(), **SCALARS).launches[0].registers_per_thread == 32


def test_addresses_come_back_in_warp_order_with_inactive_lanes_marked(tmp_path: Path) -> None:
    addresses = some_addresses(4, 6)
    path = tmp_path / "trace.npz"
    write_lane_address(path, addresses, **SCALARS)
    trace = open_trace(path)
    lanes = np.concatenate([chunk.lanes for chunk in trace.chunks()])
    expected = np.where(addresses == 0, INACTIVE_ADDRESS, addresses).reshape(-1, 32)
    np.testing.assert_array_equal(lanes, expected)
    assert trace.launches[0].num_ctas == 2
    assert trace.is_lane_address
    assert {key: trace.manifest[key] for key in SCALARS} == SCALARS
    assert check(trace).num_lane_fetches == np.count_nonzero(addresses)


def test_equal_instructions_are_one(tmp_path: Path) -> None:
    trace = lane_address_trace(some_addresses(2, 400), **SCALARS)
    # The warp's first access, those after FMAs, and the rest.
    assert len(trace.instructions) == 3


def test_stores_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "trace.npz"
    stores = np.array([False, True, False, True, False, True])
    write_lane_address(path, some_addresses(), **SCALARS, stores=stores)
    trace = read_lane_address(path)
    chunk = next(iter(trace.chunks()))
    operations = [trace.instructions[i].operation for i in chunk.instruction[:6]]
    assert operations == ["load", "store"] * 3


def test_a_trace_without_accesses_has_its_warps(tmp_path: Path) -> None:
    path = tmp_path / "empty.npz"
    write_lane_address(path, np.zeros((2048, 0, 32), np.uint64), **SCALARS)
    trace = read_lane_address(path)
    summary = check(trace)
    assert (summary.num_ctas, summary.num_warps, summary.num_rows) == (1024, 2048, 0)
    assert trace.launches[0].trailing_arithmetic == (("int", 1),)


def test_a_partial_last_cta_is_filled_with_idle_warps() -> None:
    trace = lane_address_trace(some_addresses(5, 3), **SCALARS)
    summary = check(trace)
    assert (summary.num_ctas, summary.num_warps, summary.num_rows) == (3, 6, 15)
    assert trace.manifest["padding_warps"] == 1
    lengths = np.concatenate([np.diff(chunk.warp_offsets) for chunk in trace.chunks()])
    assert lengths.tolist() == [3] * 5 + [0]


def test_long_traces_come_in_several_chunks_with_the_same_rows() -> None:
    num_warps = 1200
    addresses = (
        np.arange(1, num_warps * 64 * 32 + 1, dtype=np.uint64).reshape(num_warps, 64, 32) * 8
    )
    trace = lane_address_trace(addresses, **SCALARS)
    chunks = list(trace.chunks())
    assert len(chunks) > 1
    np.testing.assert_array_equal(
        np.concatenate([c.lanes for c in chunks]), addresses.reshape(-1, 32)
    )
    check(trace)


def save(path: Path, **changes: object) -> None:
    fields: dict[str, object] = {"addresses": some_addresses(), **SCALARS}
    fields |= changes
    np.savez(path, **{key: value for key, value in fields.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"addresses": None}, "addresses is missing"),
        ({"bytes_per_lane": None}, "bytes_per_lane is missing"),
        ({"addresses": some_addresses().astype(np.int64)}, "addresses: int64: need uint64"),
        ({"addresses": some_addresses().astype(float)}, "addresses: float64: need uint64"),
        ({"addresses": some_addresses()[0]}, "addresses: shape (6, 32): need (warps, loads, 32)"),
        ({"addresses": some_addresses()[..., :16]}, "addresses: shape (4, 6, 16)"),
        ({"addresses": np.zeros((0, 6, 32), np.uint64)}, "at least one warp"),
        (
            {"addresses": some_addresses() + np.uint64(4)},
            "at warp 0, load 0, lane 0: need multiples",
        ),
        (
            {"addresses": np.full((2, 1, 32), 2**64 - 1, np.uint64), "bytes_per_lane": 1},
            "0xffffffffffffffff at warp 0, load 0, lane 0",
        ),
        ({"warps_per_cta": 0}, "warps_per_cta 0: allowed are 1 to 32"),
        ({"warps_per_cta": -3}, "warps_per_cta -3: allowed are 1 to 32"),
        ({"warps_per_cta": 33}, "warps_per_cta 33: allowed are 1 to 32"),
        ({"warps_per_cta": 2.0}, "warps_per_cta: float64 of shape (): need one integer"),
        ({"warps_per_cta": [2, 2]}, "warps_per_cta: int64 of shape (2,): need one integer"),
        ({"loads_in_flight": 0}, "loads_in_flight 0: allowed are 1"),
        ({"compute_per_load": -1}, "compute_per_load -1: allowed are 0"),
        ({"bytes_per_lane": 12}, "bytes_per_lane 12: allowed are (1, 2, 4, 8, 16)"),
        ({"stores": np.zeros(6, np.uint8)}, "stores: uint8 of shape (6,): need bool of shape (6,)"),
        ({"stores": np.zeros(5, bool)}, "stores: bool of shape (5,): need bool of shape (6,)"),
        ({"addresses": np.array([None, {}])}, "holds pickled Python objects"),
    ],
)
def test_bad_fields_are_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = tmp_path / "bad.npz"
    save(path, **changes)
    with pytest.raises(InputError) as caught:
        open_trace(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_truncated_and_corrupt_files_are_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    save(path)
    whole = path.read_bytes()
    for size in (0, 4, 50, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"bad\.npz"):
            read_lane_address(path)
    for position in range(0, len(whole), 97):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            trace = read_lane_address(path)
        except InputError:
            continue
        # Archives do not guard their own time stamps and flags; the numbers they do.
        assert check(trace).num_lane_fetches == np.count_nonzero(some_addresses())


def test_files_of_no_known_format_are_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "trace.npz"
    with pytest.raises(InputError, match="no such file"):
        open_trace(path)
    with pytest.raises(InputError, match="no such file"):
        read_lane_address(path)
    with pytest.raises(InputError, match="cannot be read"):
        open_trace(tmp_path)
    np.save(tmp_path / "array.npy", some_addresses())
    with pytest.raises(InputError, match="is no Parquet trace, lane-address"):
        open_trace(tmp_path / "array.npy")
    with pytest.raises(InputError, match=r"is not an \.npz archive"):
        read_lane_address(tmp_path / "array.npy")


def test_the_format_is_told_by_content_not_by_name(tmp_path: Path) -> None:
    write_parquet(stream(16, 2), tmp_path / "trace.npz")
    assert open_trace(tmp_path / "trace.npz").manifest == {"scene": "stream"}


def test_writing_bad_arguments_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="warps_per_cta 0"):
        write_lane_address(tmp_path / "a.npz", some_addresses(), **SCALARS | {"warps_per_cta": 0})
    with pytest.raises(InputError, match=r"must end in \.npz"):
        write_lane_address(tmp_path / "a.parquet", some_addresses(), **SCALARS)
    with pytest.raises(InputError, match="cannot write here"):
        write_lane_address(tmp_path / "none" / "a.npz", some_addresses(), **SCALARS)
    assert list(tmp_path.iterdir()) == []


def test_no_space_is_a_work_error_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: Path, **_: object) -> None:
        Path(file).write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(WorkError, match=r"a\.npz: cannot write: No space left on device"):
        write_lane_address(tmp_path / "a.npz", some_addresses(), **SCALARS)
    assert list(tmp_path.iterdir()) == []
