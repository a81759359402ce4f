"""`quality-traffic`: what a picture's quality costs in bytes, on five GPU generations.

A curve per method over its budget: samples of a fixed count, target variance of adaptive counts,
taps of Separable. Quality is PSNR and FLIP against many samples per pixel; the cost is what the
frame asks of the L2 and moves to and from DRAM, all passes included.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings
from experiments.reproduce.gpu_generations import GPUS

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from experiments.reproduce.parts import Parts
    from kernels.frame import Float
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

SCENES, QUICK_SCENES = ("close", "ear", "front"), ("front",)
SIZE, QUICK_SIZE = (1920, 1080), (160, 90)
FRAMES, QUICK_FRAMES = 32, 6
REFERENCE_SAMPLES, QUICK_REFERENCE_SAMPLES = 1024, 512
SOURCES = (
    "kernels", "cachesim", "traces", "experiments.reproduce.reference",
    "experiments.reproduce.quality_traffic",
)  # fmt: skip
UNFILTERED, FIXED, ADAPTIVE, SEPARABLE, HYBRID = (
    "AFIS, fixed, no mips",
    "AFIS, fixed",
    "AFIS, adaptive",
    "Separable",
    "hybrid",
)
SAMPLES, QUICK_SAMPLES = (4, 8, 16, 32, 64, 128), (8, 32)
VARIANCES, QUICK_VARIANCES = (0.008, 0.004, 0.002, 0.001, 0.0005, 0.00025), (0.004, 0.0005)
TAPS, QUICK_TAPS = (7, 11, 13, 19, 27, 51), (11, 27)
#: Column of bytes: what it is called.
TRAFFIC = {"l2_bytes": "L2 demand", "dram_bytes": "DRAM traffic"}


def list_methods(quick: bool) -> dict[str, list[tuple[float, Method]]]:
    """(budget, method) of each family, in the scale on which the paper's constants were tuned."""
    from kernels.method import Method

    samples = QUICK_SAMPLES if quick else SAMPLES
    variances = QUICK_VARIANCES if quick else VARIANCES
    taps = QUICK_TAPS if quick else TAPS
    return {
        UNFILTERED: [
            (n, Method(num_samples=n, scale="legacy", mip_rule="mip0", prefilter=False))
            for n in samples
        ],
        FIXED: [(n, Method(num_samples=n, scale="legacy")) for n in samples],
        ADAPTIVE: [(v, Method(kind="adaptive", sigma0_sq=v, scale="legacy")) for v in variances],
        SEPARABLE: [(n, Method(kind="separable", num_taps=n, scale="legacy")) for n in taps],
        HYBRID: [(v, Method(kind="hybrid", sigma0_sq=v, scale="legacy")) for v in variances],
    }


def run(settings: Settings) -> Outcome:
    """Judge every method and budget once, count it on every GPU; curves, tables, verdicts."""
    import pandas as pd

    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments.reproduce.quality_traffic_plots import traffic_figure
    from experiments.reproduce.reference import draw_reference
    from kernels.method import Method
    from kernels.scene import load_scene

    settings.progress("rendering the scenes", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    scenes = QUICK_SCENES if settings.quick else SCENES
    machines = {name: presets.load(name) for name in GPUS}
    compile_loops(timing=False)
    parts = settings.parts("quality-traffic", *SOURCES)
    as_reference = Method(scale="legacy")
    num_reference = QUICK_REFERENCE_SAMPLES if settings.quick else REFERENCE_SAMPLES
    budgets = [(f, b, m) for f, own in list_methods(settings.quick).items() for b, m in own]
    rows: list[dict[str, Any]] = []
    total = len(scenes) * len(budgets)
    for scene in scenes:
        gbuffer = load_scene(scene, width, height, device=device)
        reference = draw_reference(gbuffer, as_reference, num_reference, parts, device)
        for family, budget, method in budgets:
            share = len(rows) / (total * len(machines))
            settings.progress(f"{scene}, {family}, {budget:g}", 0.02 + 0.98 * share)
            shared = {"scene": scene, "method": family, "budget": budget}
            rows += [
                shared | found
                for found in measure_kept(
                    shared, gbuffer, method, machines, reference, settings.quick, parts, device
                )
            ]
    frame = pd.DataFrame(rows)
    gains = compare_at_equal_quality(frame)
    size = f"{width}x{height}"
    figures = {
        f"{scene}-{metric}": traffic_figure(
            frame[frame["scene"] == scene], metric, f"{scene}, {size}", TRAFFIC
        )
        for scene in scenes
        for metric in ("psnr", "flip")
    }
    return Outcome(
        tables={"curves": curves_table(frame, size), "equal-quality": gains},
        figures=figures,
        comparisons=judge(gains),
        words=(
            "Each point is one frame of one method at one budget: bytes of all its passes, with "
            "irradiance, normals and profile ids fetched, against the frame's quality over the "
            "pixels that scatter. Up and to the left is better in PSNR, down and to the left in "
            "FLIP. An adaptive frame reads its history too; it is the last of "
            f"{QUICK_FRAMES if settings.quick else FRAMES}, judged by itself, not blended.",
            "PSNR is on the shown luminance, FLIP on the picture clipped to [0, 1] at 67 pixels "
            "per degree, both against "
            f"{num_reference} samples per pixel "
            "from the finest mip. The DRAM of the GPUs whose caches hold the whole frame moves "
            "each texel once, whatever the method; small frames fit in every L2.",
        ),
    )


def measure_kept(
    shared: dict[str, Any],
    gbuffer: GBuffer,
    method: Method,
    machines: dict[str, Gpu],
    reference: Float,
    quick: bool,
    parts: Parts,
    device: Device,
) -> list[dict[str, Any]]:
    """A row per GPU: the quality and the bytes of one method's frame, read where finished."""
    from experiments.p4000_study import digest
    from experiments.reproduce.parts import cell_name

    num_frames = (QUICK_FRAMES if quick else FRAMES) if method.adaptive else 1
    inputs = {
        "gbuffer": digest(gbuffer),
        "method": method.as_dict(),
        "num_frames": num_frames,
        "reference": QUICK_REFERENCE_SAMPLES if quick else REFERENCE_SAMPLES,
        "gpus": {name: gpu.model_dump(mode="json") for name, gpu in machines.items()},
    }

    def measure() -> list[dict[str, Any]]:
        quality = measure_quality(gbuffer, method, reference, num_frames, device)
        traffic = measure_traffic(gbuffer, method, list(machines.values()), num_frames, device)
        return [
            {"gpu": name, **quality, **found} for name, found in zip(machines, traffic, strict=True)
        ]

    rows: list[dict[str, Any]] = parts.json(
        cell_name("{scene}-{method}-{budget:g}".format(**shared)), inputs, measure
    )
    return rows


def measure_quality(
    gbuffer: GBuffer, method: Method, reference: Float, num_frames: int, device: Device
) -> dict[str, Any]:
    """PSNR in dB, FLIP and samples per scattering pixel of the last frame."""
    from kernels.frame import render
    from kernels.quality import flip, psnr

    shown = render(gbuffer, method, num_frames, device)
    mask = gbuffer.subsurface
    return {
        "psnr_db": psnr(shown.combined, reference, mask),
        "flip": flip(shown.combined, reference, mask),
        "mean_samples": float(shown.num_samples / mask.sum()),
    }


def measure_traffic(
    gbuffer: GBuffer, method: Method, gpus: list[Gpu], num_frames: int, device: Device
) -> list[dict[str, Any]]:
    """Bytes asked of L1 and L2 and moved to and from DRAM by the last frame, on each GPU; the
    frames are rendered once for all of them.
    """
    from cachesim import simulate_all
    from kernels.record import record

    trace = record(gbuffer, method, num_frames=num_frames, device=device, self_check=False)
    return [
        {
            "lane_fetches": report.lane_fetches,
            "l1_bytes": report.counters["l1"].demand_bytes,
            "l2_bytes": report.counters["l2"].demand_bytes,
            "dram_bytes": report.dram.bytes,
        }
        for report in simulate_all(trace, gpus)
    ]


def compare_at_equal_quality(frame: pd.DataFrame) -> pd.DataFrame:
    """For every scene, GPU and point of the adaptive methods and Separable: its bytes over those
    that a fixed count, with mips, needs for the same PSNR; NaN outside the fixed counts' range.
    """
    import pandas as pd

    rows = []
    for (scene, gpu), part in frame.groupby(["scene", "gpu"], sort=False):
        fixed = part[part["method"] == FIXED].sort_values("psnr_db")
        for _, row in part[part["method"].isin((ADAPTIVE, SEPARABLE, HYBRID))].iterrows():
            found = {"scene": scene, "gpu": gpu, "method": row["method"], "budget": row["budget"],
                     "psnr_db": row["psnr_db"]}  # fmt: skip
            for column in TRAFFIC:
                needed = bytes_for(fixed["psnr_db"], fixed[column], float(row["psnr_db"]))
                found[f"{column}_ratio"] = float(row[column]) / needed
            rows.append(found)
    return pd.DataFrame(rows)


def bytes_for(psnr_db: Any, num_bytes: Any, wanted_db: float) -> float:
    """Bytes at a PSNR, on the curve that log bytes draw over ascending PSNR; NaN outside it."""
    at, logs = np.asarray(psnr_db, float), np.log(np.asarray(num_bytes, float))
    return float(np.exp(np.interp(wanted_db, at, logs, left=np.nan, right=np.nan)))


def judge(gains: pd.DataFrame) -> tuple[Comparison, ...]:
    """What each method's frames cost beside fixed counts of the same PSNR, on every GPU."""
    found = []
    for method in (ADAPTIVE, HYBRID, SEPARABLE):
        own = gains[gains["method"] == method]
        for column, name in TRAFFIC.items():
            ratios = own[f"{column}_ratio"].dropna()
            quantity = f"{name}, {method} / fixed count of the same PSNR"
            if ratios.empty:
                verdict = "no fixed count here has the same PSNR"
                found.append(Comparison(quantity, None, "-", verdict=verdict))
                continue
            lower = int((ratios < 1).sum())
            found.append(
                Comparison(
                    quantity,
                    None,
                    f"{ratios.min():.2f} to {ratios.max():.2f}",
                    verdict=f"median {ratios.median():.2f}; lower in {lower} of {len(ratios)} "
                    "points that have a fixed count of the same PSNR",
                )
            )
    return tuple(found)


def curves_table(frame: pd.DataFrame, size: str) -> Any:
    """Every point."""
    from experiments.tables import Column, Table

    shown = frame.assign(l2_mb=frame["l2_bytes"] / 1e6, dram_mb=frame["dram_bytes"] / 1e6)
    columns = (
        Column("scene", "scene"),
        Column("gpu", "GPU"),
        Column("method", "method"),
        Column("budget", "budget", "g"),
        Column("mean_samples", "samples or taps", ".1f"),
        Column("psnr_db", "PSNR (dB)", ".2f"),
        Column("flip", "FLIP", ".4f"),
        Column("l2_mb", "L2 (MB)", ",.2f"),
        Column("dram_mb", "DRAM (MB)", ",.2f"),
    )
    note = "Budget: samples, target variance or taps of each pass."
    return Table(f"Quality and traffic of one frame, {size}", shown, columns, (note,))


EXPERIMENT = Experiment(
    name="quality-traffic",
    title="FLIP and PSNR against L2 and DRAM bytes: a curve per method, a panel per GPU",
    chapter="3 to 6",
    figure="none: it sums the study up",
    minutes=100,
    quick_minutes=0.3,
    run=run,
)
