"""The options of GPGPU-Sim that a preset is made of, with their defaults, and what becomes of the
others.

Facts sheet section 3.3 has the meanings; the defaults are those of `reg_options` in gpu-sim.cc,
icnt_wrapper.cc and trace_driven.cc.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from cachesim.gpgpusim.syntax import Setting
from cachesim.presets.files import Sourced
from traces.errors import InputError

#: -specialized_unit_1 and on.
MAX_SPECIAL_UNITS = 8

#: Option -> GPGPU-Sim's default. None: a preset cannot do without.
DEFAULTS: dict[str, str | None] = {
    # The chip
    "-gpgpu_n_clusters": "10",
    "-gpgpu_n_cores_per_cluster": "3",
    "-gpgpu_n_mem": "8",
    "-gpgpu_n_sub_partition_per_mchannel": "1",
    "-gpgpu_clock_domains": "500.0:2000.0:2000.0:2000.0",
    "-gpgpu_kernel_launch_latency": "0",
    "-gpgpu_TB_launch_latency": "0",
    # The SM
    "-gpgpu_shader_core_pipeline": "1024:32",
    "-gpgpu_shader_cta": "32",
    "-gpgpu_shader_registers": "8192",
    "-gpgpu_shmem_size": "16384",
    "-gpgpu_num_sched_per_core": "1",
    "-gpgpu_scheduler": "gto",
    "-gpgpu_max_insn_issue_per_warp": "2",
    "-gpgpu_dual_issue_diff_exec_units": "1",
    "-gpgpu_num_sp_units": "1",
    "-gpgpu_num_int_units": "0",
    "-gpgpu_num_sfu_units": "1",
    "-gpgpu_pipeline_widths": "1,1,1,1,1,1,1,1,1,1,1,1,1",
    "-gpgpu_enable_specialized_operand_collector": "1",
    "-gpgpu_num_reg_banks": "8",
    "-gpgpu_operand_collector_num_units_gen": "0",
    "-gpgpu_operand_collector_num_units_mem": "2",
    "-trace_opcode_latency_initiation_int": "4,1",
    "-trace_opcode_latency_initiation_sp": "4,1",
    "-trace_opcode_latency_initiation_sfu": "4,1",
    # The L1s
    "-gpgpu_cache:dl1": None,
    "-gpgpu_tex_cache:l1": "8:128:5,L:R:m:N,F:128:4,128:2",
    "-gpgpu_gmem_skip_L1D": "0",
    "-gpgpu_l1_banks": "1",
    "-gpgpu_l1_banks_byte_interleaving": "32",
    "-gpgpu_l1_latency": "1",
    "-gpgpu_l1_cache_write_ratio": "0",
    "-gpgpu_adaptive_cache_config": "0",
    "-gpgpu_shmem_option": "0",
    "-gpgpu_unified_l1d_size": "0",
    # The interconnect
    "-network_mode": "1",
    "-inter_config_file": "mesh",
    "-icnt_flit_size": "32",
    "-icnt_in_buffer_limit": "64",
    "-icnt_out_buffer_limit": "64",
    "-gpgpu_n_cluster_ejection_buffer_size": "8",
    "-gpgpu_n_ldst_response_buffer_size": "2",
    # The L2
    "-gpgpu_cache:dl2": "S:32:128:24,L:B:m:L:P,A:192:4,32:0,32",
    "-gpgpu_memory_partition_indexing": "0",
    "-gpgpu_dram_partition_queues": "8:8:8:8",
    "-gpgpu_l2_rop_latency": "85",
    # The memory
    "-gpgpu_mem_addr_mapping": None,
    "-gpgpu_dram_buswidth": "4",
    "-gpgpu_dram_burst_length": "4",
    "-gpgpu_n_mem_per_ctrlr": "1",
    "-dram_data_command_freq_ratio": "2",
    "-gpgpu_dram_timing_opt": "4:2:8:12:21:13:34:9:4:5:13:1:0:0",
    "-dram_latency": "30",
    "-gpgpu_dram_scheduler": "1",
    "-gpgpu_frfcfs_dram_sched_queue_size": "0",
    "-gpgpu_dram_return_queue_size": "0",
    "-dram_dual_bus_interface": "0",
    **{
        f"-trace_opcode_latency_initiation_spec_op_{number}": "4,4"
        for number in range(1, MAX_SPECIAL_UNITS + 1)
    },
}

#: Option -> default, the values under which the timing model does the same, and what it does.
FIXED: dict[str, tuple[str, str, str]] = {
    "-gpgpu_simd_model": ("1", "1", "divergent lanes are masked"),
    "-gpgpu_coalesce_arch": ("13", r"[4-9]\d|\d{3}", "loads are coalesced into sectors of 32 B"),
    "-gpgpu_shmem_warp_parts": ("2", "1", "a warp is coalesced whole"),
    "-gpgpu_mem_unit_ports": ("1", "1", "the load/store unit has one port"),
    "-gpgpu_sub_core_model": ("0", "1", "every scheduler has its own units"),
    "-gpgpu_perfect_mem": ("0", "0", "every access goes through the caches"),
    "-gpgpu_perfect_inst_const_cache": ("0", "1", "instructions and constants always hit"),
    "-gpgpu_l1_banks_hashing_function": ("0", "0", "banks are interleaved linearly"),
    "-gpgpu_flush_l1_cache": ("0", "1", "the L1s start empty at each pass"),
    "-gpgpu_flush_l2_cache": ("0", "0", "the L2 is kept between passes"),
    "-gpgpu_perf_sim_memcpy": ("1", "0", "the L2 starts empty: copies from the host fill nothing"),
    "-gpgpu_cache:dl2_texture_only": ("1", "0", "the L2 serves every access"),
    "-l2_ideal": ("0", "0", "the L2 misses as its geometry says"),
    "-icnt_subnets": ("2", "2", "requests and replies have a network each"),
    "-icnt_grant_cycles": ("1", "1", "a port is granted for one packet"),
    "-gpgpu_simple_dram_model": ("0", "0", "the memory has banks and rows"),
    "-dram_bnk_indexing_policy": ("0", "0", "a bank's number is its address bits"),
    "-dram_bnkgrp_indexing_policy": ("0", "1", "consecutive banks lie in different groups"),
    "-dram_seperate_write_queue_enable": ("0", "0", "reads and writes share a queue"),
    "-dram_elimnate_rw_turnaround": ("0", "0", "turning the bus round costs cycles"),
    "-gpgpu_lrc_enabled": ("0", "0", "loads are not merged between SMs"),
    "-gpgpu_n_chiplet_partition": ("1", "1", "the chip is one piece"),
}

#: Why an option has no part in a preset; the first pattern that its name begins with.
_IGNORED = {
    "ptx_opcode": "trace.config's latencies are taken instead, where there are any",
    "specialized_unit|trace_opcode": "no instruction of ours uses that unit",
    r"gpgpu_(num_(dp|tensor)|tensor)": "no instruction of ours uses that unit",
    r"gpgpu_cache:dl1Pref|gpgpu_shmem_size_?(Pref|Def)": "kernels ask for no other split",
    r"gpgpu_(smem|shmem|sharedmem)": "no shared memory is accessed",
    r"gpgpu_(cache:il1|const_cache|inst_)": "instructions and constants always hit",
    r"gpgpu_(reg_|opndcoll|operand)": "operands are read in two steps a cycle",
    r"gpgpu_(compute_cap|occupancy|stack|heap|runtime_(sync|pend)|ignore_res|max_conc|cdp|"
    r"registers_per|num_cta_bar|concurrent)": "limits of software, not of the memory system",
    r"gpgpu_ptx|save_|keep|ptx_": "the functional simulator",
    r"power|accelwattch|gpuwattch|dvfs|steady|hw_perf|aggregate|n_regfile|gpgpu_clock_gated": (
        "the power model"
    ),
    r"visualizer|trace_|enable_ptx|gpgpu_(memlat|runtime_stat|cflog|warp_?(distro|issue))|"
    "liveness|icnt_verbose": "statistics and output",
    r"gpgpu_max_|gpgpu_deadlock": "limits of a run",
    "gpgpu_mem_address_mask|gpgpu_mem_addr_test": "-gpgpu_mem_addr_mapping decides",
    "icnt_arbiter": "inputs take turns as the model has them",
}


@dataclass(frozen=True)
class Remark:
    """An option that has no counterpart in the preset, and why."""

    setting: Setting
    reason: str


@dataclass
class Options:
    """Settings by option, with GPGPU-Sim's defaults behind them; notes which ones were read."""

    settings: Mapping[str, Setting]
    where: str
    _read: set[str] = field(default_factory=set)

    def setting(self, option: str) -> Setting:
        """The option as given, or as GPGPU-Sim has it where it is not.

        Raises:
            InputError: not given, and a preset cannot do without.
        """
        self._read.add(option)
        if option in self.settings:
            return self.settings[option]
        default = DEFAULTS[option]
        if default is None:
            raise InputError(f"{self.where}: missing {option}; a preset cannot do without")
        return Setting(option, default)

    def given(self, option: str) -> bool:
        return option in self.settings

    def number(self, option: str, least: int = 0, most: int = 1 << 40) -> int:
        """A whole number, written as in C: decimal, 0x hexadecimal, 0 octal."""
        setting = self.setting(option)
        text = setting.text
        if not re.fullmatch(r"0[xX][0-9a-fA-F]{1,15}|0[0-7]{0,15}|[1-9]\d{0,15}", text):
            raise setting.refuse("allowed are whole numbers")
        octal = len(text) > 1 and text.isdecimal() and text[0] == "0"
        value = int(text, 8 if octal else 0)
        if not least <= value <= most:
            raise setting.refuse(f"allowed are whole numbers from {least} to {most}")
        return value

    def flag(self, option: str) -> bool:
        """A switch; given without a value it is on."""
        setting = self.setting(option)
        if setting.text not in ("", "0", "1"):
            raise setting.refuse("allowed are 0, 1")
        return setting.text != "0"

    def choice(self, option: str, choices: Mapping[str, str]) -> str:
        """What one of the values in `choices` stands for."""
        setting = self.setting(option)
        if setting.text not in choices:
            raise setting.refuse(f"allowed are {', '.join(choices)}")
        return choices[setting.text]

    def numbers(self, option: str, separator: str, least: int, most: int = 99) -> list[int]:
        """`least` to `most` whole numbers in a row."""
        setting = self.setting(option)
        parts = [part.strip() for part in setting.text.split(separator)]
        if not least <= len(parts) <= most or not all(
            part.isdecimal() and len(part) < 10 for part in parts
        ):
            raise setting.refuse(f"allowed are {least} whole numbers with {separator!r} between")
        return [int(part) for part in parts]

    def clocks_hz(self) -> list[int]:
        """Hertz of core, interconnect, L2 and memory."""
        setting = self.setting("-gpgpu_clock_domains")
        parts = setting.text.split(":")
        if len(parts) != 4 or not all(
            re.fullmatch(r"\d{1,6}(\.\d{0,9})?", part) and Fraction(part) > 0 for part in parts
        ):
            raise setting.refuse("allowed is <core>:<icnt>:<L2>:<DRAM> in MHz")
        return [round(Fraction(part) * 10**6) for part in parts]

    def source(self, option: str) -> str:
        """Where the value of an option that was read comes from: "SM6_TITANX -gpgpu_l1_latency"."""
        setting = self.setting(option)
        if setting.file is None:
            return f"GPGPU-Sim's default of {option}"
        return f"{label(setting)} {option}"

    def sourced(self, value: Any, option: str, remark: str = "") -> Sourced:
        """A value that stands in the files as it is."""
        return Sourced(value, self.source(option) + remark, "S")

    def ignored(self) -> list[Remark]:
        """The settings that nothing was made of, in the order of the files."""
        return [
            Remark(setting, _why_ignored(option))
            for option, setting in self.settings.items()
            if option not in self._read and option not in FIXED
        ]

    def differing(self) -> list[Remark]:
        """The settings, defaults too, under which GPGPU-Sim does what the timing model does not."""
        remarks = []
        for option, (default, same, model) in FIXED.items():
            setting = self.settings.get(option, Setting(option, default))
            if not re.fullmatch(same, setting.text or "1"):
                remarks.append(Remark(setting, model))
        return remarks


def label(setting: Setting) -> str:
    """What sources call a file: its folder where the file has the usual name, else its own name."""
    file = setting.file
    if file is None:
        return "GPGPU-Sim"
    usual = file.name in ("gpgpusim.config", "trace.config") or file.suffix == ".icnt"
    return (file.resolve().parent.name if usual else "") or file.name


def _why_ignored(option: str) -> str:
    if option in DEFAULTS and "_spec_op_" not in option:
        return "other options leave it nothing to decide"
    for pattern, reason in _IGNORED.items():
        if re.match(f"-(?:{pattern})", option):
            return reason
    near = difflib.get_close_matches(option, [*DEFAULTS, *FIXED], n=1, cutoff=0.85)
    return "unknown to this reader" + (f"; did you mean {near[0]}?" if near else "")
