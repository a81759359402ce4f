"""Timing results with known numbers, for tests of what is shown of them."""

from cachesim.timing.results import LevelTiming, PassTiming, TimingResult

CLOCK_HZ = 1_000_000_000
NUM_SMS = 4


def one_pass(name: str = "sampling", scale: int = 1, **changes: object) -> PassTiming:
    """A pass of 10,000 x scale cycles and a launch of 1000: DRAM is what most of them wait for."""
    n = scale
    given: dict = {
        "name": name,
        "num_launches": 1,
        "cycles": 10_000 * n + 1000,
        "launch_cycles": 1000,
        "where": {
            "issue": 1500 * n,
            "arithmetic": 500 * n,
            "l1_bandwidth": 1000 * n,
            "l1_reservation": 0,
            "interconnect": 250 * n,
            "l2": 750 * n,
            "dram": 4000 * n,
            "latency": 1500 * n,
            "launch": 1000,
            "idle": 500 * n,
        },
        "warp_instructions": {"fp32": 3000 * n, "int": 1000 * n, "memory": 2000 * n},
        "resident_warp_cycles": 10_000 * NUM_SMS * 19 * n,
        "sm_cycles": 10_000 * NUM_SMS * n,
        "max_warps": 64,
        # Peaks of 512, 128 and 32 bytes per cycle.
        "levels": {
            "l1": LevelTiming(1_000_000 * n, 512_000, 40 * 900 * n, 900 * n),
            "l2": LevelTiming(400_000 * n, 128_000, 240 * 300 * n, 300 * n),
            "dram": LevelTiming(240_000 * n, 32_000, 600 * 100 * n, 100 * n),
        },
    }
    return PassTiming(**(given | changes))


GPGPUSIM = {
    "l1": {
        "HIT": 20_000,
        "HIT_RESERVED": 1000,
        "MISS": 8000,
        "SECTOR_MISS": 2000,
        "RESERVATION_FAIL": 444,
        "MSHR_HIT": 1500,
        "W_HIT": 5,
        "W_MISS": 95,
    },
    "l2": {"HIT": 4000, "MISS": 5000, "SECTOR_MISS": 500, "RESERVATION_FAIL": 3, "W_MISS": 100},
    "dram": {"reads": 5500, "writes": 90, "row_hits": 5000, "activates": 590, "precharges": 574},
    "sm": {
        "gpu_sim_cycle": 11_000,
        "gpu_sim_insn": 192_000,
        "gpgpu_n_tot_w_icount": 6000,
        "gpgpu_n_load_insn": 60_800,
        "l1_bank_conflicts": 12,
        "averagemflatency_sum": 3_250_099,
        "averagemflatency_num": 10_000,
    },
}


def timing_result(*passes: PassTiming) -> TimingResult:
    """A result of these passes, or of one."""
    return TimingResult(CLOCK_HZ, passes or (one_pass(),), GPGPUSIM)
