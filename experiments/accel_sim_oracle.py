"""The oracle: the machines that Accel-Sim ran `traces.oracle_traces` on, what it printed, and the
same counters of our own runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.gpgpusim_format import ACCEPTED
from traces.errors import InputError, unknown
from traces.oracle_traces import ORACLE_TRACES

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from cachesim.timing.results import TimingResult

#: What printed the numbers, as `tests/oracles/accel-sim/README.md` says.
VERSION = "Accel-Sim dev 73f9fac with gpgpu-sim dev 667834cf (4.2.0), October 2024"
#: Of a kernel's launch, in Accel-Sim's cycle counts.
LAUNCH_CYCLES = 5000
#: The numbers; in a checkout, since tests are not installed.
RESULTS = Path(__file__).resolve().parents[1] / "tests" / "oracles" / "accel-sim" / "results.csv"
#: Loads of lane-address traces are plain global loads there.
FETCH_PATH = "global"
#: Compared, and what people read. "run_cycles" leaves the launch out.
QUANTITIES: Mapping[str, str] = {
    "cycles": "cycles",
    "run_cycles": "cycles without launch",
    "l1_accesses": "L1 accesses",
    "l1_misses": "L1 misses",
    "l2_accesses": "L2 accesses",
    "l2_misses": "L2 misses",
}


@dataclass(frozen=True)
class OracleConfig:
    """One machine, theirs and ours.

    folder: of Accel-Sim's configurations. options: that its command line adds. preset, overrides:
        ours. binary_version: of the opcodes that it reads. skips_l1: whether loads go to the L2.
    """

    folder: str
    options: tuple[str, ...]
    preset: str
    overrides: tuple[str, ...]
    binary_version: int
    skips_l1: bool

    def gpu(self) -> Gpu:
        """Our preset with the overrides."""
        from cachesim import presets

        return presets.load(self.preset, list(self.overrides))


#: Name, as in `results.csv` -> machine.
CONFIGS: Mapping[str, OracleConfig] = {
    "SM6_TITANX": OracleConfig("SM6_TITANX", (), "titan-x-pascal-gpgpusim", (), 61, True),
    "SM6_TITANX_L1": OracleConfig(
        "SM6_TITANX",
        ("-gpgpu_gmem_skip_L1D", "0"),
        "titan-x-pascal-gpgpusim",
        ("l1.bypass_loads=false",),
        61,
        False,
    ),
    "SM75_RTX2060": OracleConfig("SM75_RTX2060", (), "rtx-2060-gpgpusim", (), 75, False),
}


def choose(names: Sequence[str] | None, known: Mapping[str, object], what: str) -> list[str]:
    """The names that were asked for, each once and in the order of `known`; None asks for all.

    Raises:
        InputError: an unknown name.
    """
    for name in names or ():
        if name not in known:
            raise unknown(what, name, known)
    return [name for name in known if not names or name in names]


def read_results(path: Path = RESULTS) -> pd.DataFrame:
    """What Accel-Sim printed, indexed by config and trace.

    Raises:
        InputError: the file is not there, or lacks a run.
    """
    import pandas as pd

    if not path.is_file():
        raise InputError(
            f"{path}: no such file: Accel-Sim's numbers are in the repository's checkout, "
            "not in an installed package; install with `pip install -e .`"
        )
    frame = pd.read_csv(path).set_index(["config", "trace"])
    missing = [(c, t) for c in CONFIGS for t in ORACLE_TRACES if (c, t) not in frame.index]
    if missing:
        raise InputError(f"{path}: no row for config {missing[0][0]}, trace {missing[0][1]}")
    return frame


def theirs(row: Mapping[str, int]) -> dict[str, int]:
    """`QUANTITIES` of a row of `read_results`."""
    return {
        "cycles": int(row["cycles"]),
        "run_cycles": int(row["cycles"]) - LAUNCH_CYCLES,
        "l1_accesses": int(row["l1_accesses"]),
        "l1_misses": int(row["l1_miss"]) + int(row["l1_sector_miss"]),
        "l2_accesses": int(row["l2_accesses"]),
        "l2_misses": int(row["l2_miss"]) + int(row["l2_sector_miss"]),
    }


def ours(timing: TimingResult) -> dict[str, int]:
    """`QUANTITIES` of a timed run: loads only, in GPGPU-Sim's definitions."""
    total = timing.total
    found = {"cycles": total.cycles, "run_cycles": total.cycles - total.launch_cycles}
    for level in ("l1", "l2"):
        counts = timing.gpgpusim[level]
        found[f"{level}_accesses"] = sum(counts[outcome] for outcome in ACCEPTED)
        found[f"{level}_misses"] = counts["MISS"] + counts["SECTOR_MISS"]
    return found


def parsed(stats: Mapping[str, int | float]) -> dict[str, int]:
    """`QUANTITIES` of an Accel-Sim's output, as `gpgpusim_format.parse_stat_lines` reads it.

    Raises:
        KeyError: it has no `gpu_tot_sim_cycle`, as a run that did not come to its end.
    """
    cycles = int(stats["gpu_tot_sim_cycle"])
    found = {"cycles": cycles, "run_cycles": cycles - LAUNCH_CYCLES}
    names = {"l1": "Total_core_cache_stats_breakdown", "l2": "L2_cache_stats_breakdown"}
    for level, name in names.items():
        counts = {o: int(stats.get(f"{name}[GLOBAL_ACC_R][{o}]", 0)) for o in ACCEPTED}
        found[f"{level}_accesses"] = sum(counts.values())
        found[f"{level}_misses"] = counts["MISS"] + counts["SECTOR_MISS"]
    return found


def sectors(quantities: Mapping[str, int]) -> int:
    """Sector requests of loads at the first cache that they reach: the L1, or the L2 where loads
    skip the L1.
    """
    return quantities["l1_accesses"] or quantities["l2_accesses"]
