"""A GPU's memory system as boxes, drawn from its configuration alone: the SMs with their L1s, what
several SMs share, the slices of the L2, a last-level cache where there is one, and the memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from cachesim.units import format_size
from experiments.plots import FONT_SIZE, PALETTE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cachesim.config import L1, L2, CacheLevel, Gpu

WIDTH = 100.0
#: Right of this stand the latencies.
BLOCKS = 84.0
GAP = 1.2
_ROW, _SPACE = 9.0, 3.0
#: Above the caches of an SM, and below them.
_HEAD, _PAD = 6.0, 1.5
_COLOURS = {
    "sm": "0.93", "l1": PALETTE[0], "l1_texture": PALETTE[5], "gl1": PALETTE[4],
    "icnt": "0.6", "l2": PALETTE[2], "llc": PALETTE[1], "dram": PALETTE[3],
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One level from top to bottom. key: of the colour. latency: text on the right."""

    key: str
    latency: str


def block_diagram(gpu: Gpu, title: str) -> Figure:
    """The memory system of `gpu`."""
    rows = list_rows(gpu)
    height = len(rows) * (_ROW + _SPACE) + _HEAD + 3.0
    figure = Figure(figsize=(7.2, 7.2 * height / WIDTH), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlim(0, WIDTH)
    axes.set_ylim(0, height)
    axes.axis("off")
    axes.set_title(title, fontsize=FONT_SIZE + 2, loc="left")
    top = height - 1
    num_upper = sum(r.key in ("l1", "l1_texture", "gl1") for r in rows)
    _draw_upper(axes, gpu, top, num_upper, rows)
    top -= _HEAD + num_upper * (_ROW + _SPACE)
    above = top + _SPACE - _PAD
    for row in rows[num_upper:]:
        bottom = top - _ROW
        # The network is a thin bar.
        inset = 2.0 if row.key == "icnt" else 0.0
        if row.key == "icnt":
            told = describe_interconnect(gpu)
            _box(axes, 0, bottom + inset, BLOCKS, _ROW - 2 * inset, row.key, told)
        elif row.key == "dram":
            channels = last_level(gpu).num_channels
            _cells(axes, bottom, row.key, channels, describe_memory(gpu))
        else:
            level = gpu.l2 if row.key == "l2" else gpu.llc
            assert level is not None
            _cells(axes, bottom, row.key, level.num_slices, describe_slices(row.key, level))
        _note(axes, bottom, row.latency)
        _arrow(axes, above, top - inset)
        above = bottom + inset
        top = bottom - _SPACE
    return figure


def list_rows(gpu: Gpu) -> list[Row]:
    """The levels that this GPU has, with the core cycles that each adds."""
    rows = []
    if gpu.l1_texture is not None:
        rows.append(Row("l1_texture", ""))
    timing = gpu.l1_timing
    rows.append(
        Row(
            "l1",
            f"hit after\n{timing.latency_cycles} (load)\n{timing.texture_latency_cycles} (texture)"
            if timing
            else "",
        )
    )
    if gpu.gl1 is not None:
        rows.append(Row("gl1", f"+{gpu.gl1_timing.latency_cycles}" if gpu.gl1_timing else ""))
    icnt = gpu.icnt
    there = (
        f"+{icnt.request_latency_cycles} there\n+{icnt.reply_latency_cycles} back" if icnt else ""
    )
    rows.append(Row("icnt", there))
    rows.append(Row("l2", f"+{gpu.l2_timing.latency_cycles}" if gpu.l2_timing else ""))
    if gpu.llc is not None:
        rows.append(Row("llc", f"+{gpu.llc_timing.latency_cycles}" if gpu.llc_timing else ""))
    memory = gpu.dram_timing
    rows.append(Row("dram", f"+{memory.fixed_latency_cycles}\nand the bank" if memory else ""))
    return rows


def last_level(gpu: Gpu) -> L2:
    """The cache whose channels are the memory's."""
    return gpu.llc or gpu.l2


def memory_gb_per_s(gpu: Gpu) -> float | None:
    """Peak of the memory in 10^9 bytes a second; None without timing."""
    memory = gpu.dram_timing
    if memory is None:
        return None
    per_channel = memory.bus_bytes * memory.data_rate * memory.clock_hz
    return last_level(gpu).num_channels * per_channel / 1e9


def describe_level(level: CacheLevel) -> str:
    """Line, sector and ways."""
    sector = "" if level.sectors_per_line == 1 else f", {level.sector_bytes} B sectors"
    return f"{level.line_bytes} B lines{sector}, {level.ways} ways"


def describe_first(name: str, level: L1) -> str:
    """The first level of an SM in three short lines."""
    units = f"{level.units_per_sm} x " if level.units_per_sm > 1 else ""
    sector = f"/{level.sector_bytes}" if level.sectors_per_line > 1 else ""
    return (
        f"{name} {units}{format_size(level.capacity)}\n{level.line_bytes}{sector} B, "
        f"{level.ways} ways"
    )


def describe_slices(key: str, level: L2) -> str:
    """A sliced level in two lines."""
    each = format_size(level.capacity // level.num_slices)
    return (
        f"{'L2' if key == 'l2' else 'Infinity Cache'} {format_size(level.capacity)}: "
        f"{level.num_slices} slices x {each}\n{describe_level(level)}, {level.write_policy}"
    )


def describe_interconnect(gpu: Gpu) -> str:
    """The network in one line."""
    icnt = gpu.icnt
    return f"interconnect, {icnt.flit_bytes} B per port and cycle" if icnt else "interconnect"


def describe_memory(gpu: Gpu) -> str:
    """Channels, atom and peak in two lines."""
    rate = memory_gb_per_s(gpu)
    peak = f", {rate:,.0f} GB/s" if rate else ""
    return f"memory: {last_level(gpu).num_channels} channels{peak}\n{gpu.dram.sector_bytes} B atoms"


def _draw_upper(axes: Axes, gpu: Gpu, top: float, num_levels: int, rows: list[Row]) -> None:
    """The first and last SMs with their own caches, or the first and last arrays of SMs."""
    group = gpu.gl1.sms_per_instance if gpu.gl1 else 1
    num_groups = -(-gpu.sm.count // group)
    tall = _HEAD + num_levels * (_ROW + _SPACE) - _SPACE + _PAD
    bottom = top - tall
    if group == 1:
        spans = [(0, 24.0, 0), (26, 24.0, 1), (60, 24.0, gpu.sm.count - 1)]
    else:
        spans = [(0, 36.0, 0), (48, 36.0, num_groups - 1)]
    spans = spans[:1] if num_groups == 1 else spans
    for left, wide, index in spans:
        if group == 1:
            _draw_sm(axes, gpu, left, bottom, wide, tall, index)
        else:
            _draw_array(axes, gpu, left, bottom, wide, tall, index)
    if num_groups > 1:
        middle = (spans[-2][0] + spans[-2][1] + spans[-1][0]) / 2
        axes.text(
            middle, bottom + tall / 2, ". . .", ha="center", va="center", fontsize=FONT_SIZE + 2
        )
    level = 0
    for row in rows:
        if row.key in ("l1_texture", "l1", "gl1"):
            _note(axes, top - _HEAD - level * (_ROW + _SPACE) - _ROW, row.latency)
            level += 1


def _draw_sm(
    axes: Axes, gpu: Gpu, left: float, bottom: float, wide: float, tall: float, index: int
) -> None:
    """One SM: its name, its warps, its first level and, where it has one, its texture L1."""
    name = "SM" if gpu.vendor != "amd" else "CU"
    _frame(axes, left, bottom, wide, tall)
    text = f"{name} {index}: {gpu.sm.max_warps} warps of {gpu.sm.warp_size}"
    axes.text(
        left + wide / 2, bottom + tall - 3, text, ha="center", va="center", fontsize=FONT_SIZE - 1
    )
    at = bottom + tall - _HEAD - _ROW
    if gpu.l1_texture is not None:
        told = describe_first("texture L1", gpu.l1_texture)
        _box(axes, left + GAP, at, wide - 2 * GAP, _ROW, "l1_texture", told)
        at -= _ROW + _SPACE
    _box(axes, left + GAP, at, wide - 2 * GAP, _ROW, "l1", describe_first("L1", gpu.l1))


def _draw_array(
    axes: Axes, gpu: Gpu, left: float, bottom: float, wide: float, tall: float, index: int
) -> None:
    """One shader array: two of its CUs with their L0, and the GL1 that all of them share."""
    assert gpu.gl1 is not None
    group = gpu.gl1.sms_per_instance
    _frame(axes, left, bottom, wide, tall)
    first = index * group
    last = min(first + group, gpu.sm.count) - 1
    text = f"CU {first} to {last}: {gpu.sm.max_warps} waves of {gpu.sm.warp_size} each"
    axes.text(
        left + wide / 2, bottom + tall - 3, text, ha="center", va="center", fontsize=FONT_SIZE - 1
    )
    at, half = bottom + tall - _HEAD - _ROW, (wide - 8) / 2
    for start in (left + GAP, left + wide - GAP - half):
        _box(axes, start, at, half, _ROW, "l1", describe_first("L0", gpu.l1))
    axes.text(left + wide / 2, at + _ROW / 2, "...", ha="center", va="center", fontsize=FONT_SIZE)
    told = f"GL1 {format_size(gpu.gl1.capacity)} of {group} CUs\n{describe_level(gpu.gl1)}"
    _box(axes, left + GAP, at - _ROW - _SPACE, wide - 2 * GAP, _ROW, "gl1", told)


def _arrow(axes: Axes, above: float, below: float) -> None:
    axes.annotate(
        "", (BLOCKS / 2, below), (BLOCKS / 2, above),
        arrowprops={
            "arrowstyle": "<->", "color": "0.3", "linewidth": 1, "mutation_scale": 7,
            "shrinkA": 0, "shrinkB": 0,
        },
    )  # fmt: skip


def _frame(axes: Axes, left: float, bottom: float, wide: float, tall: float) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (left, bottom),
            wide,
            tall,
            boxstyle="round,pad=0,rounding_size=1",
            facecolor=_COLOURS["sm"],
            edgecolor="0.5",
            linewidth=0.8,
        )
    )


def _box(
    axes: Axes, left: float, bottom: float, wide: float, tall: float, key: str, text: str
) -> None:
    """A level's box: its colour at the edge, a tint of it inside, so that text stays readable."""
    colour = _COLOURS[key]
    axes.add_patch(Rectangle((left, bottom), wide, tall, facecolor="white", linewidth=0))
    axes.add_patch(Rectangle((left, bottom), wide, tall, facecolor=colour, alpha=0.18, linewidth=0))
    axes.add_patch(
        Rectangle((left, bottom), wide, tall, facecolor="none", edgecolor=colour, linewidth=1.3)
    )
    axes.text(
        left + wide / 2, bottom + tall / 2, text, ha="center", va="center", fontsize=FONT_SIZE - 1.5
    )


def _cells(axes: Axes, bottom: float, key: str, count: int, text: str) -> None:
    """A level over the whole width with a stroke between its slices or channels."""
    _box(axes, 0, bottom, BLOCKS, _ROW, key, text)
    for i in range(1, count):
        x = BLOCKS * i / count
        for low, high in ((bottom, bottom + 1.2), (bottom + _ROW - 1.2, bottom + _ROW)):
            axes.plot((x, x), (low, high), color=_COLOURS[key], linewidth=0.8)


def _note(axes: Axes, bottom: float, text: str) -> None:
    axes.text(BLOCKS + 1.5, bottom + _ROW / 2, text, ha="left", va="center", fontsize=FONT_SIZE - 2)
