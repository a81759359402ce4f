"""The dissertation's central comparison: the same frame with a fixed and with an adaptive count.

In go scenes and GPUs; out come, per scene, GPU and method, the demand and miss rate of each cache
level, in total and per mip of the irradiance texture, the cycles, and the quality of both pictures.
The slides give the comparison for one GPU (TITAN X Pascal, side view) as plots without axes, so
only directions can be held against ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import pandas as pd

from cachesim import simulate_all
from cachesim.report import sum_parts
from experiments.console import StageClock
from kernels.frame import Frame, render
from kernels.method import Method
from kernels.quality import psnr, reference_image
from kernels.record import record

if TYPE_CHECKING:
    from cachesim import Report
    from cachesim.config import Gpu
    from cachesim.report import Part
    from cachesim.timing.results import TimingResult
    from kernels.gbuffer import GBuffer
    from kernels.opencl.device import Device

METHODS = ("fixed", "adaptive")
#: Of which passes a number is: of all that are traced, or of the sampling pass alone.
PASSES = ("all", "sampling")
REFERENCE_SAMPLES = 1024
#: The texture that the mip levels belong to: irradiance and depth, which the sampling pass reads.
MIPPED_TEXTURE = "setup"
#: Slides, 1080p on a Quadro P4000: PSNR of adaptive in dB, sampling time adaptive / fixed.
PAPER_PSNR_DB = {"close": 37.58, "ear": 45.70, "front": 44.28}
PAPER_TIME_RATIO = {"close": 0.140, "ear": 0.280, "front": 0.262}


@dataclass(frozen=True, eq=False)
class SceneResult:
    """One scene, both methods.

    label: the scene's name in tables. frames, psnr_db, reports: by method; reports one per GPU;
    psnr_db["accumulated"] is of adaptive's frames blended over time. timings: by method and name
    of the GPU, of those that were timed.
    """

    label: str
    gbuffer: GBuffer
    frames: dict[str, Frame]
    psnr_db: dict[str, float]
    reports: dict[str, list[Report]]
    timings: dict[str, dict[str, TimingResult]] = field(default_factory=dict)


def compare(
    label: str,
    gbuffer: GBuffer,
    gpus: Sequence[Gpu],
    *,
    num_frames: int,
    method: Method | None = None,
    timed: Sequence[Gpu] = (),
    device: Device | None = None,
    clock: StageClock | None = None,
    step: Callable[[str], None] = lambda _: None,
) -> SceneResult:
    """Render, measure, record and count one scene with both methods.

    Args:
        label: the scene's name in tables.
        gbuffer: the scene.
        gpus: what to count on, all in one pass over each recording.
        num_frames: frames of the adaptive run; the last one is shown, measured and traced.
        method: settings that both methods share.
        timed: which of the GPUs to time as well, in a second pass over each recording; counters
            are those of the first everywhere.
        device: where to render.
        clock: is given the time of each stage.
        step: is told the next stage's name.
    """
    clock = clock or StageClock()
    shared = method or Method()
    frames, qualities, reports = {}, {}, {}
    timings: dict[str, dict[str, TimingResult]] = {}

    def stage(name: str) -> Any:
        step(f"{label}: {name}")
        return clock.stage(name)

    with stage(f"reference, {REFERENCE_SAMPLES} samples per pixel"):
        reference = reference_image(gbuffer, shared, device, REFERENCE_SAMPLES)
    for kind in METHODS:
        chosen = replace(shared, kind=kind)
        count = num_frames if chosen.adaptive else 1
        with stage(f"rendering {kind}"):
            frame = render(gbuffer, chosen, num_frames=count, device=device)
        frames[kind] = frame
        qualities[kind] = psnr(frame.combined, reference, gbuffer.subsurface)
        if chosen.adaptive:
            qualities["accumulated"] = psnr(frame.accumulated, reference, gbuffer.subsurface)
        with stage(f"recording and counting {kind}"):
            trace = record(gbuffer, chosen, num_frames=count, device=device)
            reports[kind] = simulate_all(trace, gpus)
        if timed:
            with stage(f"recording and timing {kind}"):
                runs = simulate_all(trace, timed, timing=True)
                timings[kind] = {r.gpu: r.timing for r in runs if r.timing is not None}
    return SceneResult(label, gbuffer, frames, qualities, reports, timings)


def mean_count(result: SceneResult, method: str) -> float:
    """Samples per scattering pixel."""
    return result.frames[method].num_samples / int(result.gbuffer.subsurface.sum())


def quality_frame(results: Sequence[SceneResult]) -> pd.DataFrame:
    """One row per scene: what is in the frame, how many samples, and how good both pictures are."""
    rows = []
    for result in results:
        fixed, adaptive = (mean_count(result, m) for m in METHODS)
        rows.append(
            {
                "scene": result.label,
                "coverage_rate": result.gbuffer.coverage_rate,
                "pixels_per_mm": result.gbuffer.pixels_per_mm(),
                "samples_fixed": fixed,
                "samples_adaptive": adaptive,
                "samples_ratio": adaptive / fixed,
                "paper_time_ratio": PAPER_TIME_RATIO.get(result.label),
                "psnr_fixed_db": result.psnr_db["fixed"],
                "psnr_adaptive_db": result.psnr_db["adaptive"],
                "psnr_accumulated_db": result.psnr_db["accumulated"],
                "paper_psnr_adaptive_db": PAPER_PSNR_DB.get(result.label),
            }
        )
    return pd.DataFrame(rows)


def demand_frame(results: Sequence[SceneResult]) -> pd.DataFrame:
    """One row per scene, GPU, passes ("all" or "sampling") and method.

    Lane fetches, demand in bytes, miss rates, cycles and milliseconds; columns of levels that a GPU
    lacks are empty, and so are cycles and milliseconds of GPUs that were not timed.
    """
    rows = []
    for result in results:
        for gpu in range(len(result.reports["fixed"])):
            for passes in PASSES:
                for method in METHODS:
                    report = result.reports[method][gpu]
                    key = {"scene": result.label, "gpu": report.gpu}
                    key |= {"passes": passes, "method": method}
                    timing = result.timings.get(method, {}).get(report.gpu)
                    rows.append(key | _totals(report, passes) | timing_totals(timing, passes))
    return pd.DataFrame(rows)


def _totals(report: Report, passes: str) -> dict[str, Any]:
    """Lane fetches, bytes and miss rates of the whole frame, or of its sampling pass."""
    if passes == "all":
        counters, row = report.counters, dict[str, Any](report.demand)
    else:
        parts = [p for p in report.parts or () if p.pass_name == passes]
        counters = {level: sum_parts(parts, level) for level in report.levels}
        row = {"lane_fetches": sum(p.lane_fetches for p in parts)}
        row |= {f"{n}_bytes": c.demand_bytes for n, c in counters.items()}
        row["dram_bytes"] = sum(p.dram.bytes for p in parts)
    return row | {f"{name}_miss_rate": c.miss_rate for name, c in counters.items()}


def timing_totals(timing: TimingResult | None, passes: str) -> dict[str, float]:
    """Cycles and milliseconds of the whole frame, or of its sampling pass; NaN without timing."""
    if timing is None:
        return {"cycles": math.nan, "time_ms": math.nan}
    parts = [timing.total] if passes == "all" else [p for p in timing.passes if p.name == passes]
    return {
        "cycles": float(sum(p.cycles for p in parts)),
        "time_ms": sum(timing.milliseconds(p) for p in parts),
    }


def ratio_frame(demand: pd.DataFrame) -> pd.DataFrame:
    """Adaptive / fixed of every number of `demand_frame`: one row per scene, GPU and passes."""
    keys = ["scene", "gpu", "passes"]
    fixed, adaptive = (
        demand[demand["method"] == m].drop(columns="method").set_index(keys) for m in METHODS
    )
    return (adaptive / fixed).reset_index()


def mip_frame(results: Sequence[SceneResult]) -> pd.DataFrame:
    """One row per scene, GPU, method and part of memory; the parts sum to the frame's totals.

    A part is one mip of the irradiance texture, or all other textures together ("other").
    """
    rows = [
        _part_row(result.label, report, method, part)
        for result in results
        for gpu in range(len(result.reports["fixed"]))
        for method in METHODS
        for report in [result.reports[method][gpu]]
        for part in report.parts or ()
    ]
    keys = ["scene", "gpu", "method", "part"]
    frame = pd.DataFrame(rows).groupby(keys, sort=False).sum().reset_index()
    for level in ("l1", "l2"):
        frame[f"{level}_miss_rate"] = frame[f"{level}_misses"] / frame[f"{level}_accesses"]
    return frame


def _part_row(label: str, report: Report, method: str, part: Part) -> dict[str, Any]:
    name = f"mip {part.mip}" if part.texture == MIPPED_TEXTURE else "other"
    row: dict[str, Any] = {"scene": label, "gpu": report.gpu, "method": method, "part": name}
    row |= {"lane_fetches": part.lane_fetches, "dram_bytes": part.dram.bytes}
    for level in ("l1", "l2"):
        counts = part.counters[level]
        row[f"{level}_accesses"] = counts.accesses
        row[f"{level}_misses"] = counts.misses
        row[f"{level}_bytes"] = counts.demand_bytes
    return row
