"""`cache-table`: chapter 4's study under GPGPU-Sim's TITAN X Pascal, fixed against adaptive, per
fetch path and mip; `cachesim cache-table` with its options, one kept cell per timed run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from experiments.reproduce.experiment import Comparison, Experiment, Outcome, Settings

if TYPE_CHECKING:
    import pandas as pd

GPU, SCENE, SCALE = "titan-x-pascal-gpgpusim", "side", "legacy"
SIZE, QUICK_SIZE = (480, 270), (96, 54)
FRAMES, QUICK_FRAMES = 32, 6
#: What lies between an input and a cell.
SOURCES = ("kernels", "cachesim", "traces", "experiments.cache_table_study")
PRINTED_PAIR = (91_541, 151_356)


def run(settings: Settings) -> Outcome:
    """Time every combination of fetch path, mips and method; tables, bar charts, directions."""
    import pandas as pd

    from cachesim import presets
    from cachesim.first_use import compile_loops
    from experiments import cache_table_plots as plots
    from experiments import cache_table_study as study
    from experiments.p4000_study import digest
    from kernels.method import Method
    from kernels.scene import load_scene

    settings.progress("rendering the scene", 0.0)
    device = settings.open_device()
    width, height = QUICK_SIZE if settings.quick else SIZE
    num_frames = QUICK_FRAMES if settings.quick else FRAMES
    gbuffer = load_scene(SCENE, width, height, device=device)
    gpu, shared = presets.load(GPU), Method(scale=SCALE)
    compile_loops(timing=True)
    parts = settings.parts("cache-table", *SOURCES)
    inputs = {
        "gbuffer": digest(gbuffer),
        "gpu": gpu.model_dump(mode="json"),
        "method": shared.as_dict(),
        "num_frames": num_frames,
    }
    names = [(p, m, k) for p in study.FETCH_PATHS for m in study.MIPS for k in study.METHODS]
    cells = []
    for done, (path, mips, kind) in enumerate(names):
        settings.progress(f"{path}, {mips}, {kind}", (1 + done) / (1 + len(names)))

        def measure(path: str = path, mips: str = mips, kind: str = kind) -> dict[str, Any]:
            timed = study.measure_run(
                gbuffer, gpu, shared, path, mips, kind, num_frames=num_frames, device=device
            )
            frames = study.totals_frame([timed]), study.mips_frame([timed])
            return {
                name: frame.to_dict("records")
                for name, frame in zip(("totals", "mips"), frames, strict=True)
            }

        name = f"{path}-{mips}-{kind}".replace(" ", "-")
        cells.append(parts.json(name, inputs, measure))
    totals = pd.DataFrame([row for cell in cells for row in cell["totals"]])
    mips_rows = pd.DataFrame([row for cell in cells for row in cell["mips"]])
    title = f"{gbuffer.name}, {width}x{height}, {gpu.name}"
    ratios = study.ratio_rows(totals)
    return Outcome(
        tables={
            "totals": study.totals_table(totals, gpu, title),
            "mips": study.mips_table(mips_rows, title),
            "numbers": totals,
        },
        figures={
            path: plots.path_figure(totals, path, f"{title}, fetch path {path}")
            for path in study.FETCH_PATHS
        },
        comparisons=(*directions(ratios, settings.quick), *pair_candidates(totals, mips_rows)),
        words=(
            "The slides show three plots in turn for a side view, without axes: simulation cycles, "
            "L1 and L2 demand, L1 and L2 miss rate. So directions can be held against them, over "
            "the sampling pass and the pre-filtered runs; a demand is the sectors that a level is "
            "asked for.",
            study.PRINTED,
        ),
        captions={path: gbuffer.attribution for path in study.FETCH_PATHS},
    )


def directions(ratios: pd.DataFrame, small: bool) -> tuple[Comparison, ...]:
    """Whether adaptive asks less and takes fewer cycles, on every fetch path that has the level.

    small: the frame is so small that its hungriest warp decides the cycles, 64 samples either way.
    """
    chosen = ratios[(ratios["mips"] == "Eq 5.12") & (ratios["passes"] == "sampling")]
    found = []
    for column, name in (
        ("cycles", "simulation cycles"),
        ("l1_accesses", "L1 demand"),
        ("l2_accesses", "L2 demand"),
    ):
        known = chosen[column].dropna()
        lower = bool((known < 1).all())
        if column == "cycles" and small:
            ours = f"{known.min():.3f} to {known.max():.3f}"
            told = "no claim: so small a frame takes as long as its hungriest warp"
            found.append(Comparison(f"{name}, sampling pass", "less than 1", ours, verdict=told))
            continue
        found.append(
            Comparison(
                f"{name}, sampling pass, adaptive / fixed",
                "less than 1",
                f"{known.min():.3f} to {known.max():.3f}",
                verdict=f"{'agrees: lower' if lower else 'differs: not lower'} on all fetch paths "
                "that ask this level",
                agrees=lower,
            )
        )
    return tuple(found)


def pair_candidates(totals: pd.DataFrame, mips: pd.DataFrame) -> tuple[Comparison, ...]:
    """What the printed pair's ratio might be of, without a claim."""
    ratio = PRINTED_PAIR[0] / PRINTED_PAIR[1]
    candidates: list[tuple[str, list[float]]] = []
    only = totals[(totals["mips"] == "mip 0 only") & (totals["passes"] == "sampling")]
    for column, name in (("cycles", "cycles with mip 0 only"), ("l2_misses", "L2 misses of it")):
        candidates.append((name, _ratios(only, column)))
    of_mip = mips[mips["part"] == "mip 0"]
    for column, name in (
        ("l1_accesses", "L1 accesses of mip 0"),
        ("l2_accesses", "L2 accesses of mip 0"),
        ("l1_misses", "L1 misses of mip 0"),
        ("l2_misses", "L2 misses of mip 0"),
    ):
        candidates.append((name, _ratios(of_mip, column)))
    return tuple(
        Comparison(
            f"the printed pair's ratio, if of {name}",
            f"{ratio:.3f}",
            f"{min(found):.3f} to {max(found):.3f}" if found else "-",
            verdict="no claim: the slides do not say what the pair counts",
        )
        for name, found in candidates
    )


def _ratios(frame: pd.DataFrame, column: str) -> list[float]:
    """Adaptive / fixed of each fetch path where fixed is not 0."""
    by_key = frame.set_index(["fetch_path", "method"])[column]
    paths = dict.fromkeys(frame["fetch_path"])
    pairs = [(by_key.get((p, "adaptive"), 0), by_key.get((p, "fixed"), 0)) for p in paths]
    return [float(a) / float(f) for a, f in pairs if f]


EXPERIMENT = Experiment(
    name="cache-table",
    title="Cycles, L1 and L2 demand and miss rates under GPGPU-Sim's TITAN X, fixed and adaptive",
    chapter="4",
    figure="slides: cycle-level analysis of bandwidth demands",
    minutes=3,
    quick_minutes=0.4,
    run=run,
)
