"""`p4000-times`: chapter 5's table of pass times on a Quadro P4000, ours beside the published; the
cases of `cachesim p4000-times`, kept one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.p4000_cases import Case
    from experiments.p4000_study import Counts
    from kernels.gbuffer import GBuffer

GPU = "quadro-p4000"
SIZE, QUICK_SIZE = (1920, 1080), (160, 90)
#: A time that is off by less than this factor is said to agree with the published one.
AGREES_WITHIN = 1.5


def choose_cases() -> list[Case]:
    """The paper's own methods in its engine's scale. Sampling reads irradiance alone: what else the
    paper's read is not known, and all planes take three times as long to simulate.
    """
    from experiments.p4000_cases import list_cases
    from experiments.p4000_tables import PUBLISHED_METHODS

    return list_cases(methods=PUBLISHED_METHODS, scales=("legacy",), plane_sets=("irradiance",))


def run(settings: Settings) -> Outcome:
    """Time the cases; tables, figures, words and each published total beside ours."""
    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments import p4000_cases, p4000_plots, p4000_study, p4000_tables, p4000_words
    from experiments.output import output_folder
    from kernels.scene import load_scene

    settings.progress("rendering the scenes", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    gbuffers = {name: load_scene(name, width, height, device=device) for name in p4000_cases.SCENES}
    gpu = presets.load(GPU)
    compile_loops(timing=True)
    cases = choose_cases()
    kept = settings.out / ".parts" / "p4000-times" / ("quick" if settings.quick else "full")
    cells = p4000_study.run_cases(
        cases,
        gbuffers,
        gpu,
        output_folder(kept),
        device=device,
        progress=lambda share: settings.progress(f"timing on {gpu.name}", 0.95 * share),
    )
    settings.progress("drawing the sample counts", 0.95)
    maps = draw_counts(settings, cases, gbuffers)
    size, shown = f"{width}x{height}", cells[0]["planes"]
    ratios = p4000_tables.ratios_frame(cells)
    figure = p4000_plots.passes_figure(cells, "legacy", shown, gpu.name)
    figures = maps | ({} if figure is None else {"passes": figure})
    return Outcome(
        tables={
            "times": p4000_tables.times_table(cells, gpu.name, size),
            "ratios": p4000_tables.ratios_table(ratios),
            "traffic": p4000_tables.traffic_table(cells, "legacy", shown),
            "passes": p4000_tables.passes_frame(cells),
        },
        figures=figures,
        comparisons=(
            *compare_times(cells, size == p4000_cases.PUBLISHED_SIZE),
            *compare_ratios(cells, size == p4000_cases.PUBLISHED_SIZE),
        ),
        words=(
            *p4000_tables.size_note(size),
            "Forced counts, all planes and the physical scale, which judge the model rather than "
            "the paper, are in `cachesim p4000-times`.",
            *([] if settings.quick else p4000_words.explain(cells, "legacy", shown)),
            *p4000_words.UNKNOWN,
        ),
    )


def draw_counts(
    settings: Settings, cases: Sequence[Case], gbuffers: dict[str, GBuffer]
) -> dict[str, Figure]:
    """The sample counts of each view's adaptive case, by the figure's name."""
    from experiments.p4000_study import count_samples, digest
    from experiments.plots import count_map

    parts = settings.parts("p4000-times", "kernels")
    figures = {}
    for case in {c.scene: c for c in cases if c.settings.adaptive}.values():
        gbuffer = gbuffers[case.scene]
        inputs = {"gbuffer": digest(gbuffer), "method": case.settings.as_dict()}

        def count(case: Case = case, gbuffer: GBuffer = gbuffer) -> dict[str, Counts]:
            return {"counts": count_samples(case, gbuffer, settings.open_device())}

        counts = parts.arrays(f"counts-{case.scene}", inputs, count)["counts"]
        title = f"{case.scene}, {case.scale} scale, frame {case.num_frames - 1}"
        figures[f"counts-{case.scene}"] = count_map(counts, title, gbuffer.attribution)
    return figures


def compare_times(cells: Sequence[dict[str, Any]], same_size: bool) -> list[Comparison]:
    """Sampling and total of each published case beside ours."""
    from experiments.p4000_cases import PUBLISHED_MS
    from experiments.p4000_tables import sampling_ms

    found = []
    for (scene, method), published in PUBLISHED_MS.items():
        ours = [c for c in cells if (c["scene"], c["method"]) == (scene, method)]
        for cell in ours:
            for name, ms in (("sampling", sampling_ms(cell)), ("total", cell["time_ms"])):
                if name not in published:
                    continue
                ratio = ms / published[name]
                agrees: bool | None = 1 / AGREES_WITHIN <= ratio <= AGREES_WITHIN
                verdict = f"{'agrees' if agrees else 'differs'}: {ratio:.2f} of the published time"
                if not same_size:
                    agrees, verdict = None, "no claim: the frame is smaller than the paper's"
                found.append(
                    Comparison(
                        f"{scene}, {method}, {name}, planes {cell['planes']}",
                        f"{published[name]:.2f}",
                        f"{ms:.2f}",
                        "ms",
                        verdict,
                        agrees,
                    )
                )
    return found


def compare_ratios(cells: Sequence[dict[str, Any]], same_size: bool) -> list[Comparison]:
    """Adaptive / fixed of the sampling pass, and what of it the counts explain."""
    from experiments.p4000_tables import ratios_frame

    found = []
    for _, row in ratios_frame(cells).iterrows():
        ours, paper = float(row["sampling_ratio"]), float(row["paper_sampling_ratio"])
        factor = ours / paper
        agrees: bool | None = 1 / AGREES_WITHIN <= factor <= AGREES_WITHIN
        told = f"{'agrees' if agrees else 'differs'}: {factor:.2f} of the published ratio"
        if not same_size:
            agrees, told = None, "no claim: the frame is smaller than the paper's"
        found.append(
            Comparison(
                f"{row['scene']}, sampling time, adaptive / fixed, planes {row['planes']}",
                f"{paper:.3f}",
                f"{ours:.3f}",
                verdict=f"{told}; mean count {row['count_ratio']:.2f} of 64, a warp's hungriest "
                f"lane {row['warp_ratio']:.2f} of it",
                agrees=agrees,
            )
        )
    return found


EXPERIMENT = Experiment(
    name="p4000-times",
    title="Times of the passes on a Quadro P4000 beside the published milliseconds",
    chapter="5",
    figure="slide: fixed and adaptive 64 spp sampling time",
    minutes=60,
    quick_minutes=0.5,
    run=run,
)
