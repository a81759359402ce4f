"""T(n) in cycles: what each launch would take if one thing alone limited it.

The cycles of a launch are its launch latency and a sum of these times, each with a fitted weight:
0 where it is hidden behind the others, 1 where it is paid in full, more where the machine does not
reach its peak.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cachesim.cost.machine import Machine
from cachesim.cost.memory import Memory
from cachesim.cost.tiles import ScatterCost
from cachesim.cost.workload import LaunchWork, Workload

#: The limits, in the order of their coefficients.
LIMITS = ("issue", "traffic", "latency")


def has_timing(machine: Machine) -> bool:
    """Whether the configuration says enough for cycles."""
    gpu = machine.gpu
    needed = (gpu.sm_timing, gpu.l1_timing, gpu.l2_timing, gpu.dram_timing)
    return all(part is not None for part in needed)


def launch_cycles(machine: Machine) -> int:
    """Launch latency of one kernel."""
    return machine.gpu.sm_timing.launch_cycles if machine.gpu.sm_timing else 0


def limit_times(
    workload: Workload,
    costs: Sequence[ScatterCost],
    machine: Machine,
    memory: Memory,
    l2_asked: Mapping[int, float],
    dram_moved: Mapping[int, float],
) -> list[dict[str, float]]:
    """Per launch, the cycles that each of `LIMITS` alone would take; latency in dependent accesses.

    l2_asked, dram_moved: launch -> bytes.
    """
    found = []
    for launch in workload.launches:
        cost = next((c for c in costs if c.scatter.launch == launch.launch), None)
        found.append(_of_launch(workload, launch, cost, machine, memory, l2_asked, dram_moved))
    return found


def _of_launch(
    workload: Workload,
    launch: LaunchWork,
    cost: ScatterCost | None,
    machine: Machine,
    memory: Memory,
    l2_asked: Mapping[int, float],
    dram_moved: Mapping[int, float],
) -> dict[str, float]:
    gpu, l1 = machine.gpu, machine.levels[0]
    assert gpu.sm_timing and gpu.l1_timing and gpu.l2_timing and gpu.dram_timing
    sms = min(gpu.sm.count, launch.num_ctas)
    busiest, sectors = 1.0, 0.0
    waves = max(1.0, launch.num_ctas / (gpu.sm.count * machine.resident(launch)))
    accesses = launch.accesses / max(launch.num_ctas * launch.warps_per_cta, 1)
    if cost is not None and cost.classes:
        scatter = cost.scatter
        total = float(scatter.steps.sum()) * len(scatter.reads)
        busiest = max(1.0, float(cost.schedule.end.max()) * sms / max(total, 1.0))
        sectors += cost.asked
        working = sum(len(c.tiles) for c in cost.classes)
        waves = max(1.0, working / (gpu.sm.count * machine.resident(launch)))
        longest = max(c.turns for c in cost.classes)
        accesses = len(scatter.reads) * longest
    for sweep in (s for s in workload.sweeps if s.launch == launch.launch):
        blocks = sweep.rows * 32.0 / (machine.warp_shape[0] * machine.warp_shape[1])
        sectors += blocks * memory.row_sectors(sweep, machine.warp_shape)
    l1_rate = gpu.l1_timing.bytes_per_cycle or gpu.l1_timing.num_banks * gpu.l1_timing.bank_bytes
    units = sms * l1.instances / gpu.sm.count
    l2, dram = gpu.l2_timing, gpu.dram_timing
    l2_rate = gpu.l2.num_slices * l2.port_bytes * l2.clock_hz / gpu.clock_hz
    last = gpu.llc or gpu.l2
    dram_rate = last.num_channels * dram.bus_bytes * dram.data_rate * dram.clock_hz / gpu.clock_hz
    return {
        "issue": launch.instructions / (sms * gpu.sm_timing.num_schedulers) * busiest,
        "traffic": max(
            sectors * l1.sector_bytes / (units * l1_rate) * busiest,
            l2_asked.get(launch.launch, 0.0) / l2_rate,
            dram_moved.get(launch.launch, 0.0) / dram_rate,
        ),
        "latency": waves * accesses,
    }
