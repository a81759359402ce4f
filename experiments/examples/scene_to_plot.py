"""From a scene to a DataFrame and a plot: miss rate of fixed and adaptive over the size of the L1.

Run: python experiments/examples/scene_to_plot.py [FOLDER]
"""

import sys
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from cachesim import presets, simulate_all
from kernels.method import Method
from kernels.record import record
from kernels.scene import load_scene


def main(folder: Path, width: int = 960, height: int = 540) -> pd.DataFrame:
    """Record `ear` with both methods, count each on four sizes of L1, and draw the miss rates."""
    scene = load_scene("ear", width, height)
    sizes_kib = [12, 24, 48, 96]
    gpus = [presets.load("titan-x-pascal", [f"l1.capacity={kib}KiB"]) for kib in sizes_kib]
    rows = []
    for kind, num_frames in (("fixed", 1), ("adaptive", 8)):
        trace = record(scene, Method(kind=kind), num_frames=num_frames)
        # One pass over the trace counts all four; only the last frame is traced.
        for kib, report in zip(sizes_kib, simulate_all(trace, gpus), strict=True):
            rows.append({"method": kind, "l1_kib": kib} | report.demand)
            rows[-1]["l1_miss_rate"] = report.counters["l1"].miss_rate
    frame = pd.DataFrame(rows)
    frame.to_csv(folder / "ear-l1.csv", index=False)
    figure = Figure(figsize=(4, 3), layout="constrained")
    axes = figure.add_subplot(xlabel="L1 unit (KiB)", ylabel="L1 miss rate")
    for kind, part in frame.groupby("method", sort=False):
        axes.plot(part["l1_kib"], part["l1_miss_rate"], marker="o", label=kind)
    axes.legend()
    figure.savefig(folder / "ear-l1.png", dpi=150)
    return frame


if __name__ == "__main__":
    print(main(Path(sys.argv[1] if len(sys.argv) > 1 else ".")).to_string(index=False))
