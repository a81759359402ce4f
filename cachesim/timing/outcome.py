"""From the engine's sums to `results.PassTiming` and GPGPU-Sim's counters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cachesim.config import Gpu
from cachesim.counts import ACCESSES, BYPASSES, HIT_BACK
from cachesim.timing import records
from cachesim.timing.records import KINDS, NEVER, OUTCOMES, R_MEMORY
from cachesim.timing.results import REASONS, LevelTiming, PassTiming
from cachesim.timing.state import State
from cachesim.timing.tags import Tags

_DIRECT = {
    "issue": records.R_ISSUE,
    "arithmetic": records.R_ARITHMETIC,
    "l1_bandwidth": records.R_L1_BANDWIDTH,
    "l1_reservation": records.R_L1_RESERVATION,
    "interconnect": records.R_INTERCONNECT,
    "idle": records.R_IDLE,
}


@dataclass(frozen=True)
class Snapshot:
    """The engine's sums at one moment; two make a launch's share."""

    now: int
    reasons: npt.NDArray[np.int64]
    waits: npt.NDArray[np.int64]
    latency: npt.NDArray[np.int64]
    issued: npt.NDArray[np.int64]
    resident: int
    served: tuple[int, ...]
    dram: tuple[int, int]
    rows_opened: int

    @staticmethod
    def take(state: State) -> Snapshot:
        """Copy the sums."""
        machine = state.pool.machine[0]
        served = [
            int(t.counters[:, ACCESSES].sum() + (t.counters[:, BYPASSES].sum() if k else 0))
            for k, t in enumerate((state.l1, state.gl1, state.l2, state.llc))
        ]
        return Snapshot(
            int(machine["now"]),
            state.reasons.copy(),
            state.pool.waits.copy(),
            state.latency.copy(),
            state.issued.copy(),
            int(state.resident[0]),
            tuple(served),
            (int(machine["dram_reads"]), int(machine["dram_writes"])),
            int(machine["activates"]),
        )


def _shares(total: int, weights: dict[str, int]) -> dict[str, int]:
    """Split `total` by weights; the remainders go to the largest."""
    whole = sum(weights.values())
    if whole == 0:
        return {name: 0 for name in weights}
    parts = {name: total * w // whole for name, w in weights.items()}
    left = total - sum(parts.values())
    for name in sorted(weights, key=lambda n: (-(total * weights[n] % whole), n))[:left]:
        parts[name] += 1
    return parts


def _queues(before: Snapshot, after: Snapshot, gpu: Gpu) -> tuple[dict[str, int], int]:
    """Request-cycles that a launch's requests queued for each level, and those that the way to the
    L2 or memory and back would have taken without queues.

    What queues before a level that cannot take it queues for the one behind: as full as memory's
    queues were on average, so much of the waiting before it is memory's, and so at the L2.
    """
    assert gpu.l2_timing and gpu.dram_timing
    waits = after.waits - before.waits
    least = np.where(after.waits[:, 2] < NEVER, after.waits[:, 2], 0)
    unloaded = waits[:, 1] * least
    queued = np.maximum(0, waits[:, 0] - unloaded)
    request, l2, dram = (int(queued[k]) for k in (records.S_REQUEST, records.S_L2, records.S_BELOW))
    cycles = max(1, after.now - before.now)
    room = cycles * (gpu.llc or gpu.l2).num_channels * gpu.dram_timing.queue
    held_back, behind = min(dram, room), l2 + request
    dram += behind * held_back // room
    l2 -= l2 * held_back // room
    request -= request * held_back // room
    room = cycles * gpu.l2.num_slices * gpu.l2_timing.queue_in
    held_back = request * min(l2, room) // room
    l2, request = l2 + held_back, request - held_back
    queues = {"interconnect": request + int(queued[records.S_REPLY]), "l2": l2, "dram": dram}
    return queues, int(unloaded.sum())


def _where(before: Snapshot, after: Snapshot, gpu: Gpu, launch: int) -> dict[str, int]:
    """Reason -> cycles of one launch.

    Slots that wait for data are shared out by what the requests spend their time with. So are those
    whose access cannot leave the L1, because its MSHRs or the network are full: they are full
    because requests stay long. What would be full without queues, too, stays with them.
    """
    assert gpu.sm_timing
    spent = after.reasons - before.reasons
    queues, unloaded = _queues(before, after, gpu)
    latency = int((after.latency - before.latency)[:, 0].sum())
    slots = {name: int(spent[code]) for name, code in _DIRECT.items()}
    waiting = [(int(spent[R_MEMORY]), "latency", max(0, latency - sum(queues.values())))]
    if any(queues.values()):
        full = ("l1_reservation", "interconnect")
        waiting += [(slots.pop(name), name, unloaded) for name in full]
    for total, own, rest in waiting:
        weights = dict(queues)
        weights[own] = weights.get(own, 0) + rest
        for name, share in _shares(total, weights).items():
            slots[name] = slots.get(name, 0) + share
    # While the kernel is launched every SM is idle.
    num_slots = gpu.sm.count * gpu.sm_timing.num_schedulers
    slots["idle"] = max(0, slots["idle"] - launch * num_slots)
    cycles = _shares(after.now - before.now - launch, slots)
    cycles["launch"] = launch
    return {name: cycles.get(name, 0) for name in REASONS}


def _peaks(gpu: Gpu) -> dict[str, int]:
    """Bytes per 1000 core cycles that each level can move."""
    assert gpu.l1_timing and gpu.l2_timing and gpu.dram_timing
    units = gpu.sm.count * gpu.l1.units_per_sm
    peaks = {"l1": 1000 * units * gpu.l1_timing.num_banks * gpu.l1.sector_bytes}
    if gpu.gl1 is not None and gpu.gl1_timing is not None:
        arrays = -(-gpu.sm.count // gpu.gl1.sms_per_instance)
        rate = gpu.gl1_timing.port_bytes * gpu.gl1_timing.clock_hz
        peaks["gl1"] = 1000 * arrays * rate // gpu.clock_hz
    rate = gpu.l2_timing.port_bytes * gpu.l2_timing.clock_hz
    peaks["l2"] = 1000 * gpu.l2.num_slices * rate // gpu.clock_hz
    if gpu.llc is not None and gpu.llc_timing is not None:
        rate = gpu.llc_timing.port_bytes * gpu.llc_timing.clock_hz
        peaks["llc"] = 1000 * gpu.llc.num_slices * rate // gpu.clock_hz
    dram, channels = gpu.dram_timing, (gpu.llc or gpu.l2).num_channels
    rate = channels * dram.bus_bytes * dram.data_rate * dram.clock_hz
    peaks["dram"] = 1000 * rate // gpu.clock_hz
    return peaks


def passes_of(name: str, before: Snapshot, after: Snapshot, gpu: Gpu, state: State) -> PassTiming:
    """The timing of one launch."""
    assert gpu.sm_timing and gpu.dram_timing
    launch = min(gpu.sm_timing.launch_cycles, after.now - before.now)
    l1_bytes = state.l1.level[0]["sector_shift"]
    sectors = {
        "l1": 1 << int(l1_bytes),
        "gl1": gpu.gl1.sector_bytes if gpu.gl1 else 0,
        "l2": gpu.l2.sector_bytes,
        "llc": gpu.llc.sector_bytes if gpu.llc else 0,
    }
    latency = after.latency - before.latency
    peaks = _peaks(gpu)
    levels = {}
    for k, (level, size) in enumerate(sectors.items()):
        if level in peaks:
            levels[level] = LevelTiming(
                (after.served[k] - before.served[k]) * size,
                peaks[level],
                int(latency[k, 0]),
                int(latency[k, 1]),
            )
    bursts = sum(after.dram) - sum(before.dram)
    levels["dram"] = LevelTiming(
        bursts * gpu.dram_timing.atom_bytes, peaks["dram"], int(latency[4, 0]), int(latency[4, 1])
    )
    issued = after.issued - before.issued
    return PassTiming(
        name,
        1,
        after.now - before.now,
        launch,
        _where(before, after, gpu, launch),
        {kind: int(issued[k]) for k, kind in enumerate(KINDS[:5])},
        after.resident - before.resident,
        gpu.sm.count * (after.now - before.now - launch),
        gpu.sm.max_warps,
        levels,
        after.rows_opened - before.rows_opened,
    )


def dirty_sectors(tags: Tags, num_groups: int) -> npt.NDArray[np.int64]:
    """(groups,) modified sectors that a write-back level holds, by the group that wrote them."""
    dirty = np.zeros(num_groups, np.int64)
    if len(tags.lines) and tags.level[0]["on_hit"] == HIT_BACK:
        sectors = int(tags.level[0]["sectors_per_line"])
        owner = tags.owner.reshape(-1, sectors)
        for s in range(sectors):
            held = (tags.lines["modified"] >> s) & 1 == 1
            np.add.at(dirty, owner[held, s], 1)
    return dirty


def raw_counters(state: State, launches: Sequence[PassTiming]) -> dict[str, dict[str, int]]:
    """GPGPU-Sim's counters under its own names; those of stores with a leading "W_"."""
    machine = state.pool.machine[0]
    found: dict[str, dict[str, int]] = {}
    for name, tags in (("l1", state.l1), ("l2", state.l2)):
        found[name] = {outcome: int(tags.outcomes[0, k]) for k, outcome in enumerate(OUTCOMES)}
        found[name] |= {
            f"W_{outcome}": int(tags.outcomes[1, k]) for k, outcome in enumerate(OUTCOMES)
        }
    found["dram"] = {
        "reads": int(machine["dram_reads"]),
        "writes": int(machine["dram_writes"]),
        "row_hits": int(machine["row_hits"]),
        "activates": int(machine["activates"]),
        "precharges": int(machine["precharges"]),
    }
    below = state.latency[1:].sum(axis=0)
    found["sm"] = {
        "gpu_sim_cycle": sum(one.cycles for one in launches),
        "gpu_sim_insn": int(machine["instruction_threads"]),
        "gpgpu_n_tot_w_icount": sum(sum(one.warp_instructions.values()) for one in launches),
        "l1_bank_conflicts": int(machine["bank_conflicts"]),
        "averagemflatency_sum": int(below[0]),
        "averagemflatency_num": int(below[1]),
    }
    return found
