"""The native file gives back what was written, or says what is wrong with the file."""

import json
import resource
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from strategies import traces

from traces.check import check
from traces.errors import InputError, WorkError
from traces.parquet import read_parquet, write_parquet
from traces.row_groups import ROWS_PER_GROUP
from traces.synthetic import gather, pixel_pass, scatter, stream
from traces.texture import Texture
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

TEXTURE = Texture("setup", "RGBA16F", 64, 48, 3)


def rows(trace: Trace) -> dict[int, tuple]:
    """All rows of each launch in one piece, whatever the chunks."""
    joined: dict[int, tuple] = {}
    for chunk in trace.chunks():
        lengths = np.diff(chunk.warp_offsets)
        if chunk.launch in joined:
            before = joined[chunk.launch]
            parts = zip(before, (lengths, chunk.instruction, chunk.lanes), strict=True)
            joined[chunk.launch] = tuple(np.concatenate(pair) for pair in parts)
        else:
            joined[chunk.launch] = (lengths, chunk.instruction, chunk.lanes)
    return joined


def assert_same(read: Trace, written: Trace) -> None:
    assert read.manifest == written.manifest
    assert list(read.textures) == list(written.textures)
    assert list(read.instructions) == list(written.instructions)
    assert read.launches == written.launches
    got, expected = rows(read), rows(written)
    assert got.keys() == expected.keys()
    for launch in expected:
        for a, b in zip(got[launch], expected[launch], strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(trace=traces())
def test_any_trace_comes_back_exactly(tmp_path: Path, trace: Trace) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(trace, path)
    assert_same(read_parquet(path), trace)


@pytest.mark.parametrize(
    "trace",
    [
        scatter(40, 24, 18.0, 5, adaptive=True, frames=2),
        pixel_pass(TEXTURE, "store", mip=1),
        stream(64, 8),
        stream(64, 0),
    ],
    ids=["scatter", "pixel pass", "stream", "no loads"],
)
def test_realistic_traces_come_back_and_can_be_read_again(tmp_path: Path, trace: Trace) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(trace, path)
    read = read_parquet(path)
    assert_same(read, trace)
    assert_same(read, trace)


def test_rows_are_columns_that_any_parquet_reader_understands(tmp_path: Path) -> None:
    trace = pixel_pass(Texture("small", "R8", 12, 6))
    path = tmp_path / "trace.parquet"
    write_parquet(trace, path)
    table = pq.read_table(path)
    # Two tiles of two warps; of the lower warp of each the two rows within the six are active, and
    # 4 of 8 columns of the right.
    assert table.column("cta").to_pylist() == [0, 0, 1, 1]
    assert table.column("warp").to_pylist() == [0, 1, 0, 1]
    assert table.column("step").to_pylist() == [0, 0, 0, 0]
    assert table.column("mask").to_pylist() == [0xFFFFFFFF, 0xFFFF, 0x0F0F0F0F, 0x0F0F]


def test_large_chunks_are_cut_and_small_ones_merged_into_row_groups(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    written = stream(2 * ROWS_PER_GROUP // 64, 64, warps_per_cta=4)
    whole = Chunk(
        0,
        0,
        np.arange(0, 2 * ROWS_PER_GROUP + 1, 64, dtype=np.int64),
        np.concatenate([c.instruction for c in written.chunks()]),
        np.concatenate([c.lanes for c in written.chunks()]),
    )
    write_parquet(
        from_chunks([whole], (), written.instructions, written.launches, written.manifest), path
    )
    assert [c.num_rows for c in read_parquet(path).chunks()] == [ROWS_PER_GROUP] * 2
    write_parquet(gather(Texture("tall", "R8", 8, 512), 2, 3), path)
    assert pq.ParquetFile(path).num_row_groups == 1


def test_one_cta_larger_than_a_row_group_stays_whole(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    num_rows = ROWS_PER_GROUP + 10
    chunk = Chunk(
        0,
        0,
        np.array([0, num_rows], np.int64),
        np.zeros(num_rows, np.uint16),
        np.zeros((num_rows, 32), np.uint32),
    )
    trace = from_chunks([chunk], [TEXTURE], [Instruction("p", 0)], [Launch(0, "p", 1, 1)])
    write_parquet(trace, path)
    assert [c.num_rows for c in read_parquet(path).chunks()] == [num_rows]


def test_launches_may_be_appended_while_the_recording_runs(tmp_path: Path) -> None:
    static = scatter(16, 16, 7.0, 2, frames=3)
    launches: list[Launch] = []

    def live() -> Iterator[Chunk]:
        launches.clear()
        for chunk in static.chunks():
            if chunk.launch == len(launches):
                launches.append(static.launches[chunk.launch])
            yield chunk

    write_parquet(replace(static, launches=launches, source=live), tmp_path / "live.parquet")
    assert_same(read_parquet(tmp_path / "live.parquet"), static)


def test_scattered_fetches_meet_the_size_targets_and_regular_ones_take_next_to_nothing(
    tmp_path: Path,
) -> None:
    path = tmp_path / "trace.parquet"
    for pixels_per_mm, allowed in ((60.0, 1.8), (7.0, 1.0)):
        trace = scatter(512, 64, pixels_per_mm, 32, adaptive=True)
        write_parquet(trace, path)
        assert path.stat().st_size < allowed * check(trace).num_lane_fetches
    trace = pixel_pass(Texture("frame", "RGBA16F", 2048, 1024))
    write_parquet(trace, path)
    assert path.stat().st_size < 0.03 * check(trace).num_lane_fetches


def test_progress_counts_lane_fetches(tmp_path: Path) -> None:
    done: list[int] = []
    trace = gather(TEXTURE, 3, 2)
    write_parquet(trace, tmp_path / "trace.parquet", done.append)
    assert done == sorted(done)
    assert done[-1] == 64 * 48 * 2


class Interrupted(Exception):
    pass


@pytest.mark.parametrize("error", [Interrupted, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "trace.parquet"
    good = gather(TEXTURE, 3, 2)
    write_parquet(good, path)

    def broken() -> Iterator[Chunk]:
        yield next(iter(good.chunks()))
        raise error

    with pytest.raises(error):
        write_parquet(replace(good, source=broken), path)
    assert_same(read_parquet(path), good)
    assert list(tmp_path.iterdir()) == [path]


def test_no_space_is_a_work_error_and_leaves_nothing(tmp_path: Path) -> None:
    trace = scatter(256, 64, 18.0, 16)
    write_parquet(gather(TEXTURE, 3, 2), tmp_path / "warm-up.parquet")
    (tmp_path / "warm-up.parquet").unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    try:
        with pytest.raises(WorkError, match=r"trace\.parquet: cannot write"):
            write_parquet(trace, tmp_path / "trace.parquet")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_does_not_exist_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot write here"):
        write_parquet(gather(TEXTURE, 3, 2), tmp_path / "none" / "trace.parquet")
    with pytest.raises(InputError, match="is a folder"):
        write_parquet(gather(TEXTURE, 3, 2), tmp_path)


def test_a_broken_trace_is_not_written(tmp_path: Path) -> None:
    good = gather(TEXTURE, 3, 2)
    with pytest.raises(InputError, match="CTAs 48 to 99 are missing"):
        write_parquet(replace(good, launches=[Launch(0, "gather", 100, 2)]), tmp_path / "t.parquet")
    assert list(tmp_path.iterdir()) == []


def test_every_truncation_is_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(gather(TEXTURE, 3, 2), path)
    whole = path.read_bytes()
    for size in (0, 3, 4, 100, len(whole) // 2, len(whole) - 9, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"trace\.parquet: not a readable Parquet file"):
            list(read_parquet(path).chunks())


def test_any_flipped_byte_is_bad_input_or_harmless(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    trace = gather(Texture("setup", "RGBA16F", 16, 8), 3, 1)
    write_parquet(trace, path)
    whole = path.read_bytes()
    caught = 0
    for position in range(0, len(whole), 23):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            read = read_parquet(path)
            got = rows(read)
        except InputError:
            caught += 1
        else:
            # What slips through must lie where nothing is read from, such as statistics.
            np.testing.assert_array_equal(got[0][2], rows(trace)[0][2])
    assert caught > 50


def test_other_files_are_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    with pytest.raises(InputError, match="no such file"):
        read_parquet(path)
    pq.write_table(pa.table({"a": [1, 2]}), path)
    with pytest.raises(InputError, match=r"metadata 'sss-cachesim.version' is missing"):
        read_parquet(path)


def rewrite(
    path: Path, change: dict[str, object], columns: dict[str, pa.Array] | None = None
) -> None:
    """Write the file again with some JSON texts of the metadata (None: left out) or some columns
    exchanged.
    """
    table = pq.read_table(path)
    metadata = dict(pq.ParquetFile(path).metadata.metadata)
    for key, value in change.items():
        if value is None:
            del metadata[f"sss-cachesim.{key}".encode()]
        else:
            text = value if isinstance(value, str) else json.dumps(value)
            metadata[f"sss-cachesim.{key}".encode()] = text.encode()
    for name, values in (columns or {}).items():
        index = table.schema.get_field_index(name)
        table = table.set_column(index, table.schema.field(name).with_type(values.type), values)
    pq.write_table(table.replace_schema_metadata(metadata), path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "'version': '99': this program reads version 1"),
        ({"launches": None}, "'sss-cachesim.launches' is missing"),
        ({"manifest": "{"}, "metadata 'manifest'"),
        ({"manifest": [1]}, "metadata 'manifest'"),
        ({"textures": [{"name": "a", "format": "RGB", "width": 64, "height": 48}]}, "RGB"),
        ({"textures": [{"name": "a", "format": "R8", "width": 0, "height": 48}]}, "width 0"),
        ({"textures": [{"name": "a", "format": "R8", "width": "64", "height": 48}]}, "0.width"),
        ({"textures": [{"name": "a", "format": "R8", "width": 32, "height": 48}]}, "x below 32"),
        ({"textures": []}, "a lane-address trace has texture -1"),
        (
            {"instructions": [{"pass_name": "gather", "texture": 1}]},
            "texture 1: allowed are 0 to 0",
        ),
        ({"instructions": [{"pass_name": "other", "texture": 0}]}, "of pass 'other'"),
        ({"instructions": []}, "instruction 0: allowed are 0 to -1"),
        ({"launches": [{"frame": 0, "pass_name": "gather", "num_ctas": 9}]}, "0.warps_per_cta"),
        (
            {"launches": [{"frame": 0, "pass_name": "gather", "num_ctas": 48, "warps_per_cta": 0}]},
            "warps_per_cta 0",
        ),
        ({"chunks": [[0, 0, 48, 7]]}, "other numbers of rows"),
        ({"chunks": [[1, 0, 48, 192]]}, "launch 1: allowed are 0 to 0"),
        ({"chunks": [[0, 1, 48, 192]]}, "row 0: launch 0, cta 0"),
        ({"chunks": [[0, 0, 47, 192]]}, "must be of launch 0, CTAs 0 to 46"),
        ({"chunks": [[0, 0, -1, 192]]}, "-1 CTAs"),
    ],
)
def test_contradicting_metadata_is_bad_input(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(gather(TEXTURE, 3, 2), path)
    rewrite(path, {})
    assert len(list(read_parquet(path).chunks())) == 1
    rewrite(path, change)
    with pytest.raises(InputError, match=r"trace\.parquet") as caught:
        list(read_parquet(path).chunks())
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("launch", 1, "launch 1"),
        ("cta", 47, "in order"),
        ("warp", 2, "warp 2"),
        ("step", 5, "step 5"),
        ("instruction", 1, "instruction 1: allowed are 0 to 0"),
        ("mask", 0x7FFFFFFF, "wrong length"),
        ("predictor", 1, "predictor 1 has no row to go by"),
        ("predictor", 7, "predictor 7 has no row to go by"),
        ("predictor", 99, "predictor 99 has no row to go by"),
    ],
)
def test_contradicting_columns_are_bad_input(
    tmp_path: Path, column: str, value: int, message: str
) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(gather(TEXTURE, 3, 2), path)
    values = pq.read_table(path).column(column).to_numpy().copy()
    values[0] = value
    rewrite(path, {}, {column: pa.array(values)})
    with pytest.raises(InputError, match=r"trace\.parquet") as caught:
        list(read_parquet(path).chunks())
    assert message in str(caught.value)


def test_a_wrong_column_type_is_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    write_parquet(gather(TEXTURE, 3, 2), path)
    values = pq.read_table(path).column("mask").cast(pa.uint64())
    rewrite(path, {}, {"mask": values})
    with pytest.raises(InputError, match=r"mask uint64.*need .*mask uint32"):
        read_parquet(path)


def test_a_manifest_that_is_not_json_is_refused(tmp_path: Path) -> None:
    trace = gather(TEXTURE, 3, 2)
    trace.manifest["kappa"] = float("nan")
    with pytest.raises(ValueError, match="JSON"):
        write_parquet(trace, tmp_path / "trace.parquet")
    assert list(tmp_path.iterdir()) == []
