"""The table `dram_timing` of a preset: one memory channel and its controller."""

from __future__ import annotations

from cachesim.gpgpusim.geometry import address_map
from cachesim.gpgpusim.options import Options
from cachesim.gpgpusim.syntax import Setting
from cachesim.presets.files import Sourced
from cachesim.timing_config import MAX_ENTRIES

_TIMING = "-gpgpu_dram_timing_opt"
#: The numbers of -gpgpu_dram_timing_opt: key -> field, in the order of the form without keys.
_KEYS = {
    "nbk": "num_banks",
    "CCD": "ccd",
    "RRD": "rrd",
    "RCD": "rcd",
    "RAS": "ras",
    "RP": "rp",
    "RC": "rc",
    "CL": "cl",
    "WL": "wl",
    "CDLR": "cdlr",
    "WR": "wr",
    "nbkgrp": "num_bank_groups",
    "CCDL": "ccdl",
    "RTPL": "rtpl",
}
#: What the form with keys may leave out.
_KEY_DEFAULTS = {"num_bank_groups": 1, "ccdl": 0, "rtpl": 0}


def dram_timing(options: Options) -> dict[str, Sourced]:
    """The fields of `dram_timing`.

    Raises:
        InputError: an option's value is wrong, or no preset can express it.
    """
    width, chips = "-gpgpu_dram_buswidth", "-gpgpu_n_mem_per_ctrlr"
    burst, ratio = "-gpgpu_dram_burst_length", "-dram_data_command_freq_ratio"
    latency, dual = "-dram_latency", "-dram_dual_bus_interface"
    mapping, clocks = "-gpgpu_mem_addr_mapping", "-gpgpu_clock_domains"
    first_bit, letters = address_map(options)
    timing = _timing_numbers(options.setting(_TIMING))
    banks = 1 << letters.count("B")
    if banks != timing["num_banks"]:
        raise options.setting(_TIMING).refuse(
            f"{timing['num_banks']} banks; {mapping} has letters B for {banks}"
        )
    fields = {
        "clock_hz": options.sourced(
            options.clocks_hz()[3], clocks, f" {options.setting(clocks).text}"
        ),
        "bus_bytes": options.sourced(
            options.number(width, 1, 1024) * options.number(chips, 1, 64),
            width,
            f" x {chips} {options.number(chips)}",
        ),
        "burst_length": options.sourced(options.number(burst, 1, 1024), burst),
        "data_rate": options.sourced(options.number(ratio, 1, 64), ratio),
        **{
            field: options.sourced(timing[field], _TIMING, f" {key}={timing[field]}")
            for key, field in _KEYS.items()
        },
        "fixed_latency_cycles": options.sourced(options.number(latency, 0, 4096), latency),
        "scheduler": options.sourced(
            options.choice("-gpgpu_dram_scheduler", {"0": "fifo", "1": "fr-fcfs"}),
            "-gpgpu_dram_scheduler",
        ),
        "queue": _queue(options, "-gpgpu_frfcfs_dram_sched_queue_size"),
        "return_queue": _queue(options, "-gpgpu_dram_return_queue_size"),
        "command_bus": options.sourced(
            "dual" if options.flag(dual) else "bank-order",
            dual,
            "" if options.flag(dual) else ": dram.cc tries the banks in turn, a row command first",
        ),
        "address_map": options.sourced(f"dramid@{first_bit};{letters}", mapping),
    }
    return {f"dram_timing.{field}": entry for field, entry in fields.items()}


def _timing_numbers(setting: Setting) -> dict[str, int]:
    """Field -> value from either form: `nbk=16:CCD=2:…`, or the numbers alone."""
    parts = [part.strip() for part in setting.text.split(":") if part.strip()]
    values = dict(_KEY_DEFAULTS)
    if not any("=" in part for part in parts):
        if len(parts) != len(_KEYS):
            raise setting.refuse(f"{len(parts)} numbers; allowed are {':'.join(_KEYS)}")
        parts = [f"{key}={part}" for key, part in zip(_KEYS, parts, strict=True)]
    for part in parts:
        key, _, text = (word.strip() for word in part.partition("="))
        if key not in _KEYS:
            raise setting.refuse(f"key {key!r}; allowed are {', '.join(_KEYS)}")
        if not (text.isdecimal() and len(text) < 7):
            raise setting.refuse(f"{key} {text!r}; allowed are whole numbers")
        values[_KEYS[key]] = int(text)
    for key, field in _KEYS.items():
        if field not in values:
            raise setting.refuse(f"missing {key}; allowed are {', '.join(_KEYS)}")
    if values["num_bank_groups"] < 1 or values["num_banks"] % values["num_bank_groups"]:
        raise setting.refuse(
            f"nbkgrp {values['num_bank_groups']}; allowed are divisors of nbk {values['num_banks']}"
        )
    return {field: values[field] for field in _KEYS.values()}


def _queue(options: Options, option: str) -> Sourced:
    """Entries of a queue, of which 0 means no limit."""
    entries = options.number(option, 0, MAX_ENTRIES)
    if entries:
        return options.sourced(entries, option)
    return options.sourced(MAX_ENTRIES, option, " 0, without limit: as many as the model takes")
