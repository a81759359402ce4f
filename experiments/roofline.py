"""The bandwidth roofline of a timed run: each level's roof, the issue roof, each pass in it.

Instruction roofline of Ding and Williams (PMBS 2019), with the warp instruction as the unit of
work: a pass stands at the height of its issue rate, once per level, at the instructions it ran for
each byte that the level moved. A level's roof is its peak bandwidth times that intensity, the issue
roof what the schedulers can issue.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from experiments.plots import FONT_SIZE, PALETTE
from experiments.timing_tables import LEVEL_NAMES, bottleneck_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cachesim.config import Gpu
    from cachesim.timing.results import TimingResult

_COLOURS = dict(zip(LEVEL_NAMES, PALETTE, strict=False))
_DASHES = dict(zip(LEVEL_NAMES, ("-", ":", (0, (3, 1.5)), (0, (8, 3)), "-."), strict=True))
_MARKERS = "osD^vPX*<>"
#: Powers of ten to spare around the points.
_MARGIN = 0.45


@dataclass(frozen=True)
class Point:
    """One pass at one level.

    instructions_per_byte: warp instructions / bytes moved at the level. giga_per_s: 10^9 warp
    instructions per second while the kernels ran.
    """

    pass_name: str
    level: str
    instructions_per_byte: float
    giga_per_s: float


def roofline_points(timing: TimingResult) -> list[Point]:
    """The points of every pass, and of each level that moved anything in it."""
    points = []
    for part in timing.passes:
        instructions = sum(part.warp_instructions.values())
        running = part.cycles - part.launch_cycles
        if not instructions or running <= 0:
            continue
        rate = instructions * timing.clock_hz / running / 1e9
        points += [
            Point(part.name, name, instructions / level.bytes, rate)
            for name, level in part.levels.items()
            if level.bytes
        ]
    return points


def bandwidth_roofs(timing: TimingResult) -> dict[str, float]:
    """Level -> peak bandwidth in GB/s (10^9)."""
    levels = timing.total.levels
    return {
        name: levels[name].peak_bytes_per_kilocycle * timing.clock_hz / 1e12
        for name in LEVEL_NAMES
        if name in levels and levels[name].peak_bytes_per_kilocycle
    }


def issue_roof(gpu: Gpu) -> float:
    """10^9 warp instructions per second that all schedulers issue at most.

    Raises:
        ValueError: the GPU has no timing.
    """
    if gpu.sm_timing is None:
        raise ValueError(f"{gpu.name} has no sm_timing")
    per_cycle = gpu.sm.count * gpu.sm_timing.num_schedulers * gpu.sm_timing.issue_per_warp
    return per_cycle * gpu.clock_hz / 1e9


def roofline_figure(timing: TimingResult, gpu: Gpu, title: str) -> Figure:
    """The roofs and the passes, both axes logarithmic.

    Colour and dash tell levels apart, the marker passes; the points of a pass lie on one line.
    """
    points, roofs, peak = roofline_points(timing), bandwidth_roofs(timing), issue_roof(gpu)
    figure = Figure(figsize=(7.2, 5.0), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = _limits(points, roofs, peak)
    for name, bandwidth in roofs.items():
        ridge = peak / bandwidth
        axes.plot(
            [low / 10, ridge],
            [bandwidth * low / 10, peak],
            color=_COLOURS[name],
            linestyle=_DASHES[name],
            linewidth=1.6,
            label=f"{LEVEL_NAMES[name]}: {bandwidth:,.0f} GB/s",
        )
    axes.plot(
        [min(peak / max(roofs.values()), high) if roofs else low, high * 10],
        [peak, peak],
        color="black",
        linewidth=1.6,
        label=f"issue: {peak:,.0f} G warp instructions/s",
    )
    _draw_points(axes, points)
    axes.set_xlim(low, high)
    bottom = min([p.giga_per_s for p in points], default=peak / 100)
    axes.set_ylim(bottom / 10**_MARGIN, peak * 10**_MARGIN)
    axes.set_xlabel(
        "warp instructions per byte moved at the level (1/B)\n"
        "a point that touches its level's roof has that level at its peak bandwidth",
        fontsize=FONT_SIZE,
    )
    axes.set_ylabel("10⁹ warp instructions per second, launches left out", fontsize=FONT_SIZE)
    axes.grid(which="major", color="0.88", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=FONT_SIZE)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, fontsize=FONT_SIZE, frameon=False)
    figure.suptitle(title, fontsize=FONT_SIZE + 2)
    axes.set_title(bottleneck_line(timing.total), fontsize=FONT_SIZE - 1, color="0.25", wrap=True)
    return figure


def _draw_points(axes: Axes, points: list[Point]) -> None:
    """A marker per level on a thin line per pass, and a grey entry of the legend per pass."""
    names = list(dict.fromkeys(p.pass_name for p in points))
    for index, name in enumerate(names):
        marker = _MARKERS[index % len(_MARKERS)]
        of_pass = [p for p in points if p.pass_name == name]
        height = of_pass[0].giga_per_s
        at = [p.instructions_per_byte for p in of_pass]
        axes.plot([min(at), max(at)], [height, height], color="0.6", linewidth=0.8, zorder=3)
        for point in of_pass:
            axes.plot(
                point.instructions_per_byte,
                height,
                marker=marker,
                # Smaller below, so that of points that coincide both are seen.
                markersize=10 - 1.4 * list(LEVEL_NAMES).index(point.level),
                color=_COLOURS[point.level],
                markeredgecolor="black",
                markeredgewidth=0.6,
                linestyle="none",
                zorder=4,
            )
        axes.plot(
            [], [], marker=marker, markersize=7, color="0.6", markeredgecolor="black",
            markeredgewidth=0.6, linestyle="none", label=name,
        )  # fmt: skip


def _limits(points: list[Point], roofs: dict[str, float], peak: float) -> tuple[float, float]:
    """The ends of the horizontal axis: around the points and the roofs' ridges."""
    at = [p.instructions_per_byte for p in points] + [peak / b for b in roofs.values()]
    if not at:
        return 0.01, 10.0
    return float(min(at) / 10**_MARGIN), float(max(at) * 10**_MARGIN)
