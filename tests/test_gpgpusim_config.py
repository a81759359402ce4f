"""GPGPU-Sim's option files become presets: syntax, cache strings, refusals, and the shipped two."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cachesim import presets
from cachesim.gpgpusim import Imported, group_remarks, import_config, leading_comments
from cachesim.gpgpusim.cache_string import parse_cache_string
from cachesim.gpgpusim.options import DEFAULTS, FIXED
from cachesim.gpgpusim.syntax import Setting, read_network_file, read_option_files
from experiments.cli import run_command
from traces.errors import InputError

CONFIGS = Path(__file__).resolve().parents[2] / "shared" / "oracles" / "accel-sim" / "configs"
SHIPPED = {"titan-x-pascal-gpgpusim": "SM6_TITANX", "rtx-2060-gpgpusim": "SM75_RTX2060"}
KIB = 1 << 10

#: A machine of our own, whose numbers all differ where a mix-up could hide.
SMALL = """
# A small machine
-gpgpu_n_clusters 3
-gpgpu_n_cores_per_cluster 2
-gpgpu_n_mem 4
-gpgpu_n_sub_partition_per_mchannel 2
-gpgpu_clock_domains 1000:1000:900.5:2000.25
-gpgpu_kernel_launch_latency 700
-gpgpu_TB_launch_latency 30
-gpgpu_shader_core_pipeline 512:32
-gpgpu_shader_cta 8
-gpgpu_shader_registers 16384
-gpgpu_shmem_size 49152
-gpgpu_num_sched_per_core 2
-gpgpu_scheduler lrr
-gpgpu_max_insn_issue_per_warp 1
-gpgpu_dual_issue_diff_exec_units 0
-gpgpu_num_sp_units 2
-gpgpu_num_int_units 2
-gpgpu_num_sfu_units 1
-gpgpu_pipeline_widths 2,0,2,2,4,2,0,2,2,2,4
-gpgpu_enable_specialized_operand_collector 0
-gpgpu_operand_collector_num_units_gen 6
-gpgpu_num_reg_banks 12
-gpgpu_cache:dl1 S:8:128:16,F:E:f:N:X,A:64:4,12:0,64
-gpgpu_tex_cache:l1 N:4:64:8,L:R:m:N:L,F:32:6,24:3
-gpgpu_gmem_skip_L1D 1
-gpgpu_l1_banks 4
-gpgpu_l1_banks_byte_interleaving 64
-gpgpu_l1_latency 25
-gpgpu_l1_cache_write_ratio 40
-network_mode 2
-icnt_flit_size 80
-icnt_in_buffer_limit 17
-icnt_out_buffer_limit 19
-gpgpu_n_cluster_ejection_buffer_size 13
-gpgpu_n_ldst_response_buffer_size 3
-gpgpu_cache:dl2 S:32:128:8,L:B:m:F:H,A:96:5,7:0
-gpgpu_memory_partition_indexing 1
-gpgpu_dram_partition_queues 5:6:7:9
-gpgpu_l2_rop_latency 111
-gpgpu_mem_addr_mapping "dramid@9;00000000.00000000.00000000.00000000|
                         00000RRR.RRRRRRRR.RRRBBCCC.CCCSSSSS"
-gpgpu_dram_buswidth 4
-gpgpu_n_mem_per_ctrlr 2
-gpgpu_dram_burst_length 4
-dram_data_command_freq_ratio 2
-gpgpu_dram_timing_opt "nbk=4:CCD=2:RRD=3:RCD=12:RAS=28:RP=11:RC=40: # a comment in quotes
                        CL=13:WL=5:CDLR=6:WR=10:nbkgrp=2:CCDL=4:RTPL=1"
-dram_latency 55
-gpgpu_dram_scheduler 0
-gpgpu_frfcfs_dram_sched_queue_size 21
-gpgpu_dram_return_queue_size 0
-dram_dual_bus_interface 1
"""
NOTED = """
-power_simulation_enabled 0
-gpgpu_cache:il1 N:8:128:4,L:R:m:N:L,S:2:48,4
-gpgpu_perfect_mem 1
"""
TRACE = """
-trace_opcode_latency_initiation_int 6,2
-trace_opcode_latency_initiation_sp 5,3
-trace_opcode_latency_initiation_sfu 18,4
-specialized_unit_2 1,2,9,2,2,BRA
-trace_opcode_latency_initiation_spec_op_2 9,7
"""
EXPECTED = {
    "name": "small",
    "clock_hz": 1_000_000_000,
    "sm.count": 6,
    "sm.max_warps": 16,
    "sm.max_ctas": 8,
    "sm.warp_size": 32,
    "sm.registers": 16384,
    "sm.shared": 48 * KIB,
    "l1.capacity": 16 * KIB,
    "l1.line_bytes": 128,
    "l1.sector_bytes": 32,
    "l1.ways": 16,
    "l1.replacement": "fifo",
    "l1.write_policy": "write-evict",
    "l1.write_allocate": "none",
    "l1.set_hash": "xor",
    "l1.bypass_loads": True,
    "l1_texture.capacity": 2 * KIB,
    "l1_texture.sector_bytes": 64,
    "l1_texture.write_policy": "read-only",
    "l2.capacity": 256 * KIB,
    "l2.ways": 8,
    "l2.set_hash": "fermi",
    "l2.write_policy": "write-back",
    "l2.write_allocate": "fetch-on-write",
    "l2.num_channels": 4,
    "l2.slices_per_channel": 2,
    "l2.channel_interleave": 512,
    "l2.partition_hash": "xor",
    "dram.sector_bytes": 32,
    "sm_timing.num_schedulers": 2,
    "sm_timing.scheduler": "lrr",
    "sm_timing.issue_per_warp": 1,
    "sm_timing.dual_issue_different_units": False,
    "sm_timing.int_latency_cycles": 6,
    "sm_timing.int_initiation_cycles": 2,
    "sm_timing.fp32_latency_cycles": 5,
    "sm_timing.fp32_initiation_cycles": 3,
    "sm_timing.sfu_latency_cycles": 18,
    "sm_timing.sfu_initiation_cycles": 8,  # two schedulers on one unit
    "sm_timing.control_latency_cycles": 9,
    "sm_timing.control_initiation_cycles": 7,
    "sm_timing.int_on_fp32": False,
    "sm_timing.collector_units": 3,
    "sm_timing.register_banks": 6,
    "sm_timing.memory_queue": 2 + 3 + 1,
    "sm_timing.launch_cycles": 700,
    "sm_timing.cta_launch_cycles": 30,
    "l1_timing.latency_cycles": 25,
    "l1_timing.texture_latency_cycles": 25,
    "l1_timing.num_banks": 4,
    "l1_timing.bank_bytes": 64,
    "l1_timing.num_mshrs": 64,
    "l1_timing.mshr_merge": 4,
    "l1_timing.miss_queue": 12,
    "l1_timing.allocation": "on-fill",
    "l1_timing.fill_bytes_per_cycle": 64,
    "l1_timing.dirty_limit_percent": 40,
    "l1_texture_timing.fragment_fifo": 32,
    "l1_texture_timing.request_fifo": 6,
    "l1_texture_timing.reorder_buffer": 24,
    "l1_texture_timing.result_fifo": 3,
    "icnt.queueing": "input-fifo",
    "icnt.router_steps": 0,
    "icnt.request_latency_cycles": 0,
    "icnt.reply_latency_cycles": 0,
    "icnt.flit_bytes": 80,
    "icnt.header_bytes": 8,
    "icnt.input_packets": 17,
    "icnt.output_packets": 19,
    "icnt.ejection_packets": 13,
    "icnt.response_packets": 3,
    "l2_timing.clock_hz": 900_500_000,
    "l2_timing.latency_cycles": 111,
    "l2_timing.texture_latency_cycles": 0,
    "l2_timing.port_bytes": 128,  # no port in the string: the line
    "l2_timing.num_mshrs": 96,
    "l2_timing.mshr_merge": 5,
    "l2_timing.miss_queue": 7,
    "l2_timing.allocation": "on-miss",
    "l2_timing.queue_in": 5,
    "l2_timing.queue_down": 6,
    "l2_timing.queue_fill": 7,
    "l2_timing.queue_out": 9,
    "dram_timing.clock_hz": 2_000_250_000,
    "dram_timing.bus_bytes": 8,
    "dram_timing.burst_length": 4,
    "dram_timing.data_rate": 2,
    "dram_timing.num_banks": 4,
    "dram_timing.num_bank_groups": 2,
    "dram_timing.ccd": 2,
    "dram_timing.rrd": 3,
    "dram_timing.rcd": 12,
    "dram_timing.ras": 28,
    "dram_timing.rp": 11,
    "dram_timing.rc": 40,
    "dram_timing.cl": 13,
    "dram_timing.wl": 5,
    "dram_timing.cdlr": 6,
    "dram_timing.wr": 10,
    "dram_timing.ccdl": 4,
    "dram_timing.rtpl": 1,
    "dram_timing.fixed_latency_cycles": 55,
    "dram_timing.scheduler": "fifo",
    "dram_timing.queue": 21,
    "dram_timing.return_queue": 1 << 16,  # 0: without limit
    "dram_timing.command_bus": "dual",
}


def write(folder: Path, text: str, name: str = "gpgpusim.config") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def small(folder: Path, more: str = "", without: str = "") -> Imported:
    """The small machine with options put behind it, and one taken out."""
    kept = re.sub(rf'{without} ("[^"]*"|.*)\n', "", SMALL) if without else SMALL
    path = write(folder / "TINY", f"{kept}\n{more}")
    return import_config([path], "small")


def value(imported: Imported, field: str) -> object:
    return imported.fields[field].value


# ---- what becomes of each option


def test_every_option_reaches_its_field(tmp_path: Path) -> None:
    config = write(tmp_path, SMALL)
    trace = write(tmp_path, TRACE, "trace.config")
    imported = import_config([config, trace], "small")
    found = {field: value(imported, field) for field in EXPECTED}
    assert found == EXPECTED


def test_every_field_but_the_constants_of_the_simulator_hangs_on_an_option(tmp_path: Path) -> None:
    """A field that EXPECTED does not name is the same for every config."""
    imported = import_config([write(tmp_path, SMALL)], "small")
    constants = {field for field in imported.fields if field not in EXPECTED}
    assert constants == {
        *("vendor", "texture_layout", "lane_address_path", "l1.units_per_sm"),
        *(f"l1_texture.{field}" for field in ("line_bytes", "ways", "replacement", "set_hash")),
        *("l1_texture.write_allocate", "l1_texture.units_per_sm", "l1_texture.bypass_loads"),
        *("l2.line_bytes", "l2.sector_bytes", "l2.replacement"),
        *("sm_timing.result_cycles", "sm_timing.memory_cycles"),
        *("sm_timing.texture_quads_per_cycle", "l1_timing.lines_per_cycle"),
        *("l1_timing.bytes_per_cycle", "l2_timing.dirty_limit_percent"),
        "dram_timing.address_map",
    }


def test_every_field_names_its_file_and_option(tmp_path: Path) -> None:
    fields = small(tmp_path).fields
    assert fields["l1_timing.latency_cycles"].source == "TINY -gpgpu_l1_latency"
    assert "TINY -gpgpu_cache:dl1 S:8:128:16,F:E:f:N:X" in fields["l1.capacity"].source
    for field, entry in fields.items():
        assert entry.confidence in presets.CONFIDENCES, field
        assert (entry.confidence == "?") == entry.source.startswith("assumed"), field


def test_what_is_not_given_is_gpgpusims_default_and_says_so(tmp_path: Path) -> None:
    imported = small(tmp_path, without="-gpgpu_l1_latency")
    entry = imported.fields["l1_timing.latency_cycles"]
    assert (entry.value, entry.source) == (1, "GPGPU-Sim's default of -gpgpu_l1_latency")


def test_only_two_options_must_be_given(tmp_path: Path) -> None:
    needed = [option for option, default in DEFAULTS.items() if default is None]
    assert needed == ["-gpgpu_cache:dl1", "-gpgpu_mem_addr_mapping"]
    for option in needed:
        with pytest.raises(InputError, match=rf"gpgpusim\.config: missing {option}; a preset"):
            small(tmp_path, without=option)


@pytest.mark.parametrize(
    ("old", "text", "field", "expected"),
    [
        ("-gmem_skip_L1D", "0", "l1.bypass_loads", False),
        ("-rop_latency", "77", "l2_timing.latency_cycles", 77),
        ("-memory_partition_indexing", "0", "l2.partition_hash", "linear"),
        ("-l1_latency", "88", "l1_timing.latency_cycles", 88),
    ],
)
def test_old_names_are_taken(
    tmp_path: Path, old: str, text: str, field: str, expected: object
) -> None:
    assert value(small(tmp_path, f"{old} {text}"), field) == expected


def test_integers_share_the_fp32_unit_where_there_are_no_int_units(tmp_path: Path) -> None:
    imported = small(tmp_path, "-gpgpu_num_int_units 0\n-gpgpu_num_sp_units 1\n" + TRACE)
    assert value(imported, "sm_timing.int_on_fp32") is True
    # Two schedulers on one SP unit.
    assert value(imported, "sm_timing.int_initiation_cycles") == 4


def test_branches_take_the_integer_unit_where_no_unit_is_theirs(tmp_path: Path) -> None:
    units = TRACE.replace("BRA", "TEX")
    imported = small(tmp_path, units)
    assert value(imported, "sm_timing.control_latency_cycles") == 6
    off = small(tmp_path, TRACE.replace("unit_2 1,", "unit_2 0,"))
    assert value(off, "sm_timing.control_initiation_cycles") == 2


def test_ptx_latencies_stand_in_where_no_trace_config_is_given(tmp_path: Path) -> None:
    ptx = (
        "-ptx_opcode_latency_int 7,13,4,5,145,32\n-ptx_opcode_latency_fp 4,13,4,9,39\n"
        "-ptx_opcode_initiation_fp 1,2,1,3,4\n-ptx_opcode_latency_sfu 23"
    )
    imported = small(tmp_path, ptx)
    assert value(imported, "sm_timing.int_latency_cycles") == 7  # ADD
    assert value(imported, "sm_timing.fp32_latency_cycles") == 9  # MAD
    assert value(imported, "sm_timing.fp32_initiation_cycles") == 3
    assert value(imported, "sm_timing.sfu_latency_cycles") == 23
    assert "no trace.config" in imported.fields["sm_timing.fp32_latency_cycles"].source
    both = small(tmp_path, ptx + TRACE)
    assert value(both, "sm_timing.fp32_latency_cycles") == 5


def test_collectors_of_their_own_leave_arithmetic_alone(tmp_path: Path) -> None:
    imported = small(
        tmp_path,
        "-gpgpu_enable_specialized_operand_collector\n-gpgpu_operand_collector_num_units_mem 8",
    )
    assert value(imported, "sm_timing.collector_units") == 0
    assert value(imported, "sm_timing.memory_queue") == 2 + 4 + 1


def test_the_adaptive_l1_gets_what_the_smallest_shared_memory_leaves(tmp_path: Path) -> None:
    """96 KB less 32 are 64 KiB: 4 sets of 128 ways (facts sheet section 3.5)."""
    adaptive = "-gpgpu_adaptive_cache_config 1\n-gpgpu_shmem_option 64,32\n"
    adaptive += "-gpgpu_unified_l1d_size 96\n-gpgpu_cache:dl1 S:4:128:64,L:T:m:L:L,A:256:32,16:0,32"
    imported = small(tmp_path, adaptive)
    assert (value(imported, "l1.ways"), value(imported, "l1.capacity")) == (128, 64 * KIB)
    assert imported.gpu.l1.num_sets == 4
    whole = small(tmp_path, adaptive + "\n-gpgpu_shmem_option 0,8,64\n-gpgpu_unified_l1d_size 128")
    assert value(whole, "l1.capacity") == 128 * KIB


def test_a_streaming_l1_allocates_on_miss_where_the_split_is_adaptive(tmp_path: Path) -> None:
    streaming = "-gpgpu_cache:dl1 S:4:128:64,L:L:s:N:L,A:256:32,16:0,32\n"
    assert value(small(tmp_path, streaming), "l1_timing.allocation") == "streaming"
    adaptive = "-gpgpu_adaptive_cache_config 1\n-gpgpu_shmem_option 0,32\n"
    imported = small(tmp_path, streaming + adaptive + "-gpgpu_unified_l1d_size 96")
    assert value(imported, "l1_timing.allocation") == "on-miss"
    assert imported.fields["l1_timing.allocation"].confidence == "D"


def test_the_built_in_crossbar_moves_a_packet_of_any_size_in_a_cycle(tmp_path: Path) -> None:
    imported = small(tmp_path, "-icnt_flit_size 40")
    # 8 B of header and a texture line of 64 B.
    assert value(imported, "icnt.flit_bytes") == 72


def test_booksims_file_is_read_beside_the_config(tmp_path: Path) -> None:
    config = "-network_mode 1\n-inter_config_file net.icnt"
    missing = small(tmp_path, config)
    assert missing.fields["icnt.input_packets"].confidence == "?"
    write(
        tmp_path / "TINY",
        """
        // flits of half a packet
        flit_size = 20; topology = fly; k = 52; n = 1;
        num_vcs = 2; vc_buf_size = 8; input_buffer_size = 0; // 0: BookSim's 9
        boundary_buffer_size = 32; packet_size = {{1,2},{3}}; internal_speedup = 2.0;
        """,
        "net.icnt",
    )
    imported = small(tmp_path, config)
    assert {field: value(imported, f"icnt.{field}") for field in ("flit_bytes", "queueing")} == {
        "flit_bytes": 20,
        "queueing": "input-fifo",
    }
    assert value(imported, "icnt.router_steps") == 2
    assert value(missing, "icnt.router_steps") == 1
    assert value(imported, "icnt.input_packets") == (9 + 2 * 8) // 2
    assert value(imported, "icnt.output_packets") == (2 * 8 + 32) // 2
    assert value(imported, "icnt.request_latency_cycles") == 5
    reasons = group_remarks(missing.differing)
    assert reasons["there is no such file beside the config"] == ["-inter_config_file net.icnt"]
    assert "there is no such file beside the config" not in group_remarks(imported.differing)


@pytest.mark.parametrize("speedup", ["1.5", "0", "9", "fast"])
def test_a_router_has_whole_steps(tmp_path: Path, speedup: str) -> None:
    write(tmp_path / "TINY", f"k = 6;\ninternal_speedup = {speedup};", "net.icnt")
    with pytest.raises(InputError, match=r"net\.icnt:2: .*internal_speedup.*from 1 to 8"):
        small(tmp_path, "-network_mode 1\n-inter_config_file net.icnt")


def test_another_topology_is_told_of(tmp_path: Path) -> None:
    write(tmp_path / "TINY", "topology = mesh;\nk = 6;\nn = 2;", "mesh.icnt")
    imported = small(tmp_path, "-network_mode 1\n-inter_config_file mesh.icnt")
    remarks = group_remarks(imported.differing)["the network is one crossbar"]
    assert remarks == ["n 2", "topology mesh"]


def test_both_forms_of_dram_timing_say_the_same(tmp_path: Path) -> None:
    numbers = small(tmp_path, "-gpgpu_dram_timing_opt 4:2:3:12:28:11:40:13:5:6:10:2:4:1")
    assert numbers.gpu == small(tmp_path).gpu


def test_letters_for_the_channel_are_rewritten(tmp_path: Path) -> None:
    """Channel bits 9 and 10 spelled as D: the same machine as dramid@9 over the other bits."""
    plain = small(tmp_path)
    letters = str(value(plain, "dram_timing.address_map")).partition(";")[2].replace(".", "")
    spelled = letters[2:-9] + "DD" + letters[-9:]
    assert small(tmp_path, f"-gpgpu_mem_addr_mapping {spelled}").gpu == plain.gpu


def test_a_config_without_a_texture_cache_has_none(tmp_path: Path) -> None:
    imported = small(tmp_path, "-gpgpu_tex_cache:l1 none")
    assert imported.gpu.l1_texture is None
    assert imported.gpu.l1_texture_timing is None


# ---- what is told of the rest


def test_every_setting_is_used_told_of_or_agrees_with_the_model(tmp_path: Path) -> None:
    extra = "-gpgpu_smem_latency 24\n-power_simulation_enabled 0\n-gpgpu_l1_latncy 3\n"
    extra += "-gpgpu_shmem_warp_parts 1\n-gpgpu_perfect_mem 1\n-my_own thing"
    imported = small(tmp_path, extra)
    ignored = group_remarks(imported.ignored)
    assert ignored == {
        "no shared memory is accessed": ["-gpgpu_smem_latency 24"],
        "the power model": ["-power_simulation_enabled 0"],
        "unknown to this reader; did you mean -gpgpu_l1_latency?": ["-gpgpu_l1_latncy 3"],
        "unknown to this reader": ["-my_own thing"],
    }
    differing = group_remarks(imported.differing)
    assert differing["every access goes through the caches"] == ["-gpgpu_perfect_mem 1"]
    assert "a warp is coalesced whole" not in differing
    # Defaults of GPGPU-Sim count too.
    assert differing["loads are coalesced into sectors of 32 B"] == ["-gpgpu_coalesce_arch 13"]


@pytest.mark.parametrize("option", sorted(FIXED))
def test_a_fixed_option_is_told_of_exactly_where_the_simulator_differs(
    tmp_path: Path, option: str
) -> None:
    same = {"-gpgpu_coalesce_arch": "75", "-icnt_subnets": "2"}
    ones = {
        *("-gpgpu_simd_model", "-gpgpu_shmem_warp_parts", "-gpgpu_mem_unit_ports"),
        *("-gpgpu_sub_core_model", "-gpgpu_perfect_inst_const_cache", "-gpgpu_flush_l1_cache"),
        *("-icnt_grant_cycles", "-dram_bnkgrp_indexing_policy", "-gpgpu_n_chiplet_partition"),
    }
    agreeing = same.get(option, "1" if option in ones else "0")
    other = {"-gpgpu_coalesce_arch": "20"}.get(option, "0" if option in ones else "3")

    def told(text: str) -> bool:
        imported = small(tmp_path, f"{option} {text}")
        return option in {remark.setting.option for remark in imported.differing}

    assert (told(agreeing), told(other)) == (False, True)


def test_clocks_and_clusters_that_the_network_cannot_have_are_told_of(tmp_path: Path) -> None:
    remarks = group_remarks(small(tmp_path, "-gpgpu_clock_domains 1000:700:900:2000").differing)
    assert remarks["the interconnect runs at the cores' clock"] == [
        "-gpgpu_clock_domains 1000:700:900:2000"
    ]
    assert remarks["every SM has its own port to the interconnect"] == [
        "-gpgpu_n_cores_per_cluster 2"
    ]


# ---- syntax


def texts(*files: Path) -> dict[str, str]:
    return {option: setting.text for option, setting in read_option_files(files).items()}


def test_comments_quotes_flags_and_overrides(tmp_path: Path) -> None:
    first = write(
        tmp_path,
        '-a 1 # -b 2\n#-c 3\n-d "x=1:\n      y=2" -e\n-f -1\n-a 4\n-g "p # hidden\n q"',
        "a.config",
    )
    second = write(tmp_path, "-e 0\r\n-h 0x1F\r\n", "b.config")
    assert texts(first) == {"-a": "4", "-d": "x=1: y=2", "-e": "", "-f": "-1", "-g": "p q"}
    assert texts(first, second)["-e"] == "0"
    assert texts(second, first)["-e"] == ""


def test_settings_know_their_file_and_line(tmp_path: Path) -> None:
    path = write(tmp_path, '\n-a 1\n-b "x\ny"\n-c 2 # c\n-d 3', "a.config")
    lines = {option: setting.line for option, setting in read_option_files([path]).items()}
    assert lines == {"-a": 2, "-b": 3, "-c": 5, "-d": 6}


def test_a_file_reads_another_at_its_place(tmp_path: Path) -> None:
    write(tmp_path, "-a 2\n-b 2", "sub/other.config")
    path = write(tmp_path, "-a 1\n-config sub/other.config\n-b 3", "main.config")
    assert texts(path) == {"-a": "2", "-b": "3"}


@given(
    st.dictionaries(
        st.from_regex(r"-[a-z][a-z0-9_:]{0,8}", fullmatch=True).filter(lambda o: o != "-config"),
        st.from_regex(r"[A-Za-z0-9:,.;@=]{1,12}", fullmatch=True),
        min_size=1,
        max_size=6,
    ),
    st.booleans(),
    st.sampled_from(["\n", " ", "\n# note\n", "  \t"]),
)
def test_any_settings_come_back(
    tmp_path_factory: pytest.TempPathFactory, settings: dict[str, str], quoted: bool, between: str
) -> None:
    quote = '"' if quoted else ""
    text = between.join(f"{option} {quote}{text}{quote}" for option, text in settings.items())
    path = write(tmp_path_factory.getbasetemp(), text, "any.config")
    assert texts(path) == settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 -a", r"gpgpusim\.config:1: '1' stands before any option"),
        ('-a "open\n-b', r"gpgpusim\.config:1: '\"open' *: the quote is not closed"),
        ("-config gone.config", r"gone\.config: No such file"),
        ("-config gpgpusim.config", r"gpgpusim\.config: a file cannot read itself"),
        ("-config a b", r"gpgpusim\.config:1: -config 'a b'; allowed is the name of one file"),
        ("# nothing", r"gpgpusim\.config: no option in it"),
    ],
)
def test_what_is_no_option_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        import_config([write(tmp_path, text)], "x")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["flit_size 40;", "flit_size = 40", "= 40;", "a = 1;\n b"])
def test_what_is_no_network_file_is_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text, "net.icnt")
    with pytest.raises(InputError, match=r"net\.icnt:\d: .*allowed is key = value;"):
        read_network_file(path)


# ---- values


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("-gpgpu_l1_latency fast", "allowed are whole numbers$"),
        ("-gpgpu_l1_latency 5000", "allowed are whole numbers from 1 to 4096"),
        ("-gpgpu_l1_latency", "allowed are whole numbers"),
        ("-gpgpu_n_clusters 0", "allowed are whole numbers from 1"),
        ("-gpgpu_gmem_skip_L1D 2", "allowed are 0, 1"),
        ("-gpgpu_scheduler two_level_active:6:0:1", "allowed are gto, lrr"),
        ("-gpgpu_clock_domains 1000:1000:1000", "allowed is <core>:<icnt>:<L2>:<DRAM> in MHz"),
        ("-gpgpu_shader_core_pipeline 512", "with ':' between"),
        ("-gpgpu_shader_core_pipeline 500:32", "whole warps of threads"),
        ("-gpgpu_shader_core_pipeline 480:48", "allowed is <threads>:<32 or 64>"),
        ("-gpgpu_memory_partition_indexing 3", "allowed are 0, 1, 2, 4"),
        ("-gpgpu_n_mem 3", r"allowed are powers of two"),
        ("-network_mode 3", "allowed are 1, 2"),
        ("-gpgpu_dram_scheduler 2", "allowed are 0, 1"),
        ("-gpgpu_dram_partition_queues 8:8:8", "allowed are 4 whole numbers"),
        ("-gpgpu_dram_partition_queues 8:8:0:8", "allowed are whole numbers from 1"),
        ("-gpgpu_dram_timing_opt nbk=4:CCD=2", "missing RRD; allowed are nbk, CCD"),
        ("-gpgpu_dram_timing_opt nbk=4:XYZ=2", "key 'XYZ'; allowed are nbk"),
        ("-gpgpu_dram_timing_opt 4:2:3", "3 numbers; allowed are nbk:CCD"),
        (
            "-gpgpu_dram_timing_opt 8:2:3:12:28:11:40:13:5:6:10:2:4:1",
            "8 banks; -gpgpu_mem_addr_mapping has letters B for 4",
        ),
        (
            "-gpgpu_dram_timing_opt 4:2:3:12:28:11:40:13:5:6:10:3:4:1",
            "nbkgrp 3; allowed are divisors of nbk 4",
        ),
        ("-gpgpu_mem_addr_mapping dramid@8;RRBB", "64 letters of B, R, C, S, 0"),
        (f"-gpgpu_mem_addr_mapping dramid@x;{'0' * 64}", "allowed is dramid@<bit 4 to 39>"),
        (f"-gpgpu_mem_addr_mapping {'0' * 60}DBDS", "letters D side by side"),
        ("-gpgpu_cache:dl1 none", "cannot do without this cache"),
        ("-gpgpu_cache:dl2 none", "cannot do without this cache"),
        ("-trace_opcode_latency_initiation_sp 4", "allowed are 2 whole numbers with ','"),
        (
            "-gpgpu_adaptive_cache_config 1\n-gpgpu_unified_l1d_size 32\n-gpgpu_shmem_option 32",
            "allowed are sizes in KB below",
        ),
    ],
)
def test_a_wrong_value_gets_one_line_with_file_option_and_value(
    tmp_path: Path, setting: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        small(tmp_path, setting)
    option = setting.splitlines()[-1].split()[0]
    error = str(raised.value)
    assert "\n" not in error
    assert "gpgpusim.config:" in error
    assert option in error or option == "-gpgpu_n_mem"


def test_numbers_are_read_as_in_c(tmp_path: Path) -> None:
    for text, expected in (("0x10", 16), ("020", 16), ("16", 16)):
        imported = small(tmp_path, f"-gpgpu_l1_latency {text}")
        assert value(imported, "l1_timing.latency_cycles") == expected


# ---- cache strings


@pytest.mark.parametrize(
    ("text", "old"),
    [
        ("N:64:128:8,L:B:m:W:L,A:32:4,4:0,32", "64:128:8,L:B:m:W:L,A:32:4,4:0,32"),
        ("N:64:128:8,L:B:m:W:L,A:32:4,4", "64:128:8,L:B:m:W,A:32:4,4"),
    ],
)
def test_strings_of_older_files_mean_line_caches_with_linear_index(text: str, old: str) -> None:
    new_cache = parse_cache_string(Setting("-gpgpu_cache:dl2", text))
    old_cache = parse_cache_string(Setting("-gpgpu_cache:dl2", old))
    assert new_cache is not None and old_cache is not None
    assert new_cache.set_hash == old_cache.set_hash == "linear"
    assert new_cache.sector_bytes == old_cache.sector_bytes == 128
    assert new_cache.capacity == old_cache.capacity == 64 * KIB


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # The combinations that facts sheet section 3.2 calls illegal.
        ("S:4:128:8,L:B:f:N:L,A:8:8,8:0,32", r"write-back \(wr B\) with alloc f"),
        ("S:4:128:8,L:B:s:N:L,A:8:8,8:0,32", r"write-back \(wr B\) with alloc s"),
        ("S:4:128:8,L:T:f:F:L,A:8:8,8:0,32", "wralloc F with alloc f; allowed is alloc m"),
        ("S:4:128:8,L:T:s:F:L,A:8:8,8:0,32", "wralloc F with alloc s; allowed is alloc m"),
        ("S:4:128:8,L:T:f:L:L,A:8:8,8:0,32", "wralloc L with alloc f; allowed is alloc m"),
        ("S:4:128:8,L:L:s:L:L,A:8:8,8:0,32", "wralloc L with alloc s; allowed is alloc m"),
        ("S:4:64:8,L:T:m:N:L,A:8:8,8:0,32", "type S with lines of 64 B; allowed are 128 B"),
        ("S:4:256:8,L:T:m:N:L,A:8:8,8:0,32", "type S with lines of 256 B; allowed are 128 B"),
        ("S:16:128:8,L:T:m:N:H,A:8:8,8:0,32", "index H over 16 sets; allowed are 32, 64 sets"),
        ("S:8:128:8,L:T:m:N:P,A:8:8,8:0,32", "index P over 8 sets; allowed are 16, 32, 64"),
        ("S:4:128:8,L:T:m:N:C,A:8:8,8:0,32", "index C is not written in GPGPU-Sim"),
        # Letters and numbers.
        ("X:4:128:8,L:T:m:N:L,A:8:8,8", "type 'X'; allowed are N, S"),
        ("S:4:128:8,R:T:m:N:L,A:8:8,8", "rep 'R'; allowed are L, F"),
        ("S:4:128:8,L:X:m:N:L,A:8:8,8", "wr 'X'; allowed are R, B, T, E, L"),
        ("S:4:128:8,L:T:x:N:L,A:8:8,8", "alloc 'x'; allowed are m, f, s"),
        ("S:4:128:8,L:T:m:X:L,A:8:8,8", "wralloc 'X'; allowed are N, W, F, L"),
        ("S:4:128:8,L:T:m:N:Q,A:8:8,8", "index 'Q'; allowed are L, X, H, P"),
        ("S:4:128:8,L:T:m:N:L,T:8:8,8:2", "mshr 'T' of a data cache; allowed are A, S"),
        ("S:4:128:0,L:T:m:N:L,A:8:8,8", "ways '0'; allowed are whole numbers from 1"),
        ("S:6:128:8,L:T:m:N:L,A:8:8,8", "sets 6; allowed are powers of two"),
        ("N:4:96:8,L:T:m:N:L,A:8:8,8", "line 96; allowed are powers of two"),
        ("S:4:128:8,L:T:m:N:L,A:x:8,8", "entries 'x'"),
        ("S:4:128:8,L:T:m:N:L,A:8:0,8", "merge '0'"),
        ("S:4:128:8,L:T:m:N:L,A:8:8,0", "miss queue '0'"),
        ("S:4:128:8,L:T:m:N:L,A:8:8,8:0,48", "port 48; allowed are divisors of the line's 128 B"),
        # Shapes.
        ("S:4:128:8", "allowed is <type>:<sets>"),
        ("S:4:128:8,L:T:m:N:L,A:8:8", "allowed is <type>:<sets>"),
        ("S:4:128:8:2,L:T:m:N:L,A:8:8,8", "allowed is <type>:<sets>"),
        ("S:4:128:8,L:T:m:N:L,A:8:8,8:0,32,1", "allowed is <type>:<sets>"),
        ("", "allowed is <type>:<sets>"),
    ],
)
def test_a_wrong_cache_string_names_the_part_that_is_wrong(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        small(tmp_path, f"-gpgpu_cache:dl1 {text}")
    assert "gpgpusim.config:" in str(raised.value)
    assert f"-gpgpu_cache:dl1 {text!r}" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("N:4:128:8,L:R:m:N:L,A:8:8,8", "mshr 'A' of the texture cache; allowed are F, T"),
        ("N:4:128:8,L:R:m:N:L,T:8:8,8", "result FIFO '0'; allowed are whole numbers from 1"),
    ],
)
def test_a_texture_cache_needs_its_fifos(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        small(tmp_path, f"-gpgpu_tex_cache:l1 {text}")


@given(
    alloc=st.sampled_from("mfs"),
    write_policy=st.sampled_from("RBTEL"),
    write_allocate=st.sampled_from("NWFL"),
    line=st.sampled_from([32, 64, 128, 256]),
    kind=st.sampled_from("NS"),
)
def test_exactly_the_illegal_combinations_are_refused(
    alloc: str, write_policy: str, write_allocate: str, line: int, kind: str
) -> None:
    text = f"{kind}:4:{line}:8,L:{write_policy}:{alloc}:{write_allocate}:L,A:8:8,8:0,32"
    illegal = (
        (write_policy == "B" and alloc in "fs")
        or (write_allocate in "FL" and alloc in "fs")
        or (kind == "S" and line != 128)
    )
    try:
        cache = parse_cache_string(Setting("-gpgpu_cache:dl1", text))
    except InputError:
        assert illegal
    else:
        assert not illegal
        assert cache is not None
        assert cache.capacity == 4 * 8 * line


# ---- the preset file


def test_the_preset_file_is_the_machine(tmp_path: Path) -> None:
    imported = small(tmp_path, TRACE)
    path = write(tmp_path, imported.to_toml(), "small.toml")
    assert presets.load(path) == imported.gpu
    entries = presets.sources(path)
    assert entries == imported.fields


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_the_shipped_presets_read_as_the_reader_writes_them(name: str) -> None:
    """Their text is the reader's own format, whether or not the originals are here."""
    path = Path(presets.__file__).parent / f"{name}.toml"
    text = path.read_text(encoding="utf-8")
    again = Imported(presets.load(name), presets.sources(name), (), (), "").to_toml(
        leading_comments(text)
    )
    assert text == again


@pytest.mark.skipif(
    not CONFIGS.is_dir(),
    reason="Accel-Sim's configs are not beside the repository (../shared/oracles/accel-sim)",
)
@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_the_shipped_presets_are_what_the_originals_make(name: str) -> None:
    folder = CONFIGS / SHIPPED[name]
    imported = import_config([folder / "gpgpusim.config", folder / "trace.config"], name)
    shipped = (Path(presets.__file__).parent / f"{name}.toml").read_text(encoding="utf-8")
    assert imported.to_toml(leading_comments(shipped)) == shipped
    reasons = group_remarks(imported.ignored)
    assert not [reason for reason in reasons if reason.startswith("unknown")]
    assert list(group_remarks(imported.differing).values()) == [["-gpgpu_perf_sim_memcpy 1"]]


# ---- the command


def test_the_command_writes_a_preset_and_says_what_it_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, SMALL + NOTED, "TINY/a.config")
    write(tmp_path, TRACE, "TINY/trace.config")
    command = ["import-config", "TINY/a.config", "--trace-config", "TINY/trace.config"]
    assert run_command([*command, "-o", "mine.toml"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("wrote mine.toml: 128 fields")
    assert "ignored (the power model): -power_simulation_enabled 0" in said.err
    # Not an emoji.
    assert "(instructions and constants always hit): -gpgpu_cache:il1 N:8:128:4,L:R:m:N" in said.err
    assert "not modelled: -gpgpu_perfect_mem 1; here every access goes" in said.err
    document = tomllib.loads(Path("mine.toml").read_text(encoding="utf-8"))
    assert document["name"]["value"] == "mine"
    assert document["sm_timing"]["int_latency_cycles"]["source"].startswith("TINY -trace_opcode")
    assert run_command(["presets", "show", "mine.toml"]) == 0
    shown = capsys.readouterr().out
    assert "…" not in shown and max(map(len, shown.splitlines())) <= 100
    assert "L:R:m:N:L" in shown


def test_the_command_keeps_the_comments_on_top_of_a_preset(tmp_path: Path) -> None:
    config = write(tmp_path, SMALL)
    output = write(tmp_path, "# My own words\n# in two lines\n\nname = 'x'\n", "mine.toml")
    assert run_command(["import-config", str(config), "-o", str(output)]) == 0
    text = output.read_text(encoding="utf-8")
    assert text.startswith("# My own words\n# in two lines\n\nname ")
    assert presets.load(output).sm.count == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["gone.config", "-o", "x.toml"], "gone.config: no such file"),
        (["ok.config", "-o", "x.txt"], "x.txt: suffix '.txt': allowed are .toml"),
        (["ok.config", "--trace-config", "gone", "-o", "x.toml"], "gone: no such file"),
        (["bad.config", "-o", "x.toml"], "bad.config:1: -gpgpu_cache:dl1 'S:4'; allowed is"),
        (["ok.config", "-o", "no/x.toml"], "folder 'no' does not exist"),
    ],
)
def test_the_command_refuses_in_one_line_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, SMALL, "ok.config")
    write(tmp_path, "-gpgpu_cache:dl1 S:4", "bad.config")
    before = sorted(tmp_path.iterdir())
    assert run_command(["import-config", *arguments]) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert said.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
