"""The tables of `experiments.adaptive_vs_fixed`, and in words where they agree with the paper."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from experiments.adaptive_vs_fixed import MIPPED_TEXTURE
from experiments.tables import Column, Table

DEMAND_NAMES = {"l1_bytes": "L1", "l2_bytes": "L2", "dram_bytes": "DRAM"}
RATE_NAMES = {"l1_miss_rate": "L1", "l2_miss_rate": "L2"}


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
        Column("psnr_fixed_db", "PSNR fixed dB", ".2f"),
        Column("psnr_adaptive_db", "PSNR adaptive dB", ".2f"),
        Column("paper_psnr_adaptive_db", "paper's adaptive dB", ".2f"),
    )
    notes = (
        f"Adaptive is frame {num_frames - 1} after {num_frames - 1} frames of history; it is the frame that is "
        "traced. Samples are per scattering pixel.",
        "PSNR is of this one frame, on luminance over the scattering pixels, against 1024 samples per "
        "pixel. The paper's columns are its sampling time (adaptive / fixed, 1080p, Quadro P4000) and its "
        "adaptive PSNR, on another head, light and camera: compare the order of size only.",
    )
    return Table(title, quality, columns, notes)


def demand_table(demand: pd.DataFrame, ratios: pd.DataFrame, title: str, size: str) -> Table:
    """The central table: three rows per scene and GPU, fixed, adaptive and adaptive / fixed."""
    numbers = [*DEMAND_NAMES, *RATE_NAMES]
    rows = []
    for key, part in demand.groupby(["scene", "gpu"], sort=False):
        ratio = ratios.set_index(["scene", "gpu"]).loc[key]
        for _, row in part.iterrows():
            shown = {"scene": key[0], "gpu": key[1], "method": row["method"]}
            shown["lane_fetches"] = f"{row['lane_fetches'] / 1e6:,.1f}"
            for name in numbers:
                is_bytes = name.endswith("bytes")
                shown[name] = f"{row[name] / 1e6:,.1f}" if is_bytes else f"{row[name]:.3f}"
            rows.append(shown)
        shown = {"scene": key[0], "gpu": key[1], "method": "ratio"}
        rows.append(shown | {n: f"{ratio[n]:.3f}" for n in ("lane_fetches", *numbers)})
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
    )
    return Table(title, pd.DataFrame(rows), columns, tuple(findings(demand, ratios, size)))


def findings(demand: pd.DataFrame, ratios: pd.DataFrame, size: str) -> list[str]:
    """Sentences on the numbers: what holds everywhere, what does not, and what the paper says."""
    lines = [
        f"The L2 and DRAM columns depend on the resolution: at {size} the frame is of another size in "
        "proportion to the L2 than at 1080p, where the paper measured. MB = 10^6 B; miss rates are local "
        "(misses / accesses of that level); all passes and textures together."
    ]
    for name, level in DEMAND_NAMES.items():
        low, high = ratios[name].min(), ratios[name].max()
        text = f"{level} demand, adaptive / fixed: {low:.2f} to {high:.2f}."
        above = _where(ratios, name)
        if above:
            text += f" Disagrees with the paper, whose plots show less for adaptive: {above}."
        else:
            text += " Lower for adaptive everywhere, as the paper's plots show."
        lines.append(text)
    for name, level in RATE_NAMES.items():
        above = _where(ratios, name)
        if above:
            lines.append(
                f"{level} miss rate: adaptive is higher at {above}. The fetches that adaptive saves are not an "
                "even share: they lie in flat regions, and the passes that cost the same in both methods "
                "weigh more in its total."
            )
        else:
            lines.append(f"{level} miss rate: lower for adaptive everywhere.")
    return lines


def _where(ratios: pd.DataFrame, name: str) -> str:
    """The scenes and GPUs where a ratio is above 1, "scene on gpu, gpu; scene on gpu"; "" where none is."""
    above = ratios[ratios[name] > 1]
    parts = [f"{scene} on {', '.join(part['gpu'])}" for scene, part in above.groupby("scene", sort=False)]
    return "; ".join(parts)


def mip_table(mips: pd.DataFrame, title: str) -> Table:
    """Fixed beside adaptive, one row per scene, GPU and part of memory."""
    keys = ["scene", "gpu", "part"]
    shown = ("lane_fetches", "l1_bytes", "l2_bytes", "l1_miss_rate", "l2_miss_rate")
    wide = mips.pivot_table(index=keys, columns="method", values=list(shown), sort=False)
    rows = []
    for key in dict.fromkeys(zip(*(mips[k] for k in keys), strict=True)):
        row = dict(zip(keys, key, strict=True))
        for method in ("fixed", "adaptive"):
            for name in shown:
                value = wide.loc[key].get((name, method))
                scale = 1e6 if name in ("lane_fetches", "l1_bytes", "l2_bytes") else 1
                row[f"{name}_{method}"] = None if value is None else value / scale
        rows.append(row)
    heads = {
        "lane_fetches": ("fetches M", ",.2f"),
        "l1_bytes": ("L1 MB", ",.1f"),
        "l1_miss_rate": ("L1 miss", ".3f"),
        "l2_bytes": ("L2 MB", ",.1f"),
        "l2_miss_rate": ("L2 miss", ".3f"),
    }
    columns = [Column("scene", "scene"), Column("gpu", "GPU"), Column("part", "part")]
    for name, (heading, specification) in heads.items():
        for method, short in (("fixed", "fix"), ("adaptive", "ada")):
            columns.append(Column(f"{name}_{method}", f"{heading} {short}", specification))
    order = {part: i for i, part in enumerate(sorted({r["part"] for r in rows}))}
    place = {key: i for i, key in enumerate(dict.fromkeys((r["scene"], r["gpu"]) for r in rows))}
    rows.sort(key=lambda r: (place[r["scene"], r["gpu"]], order[r["part"]]))
    notes = (
        f"Parts sum to the frame's totals. Mips are those of the irradiance texture ({MIPPED_TEXTURE}), with "
        "its writes by the set-up and pre-filter passes; all other textures are together. Fewer samples "
        "make coarser mips (Eq 5.12), so adaptive moves fetches from mip 0 to the levels above. The slides' "
        "one printed pair, Mip0: 91,541 against 151,356 (0.605), does not say what it counts.",
    )
    return Table(title, pd.DataFrame(rows), tuple(columns), notes)


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
