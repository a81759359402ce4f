"""`afis-vs-separable`: chapter 5's times and qualities of AFIS and Separable on a Quadro P4000, and
those of the hybrid of both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from experiments.reproduce.parts import Parts
    from kernels.frame import Float
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device

GPU = "quadro-p4000"
SCENES = ("close", "ear", "front")
SIZE, QUICK_SIZE = (1920, 1080), (112, 63)
FRAMES, QUICK_FRAMES = 32, 6
REFERENCE_SAMPLES, QUICK_REFERENCE_SAMPLES = 1024, 256
SOURCES = (
    "kernels", "cachesim", "traces", "experiments.reproduce.reference",
    "experiments.reproduce.afis_vs_separable",
)  # fmt: skip
FIXED, ADAPTIVE, SEPARABLE, HYBRID = "AFIS, fixed 64", "AFIS, adaptive", "Separable", "hybrid"
#: Slides, 1080p, Quadro P4000: milliseconds of the whole and PSNR in dB; facts sheet 3.6.
PUBLISHED: dict[tuple[str, str], tuple[float, float | None]] = {
    ("close", FIXED): (11.47, None),
    ("ear", FIXED): (10.22, None),
    ("front", FIXED): (2.08, None),
    ("close", ADAPTIVE): (2.78, 37.58),
    ("ear", ADAPTIVE): (4.03, 45.70),
    ("front", ADAPTIVE): (1.15, 44.28),
    ("close", SEPARABLE): (4.13, 37.46),
    ("ear", SEPARABLE): (4.00, 40.28),
    ("front", SEPARABLE): (0.95, 42.95),
}
#: A time that is off by less than this factor, and a PSNR that is off by less than this, is said to
#: agree with the published one.
TIME_WITHIN, PSNR_WITHIN_DB = 1.5, 3.0
#: Times that differ by less than this are called equal.
TIE = 0.1


def list_methods() -> dict[str, Method]:
    """The methods by name, in the scale on which the paper's constants were tuned. The sampling
    pass fetches irradiance alone; what else the paper's read is not known.
    """
    from dataclasses import replace

    from kernels.method import Method

    plain = Method(scale="legacy", planes=("colour",))
    return {
        FIXED: plain,
        ADAPTIVE: replace(plain, kind="adaptive"),
        SEPARABLE: replace(plain, kind="separable"),
        HYBRID: replace(plain, kind="hybrid"),
    }


def run(settings: Settings) -> Outcome:
    """Time and judge each method in each scene; the tables and the published numbers beside."""
    import pandas as pd

    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments.reproduce.afis_vs_separable_plots import times_figure
    from experiments.reproduce.reference import draw_reference
    from kernels.method import Method
    from kernels.scene import load_scene

    settings.progress("rendering the scenes", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    gbuffers = {name: load_scene(name, width, height, device=device) for name in SCENES}
    gpu = presets.load(GPU)
    compile_loops(timing=True)
    parts = settings.parts("afis-vs-separable", *SOURCES)
    as_reference = Method(scale="legacy")
    num_reference = QUICK_REFERENCE_SAMPLES if settings.quick else REFERENCE_SAMPLES
    rows: list[dict[str, Any]] = []
    methods = list_methods()
    for scene, gbuffer in gbuffers.items():
        reference = draw_reference(gbuffer, as_reference, num_reference, parts, device)
        for name, method in methods.items():
            done = len(rows) / (len(gbuffers) * len(methods))
            settings.progress(f"{scene}, {name}", 0.02 + 0.98 * done)
            found = measure_kept(
                scene, name, gbuffer, method, gpu, reference, settings.quick, parts, device
            )
            rows.append({"scene": scene, "method": name, **found})
    frame = add_published(pd.DataFrame(rows))
    size = f"{width}x{height}"
    return Outcome(
        tables={"times": times_table(frame, gpu.name, size)},
        figures={"times": times_figure(frame, gpu.name)},
        comparisons=(
            *compare_numbers(frame, settings.quick),
            *compare_orders(frame, settings.quick),
        ),
        words=(
            "Times are those of the timing model, all passes of one frame; sampling fetches "
            "irradiance alone. PSNR is on the shown luminance over the scattering "
            f"pixels, against {num_reference} "
            "samples per pixel from the finest mip: a reference of AFIS's own kind, as the "
            "paper's is. Separable is 27 taps of the same profile along each axis.",
            "One frame is judged, as it comes out of the combine pass. What the paper's frames "
            "were before they were judged, anti-aliased or not, the sources do not say; the "
            "column beside has the adaptive frame blended over time as a TAA would.",
            "The hybrid samples the 8x8 tiles whose mean estimated count is above 16 or whose "
            "scatter is wider than 64 pixels, and filters the others. The sources print no number "
            "of it.",
        ),
    )


def measure_kept(
    scene: str,
    name: str,
    gbuffer: GBuffer,
    method: Method,
    gpu: Gpu,
    reference: Float,
    quick: bool,
    parts: Parts,
    device: Device,
) -> dict[str, Any]:
    """`measure`, read where it is finished."""
    from experiments.p4000_study import digest
    from experiments.reproduce.parts import cell_name

    num_frames = (QUICK_FRAMES if quick else FRAMES) if method.adaptive else 1
    inputs = {
        "gbuffer": digest(gbuffer),
        "method": method.as_dict(),
        "gpu": gpu.model_dump(mode="json"),
        "num_frames": num_frames,
        "reference": QUICK_REFERENCE_SAMPLES if quick else REFERENCE_SAMPLES,
    }
    found: dict[str, Any] = parts.json(
        cell_name(f"{scene}-{name}"),
        inputs,
        lambda: measure(gbuffer, method, gpu, reference, num_frames, device),
    )
    return found


def measure(
    gbuffer: GBuffer,
    method: Method,
    gpu: Gpu,
    reference: Float,
    num_frames: int,
    device: Device,
) -> dict[str, Any]:
    """One method's time in ms, by pass and in all, its PSNR in dB and mean samples per pixel."""
    from cachesim import simulate
    from experiments.reproduce.taxonomy import SCATTERING
    from kernels.frame import render
    from kernels.quality import psnr
    from kernels.record import record

    shown = render(gbuffer, method, num_frames, device)
    trace = record(gbuffer, method, num_frames=num_frames, device=device, self_check=False)
    timing = simulate(trace, gpu, timing=True).timing
    assert timing is not None
    passes: dict[str, float] = {}
    for part in timing.passes:
        passes[part.name] = passes.get(part.name, 0.0) + timing.milliseconds(part)
    mask = gbuffer.subsurface
    return {
        "time_ms": timing.time_ms,
        "scattering_ms": sum(ms for name, ms in passes.items() if name in SCATTERING),
        "passes": passes,
        "psnr_db": psnr(shown.combined, reference, mask),
        "accumulated_psnr_db": psnr(shown.accumulated, reference, mask),
        "mean_samples": float(shown.num_samples / mask.sum()),
    }


def add_published(frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with the paper's milliseconds and PSNR, and a column per pass."""
    import pandas as pd

    nothing = float("nan")
    keys = zip(frame["scene"], frame["method"], strict=True)
    published = [PUBLISHED.get(key, (nothing, None)) for key in keys]
    passes = pd.DataFrame(list(frame["passes"])).add_suffix("_ms")
    told = frame.drop(columns="passes").assign(
        paper_ms=[ms for ms, _ in published],
        paper_psnr_db=[nothing if db is None else db for _, db in published],
    )
    return pd.concat([told, passes], axis=1)


def times_table(frame: pd.DataFrame, gpu: str, size: str) -> Any:
    """Ours beside the published."""
    from experiments.tables import Column, Table

    columns = (
        Column("scene", "scene"),
        Column("method", "method"),
        Column("time_ms", "frame (ms)", ".3f"),
        Column("paper_ms", "paper (ms)", ".2f"),
        Column("scattering_ms", "scattering passes (ms)", ".3f"),
        Column("mean_samples", "samples or taps", ".1f"),
        Column("psnr_db", "PSNR (dB)", ".2f"),
        Column("paper_psnr_db", "paper (dB)", ".2f"),
        Column("accumulated_psnr_db", "blended over time (dB)", ".2f"),
    )
    return Table(f"{gpu}, {size}", frame, columns)


def compare_numbers(frame: pd.DataFrame, quick: bool) -> list[Comparison]:
    """Each published time and PSNR beside ours."""
    found = []
    for _, row in frame.dropna(subset=["paper_ms"]).iterrows():
        place = f"{row['scene']}, {row['method']}"
        ratio = float(row["time_ms"] / row["paper_ms"])
        agrees = 1 / TIME_WITHIN <= ratio <= TIME_WITHIN
        told = f"{'agrees' if agrees else 'differs'}: {ratio:.2f} of the published time"
        found.append(
            _claim(f"{place}, time", f"{row['paper_ms']:.2f}", f"{row['time_ms']:.2f}", "ms",
                   told, agrees, quick)
        )  # fmt: skip
        if row["paper_psnr_db"] == row["paper_psnr_db"]:
            away = float(row["psnr_db"] - row["paper_psnr_db"])
            close = abs(away) <= PSNR_WITHIN_DB
            told = f"{'agrees' if close else 'differs'}: {away:+.1f} dB, within {PSNR_WITHIN_DB:g}"
            if not close:
                told = f"differs: {away:+.1f} dB, more than {PSNR_WITHIN_DB:g}"
            told += "; another head, light and camera"
            found.append(
                _claim(f"{place}, PSNR", f"{row['paper_psnr_db']:.2f}", f"{row['psnr_db']:.2f}",
                       "dB", told, close, quick)
            )  # fmt: skip
    return found


def compare_orders(frame: pd.DataFrame, quick: bool) -> list[Comparison]:
    """What the paper's numbers say of adaptive AFIS against Separable, scene by scene."""
    indexed = frame.set_index(["scene", "method"])
    found = []
    for scene in SCENES:
        ours, theirs = (indexed.loc[(scene, m)] for m in (ADAPTIVE, SEPARABLE))
        paper_ratio = ours["paper_ms"] / theirs["paper_ms"]
        ratio = ours["time_ms"] / theirs["time_ms"]
        same = which_is_faster(ratio) == which_is_faster(paper_ratio)
        told = f"{'agrees' if same else 'differs'}: {which_is_faster(ratio)} is faster here"
        found.append(
            _claim(f"{scene}, time, adaptive / Separable", f"{paper_ratio:.2f}", f"{ratio:.2f}",
                   "", told, same, quick)
        )  # fmt: skip
        paper_gain = ours["paper_psnr_db"] - theirs["paper_psnr_db"]
        gain = ours["psnr_db"] - theirs["psnr_db"]
        better = gain > 0
        found.append(
            _claim(f"{scene}, PSNR, adaptive - Separable", f"{paper_gain:+.2f}", f"{gain:+.2f}",
                   "dB", f"{'agrees' if better else 'differs'}: adaptive is "
                   f"{'nearer' if better else 'no nearer'} to the reference", bool(better), quick)
        )  # fmt: skip
        hybrid = indexed.loc[(scene, HYBRID)]
        faster = min(ours["time_ms"], theirs["time_ms"])
        found.append(
            Comparison(
                f"{scene}, hybrid", None,
                f"{hybrid['time_ms']:.2f} ms, {hybrid['psnr_db']:.2f} dB",
                verdict=f"{hybrid['time_ms'] / faster:.2f} of the faster one's time, "
                f"{hybrid['psnr_db'] - ours['psnr_db']:+.2f} dB of adaptive's PSNR",
            )
        )  # fmt: skip
    return found


def which_is_faster(ratio: float) -> str:
    """Of two times with this ratio."""
    if abs(ratio - 1) < TIE:
        return "neither"
    return "the first" if ratio < 1 else "the second"


def _claim(
    quantity: str, paper: str, ours: str, unit: str, told: str, agrees: bool, quick: bool
) -> Comparison:
    """A comparison; of a quick run's small frame no claim."""
    if quick:
        return Comparison(
            quantity, paper, ours, unit, "no claim: the frame is smaller than the paper's"
        )
    return Comparison(quantity, paper, ours, unit, told, agrees)


EXPERIMENT = Experiment(
    name="afis-vs-separable",
    title="Time and PSNR of AFIS, Separable and the hybrid, per scene",
    chapter="5",
    figure="slide: AFIS against Separable",
    minutes=30,
    quick_minutes=0.3,
    run=run,
)
