"""Measuring silicon: the files. Rows and manifest, Nsight Compute's raw page, prepared pictures."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from experiments.silicon import inputs, ncu
from experiments.silicon.cases import COUNTS, FETCHES, Case, kernel_of, passes_of
from experiments.silicon.inputs import Expected, Picture, compare_picture, pack, unpack
from experiments.silicon.measure import merge
from experiments.silicon.rows import (
    Measurements,
    Row,
    RowWriter,
    read_measurements,
    read_parts,
    write_measurements,
)
from traces.errors import InputError

CASE = Case("ear", 1920, 1080, "fixed64", "texture", "prefilter", 3)
ROWS = (
    Row("properties", "", "num_sms", 132.0, "1", "driver"),
    Row("chase", "path=load footprint_bytes=2048", "latency", 32.125, "cycles", "clock"),
    Row("workload", CASE.text, "l1tex__t_sectors_pipe_tex_mem_texture.sum", 12.0, "base", "ncu"),
)

#: As Nsight Compute 2025 prints it, cut to a few columns; the sectors stand for an 8x4 warp.
PAGE = """\
==PROF== Connected to process 4711 (/usr/bin/python3.12)
loading
"ID","Process ID","Process Name","Host Name","Kernel Name","Context","Stream","Block Size",\
"Grid Size","Device","CC","dram__sectors_read.sum","gpu__time_duration.sum",\
"l1tex__t_sectors_pipe_tex_mem_texture.sum","launch__func_cache_config"
"","","","","","","","","","","","sector","us","sector",""
"0","4711","python3.12","127.0.0.1","afis__ear__1920x1080__fixed64__texture__sampling__0__k(int)",\
"1","7","(64, 1, 1)","(32400, 1, 1)","0","9.0","1,234,567","12.5","8","CachePreferNone"
"1","4711","python3.12","127.0.0.1","elementwise","1","7","(64, 1, 1)","(1, 1, 1)","0","9.0",\
"n/a","3","","CachePreferNone"
==PROF== Disconnected from process 4711
"""


def page(*lines: str) -> str:
    return "\n".join(lines) + "\n"


def test_a_file_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "a.csv"
    write_measurements(path, Measurements({"device": "GPU"}, ROWS))
    assert read_measurements(path).rows == ROWS
    assert read_measurements(path).manifest == {"device": "GPU"}
    assert path.read_text().splitlines()[1] == "measurement,case,quantity,value,unit,source"


def test_numbers_survive_a_process_that_dies_while_it_writes():
    file = io.StringIO()
    writer = RowWriter(file)
    writer.add("chase", "a=1", "latency", 1 / 3, "cycles", "clock")
    writer.add("chase", "a=2", "latency", float("nan"), "cycles", "clock")
    file.write("chase,a=3,lat")
    assert [row.value for row in read_parts(file.getvalue())] == [1 / 3]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.replace("# {", "{"), "line 1: no manifest"),
        (lambda t: t.replace('"device": "GPU"}', '"device": '), "line 1: the manifest is no JSON"),
        (lambda t: t.replace("device", "thing"), "names no device"),
        (lambda t: t.replace("measurement,", "kind,"), "line 2: need the columns"),
        (lambda t: t.replace("32.125", "many"), "line 4: value 'many'"),
        (lambda t: t.replace("32.125", "inf"), "line 4: value 'inf': not finite"),
        (lambda t: t.replace(",cycles,clock", ",clock"), "line 4: 5 cells"),
        (lambda t: t.replace(",clock", ",guess"), "line 4: source 'guess': allowed are"),
        (lambda t: t.replace("path=load", "path"), "line 4: case"),
        (lambda t: t + t.splitlines()[-1] + "\n", "line 6: the same as line 5"),
    ],
)
def test_a_malformed_file_is_rejected_in_one_line(tmp_path, change, told):
    path = tmp_path / "a.csv"
    write_measurements(path, Measurements({"device": "GPU"}, ROWS))
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as caught:
        read_measurements(path)
    assert told in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_runs_on_one_gpu_are_put_together_and_the_first_counts():
    again = Row("properties", "", "num_sms", 7.0, "1", "driver")
    more = Row("scan", "", "memory", 700.0, "cycles", "clock")
    parts = [Measurements({"device": "A"}, ROWS), Measurements({"device": "A"}, (again, more))]
    assert merge(parts, ["a", "b"]).rows == (*ROWS, more)
    with pytest.raises(InputError, match="of different GPUs: A, B"):
        merge([parts[0], Measurements({"device": "B"}, ())], ["a", "b"])


def test_a_case_is_found_again_in_a_kernels_name_and_in_a_row():
    assert Case.of_kernel(f"{CASE.prefix}__prefilter_texture") == CASE
    assert Case.of_kernel("void at::native::elementwise_kernel") is None
    assert Case.of_words(ROWS[2].words) == CASE
    assert Case.of_words({"path": "load"}) is None


def test_the_raw_page_of_ncu_is_read_in_base_units():
    launches = ncu.parse_raw_page(PAGE, "page")
    first, second = launches
    assert Case.of_kernel(first.kernel).pass_name == "sampling"
    assert first.kernel.endswith("__k")
    assert first.values == {
        "dram__sectors_read.sum": 1234567.0,
        "gpu__time_duration.sum": 12500.0,
        "l1tex__t_sectors_pipe_tex_mem_texture.sum": 8.0,
    }
    assert second.values == {"gpu__time_duration.sum": 3000.0}


@pytest.mark.parametrize(
    ("unit", "scale"),
    [
        *(("ns", 1), ("nsecond", 1), ("usecond", 1e3), ("ms", 1e6), ("s", 1e9), ("second", 1e9)),
        *(("Kbyte", 1e3), ("Gbyte", 1e9), ("sector", 1), ("Msector", 1e6), ("%", 1), ("", 1)),
    ],
)
def test_every_unit_of_ncu_becomes_its_base(unit, scale):
    header = '"ID","Kernel Name","a__b.sum"'
    found = ncu.parse_raw_page(page(header, f'"","","{unit}"', '"0","k","2"'), "page")
    assert found[0].values["a__b.sum"] == pytest.approx(2 * scale)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no Nsight Compute CSV"),
        ("a,b\n1,2\n", "no Nsight Compute CSV"),
        (page('"ID","Kernel Name","Metric Name"', '"","",""'), "a details page"),
        (page('"ID","Kernel Name","a__b"'), "no units and no launches"),
        (page('"ID","Kernel Name","a__b"', '"0","k","1"', '"1","k","1"'), "row of units"),
        (page('"ID","Kernel Name","a"', '"","","1"', '"0","k","1"'), "no counters"),
        (page('"ID","Kernel Name","a__b"', '"","",""'), "no launches"),
        (page('"ID","Kernel Name","a__b"', '"","",""', '"0","k"'), "line 3: 2 cells: need 3"),
        (page('"ID","Kernel Name","a__b"', '"","",""', '"0","k","1..2"'), "a__b: '1..2'"),
    ],
)
def test_a_malformed_page_of_ncu_is_rejected_in_one_line(text, told):
    with pytest.raises(InputError) as caught:
        ncu.parse_raw_page(text, "page.csv")
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_only_counters_that_the_gpu_has_are_asked_for():
    listed = ncu.parse_available(
        "Metric Name  Metric Type\n----\ndram__sectors_read Counter\nsm__cycles_elapsed Counter\n"
    )
    assert listed == {"dram__sectors_read", "sm__cycles_elapsed"}
    assert ncu.choose_metrics(listed) == ["sm__cycles_elapsed.max", "dram__sectors_read.sum"]
    assert "gpc__cycles_elapsed.max" in ncu.choose_metrics(set())


def test_counters_that_the_profiler_refuses_are_found_in_its_errors():
    text = "==ERROR== Failed to find metric b__c.sum\n==PROF== a__b.sum"
    assert ncu.refused_metrics(text, ["a__b.sum", "b__c.sum"]) == ["b__c.sum"]


def test_every_measured_launch_has_a_kernel_of_the_sources():
    from experiments.silicon.build import committed_ptx, kernel_names

    known = set(kernel_names(committed_ptx("passes")))
    for counts in COUNTS:
        for fetch in FETCHES:
            for name, level in passes_of(counts, fetch, 6):
                assert kernel_of(Case("ear", 64, 64, counts, fetch, name, level)) in known


@given(
    arrays.arrays(
        st.sampled_from([np.uint8, np.uint16, np.uint32, np.float32]),
        st.tuples(st.integers(1, 5), st.integers(1, 7)),
        elements=st.integers(0, 255),
    )
)
def test_packed_arrays_come_back_bit_for_bit(array):
    assert unpack(pack(array), str(array.dtype), array.shape).tobytes() == array.tobytes()


def picture() -> Picture:
    """A picture of noise."""
    random = np.random.default_rng(1)
    made = {}
    for name, (dtype, parts) in inputs.ARRAYS.items():
        shape = (6, 10, 4) if parts == 4 else (6, 10)
        made[name] = random.integers(0, 200, shape).astype(dtype)
    expected = {"fixed64/output": Expected.of(made["albedo"])}
    return Picture("ear", 10, 6, {"fixed64": {"d": 1.5}}, made, expected)


def test_a_prepared_picture_is_read_as_it_was_written(tmp_path):
    first = picture()
    again = inputs.read_picture(inputs.write_picture(tmp_path, first))
    assert (again.scene, again.width, again.height) == ("ear", 10, 6)
    assert again.constants == first.constants
    for name, array in first.arrays.items():
        assert again.arrays[name].dtype == array.dtype
        assert (again.arrays[name] == array).all()
    assert again.expected["fixed64/output"].sha256 == first.expected["fixed64/output"].sha256


def test_a_damaged_picture_is_rejected(tmp_path):
    path = inputs.write_picture(tmp_path, picture())
    with pytest.raises(InputError, match="no such file"):
        inputs.read_picture(tmp_path / "other.npz")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="no prepared picture"):
        inputs.read_picture(path)
    path.write_text("text")
    with pytest.raises(InputError, match="no prepared picture"):
        inputs.read_picture(path)


def test_a_picture_is_told_from_one_that_differs_in_a_bit():
    texels = np.full((40, 50, 4), 0x3C00, np.uint16)
    expected = Expected.of(texels)
    same = compare_picture(texels, expected)
    assert same == {"identical": 1.0, "differing_rate": 0.0, "max_difference": 0.0}
    other = texels.copy()
    other[3, 4, 1] += 1
    found = compare_picture(other, expected)
    assert found["identical"] == 0.0
    assert found["differing_rate"] == pytest.approx(1 / 2000)
    assert found["max_difference"] == pytest.approx(2.0**-10)
    assert found["psnr"] == pytest.approx(10 * np.log10(8000 / 2.0**-20))
