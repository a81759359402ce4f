"""A report in GPGPU-Sim's own stat lines, and the reader of such lines.

Names, spelling and number formats are GPGPU-Sim's, so that scripts which collect its statistics
read ours. Only what the model counts is printed. One block stands for the whole trace, its
launches' cycles added up: `gpu_sim_*` equals `gpu_tot_sim_*`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cachesim.config import Gpu
    from cachesim.timing.results import PassTiming, TimingResult

#: Outcomes in the order in which GPGPU-Sim prints them.
OUTCOMES = ("HIT", "HIT_RESERVED", "MISS", "RESERVATION_FAIL", "SECTOR_MISS", "MSHR_HIT")
#: Those that TOTAL_ACCESS counts: a fail is tried again, an MSHR hit is a miss as well.
ACCEPTED = ("HIT", "HIT_RESERVED", "MISS", "SECTOR_MISS")
#: What scripts look for to know that a run came to its end.
EXIT_LINE = "GPGPU-Sim: *** exit detected ***"
#: Our name of a counter that GPGPU-Sim prints under another.
_RENAMED = {"l1_bank_conflicts": "gpgpu_n_l1cache_bkconflict"}
#: Printed in lines of their own, not as they stand.
_TOTALS = ("gpu_sim_cycle", "gpu_sim_insn", "averagemflatency_sum", "averagemflatency_num")
#: Of the SMs' counters that are printed as they stand.
_PREFIXES = ("gpgpu_", "gpu_")
#: GPGPU-Sim pads these names.
_PADDED = {
    "gpgpu_n_load_insn": "gpgpu_n_load_insn ",
    "gpu_stall_icnt2sh": "gpu_stall_icnt2sh   ",
}
_NUMBER = r"[-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|nan|inf)"
_LINE = re.compile(
    rf"\s*(?P<name>[A-Za-z][\w ]*?(?:\[\w+\])*)\s*=\s*(?P<value>{_NUMBER})"
    r"\s*(?P<unit>%|x|GB/Sec|\(inst/sec\)|\(cycle/sec\))?\s*"
)


def stat_lines(
    timing: TimingResult, gpu: Gpu, *, fetch_path: str, name: str, host_s: float | None = None
) -> str:
    """The counters of a timed run as GPGPU-Sim prints them.

    Args:
        timing: what the run found. gpu: what it ran on. fetch_path: how loads entered the L1, which
            decides their access type. name: of the trace, printed as the kernel's.
        host_s: seconds that the run took; without it the lines on simulation speed are left out.
    """
    counters, total = timing.gpgpusim, timing.total
    sm = counters.get("sm", {})
    cycles, instructions = total.cycles, sm.get("gpu_sim_insn")
    l1, l2 = (access_outcomes(counters.get(level, {}), fetch_path) for level in ("l1", "l2"))
    kernel = re.sub(r"\W+", "_", name)
    lines = [f"kernel_name = {kernel} ", *_cycle_lines(cycles, instructions, total)]
    if l2:
        lines += _bandwidth_lines(l2, cycles, timing.clock_hz)
    lines += _core_lines(l1, gpu.l1_texture is not None)
    for counter, value in sm.items():
        shown = _RENAMED.get(counter, counter)
        if counter not in _TOTALS and shown.startswith(_PREFIXES):
            lines.append(f"{_PADDED.get(shown, shown)} = {value}")
    if sm.get("averagemflatency_num"):
        mean = sm["averagemflatency_sum"] // sm["averagemflatency_num"]
        lines.append(f"averagemflatency = {mean} ")
    dram = counters.get("dram", {})
    lines += [f"total dram {kind} = {dram[kind]}" for kind in ("reads", "writes") if kind in dram]
    if l2:
        lines += _total_lines("L2", l2, indent="")
        lines.append("L2_total_cache_breakdown:")
        lines += _breakdown_lines("L2_cache_stats_breakdown", l2)
    if host_s is not None:
        lines += _speed_lines(cycles, instructions, host_s, timing.clock_hz)
    return "\n".join([*lines, EXIT_LINE, ""])


def access_outcomes(counters: Mapping[str, int], fetch_path: str) -> dict[str, dict[str, int]]:
    """Access type -> outcome -> count of one level.

    counters: outcomes of loads ("HIT", ...) and of stores ("W_HIT", ...).
    """
    load = "TEXTURE_ACC_R" if fetch_path == "texture" else "GLOBAL_ACC_R"
    types: dict[str, dict[str, int]] = {}
    for kind, prefix in ((load, ""), ("GLOBAL_ACC_W", "W_")):
        counts = {o: counters[prefix + o] for o in OUTCOMES if prefix + o in counters}
        if any(counts.values()):
            types[kind] = counts
    return types


def _cycle_lines(cycles: int, instructions: int | None, total: PassTiming) -> list[str]:
    lines = []
    occupancy = active_occupancy(total)
    for prefix in ("gpu", "gpu_tot"):
        lines.append(f"{prefix}_sim_cycle = {cycles}")
        if instructions is not None:
            ipc = instructions / cycles if cycles else 0.0
            lines += [f"{prefix}_sim_insn = {instructions}", f"{prefix}_ipc = {ipc:12.4f}"]
    if occupancy is not None:
        lines += [f"{prefix}_occupancy = {100 * occupancy:.4f}% " for prefix in ("gpu", "gpu_tot")]
    return lines


def active_occupancy(part: PassTiming) -> float | None:
    """Resident warps / the limit over the cycles in which an SM had a warp.

    `PassTiming.occupancy` counts idle SMs too; GPGPU-Sim leaves them out.
    """
    running = part.cycles - part.launch_cycles
    if running <= 0:
        return None
    active = part.sm_cycles * (running - part.where.get("idle", 0)) / running
    return part.resident_warp_cycles / (active * part.max_warps) if active > 0 else None


def _bandwidth_lines(l2: Mapping[str, Mapping[str, int]], cycles: int, clock_hz: int) -> list[str]:
    """L2_BW: every accepted access gets one reply of up to 32 B."""
    replies = sum(_accepted(counts) for counts in l2.values())
    rate = replies * 32 * clock_hz / cycles / 1e9 if cycles else 0.0
    return [f"L2_BW  = {rate:12.4f} GB/Sec", f"L2_BW_total  = {rate:12.4f} GB/Sec"]


def _core_lines(types: Mapping[str, Mapping[str, int]], has_texture_l1: bool) -> list[str]:
    """The L1s: the totals of each kind of L1, and the breakdown over all."""
    # Where textures have an L1 of their own, loads of the texture path are looked up there; a
    # texel store goes through the data cache.
    of_texture = {k: v for k, v in types.items() if k == "TEXTURE_ACC_R" and has_texture_l1}
    of_data = {k: v for k, v in types.items() if k not in of_texture}
    lines = []
    for name, part in (("L1D", of_data), ("L1T", of_texture)):
        if part:
            lines += [f"{name}_cache:", *_total_lines(name, part, indent="\t")]
    if types:
        lines.append("Total_core_cache_stats:")
        lines += _breakdown_lines("Total_core_cache_stats_breakdown", types)
    return lines


def _accepted(counts: Mapping[str, int]) -> int:
    return sum(counts.get(outcome, 0) for outcome in ACCEPTED)


def _total_lines(name: str, types: Mapping[str, Mapping[str, int]], indent: str) -> list[str]:
    """The sums over access types, as GPGPU-Sim's `cache_sub_stats` has them."""

    def sum_of(*outcomes: str) -> int:
        return sum(counts.get(o, 0) for counts in types.values() for o in outcomes)

    accesses, misses = sum_of(*ACCEPTED), sum_of("MISS", "SECTOR_MISS")
    start = f"{indent}{name}_total_cache"
    lines = [f"{start}_accesses = {accesses}", f"{start}_misses = {misses}"]
    if accesses:
        lines.append(f"{start}_miss_rate = {misses / accesses:.4f}")
    return [
        *lines,
        f"{start}_pending_hits = {sum_of('HIT_RESERVED')}",
        f"{start}_reservation_fails = {sum_of('RESERVATION_FAIL')}",
    ]


def _breakdown_lines(name: str, types: Mapping[str, Mapping[str, int]]) -> list[str]:
    """One line per access type and outcome, then the totals; scripts need the leading tab."""
    lines = [
        f"\t{name}[{kind}][{outcome}] = {counts[outcome]}"
        for kind, counts in types.items()
        for outcome in OUTCOMES
        if outcome in counts
    ]
    return lines + [
        f"\t{name}[{kind}][TOTAL_ACCESS] = {_accepted(counts)}"
        for kind, counts in types.items()
        if _accepted(counts)
    ]


def _speed_lines(cycles: int, instructions: int | None, host_s: float, clock_hz: int) -> list[str]:
    """How long the simulation took; GPGPU-Sim divides by whole seconds, at least one."""
    seconds = max(1, int(host_s))
    days, rest = divmod(seconds, 86400)
    hours, rest = divmod(rest, 3600)
    told = f"{days} days, {hours} hrs, {rest // 60} min, {rest % 60} sec ({seconds} sec)"
    lines = [f"gpgpu_simulation_time = {told}"]
    if instructions is not None:
        lines.append(f"gpgpu_simulation_rate = {instructions // seconds} (inst/sec)")
    lines.append(f"gpgpu_simulation_rate = {cycles // seconds} (cycle/sec)")
    if cycles >= seconds:
        lines.append(f"gpgpu_silicon_slowdown = {clock_hz // (cycles // seconds)}x")
    return lines


def parse_stat_lines(text: str) -> dict[str, int | float]:
    """The statistics of GPGPU-Sim's output, or of `stat_lines`: name -> number.

    Of a name that is printed several times, as after each kernel, the last value stands. A rate is
    called with its unit: "gpgpu_simulation_rate (inst/sec)". Lines that are not one name and one
    number are passed over.
    """
    found: dict[str, int | float] = {}
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        if match is None:
            continue
        name, value, unit = match["name"].strip(), match["value"], match["unit"] or ""
        key = f"{name} {unit}" if unit.startswith("(") else name
        found[key] = int(value) if re.fullmatch(r"[-+]?\d+", value) else float(value)
    return found
