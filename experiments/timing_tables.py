"""What a timed run found, in tables and words: cycles and where they went, traffic against its
peak, latencies, and the one thing that bounds the run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cachesim.timing.results import REASONS
from experiments.tables import Column, Table

if TYPE_CHECKING:
    from cachesim.config import Gpu
    from cachesim.timing.results import PassTiming, TimingResult

#: How the columns of the reasons are headed.
REASON_HEADINGS = {
    "issue": "issue",
    "arithmetic": "arith.",
    "l1_bandwidth": "L1 bandw.",
    "l1_reservation": "L1 reserv.",
    "interconnect": "icnt",
    "l2": "L2",
    "dram": "DRAM",
    "latency": "latency",
    "launch": "launch",
    "idle": "idle",
}
#: The same in running text.
REASON_NAMES = REASON_HEADINGS | {
    "arithmetic": "arithmetic",
    "l1_bandwidth": "L1 bandwidth",
    "l1_reservation": "L1 reservation",
    "interconnect": "interconnect",
    "latency": "latency not hidden",
}
LEVEL_NAMES = {"l1": "L1", "gl1": "GL1", "l2": "L2", "llc": "LLC", "dram": "DRAM"}


def timing_refusal(gpu: Gpu, fetch_path: str = "texture") -> str | None:
    """Why the timing model cannot run a GPU, in one line; None where it can."""
    from cachesim.timing.refusals import check_timing
    from traces.errors import InputError

    try:
        check_timing(gpu, fetch_path)
    except InputError as error:
        return str(error)
    return None


def cycles_table(timing: TimingResult, gpu: Gpu) -> Table:
    """One row per pass and the total: cycles, time, occupancy, what most cycles went to."""
    import pandas as pd

    rows = [
        {
            "pass": part.name,
            "num_launches": part.num_launches,
            "cycles": part.cycles,
            "time_ms": timing.milliseconds(part),
            "occupancy": part.occupancy,
            "issue_slots": issue_slots_used(part, gpu),
            "bottleneck": REASON_NAMES[part.bottleneck],
            "share": bottleneck_share(part),
        }
        for part in shown_parts(timing)
    ]
    columns = (
        Column("pass", "pass"),
        Column("num_launches", "kernels"),
        Column("cycles", "cycles"),
        Column("time_ms", "ms", ",.3f"),
        Column("occupancy", "occupancy", ".0%"),
        Column("issue_slots", "issue slots used", ".0%"),
        Column("bottleneck", "bottleneck"),
        Column("share", "its share", ".0%"),
    )
    told = (
        f"ms at {timing.clock_hz / 1e6:,.0f} MHz. Occupancy: resident warps / the SMs' limit while "
        "kernels ran. Issue slots: warp instructions / what the schedulers can issue. The "
        "bottleneck's share is of the cycles without launches.",
    )
    frame = pd.DataFrame(rows).astype({"occupancy": float, "issue_slots": float})
    return Table(f"Cycles of {gpu.name}", frame, columns, told)


def where_table(timing: TimingResult, gpu: Gpu) -> Table:
    """One row per pass and the total: the share of the cycles by reason in %; launches included."""
    import pandas as pd

    parts = shown_parts(timing)
    reasons = [r for r in REASONS if any(part.where.get(r) for part in parts)]
    rows = [
        {"pass": part.name}
        | {r: 100 * part.where.get(r, 0) / part.cycles if part.cycles else 0.0 for r in reasons}
        for part in parts
    ]
    columns = (
        Column("pass", "pass"),
        *(Column(r, REASON_HEADINGS[r], ".1f") for r in reasons),
    )
    title = f"Where the cycles of {gpu.name} went, in %"
    return Table(title, pd.DataFrame(rows), columns, notes(timing, gpu))


def notes(timing: TimingResult, gpu: Gpu) -> tuple[str, ...]:
    """The bottleneck of the run, what it means, and the passes that have another one."""
    total = timing.total
    name = REASON_NAMES[total.bottleneck]
    meaning = f"{name[0].upper()}{name[1:]}: {REASONS[total.bottleneck]}."
    if total.bottleneck not in ("issue", "launch"):
        issued = share_of_cycles(total, "issue")
        meaning += f" Instructions issued in {issued:.0%} of the schedulers' cycles."
    if total.bottleneck == "dram" and total.rows_opened:
        each = total.levels["dram"].bytes / total.rows_opened
        meaning += f" A row was opened for every {each:.0f} B."
    lines = [bottleneck_line(total), meaning]
    for part in timing.passes:
        if part.bottleneck != total.bottleneck:
            share = bottleneck_share(part)
            lines.append(f"In pass {part.name} it is {REASON_NAMES[part.bottleneck]}, {share:.0%}.")
    return tuple(lines)


def issue_slots_used(part: PassTiming, gpu: Gpu) -> float | None:
    """Warp instructions / what the schedulers of all SMs can issue while the kernel runs."""
    if gpu.sm_timing is None or not part.sm_cycles:
        return None
    slots = part.sm_cycles * gpu.sm_timing.num_schedulers * gpu.sm_timing.issue_per_warp
    return sum(part.warp_instructions.values()) / slots


def bottleneck_line(part: PassTiming) -> str:
    """One line: what most cycles went to, its share, and the busiest level."""
    reason = part.bottleneck
    line = f"Bottleneck: {REASON_NAMES[reason]}, {bottleneck_share(part):.0%} of the cycles"
    if reason != "launch":
        line += " without launches"
    used = {name: part.utilisation(name) or 0.0 for name in part.levels}
    if used:
        level = max(used, key=lambda name: used[name])
        line += f"; busiest {LEVEL_NAMES.get(level, level)} at {used[level]:.0%} of peak"
    return line + "."


def bottleneck_share(part: PassTiming) -> float:
    """The bottleneck's share of the cycles; the launch is left out unless it is the bottleneck."""
    return share_of_cycles(part, part.bottleneck)


def share_of_cycles(part: PassTiming, reason: str) -> float:
    """A reason's share of the cycles; the launch is left out unless it is the reason."""
    of = part.cycles if reason == "launch" else part.cycles - part.where.get("launch", 0)
    return part.where.get(reason, 0) / of if of else 0.0


def bandwidth_table(timing: TimingResult, gpu: Gpu) -> Table:
    """One row per pass and level: traffic, achieved against peak bandwidth, mean latency."""
    import pandas as pd

    rows = []
    for part in shown_parts(timing):
        seconds = (part.cycles - part.launch_cycles) / timing.clock_hz
        for name, level in part.levels.items():
            rows.append(
                {
                    "pass": part.name,
                    "level": LEVEL_NAMES.get(name, name),
                    "megabytes": level.bytes / 1e6,
                    "achieved_gb_per_s": level.bytes / seconds / 1e9 if seconds else None,
                    "peak_gb_per_s": level.peak_bytes_per_kilocycle * timing.clock_hz / 1e12,
                    "utilisation": part.utilisation(name),
                    "mean_latency_cycles": level.mean_latency_cycles,
                    "num_latencies": level.num_latencies,
                }
            )
    columns = (
        Column("pass", "pass"),
        Column("level", "level"),
        Column("megabytes", "MB", ",.2f"),
        Column("achieved_gb_per_s", "GB/s", ",.1f"),
        Column("peak_gb_per_s", "peak GB/s", ",.1f"),
        Column("utilisation", "of peak", ".1%"),
        Column("mean_latency_cycles", "mean latency (cycles)", ",.0f"),
        Column("num_latencies", "requests answered"),
    )
    numbers = ("achieved_gb_per_s", "utilisation", "mean_latency_cycles")
    frame = pd.DataFrame(rows).astype(dict.fromkeys(numbers, float))
    told = (
        "GB/s = 10^9 B/s, over the time without launches. Latency: from the SM's load/store queue "
        "until the data is back, of the requests whose data came from that level.",
    )
    return Table(f"Traffic and latency on {gpu.name}", frame, columns, told)


def shown_parts(timing: TimingResult) -> list[PassTiming]:
    """The passes, and their total where there are several."""
    return [*timing.passes, timing.total] if len(timing.passes) > 1 else [timing.total]


def comparison_notes(gpu: Gpu, fetch_path: str, l1_accesses: int) -> list[str]:
    """Where a run on a config of GPGPU-Sim's is of another kind than its own, or than the
    dissertation's, in words.
    """
    if not is_gpgpusim(gpu):
        return []
    if fetch_path == "texture" and gpu.l1_texture is not None:
        return [
            "GPGPU-Sim asks for one texel per lane of a filtered fetch; this run asks for the "
            "footprint, so its L1T accesses, and what follows from them, are higher than there."
        ]
    if fetch_path == "global" and gpu.l1.bypass_loads and not l1_accesses:
        return [
            "As this config ships, plain loads skip the L1: there is no L1 demand and no L1 miss "
            "rate, of which the dissertation shows both. --fetch-path readonly or texture, or "
            "--set l1.bypass_loads=false, sends loads through it."
        ]
    return []


def is_gpgpusim(gpu: Gpu) -> bool:
    """Whether a GPU is what a config of GPGPU-Sim's says, and not a card."""
    return gpu.name.endswith("-gpgpusim")
