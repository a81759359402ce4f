"""The tables of `experiments.adaptive_vs_fixed`, and in words where they agree with the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from experiments.adaptive_vs_fixed import METHODS, MIPPED_TEXTURE, PAPER_TIME_RATIO, PASSES
from experiments.tables import MISSING, Column, Table, show_value, three_digits

DEMAND_NAMES = {"l1_bytes": "L1", "l2_bytes": "L2", "dram_bytes": "DRAM"}
RATE_NAMES = {"l1_miss_rate": "L1", "l2_miss_rate": "L2"}
#: Numbers of the central table that only a timed run has.
TIME_HEADINGS = {"cycles": "cycles (M)", "time_ms": "ms"}
TIME_NAMES = tuple(TIME_HEADINGS)
#: Why adaptive can ask more of a level, and why its miss rate can rise while its misses fall.
EXTRA = (
    "Only adaptive reads a history in the sampling pass and writes one in the update pass, and the "
    "first touch of each texel costs the same for 8 samples as for 64."
)
FIRST_TOUCH = (
    "Adaptive saves repeated fetches, many of which hit, and no first touches, which all miss: "
    "fewer misses are then a larger share of far fewer accesses."
)
MIP_COLUMNS = {
    "lane_fetches": "fetch M",
    "l1_bytes": "L1 MB",
    "l1_miss_rate": "L1 miss",
    "l2_bytes": "L2 MB",
    "l2_miss_rate": "L2 miss",
}


def quality_table(quality: pd.DataFrame, title: str, num_frames: int) -> Table:
    """What each scene is, the samples that both methods took, and their PSNR beside the paper's."""
    columns = (
        Column("scene", "scene"),
        Column("coverage_rate", "SSS coverage", ".1%"),
        Column("pixels_per_mm", "px per mm", ".2f"),
        Column("samples_fixed", "samples fixed", ".1f"),
        Column("samples_adaptive", "samples adaptive", ".1f"),
        Column("samples_ratio", "ratio", ".3f"),
        Column("paper_time_ratio", "paper's time ratio", ".3f"),
        Column("psnr_fixed_db", "PSNR fixed", ".2f"),
        Column("psnr_adaptive_db", "PSNR adaptive", ".2f"),
        Column("psnr_accumulated_db", "PSNR blended", ".2f"),
        Column("paper_psnr_adaptive_db", "paper's adaptive", ".2f"),
    )
    last = num_frames - 1
    notes = (
        f"Adaptive is frame {last}, after {last} frames of history: the frame that is shown, "
        "measured and traced. Samples are per scattering pixel.",
        "PSNR in dB, on luminance over the scattering pixels, against 1024 samples per pixel; "
        "fixed and adaptive of that one frame, blended of adaptive's frames accumulated over time. "
        "The paper's columns are its sampling time (adaptive / fixed, 1080p, Quadro P4000) and its "
        "adaptive PSNR, on another head, light and camera: compare the order of size only.",
    )
    return Table(title, quality, columns, notes)


def demand_table(demand: pd.DataFrame, ratios: pd.DataFrame, title: str, size: str) -> Table:
    """The central table: fixed, adaptive, and adaptive / fixed of all passes and of sampling; times
    where a GPU was timed.
    """
    times = TIME_NAMES if demand["cycles"].notna().any() else ()
    numbers = [*DEMAND_NAMES, *RATE_NAMES, *times]
    of_frame = demand[demand["passes"] == "all"]
    by_key = ratios.set_index(["scene", "gpu", "passes"])
    rows = []
    for (scene, gpu), part in of_frame.groupby(["scene", "gpu"], sort=False):
        for _, row in part.iterrows():
            shown = {"scene": scene, "gpu": gpu, "method": row["method"]}
            shown["lane_fetches"] = f"{row['lane_fetches'] / 1e6:,.1f}"
            rows.append(shown | {name: _demand_cell(name, row[name]) for name in numbers})
        for passes, name in (("all", "ratio"), ("sampling", "of sampling")):
            ratio = by_key.loc[(scene, gpu, passes)]
            shown = {"scene": scene, "gpu": gpu, "method": name}
            names = ("lane_fetches", *numbers)
            rows.append(shown | {n: show_value(float(ratio[n]), ".3f") for n in names})
    columns = (
        Column("scene", "scene"),
        Column("gpu", "GPU"),
        Column("method", "method"),
        Column("lane_fetches", "lane fetches (M)", numeric=True),
        Column("l1_bytes", "L1 demand (MB)", numeric=True),
        Column("l2_bytes", "L2 demand (MB)", numeric=True),
        Column("dram_bytes", "DRAM (MB)", numeric=True),
        Column("l1_miss_rate", "L1 miss rate", numeric=True),
        Column("l2_miss_rate", "L2 miss rate", numeric=True),
        *(Column(name, TIME_HEADINGS[name], numeric=True) for name in times),
    )
    return Table(title, pd.DataFrame(rows), columns, tuple(findings(ratios, size)))


def _demand_cell(name: str, value: float) -> str:
    """One number of the central table: MB, millions of cycles, ms, or a rate; "-" where none is."""
    if math.isnan(value):
        return MISSING
    if name in DEMAND_NAMES:
        return f"{value / 1e6:,.1f}"
    if name in TIME_NAMES:
        return three_digits(value / 1e6 if name == "cycles" else value)
    return f"{value:.3f}"


def findings(ratios: pd.DataFrame, size: str) -> list[str]:
    """Sentences on the numbers: what holds everywhere, what does not, and what the paper says."""
    whole, sampling = (ratios[ratios["passes"] == p] for p in PASSES)
    lines = [
        "ratio is adaptive / fixed over all passes, of sampling the same over the sampling pass. "
        "MB = 10^6 B; miss rates are local: misses / accesses of that level. A sector is 32 B on "
        "NVIDIA and 128 B in RDNA's L0 and L2, so a scattered texel asks for more there.",
        f"The L2 and DRAM columns depend on the resolution: at {size} the frame has another size "
        "relative to the L2 than at 1080p, the size of the paper's times (that of its GPGPU-Sim "
        "study is not known).",
    ]
    for name, level in DEMAND_NAMES.items():
        text = f"{level} demand, adaptive / fixed: {_span(whole, name)}; "
        text += f"in the sampling pass {_span(sampling, name)}. "
        above = _where(whole, name)
        if level == "DRAM":
            text += "The paper shows no DRAM traffic. "
            text += (
                f"More for adaptive: {above}. {EXTRA}" if above else "Less for adaptive everywhere."
            )
        elif above:
            text += f"Disagrees with the paper, which shows less for adaptive: {above}. {EXTRA}"
        else:
            text += "Lower for adaptive everywhere, as the paper shows."
        lines.append(text)
    for name, level in RATE_NAMES.items():
        text = f"{level} miss rate, adaptive / fixed: {_span(whole, name)}. "
        above = _where(whole, name)
        text += f"Higher for adaptive: {above}. {FIRST_TOUCH}" if above else "Lower everywhere."
        lines.append(text)
    if "cycles" in ratios and whole["cycles"].notna().any():
        lines.append(_cycles_finding(*(r[r["cycles"].notna()] for r in (whole, sampling))))
    lines.append("The paper's miss rates are a plot whose values we do not have to compare with.")
    return lines


def _cycles_finding(whole: pd.DataFrame, sampling: pd.DataFrame) -> str:
    """The sentence on cycles: where adaptive takes fewer, and what the paper's times say."""
    text = f"Cycles, adaptive / fixed: {_span(whole, 'cycles')}, kernel launches included; in the "
    text += f"sampling pass {_span(sampling, 'cycles')}, where the paper's times on a Quadro P4000 "
    text += f"are {min(PAPER_TIME_RATIO.values()):.2f} to {max(PAPER_TIME_RATIO.values()):.2f}. "
    text += f"Timed on {', '.join(whole['gpu'].unique())}. "
    above = _where(sampling, "cycles")
    if above:
        return text + f"Disagrees with the paper, which shows fewer for adaptive: {above}."
    return text + "Fewer for adaptive in every sampling pass, as the paper shows."


def _span(ratios: pd.DataFrame, name: str) -> str:
    return f"{ratios[name].min():.2f} to {ratios[name].max():.2f}"


def _where(ratios: pd.DataFrame, name: str) -> str:
    """Where a ratio is above 1: "close on all; front on gpu, gpu"; "" where none is."""
    above = ratios[ratios[name] > 1]
    num_gpus = ratios["gpu"].nunique()
    parts = []
    for scene, part in above.groupby("scene", sort=False):
        gpus = ", ".join(part["gpu"]) if len(part) < num_gpus else "all GPUs"
        parts.append(f"{scene} on {gpus}")
    return "; ".join(parts)


def mip_table(mips: pd.DataFrame, title: str) -> Table:
    """Fixed beside adaptive, one row per scene, GPU and part of memory."""
    keys = ["scene", "gpu", "part"]
    values = {(*r[keys], r["method"]): r for _, r in mips.iterrows()}
    rows = []
    for (scene, gpu), group in mips.groupby(["scene", "gpu"], sort=False):
        for part in sorted(group["part"].unique()):
            row = {"scene": scene, "gpu": gpu, "part": part}
            for method in METHODS:
                found = values.get((scene, gpu, part, method))
                for name in MIP_COLUMNS:
                    row[f"{name}_{method}"] = _mip_cell(name, found)
            rows.append(row)
    columns = [Column("scene", "scene"), Column("gpu", "GPU"), Column("part", "part")]
    for name, heading in MIP_COLUMNS.items():
        for method, short in (("fixed", "fix"), ("adaptive", "ada")):
            columns.append(Column(f"{name}_{method}", f"{heading} {short}", numeric=True))
    notes = (
        "Parts sum to the frame's totals. Mips are those of the irradiance texture "
        f"({MIPPED_TEXTURE}), with its writes by the set-up and pre-filter passes; all other "
        "textures are together. Fewer samples make coarser mips (Eq 5.12), so adaptive moves "
        "fetches from mip 0 to the levels above. The slides' one printed pair, Mip0: 91,541 "
        "against 151,356 (0.605), does not say what it counts.",
    )
    return Table(title, pd.DataFrame(rows), tuple(columns), notes)


def _mip_cell(name: str, found: pd.Series | None) -> str:
    """One number of the mip table: three digits, rates as they are; "-" where nothing was asked."""
    value = None if found is None else float(found[name])
    if value is None or math.isnan(value):
        return MISSING
    return f"{value:.3f}" if name.endswith("rate") else three_digits(value / 1e6)


def bar_frames(mips: pd.DataFrame, gpu: str) -> pd.DataFrame:
    """What `plots.mip_figure` draws: L1 demand per mip on one GPU."""
    of_gpu = mips[(mips["gpu"] == gpu) & (mips["part"] != "other")]
    return pd.DataFrame(
        {
            "scene": of_gpu["scene"],
            "method": of_gpu["method"],
            "mip": of_gpu["part"].str.removeprefix("mip ").astype(int),
            "megabytes": of_gpu["l1_bytes"] / 1e6,
        }
    )


def scene_lines(attributions: Sequence[str]) -> list[str]:
    """The attributions that are owed, once each."""
    return [line for line in dict.fromkeys(attributions) if line]
