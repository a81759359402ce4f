"""Captured G-buffers: do files come back as they were, and are bad ones refused in one line?"""

import dataclasses
import os

import numpy as np
import pytest

from kernels.gbuffer import GBuffer
from kernels.scene import load_scene
from kernels.scenes.capture import CHANNELS, PLANES, load_exr, load_npz, save_exr, save_npz
from traces.errors import InputError, WorkError

OpenEXR = pytest.importorskip("OpenEXR")

SAVE = {".npz": save_npz, ".exr": save_exr}
LOAD = {".npz": load_npz, ".exr": load_exr}


def sample(height=9, width=13):
    rng = np.random.default_rng(7)
    ids = rng.integers(0, 3, (height, width)).astype(np.uint8)
    ids[0, 0] = 1
    return GBuffer(
        name="sample",
        irradiance=rng.random((height, width, 3), dtype=np.float32) * 3,
        albedo=rng.random((height, width, 3), dtype=np.float32),
        non_subsurface=rng.random((height, width, 3), dtype=np.float32),
        depth_cm=rng.uniform(10, 90, (height, width)).astype(np.float32),
        normal=rng.normal(size=(height, width, 3)).astype(np.float32),
        profile_id=ids,
        projection_x=3.75,
        attribution="by A. Nyone",
    )


def fields():
    gbuffer = sample()
    return {name: getattr(gbuffer, name) for name in (*CHANNELS, "projection_x")}


def write_npz(path, **changes):
    content = fields() | changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


def write_exr(path, header=None, **changes):
    """An EXR file of `sample` with channels replaced (or left out: None) by name, dots as __."""
    channels = {}
    gbuffer = sample()
    for field, names in CHANNELS.items():
        planes = getattr(gbuffer, field).reshape(9, 13, -1)
        for index, name in enumerate(names):
            dtype = np.uint32 if field == "profile_id" else np.float32
            channels[name] = np.ascontiguousarray(planes[..., index]).astype(dtype)
    channels |= {name.replace("__", "."): value for name, value in changes.items()}
    held = {name: value for name, value in channels.items() if value is not None}
    basic = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(basic | ({"projectionX": 3.75} if header is None else header), held).write(
        str(path)
    )
    return path


@pytest.mark.parametrize("suffix", SAVE)
def test_a_saved_g_buffer_comes_back_bit_for_bit(tmp_path, suffix):
    path, before = tmp_path / f"view{suffix}", sample()
    SAVE[suffix](path, before)
    after = load_scene(str(path))
    for name in CHANNELS:
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
        assert getattr(before, name).dtype == getattr(after, name).dtype
    assert after.projection_x == before.projection_x
    assert after.attribution == before.attribution
    assert os.listdir(tmp_path) == [path.name], "no temporary file stays"


@pytest.mark.parametrize("suffix", SAVE)
def test_projection_may_be_given_and_size_must_fit(tmp_path, suffix):
    path = tmp_path / f"view{suffix}"
    SAVE[suffix](path, sample())
    assert load_scene(path, 13, 9, projection_x=2.5).projection_x == 2.5
    with pytest.raises(InputError, match=r"size 26x9: the captured G-buffer is 13x9"):
        load_scene(path, 26, 9)
    with pytest.raises(InputError, match="camera: only a rendered scene"):
        load_scene(path, camera="ear")


def test_other_float_and_integer_types_are_taken(tmp_path):
    gbuffer = sample()
    half = gbuffer.irradiance.astype(np.float16)
    ids = gbuffer.profile_id.astype(np.int64)
    path = write_npz(tmp_path / "a.npz", irradiance=half, profile_id=ids, non_subsurface=None)
    loaded = load_npz(path)
    assert np.array_equal(loaded.irradiance, half.astype(np.float32))
    assert not loaded.non_subsurface.any()
    exr = write_exr(
        tmp_path / "a.exr",
        irradiance__R=half[..., 0].copy(),
        profile__ID=ids.astype(np.float32),
        nonsss__R=None,
        nonsss__G=None,
        nonsss__B=None,
    )
    loaded = load_exr(exr)
    assert np.array_equal(loaded.irradiance[..., 0], half[..., 0].astype(np.float32))
    assert np.array_equal(loaded.profile_id, gbuffer.profile_id)


def moving(height=9, width=13):
    rng = np.random.default_rng(11)
    return dataclasses.replace(
        sample(height, width),
        velocity=rng.normal(size=(height, width, 2)).astype(np.float32),
        overlay=rng.random((height, width, 4), dtype=np.float32),
        importance=rng.random((height, width), dtype=np.float32),
        jitter=(0.1, -1 / 3),
    )


@pytest.mark.parametrize("suffix", SAVE)
def test_velocity_overlay_importance_and_jitter_come_back_bit_for_bit(tmp_path, suffix):
    path, before = tmp_path / f"moving{suffix}", moving()
    SAVE[suffix](path, before)
    after = load_scene(path)
    for name in (*CHANNELS, *PLANES):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
        assert getattr(before, name).dtype == getattr(after, name).dtype
    assert after.jitter == before.jitter


@pytest.mark.parametrize("suffix", SAVE)
def test_files_without_motion_are_read_as_still(tmp_path, suffix):
    path = tmp_path / f"old{suffix}"
    (write_npz if suffix == ".npz" else write_exr)(path)
    still = LOAD[suffix](path)
    assert still.velocity is None and still.overlay is None and still.importance is None
    assert still.jitter == (0.0, 0.0)


NAN_DEPTH = np.full((9, 13), np.nan, np.float32)
BAD_FIELDS = {
    "missing": ({"depth_cm": None}, "depth_cm is missing; the file holds albedo"),
    "wrong shape": ({"albedo": np.zeros((9, 13), np.float32)}, "albedo: float32 of shape"),
    "wrong size": ({"normal": np.zeros((8, 13, 3), np.float32)}, "normal: float32 of shape"),
    "NaN depth": ({"depth_cm": NAN_DEPTH}, "depth_cm: NaN"),
    "negative depth": ({"depth_cm": np.full((9, 13), -1.0)}, "depth_cm: negative"),
    "empty": ({"profile_id": np.zeros((9, 13), np.uint8)}, "empty"),
    "no pixels": ({"depth_cm": np.zeros((0, 13), np.float32)}, "depth: shape"),
    "too large": ({"depth_cm": np.zeros((1, 16385), np.float32)}, "at most 16384"),
    "beyond float32": ({"irradiance": np.full((9, 13, 3), 1e200)}, "irradiance: NaN or infinite"),
    "profile range": ({"profile_id": np.full((9, 13), 256)}, "profile_id: int64: need whole"),
    "profile type": ({"profile_id": np.ones((9, 13))}, "profile_id: float64: need whole"),
    "text": ({"albedo": np.full((9, 13, 3), "x")}, "albedo: <U1: need numbers"),
    "pickled": ({"albedo": np.array([{}, 1], dtype=object)}, "albedo: a pickled array"),
    "projection": ({"projection_x": np.zeros(2)}, "projection_x: float64 of shape"),
    "no projection": ({"projection_x": None}, "projection_x is missing"),
    "velocity size": ({"velocity": np.zeros((9, 13, 3))}, "velocity: float32 of shape"),
    "opacity": ({"overlay": np.full((9, 13, 4), 2.0)}, "overlay: opacity: allowed are 0 to 1"),
    "jitter": ({"jitter": np.zeros(3)}, "jitter: float64 of shape (3,): need two numbers"),
    "jitter text": ({"jitter": np.array(["a", "b"])}, "jitter: <U1 of shape (2,)"),
    "jitter far": ({"jitter": np.array([3.0, 0.0])}, "jitter (3.0, 0.0): allowed are -2 to 2"),
    "jitter NaN": ({"jitter": np.array([0.0, np.nan])}, "jitter (0.0, nan): allowed"),
    "projection zero": ({"projection_x": -1.0}, "projection_x -1.0: must be positive"),
}


@pytest.mark.parametrize("case", BAD_FIELDS)
def test_a_bad_npz_field_is_named_in_one_line(tmp_path, case):
    changes, words = BAD_FIELDS[case]
    path = write_npz(tmp_path / "bad.npz", **changes)
    with pytest.raises(InputError, match=r"bad\.npz") as caught:
        load_npz(path)
    assert words in str(caught.value) and "\n" not in str(caught.value)


BAD_CHANNELS = {
    "missing": ({"depth__Z": None}, "channel depth.Z (depth_cm) is missing; the file holds N.X"),
    "half a field": ({"nonsss__G": None}, "channel nonsss.G"),
    "NaN depth": ({"depth__Z": NAN_DEPTH}, "depth_cm: NaN"),
    "negative depth": ({"depth__Z": np.full((9, 13), -2, np.float32)}, "depth_cm: negative"),
    "empty": ({"profile__ID": np.zeros((9, 13), np.uint32)}, "empty"),
    "profile range": ({"profile__ID": np.full((9, 13), 300, np.uint32)}, "need whole numbers"),
    "profile part": ({"profile__ID": np.full((9, 13), 0.5, np.float32)}, "need whole numbers"),
    "profile NaN": ({"profile__ID": NAN_DEPTH}, "need whole numbers"),
    "no projection": ({"header": {}}, "projection_x is missing"),
    "half a velocity": ({"velocity__X": np.zeros((9, 13), np.float32)}, "channel velocity.Y"),
    "jitter": ({"header": {"projectionX": 3.75, "jitter": "0 0"}}, "jitter: <U3 of shape ()"),
}


@pytest.mark.parametrize("case", BAD_CHANNELS)
def test_a_bad_exr_channel_is_named_in_one_line(tmp_path, case):
    changes, words = BAD_CHANNELS[case]
    path = write_exr(tmp_path / "bad.exr", **changes)
    with pytest.raises(InputError, match=r"bad\.exr") as caught:
        load_exr(path)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", SAVE)
@pytest.mark.parametrize("keep", [0, 10, 0.3, 0.6, 0.95])
def test_a_truncated_file_is_refused(tmp_path, suffix, keep):
    path = tmp_path / f"cut{suffix}"
    SAVE[suffix](path, sample(60, 80))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep if keep >= 1 else keep * len(whole))])
    with pytest.raises(InputError, match=f"cut{suffix}") as caught:
        LOAD[suffix](path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", SAVE)
def test_a_corrupt_file_is_refused_or_read_as_written(tmp_path, suffix):
    path, before = tmp_path / f"flip{suffix}", sample(30, 40)
    SAVE[suffix](path, before)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for position in rng.integers(0, len(whole), 40):
        broken = bytearray(whole)
        broken[position] ^= 0xFF
        path.write_bytes(bytes(broken))
        try:
            LOAD[suffix](path)
        except InputError as error:
            assert path.name in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("suffix", LOAD)
def test_what_is_no_such_file_is_refused(tmp_path, suffix):
    with pytest.raises(InputError, match="no such file"):
        LOAD[suffix](tmp_path / f"none{suffix}")
    path = tmp_path / f"text{suffix}"
    path.write_text("hello")
    with pytest.raises(InputError, match="not a readable"):
        LOAD[suffix](path)


def test_a_single_array_is_refused(tmp_path):
    path = tmp_path / "single.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(InputError, match="one array"):
        load_npz(path)


@pytest.mark.parametrize("suffix", SAVE)
def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"kept{suffix}"
    path.write_bytes(b"old")

    def fail(*args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    monkeypatch.setattr(OpenEXR.File, "write", fail)
    with pytest.raises(WorkError, match="No space left"):
        SAVE[suffix](path, sample())
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == [path.name]
    with pytest.raises(InputError, match="cannot write"):
        SAVE[suffix](tmp_path / "missing" / path.name, sample())


def test_an_odd_profile_survives_both_ways(tmp_path):
    odd = dataclasses.replace(sample(), profile_id=np.full((9, 13), 255, np.uint8))
    for suffix, save in SAVE.items():
        save(tmp_path / f"odd{suffix}", odd)
        assert (LOAD[suffix](tmp_path / f"odd{suffix}").profile_id == 255).all()
