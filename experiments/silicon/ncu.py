"""Nsight Compute: which counters are asked for, how it is called, and its raw CSV page."""

from __future__ import annotations

import csv
import math
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from traces.errors import InputError

#: Counters by what they tell; of several names the first that the GPU has is taken.
METRICS: dict[str, tuple[str, ...]] = {
    "cycles": ("gpc__cycles_elapsed.max", "sm__cycles_elapsed.max"),
    "sm_cycles": ("sm__cycles_elapsed.max",),
    "time_ns": ("gpu__time_duration.sum",),
    "warp_instructions": ("smsp__inst_executed.sum",),
    "occupancy_percent": ("sm__warps_active.avg.pct_of_peak_sustained_active",),
    "tex_requests": ("l1tex__t_requests_pipe_tex_mem_texture.sum",),
    "tex_sectors": ("l1tex__t_sectors_pipe_tex_mem_texture.sum",),
    "tex_hits": ("l1tex__t_sectors_pipe_tex_mem_texture_lookup_hit.sum",),
    "tex_misses": ("l1tex__t_sectors_pipe_tex_mem_texture_lookup_miss.sum",),
    "tex_sets": ("l1tex__t_set_accesses_pipe_tex_mem_texture.sum",),
    "load_requests": ("l1tex__t_requests_pipe_lsu_mem_global_op_ld.sum",),
    "load_sectors": ("l1tex__t_sectors_pipe_lsu_mem_global_op_ld.sum",),
    "load_hits": ("l1tex__t_sectors_pipe_lsu_mem_global_op_ld_lookup_hit.sum",),
    "load_misses": ("l1tex__t_sectors_pipe_lsu_mem_global_op_ld_lookup_miss.sum",),
    "surface_store_sectors": ("l1tex__t_sectors_pipe_tex_mem_surface_op_st.sum",),
    "store_sectors": ("l1tex__t_sectors_pipe_lsu_mem_global_op_st.sum",),
    "tex_wavefronts": ("l1tex__f_wavefronts.sum",),
    "tag_wavefronts": ("l1tex__t_output_wavefronts.sum",),
    "l2_reads": ("lts__t_sectors_srcunit_tex_op_read.sum",),
    "l2_read_hits": ("lts__t_sectors_srcunit_tex_op_read_lookup_hit.sum",),
    "l2_read_misses": ("lts__t_sectors_srcunit_tex_op_read_lookup_miss.sum",),
    "l2_writes": ("lts__t_sectors_srcunit_tex_op_write.sum",),
    "l2_requests": ("lts__t_requests_srcunit_tex.sum",),
    "l2_all": ("lts__t_sectors.sum",),
    "l2_fabric": ("lts__t_sectors_srcunit_ltcfabric.sum",),
    "dram_reads": ("dram__sectors_read.sum",),
    "dram_writes": ("dram__sectors_write.sum",),
    "dram_read_bytes": ("dram__bytes_read.sum",),
    "dram_write_bytes": ("dram__bytes_write.sum",),
}
#: What ncu says where only administrators may read the counters.
BLOCKED = "ERR_NVGPUCTRPERM"
_SCALES = {
    "": 1.0,
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "m": 1e-3,
    "K": 1e3,
    "M": 1e6,
    "G": 1e9,
    "T": 1e12,
}
_TIMES = {"second": "s", "s": "s"}


def parse_available(text: str) -> set[str]:
    """The counters' names in what `ncu --query-metrics` prints, without their suffix."""
    return {m[1] for m in re.finditer(r"^([a-z0-9_]+__[a-z0-9_]+)\b", text, re.MULTILINE)}


def choose_metrics(available: set[str]) -> list[str]:
    """The counters to ask for, of those that the GPU has; with none known, the first of each."""
    chosen = []
    for names in METRICS.values():
        known = [name for name in names if not available or name.split(".")[0] in available]
        chosen += known[:1]
    return list(dict.fromkeys(chosen))


def query_available(ncu: str) -> set[str]:
    """The counters that this GPU has; empty where ncu does not say."""
    try:
        done = subprocess.run(
            [ncu, "--query-metrics"], capture_output=True, text=True, timeout=120, check=False
        )
    except (OSError, subprocess.SubprocessError):
        return set()
    return parse_available(done.stdout) if done.returncode == 0 else set()


def refused_metrics(text: str, metrics: Sequence[str]) -> list[str]:
    """The counters that ncu's errors name."""
    errors = [line for line in text.splitlines() if "==ERROR==" in line]
    return [name for name in metrics if any(name in line for line in errors)]


def command(ncu: str, metrics: Sequence[str], log: Path, prefix: str) -> list[str]:
    """How ncu is called, up to the program that it runs.

    Clocks are left as they are; the caches are emptied before each kernel, so that what a kernel
    finds there does not depend on how often the profiler repeats it.
    """
    return [
        ncu,
        *("--csv", "--page", "raw", "--print-units", "base"),
        *("--clock-control", "none", "--cache-control", "all"),
        *("--target-processes", "all", "--force-overwrite"),
        *("--kernel-name", f"regex:^{prefix}__"),
        *("--metrics", ",".join(metrics)),
        *("--log-file", str(log)),
    ]


@dataclass(frozen=True)
class KernelCounters:
    """One profiled launch. values: by the counter's own name, in base units: ns for times."""

    kernel: str
    values: dict[str, float]


def is_raw_page(text: str) -> bool:
    """Whether a text holds a CSV page of ncu."""
    return _header_at(text.splitlines()) is not None


def _header_at(lines: Sequence[str]) -> int | None:
    for number, line in enumerate(lines):
        if line.replace('"', "").startswith("ID,") and "Kernel Name" in line:
            return number
    return None


def parse_raw_page(text: str, where: str) -> list[KernelCounters]:
    """The launches of `ncu --csv --page raw`; lines before its header are what else was printed.

    Raises:
        InputError: no such page, a page of another kind, or a row that does not fit.
    """
    lines = text.splitlines()
    start = _header_at(lines)
    if start is None:
        raise InputError(f"{where}: no Nsight Compute CSV: need what `ncu --csv --page raw` prints")
    table = list(csv.reader(StringIO("\n".join(lines[start:]))))
    header = table[0]
    if "Metric Name" in header:
        raise InputError(f"{where}: line {start + 1}: a details page: need `ncu --page raw`")
    if len(table) < 2:
        raise InputError(f"{where}: line {start + 1}: no units and no launches below the header")
    units, at = table[1], header.index("Kernel Name")
    if len(units) != len(header) or units[header.index("ID")].strip():
        raise InputError(f"{where}: line {start + 2}: need the row of units, an empty ID first")
    metrics = [k for k, name in enumerate(header) if "__" in name]
    if not metrics:
        raise InputError(f"{where}: line {start + 1}: no counters: none of the columns has a '__'")
    found = []
    for number, cells in enumerate(table[2:], start=start + 3):
        if not cells or cells[0].startswith("=="):
            continue
        if len(cells) != len(header):
            raise InputError(f"{where}: line {number}: {len(cells)} cells: need {len(header)}")
        values = {}
        for k in metrics:
            value = _number(cells[k], units[k], f"{where}: line {number}: {header[k]}")
            if value is not None:
                values[header[k]] = value
        found.append(KernelCounters(cells[at].partition("(")[0].strip(), values))
    if not found:
        raise InputError(f"{where}: no launches below the header in line {start + 1}")
    return found


def _number(text: str, unit: str, where: str) -> float | None:
    """A cell in base units; None where the profiler has no value or the cell is no number."""
    text = text.strip().replace(",", "")
    if (
        not text
        or text.lower() in ("n/a", "nan", "inf", "no", "yes")
        or re.match(r"[A-Za-z(]", text)
    ):
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise InputError(f"{where}: {text!r}: no number") from error
    return value * _scale(unit.strip()) if math.isfinite(value) else None


def _scale(unit: str) -> float:
    """What a unit is in ns, bytes or plain counts. The profiler writes 'us', 'usecond', 'Kbyte'…"""
    for word in ("second", "s"):
        if unit.endswith(word) and unit[: -len(word)] in ("", "n", "u", "µ", "m"):
            return _SCALES[unit[: -len(word)]] * 1e9
    match = re.fullmatch(
        r"([KMGT])(byte|sector|inst|cycle|request|warp|register|block|thread)s?(/.*)?", unit
    )
    return _SCALES[match[1]] if match else 1.0


def pick(values: dict[str, float], what: str) -> float | None:
    """What a launch's counters say of one thing of `METRICS`; None where they do not."""
    for name in METRICS[what]:
        if name in values:
            return values[name]
    return None
