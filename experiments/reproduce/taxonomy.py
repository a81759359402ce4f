"""`taxonomy`: the computing, sample and memory demand of one frame, rendered homogeneously and
heterogeneously.

Chapter 3's Figure 1 sets a renderer that treats every shading unit alike against one that lowers
each of the three demands where that costs no quality. The steps between the two are taken one by
one here: pre-filtered mips lower the memory demand, adaptive counts the samples, and a technique
per tile the computing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    import pandas as pd

    from cachesim import Report
    from cachesim.config import Gpu
    from experiments.reproduce.demand_maps import DemandMaps
    from kernels.frame import Float
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

GPU, SCENE = "quadro-p4000", "front"
SIZE, QUICK_SIZE = (1920, 1080), (160, 90)
FRAMES, QUICK_FRAMES = 32, 6
REFERENCE_SAMPLES, QUICK_REFERENCE_SAMPLES = 1024, 256
SOURCES = (
    "kernels", "cachesim", "traces", "experiments.reproduce.reference",
    "experiments.reproduce.demand_maps",
)  # fmt: skip
#: The passes in which light scatters; the others are the same work for every method.
SCATTERING = ("sampling", "separable_h", "separable_v")
HOMOGENEOUS, HETEROGENEOUS = "homogeneous", "+ technique per tile"


def list_methods() -> dict[str, Method]:
    """The steps from the homogeneous to the heterogeneous method, by name."""
    from kernels.method import Method

    plain = Method(num_samples=64, scale="legacy", mip_rule="mip0", prefilter=False)
    filtered = replace(plain, mip_rule="eq-5.12", prefilter=True)
    adaptive = replace(filtered, kind="adaptive")
    return {
        HOMOGENEOUS: plain,
        "+ mips (memory)": filtered,
        "+ adaptive count (sample)": adaptive,
        HETEROGENEOUS: replace(adaptive, kind="hybrid"),
    }


def run(settings: Settings) -> Outcome:
    """Measure the steps on one frame; the demands' table, bars and maps."""
    import pandas as pd

    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments.p4000_study import digest
    from experiments.reproduce.demand_maps import DemandMaps, demand_figure
    from experiments.reproduce.reference import draw_reference
    from kernels.scene import load_scene

    settings.progress("rendering the scene", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    num_frames = QUICK_FRAMES if settings.quick else FRAMES
    num_reference = QUICK_REFERENCE_SAMPLES if settings.quick else REFERENCE_SAMPLES
    gbuffer, gpu, methods = (
        load_scene(SCENE, width, height, device=device),
        presets.load(GPU),
        list_methods(),
    )
    parts = settings.parts("taxonomy", *SOURCES)
    inputs = {"gbuffer": digest(gbuffer), "num_frames": num_frames}
    compile_loops(timing=True)
    settings.progress(f"reference, {num_reference} samples per pixel", 0.05)
    reference = draw_reference(gbuffer, methods[HOMOGENEOUS], num_reference, parts, device)
    rows, maps = [], {}
    for done, (name, method) in enumerate(methods.items()):
        settings.progress(name, 0.1 + 0.9 * done / len(methods))
        keyed = inputs | {
            "method": method.as_dict(),
            "gpu": gpu.model_dump(mode="json"),
            "reference": num_reference,
        }

        def demand(method: Method = method) -> dict[str, Any]:
            return measure(gbuffer, method, gpu, reference, num_frames, device)

        cell = f"step-{done}"
        rows.append({"method": name, **parts.json(cell, keyed, demand)})
        if name in (HOMOGENEOUS, HETEROGENEOUS):

            def draw(method: Method = method) -> dict[str, Any]:
                return vars(measure_maps(gbuffer, method, num_frames, device))

            maps[name] = DemandMaps(**parts.arrays(f"{cell}-maps", keyed, draw))
    frame = pd.DataFrame(rows)
    named = {
        "homogeneous": maps[HOMOGENEOUS],
        "heterogeneous": maps[HETEROGENEOUS],
    }
    title = f"{gbuffer.name}, {width}x{height}: what each pixel asks"
    return Outcome(
        tables={"demands": demand_table(frame, gpu.name, f"{SCENE}, {width}x{height}")},
        figures={
            "maps": demand_figure(named, title, gbuffer.attribution),
            "demands": _bar_figure(frame),
        },
        comparisons=judge(frame),
        words=(
            "Computing demand: the pixels that run a scattering pass, the warp instructions of "
            "those passes and their time. Sample demand: the samples of all pixels; of a pixel "
            "that is filtered separably, its taps. Memory demand: fetches of irradiance, and the "
            "bytes asked of L1, L2 and DRAM by the passes that scatter.",
            "The homogeneous method takes 64 samples from the finest mip in every scattering "
            "pixel. The steps are added one after the other. Tiles choose AFIS where the mean "
            "estimated count or the scatter's radius is above its threshold, Separable else.",
            "A filtered pixel reads all taps of both passes whatever its lighting, so that the "
            "technique per tile saves samples and time only where the count stays above what "
            "Separable costs; at the least count, 8, AFIS asks less than 27 taps twice.",
        ),
    )


def measure(
    gbuffer: GBuffer,
    method: Method,
    gpu: Gpu,
    reference: Float,
    num_frames: int,
    device: Device,
) -> dict[str, Any]:
    """The three demands of one method's frame, and its PSNR in dB."""
    from cachesim import simulate
    from kernels.frame import render
    from kernels.quality import psnr
    from kernels.record import record

    count = num_frames if method.adaptive else 1
    shown = render(gbuffer, method, count, device)
    trace = record(gbuffer, method, num_frames=count, device=device, self_check=False)
    report = simulate(trace, gpu, timing=True)
    return {
        **computing_demand(report),
        "samples": shown.num_samples,
        "sampled_pixels": int((shown.counts > 0).sum()),
        "scattering_pixels": int(gbuffer.subsurface.sum()),
        **memory_demand(report),
        "psnr_db": psnr(shown.combined, reference, gbuffer.subsurface),
    }


def computing_demand(report: Report) -> dict[str, Any]:
    """Warp instructions and milliseconds of the scattering passes, and of the whole frame."""
    timing = report.timing
    assert timing is not None
    passes = [p for p in timing.passes if p.name in SCATTERING]
    return {
        "warp_instructions": sum(sum(p.warp_instructions.values()) for p in passes),
        "scattering_ms": sum(timing.milliseconds(p) for p in passes),
        "frame_ms": timing.time_ms,
    }


def memory_demand(report: Report) -> dict[str, Any]:
    """Fetches of irradiance, and bytes asked of each level, by the scattering passes."""
    from cachesim.report import sum_parts

    parts = [p for p in report.parts or () if p.pass_name in SCATTERING]
    light = [p for p in parts if p.texture in ("setup", "tex")]
    return {
        "light_fetches": sum(p.lane_fetches for p in light),
        # A frame whose scatter is below a pixel everywhere has no such pass.
        "l1_bytes": sum_parts(parts, "l1").demand_bytes if parts else 0,
        "l2_bytes": sum_parts(parts, "l2").demand_bytes if parts else 0,
        "dram_bytes": sum(p.dram.bytes for p in parts),
    }


def measure_maps(gbuffer: GBuffer, method: Method, num_frames: int, device: Device) -> DemandMaps:
    """The maps of one method's frame."""
    from experiments.reproduce.demand_maps import map_demand
    from kernels.record import record

    count = num_frames if method.adaptive else 1
    return map_demand(record(gbuffer, method, num_frames=count, device=device, self_check=False))


def demand_table(frame: pd.DataFrame, gpu: str, title: str) -> Any:
    """The demands of every step."""
    from experiments.tables import Column, Table

    shown = frame.assign(
        instructions_m=frame["warp_instructions"] / 1e6,
        samples_k=frame["samples"] / 1e3,
        fetches_k=frame["light_fetches"] / 1e3,
        l1_mb=frame["l1_bytes"] / 1e6,
        l2_mb=frame["l2_bytes"] / 1e6,
        dram_mb=frame["dram_bytes"] / 1e6,
    )
    columns = (
        Column("method", "method"),
        Column("sampled_pixels", "pixels that scatter light"),
        Column("instructions_m", "warp instructions (M)", ",.2f"),
        Column("scattering_ms", "scattering (ms)", ".3f"),
        Column("frame_ms", "frame (ms)", ".3f"),
        Column("samples_k", "samples (thousands)", ",.1f"),
        Column("fetches_k", "fetches of irradiance (thousands)", ",.1f"),
        Column("l1_mb", "L1 (MB)", ",.2f"),
        Column("l2_mb", "L2 (MB)", ",.2f"),
        Column("dram_mb", "DRAM (MB)", ",.2f"),
        Column("psnr_db", "PSNR (dB)", ".2f"),
    )
    notes = (
        f"On {gpu}. All but the frame's time is of the passes that scatter: sampling, and the two "
        "separable ones. PSNR on luminance over the scattering pixels, of one frame.",
    )
    return Table(f"The three demands, {title}", shown, columns, notes)


def judge(frame: pd.DataFrame) -> tuple[Comparison, ...]:
    """The figure's claim: heterogeneous rendering lowers the demands without a visible loss."""
    by_name = frame.set_index("method")
    found = []
    for column, name in (
        ("warp_instructions", "computing demand, warp instructions"),
        ("samples", "sample demand"),
        ("light_fetches", "memory demand, fetches of irradiance"),
        ("l2_bytes", "memory demand, L2 bytes"),
    ):
        ratio = float(by_name[column][HETEROGENEOUS] / by_name[column][HOMOGENEOUS])
        lower = ratio < 1
        found.append(
            Comparison(
                f"{name}, heterogeneous / homogeneous",
                "reduced",
                f"{ratio:.3f}",
                verdict="agrees: reduced" if lower else "differs: not reduced",
                agrees=lower,
            )
        )
    first, last = (float(by_name["psnr_db"][n]) for n in (HOMOGENEOUS, HETEROGENEOUS))
    found.append(
        Comparison(
            "PSNR, homogeneous and heterogeneous",
            "no noticeable loss",
            f"{first:.2f} and {last:.2f}",
            "dB",
            "no claim: what is noticeable is not defined; the frames accumulate over time as shown",
        )
    )
    return tuple(found)


def _bar_figure(frame: pd.DataFrame) -> Any:
    from matplotlib.figure import Figure

    from experiments.plots import FONT_SIZE, PALETTE

    columns = {
        "warp_instructions": "computing:\nwarp instructions",
        "scattering_ms": "computing:\nscattering time",
        "samples": "samples",
        "light_fetches": "memory:\nfetches of irradiance",
        "l1_bytes": "memory: L1",
        "l2_bytes": "memory: L2",
        "dram_bytes": "memory: DRAM",
    }
    figure = Figure(figsize=(9.4, 3.3), layout="constrained")
    axes = figure.subplots()
    base = frame.set_index("method").loc[HOMOGENEOUS]
    width = 0.8 / len(frame)
    hatches = ("", "///", "...", "xxx", "\\\\\\")
    for i, (_, row) in enumerate(frame.iterrows()):
        heights = [float(row[c]) / float(base[c]) if base[c] else 0.0 for c in columns]
        at = [x + (i - (len(frame) - 1) / 2) * width for x in range(len(columns))]
        bars = axes.bar(
            at, heights, width, color=PALETTE[i], hatch=hatches[i], edgecolor="white",
            label=str(row["method"]),
        )  # fmt: skip
        labels = [f"{h:.2f}" for h in heights]
        axes.bar_label(bars, labels, fontsize=FONT_SIZE - 4, padding=1)
    axes.set_xticks(range(len(columns)), list(columns.values()), fontsize=FONT_SIZE - 1)
    axes.set_ylabel("demand / homogeneous", fontsize=FONT_SIZE)
    axes.tick_params(axis="y", labelsize=FONT_SIZE - 1)
    axes.spines[["top", "right"]].set_visible(False)
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=FONT_SIZE - 1)
    return figure


EXPERIMENT = Experiment(
    name="taxonomy",
    title="Computing, sample and memory demand of homogeneous and heterogeneous rendering",
    chapter="3",
    figure="Fig. 1",
    minutes=10,
    quick_minutes=0.5,
    run=run,
)
