"""`gpu-generations`: fixed against adaptive on Pascal, Turing, Navi 10, Navi 21 and Hopper: the
data-cache picture of the dissertation's motivation, drawn from each preset's own configuration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

GPUS = {
    "titan-x-pascal": "Pascal",
    "rtx-2080-ti": "Turing",
    "rx-5700-xt": "Navi 10",
    "rx-6900-xt": "Navi 21",
    "h100-sxm": "Hopper",
}
SCENES, QUICK_SCENES = ("close", "ear", "front"), ("front",)
SIZE, QUICK_SIZE = (1920, 1080), (160, 90)
#: Timing a frame takes some hundred times as long as counting it.
TIMED_SIZE, QUICK_TIMED_SIZE = (640, 360), (96, 54)
FRAMES, QUICK_FRAMES = 32, 6
SOURCES = ("kernels", "cachesim", "traces", "experiments.adaptive_vs_fixed")


def run(settings: Settings) -> Outcome:
    """Count and time every view on every GPU; diagrams, bars and what holds on all of them."""
    import pandas as pd

    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments import adaptive_tables as tables
    from experiments import adaptive_vs_fixed as study
    from experiments import plots
    from experiments.p4000_study import digest
    from experiments.reproduce.block_diagram import block_diagram
    from kernels.method import Method
    from kernels.scene import load_scene

    settings.progress("rendering the scenes", 0.0)
    device = settings.open_device()
    size, timed_size = (QUICK_SIZE, QUICK_TIMED_SIZE) if settings.quick else (SIZE, TIMED_SIZE)
    num_frames = QUICK_FRAMES if settings.quick else FRAMES
    machines = {name: presets.load(name) for name in GPUS}
    scenes = QUICK_SCENES if settings.quick else SCENES
    gbuffers, timed = (
        {name: load_scene(name, *shown, device=device) for name in scenes}
        for shown in (size, timed_size)
    )
    compile_loops(timing=True)
    parts = settings.parts("gpu-generations", *SOURCES)
    cells: list[dict[str, Any]] = []
    num_cells = len(gbuffers) * len(machines)
    for scene, gbuffer in gbuffers.items():
        for name, gpu in machines.items():
            settings.progress(f"{scene} on {name}", (1 + len(cells)) / (1 + num_cells))
            # The scale on which the paper's constants were tuned.
            method = Method(scale="legacy")
            inputs = {
                "gbuffer": digest(gbuffer),
                "timed": digest(timed[scene]),
                "gpu": gpu.model_dump(mode="json"),
                "method": method.as_dict(),
                "num_frames": num_frames,
            }

            def count(
                scene: str = scene, gbuffer: GBuffer = gbuffer, gpu: Gpu = gpu, m: Method = method
            ) -> dict[str, Any]:
                found = measure(scene, gbuffer, gpu, m, num_frames, device, timing=False)
                clock = measure(scene, timed[scene], gpu, m, num_frames, device, timing=True)
                return found | {"timed": clock["demand"]}

            cells.append(parts.json(f"{scene}-{name}", inputs, count))
    demand, mips, times = (
        pd.DataFrame([row for cell in cells for row in cell[key]])
        for key in ("demand", "mips", "timed")
    )
    ratios, timed_ratios = study.ratio_frame(demand), study.ratio_frame(times)
    counted_at, timed_at = (f"{width}x{height}" for width, height in (size, timed_size))
    whole = demand[demand["passes"] == "all"]
    megabytes = whole.assign(
        **{n.replace("bytes", "mb"): whole[n] / 1e6 for n in tables.DEMAND_NAMES}
    )
    diagrams = {
        f"diagram-{name}": block_diagram(gpu, f"{GPUS[name]}: {gpu.name}")
        for name, gpu in machines.items()
    }
    labels = {"l1_mb": "L1 demand (MB)", "l2_mb": "L2 demand (MB)", "dram_mb": "DRAM traffic (MB)"}
    rates = {"l1_miss_rate": "L1 miss rate", "l2_miss_rate": "L2 miss rate"}
    return Outcome(
        tables={
            "demand": tables.demand_table(
                demand, ratios, f"Fixed 64 against adaptive at {counted_at}", counted_at
            ),
            "mips": tables.mip_table(mips, f"By mip at {counted_at}"),
            "times": tables.demand_table(
                times, timed_ratios, f"With a clock at {timed_at}", timed_at
            ),
            "numbers": demand,
        },
        figures=diagrams
        | {
            "demand": plots.comparison_figure(megabytes, labels),
            "rates": plots.comparison_figure(whole, rates),
            "times": plots.comparison_figure(
                times[times["passes"] == "all"], {"time_ms": f"time at {timed_at} (ms)"}
            ),
        },
        comparisons=judge(ratios, timed_ratios, timed_at),
        words=(
            "The motivation's slide shows a simplified data-cache architecture of Turing and Navi. "
            "The diagrams here hold what the simulator is configured with: numbers beside a level "
            "are the core cycles that it adds, strokes in a level its slices or channels. The "
            "presets' fields have their sources in `cachesim presets show NAME`.",
            "Sectors are 32 B on NVIDIA and 128 B in RDNA's L0, GL1 and L2, so that a scattered "
            "texel moves four times the bytes there; the wider line pays where lanes share it.",
        ),
        captions={
            f"diagram-{name}": f"{generation}, preset `{name}`."
            for name, generation in GPUS.items()
        },
    )


def measure(
    scene: str,
    gbuffer: GBuffer,
    gpu: Gpu,
    shared: Method,
    num_frames: int,
    device: Device,
    timing: bool,
) -> dict[str, Any]:
    """One view on one GPU, fixed and adaptive, counted, or with a clock where the GPU can be timed:
    rows of the study's frames.
    """
    from dataclasses import replace

    from cachesim import simulate
    from experiments import adaptive_vs_fixed as study
    from experiments.timing_tables import timing_refusal
    from kernels.record import record

    reports: dict[str, Any] = {}
    timings: dict[str, Any] = {}
    for kind in study.METHODS:
        method = replace(shared, kind=kind)
        frames = num_frames if method.adaptive else 1
        trace = record(gbuffer, method, num_frames=frames, device=device, self_check=False)
        report = simulate(trace, gpu, timing=timing and timing_refusal(gpu) is None)
        reports[kind] = [report]
        if report.timing is not None:
            timings[kind] = {report.gpu: report.timing}
    result = study.SceneResult(scene, gbuffer, {}, {}, reports, timings)
    found = study.demand_frame([result]), study.mip_frame([result])
    return {k: f.to_dict("records") for k, f in zip(("demand", "mips"), found, strict=True)}


def judge(
    ratios: pd.DataFrame, timed_ratios: pd.DataFrame, timed_at: str
) -> tuple[Comparison, ...]:
    """What of adaptive against fixed holds on every GPU, in the sampling pass."""
    found = []
    for column, name in (
        ("l1_bytes", "L1 demand"),
        ("l2_bytes", "L2 demand"),
        ("dram_bytes", "DRAM traffic"),
        ("l1_miss_rate", "L1 miss rate"),
        ("l2_miss_rate", "L2 miss rate"),
        ("cycles", f"cycles at {timed_at}"),
    ):
        of = timed_ratios if column == "cycles" else ratios
        known = of[of["passes"] == "sampling"][column].dropna()
        if known.empty:
            continue
        lower = int((known < 1).sum())
        found.append(
            Comparison(
                f"{name}, sampling pass, adaptive / fixed, all GPUs",
                None,
                f"{known.min():.3f} to {known.max():.3f}",
                verdict=f"lower in {lower} of {len(known)} views and GPUs",
            )
        )
    return tuple(found)


EXPERIMENT = Experiment(
    name="gpu-generations",
    title="Cache demand of both methods on five GPU generations, with their block diagrams",
    chapter="1 to 3",
    figure="slide: simplified data cache architecture for Turing and Navi",
    minutes=45,
    quick_minutes=0.5,
    run=run,
)
