"""Bring the G-buffer of your own engine: arrays in, a report out; and the same as an .npz file.

Run: python experiments/examples/own_gbuffer.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

from cachesim import Report, simulate
from kernels.gbuffer import GBuffer
from kernels.method import Method
from kernels.record import record
from kernels.scenes.capture import save_npz


def main(folder: Path, width: int = 960, height: int = 540) -> Report:
    """A ball of skin 20 cm across and 60 cm away, as an engine would hand it over."""
    fov_x = np.radians(30.0)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    # Position on the ball in units of its radius, from the projected size of that radius in pixels.
    radius_px = 10.0 / 60.0 * width / 2 / np.tan(fov_x / 2)
    nx, ny = (x - width / 2) / radius_px, (height / 2 - y) / radius_px
    on_ball = nx**2 + ny**2 < 1
    nz = np.sqrt(np.where(on_ball, 1 - nx**2 - ny**2, 0))
    normal = np.stack([nx, ny, nz], axis=-1) * on_ball[..., None]
    light = np.clip(normal @ np.array([0.7, 0.5, 0.5]), 0, None)
    gbuffer = GBuffer(
        name="ball",
        irradiance=(light[..., None] * [3.0, 2.8, 2.6]).astype(np.float32),  # no albedo in it
        albedo=(on_ball[..., None] * [0.8, 0.6, 0.5]).astype(np.float32),
        non_subsurface=np.zeros((height, width, 3), np.float32),  # speculars, background
        depth_cm=np.where(on_ball, 60 - 10 * nz, 0).astype(np.float32),  # linear, not 1/z
        normal=normal.astype(np.float32),
        profile_id=on_ball.astype(np.uint8),  # 1 = skin, 0 = does not scatter
        projection_x=float(1 / np.tan(fov_x / 2)),
    )
    save_npz(folder / "ball.npz", gbuffer)  # then: cachesim record --scene ball.npz ...
    trace = record(gbuffer, Method(kind="adaptive"), num_frames=8)
    return simulate(trace, "rtx-2080-ti")


if __name__ == "__main__":
    print(main(Path(sys.argv[1] if len(sys.argv) > 1 else ".")).frame().to_string(index=False))
