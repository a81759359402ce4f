"""The timing model's part of a preset: one table after the other, the caches' here."""

from __future__ import annotations

from cachesim.gpgpusim.dram import dram_timing
from cachesim.gpgpusim.geometry import (
    L1_STRING,
    L2_STRING,
    TEXTURE_STRING,
    data_cache,
    texture_cache,
)
from cachesim.gpgpusim.network import icnt
from cachesim.gpgpusim.options import Options
from cachesim.gpgpusim.sm import sm_timing
from cachesim.presets.files import Sourced

Fields = dict[str, Sourced]


def timing(options: Options) -> Fields:
    """The fields of the timing tables.

    Raises:
        InputError: an option's value is wrong, or no preset can express it.
    """
    return {
        **sm_timing(options),
        **_l1_timing(options),
        **_l1_texture_timing(options),
        **icnt(options),
        **_l2_timing(options),
        **dram_timing(options),
    }


def _l1_timing(options: Options) -> Fields:
    cache = data_cache(options, L1_STRING)
    latency, banks = "-gpgpu_l1_latency", "-gpgpu_l1_banks"
    interleaving, dirty = "-gpgpu_l1_banks_byte_interleaving", "-gpgpu_l1_cache_write_ratio"
    cycles = options.number(latency, 1, 4096)
    allocation = options.sourced(cache.allocation, L1_STRING, f": {cache.letters['allocation']}")
    if cache.allocation == "streaming" and options.flag("-gpgpu_adaptive_cache_config"):
        # Facts sheet section 3.5, adaptive L1.
        allocation = Sourced(
            "on-miss",
            f"{options.source(L1_STRING)}: s, which the adaptive split turns into m where no "
            "shared memory is in use",
            "D",
        )
    fields = {
        "latency_cycles": options.sourced(cycles, latency),
        "texture_latency_cycles": options.sourced(
            cycles, latency, ": textures that enter this L1 wait as loads do"
        ),
        "num_banks": options.sourced(options.number(banks, 1, 64), banks),
        "bank_bytes": options.sourced(options.number(interleaving, 1, 4096), interleaving),
        "lines_per_cycle": Sourced(0, "GPGPU-Sim has no limit besides the banks", "S"),
        "bytes_per_cycle": Sourced(0, "GPGPU-Sim has no limit besides the banks", "S"),
        "num_mshrs": options.sourced(cache.entries, L1_STRING),
        "mshr_merge": options.sourced(cache.merge, L1_STRING),
        "miss_queue": options.sourced(cache.miss_queue, L1_STRING),
        "allocation": allocation,
        "fill_bytes_per_cycle": options.sourced(
            cache.port_bytes, L1_STRING, ": the port, its last number"
        ),
        "dirty_limit_percent": options.sourced(options.number(dirty, 0, 100), dirty),
    }
    return {f"l1_timing.{field}": entry for field, entry in fields.items()}


def _l1_texture_timing(options: Options) -> Fields:
    cache = texture_cache(options)
    if cache is None:
        return {}
    entries = {
        "fragment_fifo": cache.entries,
        "request_fifo": cache.merge,
        "reorder_buffer": cache.miss_queue,
        "result_fifo": cache.result_fifo,
    }
    return {
        f"l1_texture_timing.{field}": options.sourced(value, TEXTURE_STRING)
        for field, value in entries.items()
    }


def _l2_timing(options: Options) -> Fields:
    cache = data_cache(options, L2_STRING)
    queues, rop = "-gpgpu_dram_partition_queues", "-gpgpu_l2_rop_latency"
    depths = options.numbers(queues, ":", 4, 4)
    if min(depths) < 1:
        raise options.setting(queues).refuse("allowed are whole numbers from 1")
    named = zip(
        ("queue_in", "queue_down", "queue_fill", "queue_out"),
        depths,
        ("interconnect to L2", "L2 to DRAM", "DRAM to L2", "L2 to interconnect"),
        strict=True,
    )
    clocks = "-gpgpu_clock_domains"
    fields = {
        "clock_hz": options.sourced(
            options.clocks_hz()[2], clocks, f" {options.setting(clocks).text}"
        ),
        "latency_cycles": options.sourced(options.number(rop, 0, 4096), rop),
        "texture_latency_cycles": Sourced(
            0, "l2cache.cc push: requests of the texture cache do not wait in the ROP queue", "S"
        ),
        "port_bytes": options.sourced(cache.port_bytes, L2_STRING, ": the port, its last number"),
        "num_mshrs": options.sourced(cache.entries, L2_STRING),
        "mshr_merge": options.sourced(cache.merge, L2_STRING),
        "miss_queue": options.sourced(cache.miss_queue, L2_STRING),
        "allocation": options.sourced(
            cache.allocation, L2_STRING, f": {cache.letters['allocation']}"
        ),
        **{field: options.sourced(depth, queues, f", {way}") for field, depth, way in named},
        "dirty_limit_percent": Sourced(0, "GPGPU-Sim spares dirty lines in the L1 alone", "S"),
    }
    return {f"l2_timing.{field}": entry for field, entry in fields.items()}
