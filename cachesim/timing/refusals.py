"""What the timing model cannot run, refused in one line before it begins."""

from __future__ import annotations

from cachesim.config import Gpu
from cachesim.timing.records import (
    MAX_BANKS,
    MAX_DRAM_BANKS,
    MAX_MEMORY_QUEUE,
    MAX_SCHEDULERS,
    MAX_SMS,
    MAX_SUBSLICES,
    MAX_WARPS,
    MAX_WAYS,
)
from traces.errors import InputError


def check_timing(gpu: Gpu, fetch_path: str) -> None:
    """Refuse a GPU that the timing model cannot run.

    Raises:
        InputError: a table is missing, or a size is above the model's.
    """
    needed = ["sm_timing", "l1_timing", "icnt", "l2_timing", "dram_timing"]
    needed += ["gl1_timing"] if gpu.gl1 is not None else []
    needed += ["llc_timing"] if gpu.llc is not None else []
    if gpu.l1_texture is not None and fetch_path == "texture":
        needed.append("l1_texture_timing")
    missing = [name for name in needed if getattr(gpu, name) is None]
    if missing:
        raise InputError(f"{gpu.name}: timing needs the tables {', '.join(missing)}")
    assert gpu.sm_timing and gpu.l1_timing and gpu.dram_timing
    limits = (
        ("sm.count", gpu.sm.count, MAX_SMS),
        ("sm.max_warps", gpu.sm.max_warps, MAX_WARPS),
        ("sm_timing.num_schedulers", gpu.sm_timing.num_schedulers, MAX_SCHEDULERS),
        ("sm_timing.memory_queue", gpu.sm_timing.memory_queue, MAX_MEMORY_QUEUE),
        ("l1_timing.num_banks", gpu.l1_timing.num_banks, MAX_BANKS),
        ("l2.slices_per_channel", gpu.l2.slices_per_channel, MAX_SUBSLICES),
        ("dram_timing.num_banks", gpu.dram_timing.num_banks, MAX_DRAM_BANKS),
    )
    for field, value, most in limits:
        if value > most:
            raise InputError(f"{gpu.name}: {field} = {value}: timing allows up to {most}")
    if gpu.l1_timing.num_banks & (gpu.l1_timing.num_banks - 1):
        raise InputError(
            f"{gpu.name}: l1_timing.num_banks = {gpu.l1_timing.num_banks}: need a power of two"
        )
    for name in ("l1", "gl1", "l2", "llc"):
        level = getattr(gpu, name)
        if level is not None and level.replacement not in ("lru", "fifo"):
            raise InputError(
                f"{gpu.name}: {name}.replacement = {level.replacement!r}: timing allows lru, fifo"
            )
        timing = getattr(gpu, f"{name}_timing")
        if level is not None and level.ways > MAX_WAYS:
            raise InputError(
                f"{gpu.name}: {name}.ways = {level.ways}: timing allows up to {MAX_WAYS}"
            )
        if level is not None and timing.miss_queue < 2:
            raise InputError(
                f"{gpu.name}: {name}_timing.miss_queue = {timing.miss_queue}: timing needs 2 or "
                "more, as a read keeps one entry for a write-back"
            )
        if level is not None and timing.allocation != "on-miss":
            if level.write_policy == "write-back":
                raise InputError(
                    f"{gpu.name}: {name}_timing.allocation = {timing.allocation!r}: a write-back "
                    "cache must allocate on-miss"
                )
            if level.write_allocate in ("fetch-on-write", "lazy-fetch-on-read"):
                raise InputError(
                    f"{gpu.name}: {name}_timing.allocation = {timing.allocation!r}: "
                    f"{level.write_allocate} must allocate on-miss"
                )
    if gpu.l1.write_policy == "write-back":
        raise InputError(
            f"{gpu.name}: l1.write_policy = 'write-back': timing allows the policies that keep no "
            "dirty data in the L1"
        )
    if gpu.l1.write_allocate in ("write-allocate", "fetch-on-write"):
        raise InputError(
            f"{gpu.name}: l1.write_allocate = {gpu.l1.write_allocate!r}: timing allows none, "
            "lazy-fetch-on-read"
        )
    for name in ("l2", "llc"):
        level = getattr(gpu, name)
        if level is not None and level.write_policy != "write-back":
            raise InputError(
                f"{gpu.name}: {name}.write_policy = {level.write_policy!r}: timing allows "
                "write-back"
            )
    last = gpu.llc or gpu.l2
    if last.sector_bytes % gpu.dram_timing.atom_bytes:
        raise InputError(
            f"{gpu.name}: dram_timing.bus_bytes x burst_length = {gpu.dram_timing.atom_bytes} B "
            f"does not divide the last cache's sector of {last.sector_bytes} B"
        )
