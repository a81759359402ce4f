"""GPGPU-Sim's stat lines: exact names, its sums and means, read back as written."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from timing_samples import one_pass, timing_result

from cachesim import presets
from cachesim.timing.results import TimingResult
from experiments.gpgpusim_format import (
    ACCEPTED,
    EXIT_LINE,
    OUTCOMES,
    parse_stat_lines,
    stat_lines,
)

PASCAL = "titan-x-pascal-gpgpusim"
PASCAL_GPU = presets.load(PASCAL)


def told(fetch_path: str = "global", gpu: str = PASCAL, **more: object) -> str:
    result = timing_result()
    return stat_lines(result, presets.load(gpu), fetch_path=fetch_path, name="a trace.npz", **more)


# Patterns in the manner of the scripts that collect GPGPU-Sim's statistics: some need the leading
# space, some the unit.
PATTERNS = [
    (r"gpu_tot_sim_insn\s*=\s*(.*)", 192_000),
    (r"gpu_tot_sim_cycle\s*=\s*(.*)", 11_000),
    (r"gpu_sim_cycle\s*=\s*(.*)", 11_000),
    (r"\s+L2_cache_stats_breakdown\[GLOBAL_ACC_R\]\[HIT\]\s*=\s*(.*)", 4000),
    (r"\s+L2_cache_stats_breakdown\[GLOBAL_ACC_R\]\[TOTAL_ACCESS\]\s*=\s*(.*)", 9500),
    (r"\s+L2_cache_stats_breakdown\[GLOBAL_ACC_W\]\[TOTAL_ACCESS\]\s*=\s*(.*)", 100),
    (r"\s+Total_core_cache_stats_breakdown\[GLOBAL_ACC_R\]\[TOTAL_ACCESS\]\s*=\s*(.*)", 31_000),
    (r"\s+Total_core_cache_stats_breakdown\[GLOBAL_ACC_W\]\[HIT\]\s*=\s*(.*)", 5),
    (r"gpgpu_n_tot_w_icount\s*=\s*(.*)", 6000),
    (r"gpgpu_n_load_insn  = (.*)", 60_800),
    (r"gpgpu_n_l1cache_bkconflict = (.*)", 12),
    (r"total dram reads\s*=\s*(.*)", 5500),
    (r"total dram writes\s*=\s*(.*)", 90),
    # 3,250,099 / 10,000 is cut, as an integer division is.
    (r"averagemflatency = (\d+)", 325),
    (r"gpu_ipc\s*=\s*(.*)", 17.4545),
    (r"gpu_occupancy\s*=\s*(.*)%", 31.25),
    # 9600 replies of 32 B in 11 us.
    (r"L2_BW\s*=\s*(.*)GB/Sec", 27.9273),
]


@pytest.mark.parametrize(("pattern", "value"), PATTERNS)
def test_scripts_that_collect_statistics_find_them(pattern: str, value: float) -> None:
    (found,) = {m[1] for line in told().splitlines() if (m := re.search(pattern, line))}
    assert float(found) == pytest.approx(value, abs=5e-5)


def test_the_text_ends_with_the_line_that_marks_a_finished_run() -> None:
    assert told().splitlines()[-1] == EXIT_LINE
    assert told().splitlines()[0] == "kernel_name = a_trace_npz "


def test_every_line_is_a_name_that_gpgpusim_has() -> None:
    known = {
        *(f"{p}_{n}" for p in ("gpu", "gpu_tot") for n in ("sim_cycle", "sim_insn", "ipc")),
        *("gpu_occupancy", "gpu_tot_occupancy", "L2_BW", "L2_BW_total"),
        *("gpgpu_n_tot_w_icount", "gpgpu_n_load_insn", "gpgpu_n_l1cache_bkconflict"),
        *("averagemflatency", "total dram reads", "total dram writes"),
    }
    for level in ("L1D", "L2"):
        for n in ("accesses", "misses", "miss_rate", "pending_hits", "reservation_fails"):
            known.add(f"{level}_total_cache_{n}")
    for name in ("Total_core_cache_stats_breakdown", "L2_cache_stats_breakdown"):
        for kind in ("GLOBAL_ACC_R", "GLOBAL_ACC_W"):
            known |= {f"{name}[{kind}][{o}]" for o in (*OUTCOMES, "TOTAL_ACCESS")}
    assert set(parse_stat_lines(told())) <= known


def test_a_fail_is_no_access_and_an_mshr_hit_is_no_access_of_its_own() -> None:
    found = parse_stat_lines(told())
    assert found["L1D_total_cache_accesses"] == 31_000 + 100
    assert found["L1D_total_cache_misses"] == 10_000 + 95
    assert found["L1D_total_cache_miss_rate"] == pytest.approx(10_095 / 31_100, abs=5e-5)
    assert found["L1D_total_cache_pending_hits"] == 1000
    assert found["L1D_total_cache_reservation_fails"] == 444
    assert found["L2_total_cache_accesses"] == 9600


def test_texture_loads_are_texture_accesses_of_the_texture_l1_where_there_is_one() -> None:
    apart = parse_stat_lines(told("texture"))
    assert apart["Total_core_cache_stats_breakdown[TEXTURE_ACC_R][HIT]"] == 20_000
    assert apart["L2_cache_stats_breakdown[TEXTURE_ACC_R][MISS]"] == 5000
    assert "L2_cache_stats_breakdown[GLOBAL_ACC_R][MISS]" not in apart
    # Stores stay with the data cache.
    assert (apart["L1T_total_cache_accesses"], apart["L1D_total_cache_accesses"]) == (31_000, 100)
    unified = parse_stat_lines(told("texture", "titan-x-pascal"))
    assert "L1T_total_cache_accesses" not in unified
    assert unified["L1D_total_cache_accesses"] == 31_100


def test_occupancy_is_over_the_cycles_in_which_an_sm_had_a_warp() -> None:
    # 19 of 64 warps over all cycles; 5 % of them idle.
    found = parse_stat_lines(told())
    assert timing_result().total.occupancy == pytest.approx(19 / 64)
    assert found["gpu_occupancy"] == pytest.approx(100 * 19 / 64 / 0.95, abs=5e-5)


def test_what_was_not_counted_is_not_printed() -> None:
    bare = TimingResult(10**9, (one_pass(),), {})
    text = stat_lines(bare, presets.load(PASCAL), fetch_path="global", name="t")
    assert set(parse_stat_lines(text)) == {
        *("gpu_sim_cycle", "gpu_tot_sim_cycle", "gpu_occupancy", "gpu_tot_occupancy"),
    }
    assert "simulation_rate" not in told()


def test_simulation_speed_is_printed_in_the_simulators_own_lines() -> None:
    lines = told(host_s=3725.9).splitlines()
    assert "gpgpu_simulation_time = 0 days, 1 hrs, 2 min, 5 sec (3725 sec)" in lines
    found = parse_stat_lines("\n".join(lines))
    assert found["gpgpu_simulation_rate (inst/sec)"] == 192_000 // 3725
    assert found["gpgpu_simulation_rate (cycle/sec)"] == 11_000 // 3725
    assert found["gpgpu_silicon_slowdown"] == 10**9 // 2


def test_a_run_that_takes_no_time_is_taken_as_one_second() -> None:
    found = parse_stat_lines(told(host_s=0.01))
    assert found["gpgpu_simulation_rate (cycle/sec)"] == 11_000


counts = st.integers(0, 2**40)


@given(
    l1=st.dictionaries(st.sampled_from([*OUTCOMES, *(f"W_{o}" for o in OUTCOMES)]), counts),
    l2=st.dictionaries(st.sampled_from(OUTCOMES), counts),
    path=st.sampled_from(["texture", "readonly", "global"]),
)
def test_counters_are_read_back_as_they_were(
    l1: dict[str, int], l2: dict[str, int], path: str
) -> None:
    result = TimingResult(10**9, (one_pass(),), {"l1": l1, "l2": l2})
    text = stat_lines(result, PASCAL_GPU, fetch_path=path, name="t")
    found = parse_stat_lines(text)
    load = "TEXTURE_ACC_R" if path == "texture" else "GLOBAL_ACC_R"
    for name, level in (("Total_core_cache_stats", l1), ("L2_cache_stats", l2)):
        for outcome, count in level.items():
            kind = "GLOBAL_ACC_W" if outcome.startswith("W_") else load
            key = f"{name}_breakdown[{kind}][{outcome.removeprefix('W_')}]"
            assert found.get(key, 0) == count
    accesses = sum(n for o, n in l1.items() if o.removeprefix("W_") in ACCEPTED)
    parts = [found.get(f"{kind}_total_cache_accesses", 0) for kind in ("L1D", "L1T")]
    assert sum(parts) == accesses


def test_output_of_the_simulator_itself_is_read() -> None:
    text = """
        Accel-Sim [build accelsim-commit-1234]
-gpgpu_n_clusters                      28 # number of processing clusters
kernel_name = _Z6kernelv
kernel_launch_uid = 1
gpu_sim_cycle = 100
gpu_ipc =      12.5000
gpu_occupancy = 12.3456%
L2_BW  =       1.2500 GB/Sec
\tL1D_cache_core[0]: Access = 32, Miss = 8, Miss_rate = 0.250, Pending_hits = 0
\tTotal_core_cache_stats_breakdown[GLOBAL_ACC_R][HIT] = 24
averagemflatency = 311
gpgpu_simulation_rate = 1000 (inst/sec)
gpgpu_simulation_rate = 20 (cycle/sec)
kernel_launch_uid = 2
gpu_sim_cycle = 250
"""
    assert parse_stat_lines(text) == {
        "kernel_launch_uid": 2,
        "gpu_sim_cycle": 250,
        "gpu_ipc": 12.5,
        "gpu_occupancy": 12.3456,
        "L2_BW": 1.25,
        "Total_core_cache_stats_breakdown[GLOBAL_ACC_R][HIT]": 24,
        "averagemflatency": 311,
        "gpgpu_simulation_rate (inst/sec)": 1000,
        "gpgpu_simulation_rate (cycle/sec)": 20,
    }
