"""What the P4000 times mean, in words made from the numbers: each difference from the paper with
its traffic and its bound, the model judged by forced counts, and what is not known.
"""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from cachesim.timing.results import REASONS
from experiments.p4000_cases import PUBLISHED_MS, Case
from experiments.p4000_study import Cell
from experiments.p4000_tables import PASS_HEADINGS, cell_of, pass_of, sampling_ms, show_ms
from experiments.tables import three_digits
from experiments.timing_tables import REASON_NAMES

#: Times that differ by less are said to agree.
AGREE = 1.15
UNKNOWN = (
    "Not known of the published times: the clock at which the card ran (ours is its boost clock), "
    "how far passes and frames ran side by side, what the sampling loop read besides irradiance, "
    "the head, the light, and with them the mean counts. What is not known of the card stands as "
    "assumed in the preset.",
    "The engine's set-up pass also classifies tiles and writes lists, and its combine copies the "
    "frame back; ours do neither. Its update reads the result twice and the lighting filtered.",
    "Which accelerations the paper's baseline lacks is not itemised: its chapter has, besides the "
    "mip chain, an approximate inverse of the distribution and another sampling sequence. Ours "
    "takes away the pre-filter alone.",
)


def explain(cells: Sequence[Cell], scale: str, planes: str) -> list[str]:
    """A sentence or more per difference from the paper, in one scale and plane set, and what the
    others change.
    """
    lines = []
    scenes = list(dict.fromkeys(c["scene"] for c in cells))
    for scene in scenes:
        for method in ("fixed", "adaptive"):
            cell = cell_of(cells, Case(scene, scale, planes, method))
            if cell is not None:
                lines.append(_sampling(cell))
    lines += _variants(cells, scenes, scale, planes)
    lines += [_other_passes(cells, scale, planes, name) for name in PASS_HEADINGS]
    lines += _baseline(cells, scale, planes)
    return [line for line in lines if line]


def _sampling(cell: Cell) -> str:
    """Sampling time against the paper's, its bound, its traffic."""
    part = pass_of(cell, "sampling")
    published = PUBLISHED_MS.get((cell["scene"], cell["method"]), {}).get("sampling")
    if part is None or published is None:
        return ""
    line = f"{cell['scene']}, {cell['method']}, sampling: {_against(part['time_ms'], published)}. "
    line += f"{_bound(part)} {_traffic(part)}"
    if cell["method"] == "adaptive":
        line += (
            f" Its mean count is {cell['mean_count']:.1f}, but a warp waits for its hungriest "
            f"lane, {cell['warp_count']:.1f} on average; the paper's count is not given."
        )
    return line


def _against(ms: float, published: float) -> str:
    ratio = ms / published
    if 1 / AGREE <= ratio <= AGREE:
        return f"{show_ms(ms)} ms, the paper {published:.2f} ({ratio:.2f} of it: they agree)"
    return f"{show_ms(ms)} ms, the paper {published:.2f} ({ratio:.2f} of it)"


def _bound(part: Cell) -> str:
    """Which bound, with its share, and how busy the schedulers were."""
    reason = part["bound"]
    share = f"{part['bound_share']:.0%} of its cycles"
    line = f"Bound by {REASON_NAMES[reason]} ({share}: {REASONS[reason]})"
    if reason != "issue":
        running = max(1, part["cycles"] - part["launch_cycles"])
        line += f"; {part['where']['issue'] / running:.0%} of them issued an instruction"
    return line + "."


def _traffic(part: Cell) -> str:
    """Bytes and misses per level, and how busy the memory is."""
    text = f"It asks {three_digits(part['l1_mb'])} MB of the L1"
    if part["l1_miss_rate"] is not None:
        text += f" (miss rate {part['l1_miss_rate']:.2f})"
    text += f", {three_digits(part['l2_mb'])} MB of the L2"
    if part["l2_miss_rate"] is not None:
        text += f" (miss rate {part['l2_miss_rate']:.2f})"
    text += f" and {three_digits(part['dram_mb'])} MB of DRAM"
    if part["dram_of_peak"] is not None:
        text += f", {part['dram_of_peak']:.0%} of what its bus could move in that time"
    # Cells of earlier versions do not have it.
    if part.get("rows_opened"):
        text += f", a row opened for every {part['dram_mb'] * 1e6 / part['rows_opened']:.0f} B"
    return text + "."


def _variants(cells: Sequence[Cell], scenes: Sequence[str], scale: str, planes: str) -> list[str]:
    """What fewer planes and the other scale change in the sampling of the fixed count."""
    parts = []
    for scene in scenes:
        here = sampling_ms(cell_of(cells, Case(scene, scale, planes, "fixed")))
        for other_scale, other_planes in ((scale, "irradiance"), ("physical", planes)):
            if (other_scale, other_planes) == (scale, planes):
                continue
            there = sampling_ms(cell_of(cells, Case(scene, other_scale, other_planes, "fixed")))
            if here > 0 and there > 0:
                what = "irradiance alone" if other_planes != planes else f"{other_scale} scale"
                parts.append(f"{scene}, {what}: {show_ms(there)} ms ({there / here:.2f})")
    if not parts:
        return []
    return [
        f"Sampling of the fixed count against {scale} scale and planes: {planes}: "
        f"{'; '.join(parts)}. So what the paper's pass read, and how wide, move the comparison by "
        "that much."
    ]


def _other_passes(cells: Sequence[Cell], scale: str, planes: str, name: str) -> str:
    """One pass besides sampling, over the scenes of one method that has it."""
    if name in ("sampling", "total"):
        return ""
    parts, bounds = [], []
    for (scene, method), published in PUBLISHED_MS.items():
        cell = cell_of(cells, Case(scene, scale, planes, method))
        part = pass_of(cell, name) if cell else None
        if part is None or name not in published or method != "adaptive":
            continue
        parts.append(f"{scene} {_against(part['time_ms'], published[name])}")
        bounds.append(
            f"{REASON_NAMES[part['bound']]} ({three_digits(part['dram_mb'])} MB of DRAM"
            + (
                f", {part['dram_of_peak']:.0%} of peak)"
                if part["dram_of_peak"] is not None
                else ")"
            )
        )
    if not parts:
        return ""
    return f"{PASS_HEADINGS[name]}: {'; '.join(parts)}. Bounds in that order: {'; '.join(bounds)}."


def _baseline(cells: Sequence[Cell], scale: str, planes: str) -> list[str]:
    """The unaccelerated frame against the pre-filtered one."""
    lines = []
    for (scene, method), published in PUBLISHED_MS.items():
        if method != "baseline":
            continue
        base = cell_of(cells, Case(scene, scale, planes, "baseline"))
        fixed = cell_of(cells, Case(scene, scale, planes, "fixed"))
        if base is None or fixed is None:
            continue
        paper = published["total"] / PUBLISHED_MS[scene, "fixed"]["total"]
        slow, fast = pass_of(base, "sampling"), pass_of(fixed, "sampling")
        assert slow is not None and fast is not None
        ours = base["time_ms"] / fixed["time_ms"]
        line = (
            f"{scene}, baseline: mip 0 alone takes {ours:.2f} times the pre-filtered frame "
            f"({show_ms(base['time_ms'])} against {show_ms(fixed['time_ms'])} ms), the paper's "
            f"{paper:.1f} times. {_bound(slow)} Its sampling asks "
            f"{_times(slow['l2_mb'], fast['l2_mb'])} the L2 demand and "
            f"{_times(slow['dram_mb'], fast['dram_mb'])} the DRAM traffic."
        )
        if ours * AGREE < paper:
            line += (
                " The rest of the paper's factor is not in this traffic: it must come from what "
                "else its baseline lacks, which is not itemised."
            )
        lines.append(line)
    return lines


def _times(value: float, of: float) -> str:
    return f"{value / of:.2f} times" if of else f"{three_digits(value)} MB instead of none of"


def judge(counts: pd.DataFrame) -> list[str]:
    """The model by time against a forced count, over all rows of `counts_frame`."""
    known = counts.dropna(subset=["growth"])
    lines = []
    if len(known):
        lines.append(
            f"From 8 to 64 samples the sampling time grows {known['growth'].min():.2f} to "
            f"{known['growth'].max():.2f} times, over {len(known)} combinations of scene, scale "
            "and planes: below 8 where the launch, the centre reads or the first touches count, "
            "above where more samples read finer mips (Eq 5.12) and miss more."
        )
    return lines + _worth(counts.dropna(subset=["worth"]))


def _worth(counts: pd.DataFrame) -> list[str]:
    """Where the adaptive time lies between those of its mean count and of its warps' most."""
    if counts.empty:
        return []
    inside = counts["worth"].between(counts["mean_count"] * 0.95, counts["warp_count"] * 1.05)
    line = (
        "Adaptive sampling takes as long as a forced count between its mean count and its warps' "
        f"most in {inside.sum()} of {len(counts)} combinations"
    )
    outside = [
        f"{r['scene']}, {r['scale']}, {r['planes']}: worth {r['worth']:.1f}, mean "
        f"{r['mean_count']:.1f}, most {r['warp_count']:.1f}"
        for _, r in counts[~inside].iterrows()
    ]
    if outside:
        line += (
            f"; outside are {'; '.join(outside)}: above both, the history that only adaptive reads "
            "weighs more than the samples; below both, idle lanes left bandwidth to the others"
        )
    return [line + "."]
