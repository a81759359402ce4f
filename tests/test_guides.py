"""The guides' examples run, small, and say what they promise."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import experiments
from traces.open import open_trace

EXAMPLES = Path(experiments.__file__).parent / "examples"


def load(name: str) -> ModuleType:
    """The example as a module, from its file: the folder is no package."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.opencl
def test_a_scene_becomes_a_data_frame_and_a_plot(tmp_path: Path) -> None:
    frame = load("scene_to_plot").main(tmp_path, 96, 56)
    assert len(frame) == 8
    for _, part in frame.groupby("method"):
        assert part["l1_miss_rate"].is_monotonic_decreasing, "a larger LRU cache never misses more"
    fixed, adaptive = (frame[frame["method"] == m]["lane_fetches"] for m in ("fixed", "adaptive"))
    assert adaptive.iloc[0] < fixed.iloc[0]
    assert (tmp_path / "ear-l1.csv").stat().st_size > 100
    assert (tmp_path / "ear-l1.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.opencl
def test_a_g_buffer_of_ones_own_is_traced_and_can_be_loaded_again(tmp_path: Path) -> None:
    from kernels.scene import load_scene

    report = load("own_gbuffer").main(tmp_path, 96, 56)
    assert report.counters["l1"].accesses > 0
    again = load_scene(str(tmp_path / "ball.npz"))
    assert (again.width, again.height) == (96, 56)
    # The ball's projected radius: 10 cm at 60 cm, seen with a field of view of 30 degrees.
    radius_px = 10 / 60 * 48 / np.tan(np.radians(15))
    assert again.subsurface.sum() == pytest.approx(np.pi * radius_px**2, rel=0.03)


def test_a_pass_of_ones_own_is_traced_and_counted(tmp_path: Path) -> None:
    report = load("own_pass").main(tmp_path, 64, 16)
    assert report.lane_fetches == 64 * 16 * 10
    # 64x16 texels of 8 bytes are read from memory once.
    assert report.dram.sectors_read * 32 == 64 * 16 * 8
    # A warp's row of texels touches half of each 2x2 sector, so every sector is stored twice.
    assert report.counters["l1"].writes * 32 == 2 * 64 * 16 * 8
    assert open_trace(tmp_path / "blur.parquet").launches[0].num_ctas == 4


@pytest.mark.parametrize("name", ["scene_to_plot", "own_gbuffer", "own_pass"])
def test_examples_are_short(name: str) -> None:
    lines = (EXAMPLES / f"{name}.py").read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("def main"))
    assert len(lines) - start <= 45
