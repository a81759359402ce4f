"""The kernels run clean under oclgrind: no access out of bounds, no data race."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.skipif(
    shutil.which("oclgrind") is None, reason="oclgrind is not installed (apt install oclgrind)"
)

BROKEN_KERNELS = {
    "out_of_bounds": "kernel void run(global int *a) { a[get_global_id(0) + 1] = 1; }",
    "race": "kernel void run(global int *a) { a[0] = get_global_id(0); }",
    "missing_barrier": """kernel void run(global int *a) {
      local int t[8]; int l = get_local_id(0); t[l] = l; a[l] = t[7 - l]; }""",
}
RUN_BROKEN = """
import sys
import pyopencl as cl
from kernels.opencl.device import open_device
device = open_device()
buffer = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 32)
device.build(sys.argv[1]).run(device.queue, (8,), (8,), buffer)
device.queue.finish()
"""

# The distance grid of the head has a million nodes, a minute under oclgrind: the same kernels on a
# grid a quarter as fine.
RENDER_HEAD = """
import re
from kernels.scenes import head
from kernels.scenes.camera import CAMERAS

text = head.source()
text, sides = re.subn(r"(?m)^(#define GRID_[XYZ]) (\\d+)$",
                      lambda m: f"{m[1]} {int(m[2]) // 4}", text)
text, steps = re.subn(r"(?m)^(#define GRID_STEP) ([0-9.]+)f$",
                      lambda m: f"{m[1]} {float(m[2]) * 4}f", text)
assert (sides, steps) == (3, 1), "the grid is defined in another way: adapt this test"
head.source, head.GRID = lambda: text, tuple(side // 4 for side in head.GRID)
head.render_head(CAMERAS["front"], 23, 17)
"""

# Sides that are no multiple of a work-group, so that every kernel meets the frame's border; a hole
# and a depth step in the skin; an edge in the light, so that adaptive counts differ; small chunks.
RECORD = """
import json, sys
import numpy as np
from kernels.frame import render
from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.record import record

height, width = 19, 21
y, x = np.mgrid[0:height, 0:width].astype(np.float32)
skin = (x - 10) ** 2 + (y - 9) ** 2 > 4
light = np.where(skin, np.where(x > 9, 1.0, 0.1), 0)[..., None]
gbuffer = GBuffer(
    name="plate",
    irradiance=np.broadcast_to(light, (height, width, 3)).astype(np.float32),
    albedo=np.full((height, width, 3), 0.5, np.float32),
    non_subsurface=np.zeros((height, width, 3), np.float32),
    depth_cm=np.where(y > 12, 25, 20).astype(np.float32),
    normal=np.broadcast_to(np.float32([0, 0, 1]), (height, width, 3)).copy(),
    profile_id=skin.astype(np.uint8),
    projection_x=40.0,
    importance=(x > 12).astype(np.float32),
)
method = Method(num_samples=8, b_min=2, b_max=8, **json.loads(sys.argv[1]))
render(gbuffer, method, num_frames=2)
trace = record(
    gbuffer, method, num_frames=2, traced_frames="all", chunk_bytes=1 << 14, self_check=False
)
assert sum(chunk.num_rows for chunk in trace.chunks()) > 0
"""

#: Between them these take every branch that a method selects when its program is built.
METHODS = {
    "fixed": {},
    "adaptive": {"kind": "adaptive"},
    "adaptive-engine": {
        "kind": "adaptive",
        "rule": "engine",
        "inverse_cdf": "exact",
        "mip_rule": "textbook",
        "weights": "mean",
        "scale": "legacy",
        "tile_order": "morton",
        "lane_map": "quad2x2",
    },
    "control": {"kind": "adaptive", "control": "online", "epsilon_u": 0.3, "rule": "sliding"},
    "two-pass": {"kind": "adaptive", "estimator": "two-pass", "num_pilots": 3},
    "last-frame": {"kind": "adaptive", "estimator": "last-frame", "disocclusion": "none"},
    "separable": {"kind": "separable", "num_taps": 5},
    "hybrid": {"kind": "hybrid", "num_taps": 3, "hybrid_rules": ["painted", "count"]},
    "hybrid-fixed": {
        "kind": "hybrid",
        "num_taps": 3,
        "hybrid_count": "fixed",
        "hybrid_rules": ["painted"],
        "tile_order": "morton",
    },
    "patch": {"lds": True, "kind": "hybrid", "hybrid_rules": ["painted", "count"], "num_taps": 3},
    "plain": {
        "mip_rule": "mip0",
        "centre_reweighting": False,
        "bilateral": False,
        "normal_weights": False,
        "prefilter": False,
        "planes": ["colour"],
        "lane_map": "morton8x8",
    },
}


def errors_under_oclgrind(code, tmp_path, *arguments):
    """Run Python code on oclgrind's device; what oclgrind reports, "" if nothing."""
    log = tmp_path / "oclgrind.log"
    options = ["--data-races", "--uniform-writes", "--max-errors", "1", "--log", str(log)]
    # It stands in for the OpenCL loader itself, so no other driver is there.
    hidden = ("OCL_ICD_VENDORS", "CACHESIM_DEVICE")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        ["oclgrind", *options, sys.executable, "-c", code, *arguments],
        env={**environment, "CACHESIM_DEVICE": "oclgrind"},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return log.read_text().strip() if log.exists() else ""


@pytest.mark.parametrize("name", BROKEN_KERNELS)
def test_oclgrind_sees_a_broken_kernel(name, tmp_path):
    assert "Kernel: run" in errors_under_oclgrind(RUN_BROKEN, tmp_path, BROKEN_KERNELS[name])


def test_the_procedural_head_renders_clean(tmp_path):
    assert errors_under_oclgrind(RENDER_HEAD, tmp_path) == ""


@pytest.mark.parametrize("name", METHODS)
def test_every_pass_renders_and_records_clean(name, tmp_path):
    assert errors_under_oclgrind(RECORD, tmp_path, json.dumps(METHODS[name])) == ""


@pytest.mark.parametrize("name", ["patch", "fixed"])
def test_one_lane_per_work_item_is_clean(name, tmp_path):
    """As on GPUs; with a patch, two warps then share local memory."""
    code = f"from kernels import program\nprogram.lanes_per_item = lambda *_: 1\n{RECORD}"
    assert errors_under_oclgrind(code, tmp_path, json.dumps(METHODS[name])) == ""
