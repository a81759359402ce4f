"""The timing model's speed on the oracle traces, each measurement a process of its own that prints
a JSON line.

Run: python -m experiments.bench_timing compile
     python -m experiments.bench_timing CONFIG NUM_RUNS [TRACE,TRACE...]
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from experiments.accel_sim_oracle import CONFIGS, FETCH_PATH, choose, ours, sectors
from experiments.tables import Column, Table
from traces.oracle_traces import ORACLE_TRACES, oracle_trace

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from traces.trace import Trace

COMPILE = "compile"
#: Runs of each trace; the median counts.
NUM_RUNS = 3
#: Small traces for a smoke test, one of each kind.
QUICK = ("g8_linear", "chase", "l1_throughput")
#: Million sector requests a second on one core that the project asks for, and aims at.
ASKED_MSECTORS, AIM_MSECTORS = 2, 5
ALL = "all"


def compile_loops_s() -> float:
    """Seconds that a command waits for the loops: they are compiled, or come from the cache."""
    from cachesim.first_use import compile_loops

    start = time.perf_counter()
    compile_loops(lane_address=True, timing=True)
    return time.perf_counter() - start


class TimedRun(NamedTuple):
    """One run. seconds: of wall-clock time, of all that `simulate` does. cpu_s: of the processor,
    which is less where other work had the core in between.
    """

    quantities: dict[str, int]
    seconds: float
    cpu_s: float


def run_once(trace: Trace, gpu: Gpu) -> TimedRun:
    """Time a trace on one thread."""
    from cachesim import simulate

    start, cpu_start = time.perf_counter(), time.process_time()
    report = simulate(trace, gpu, fetch_path=FETCH_PATH, threaded=False, timing=True)
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu_start
    assert report.timing is not None
    return TimedRun(ours(report.timing), seconds, cpu_s)


def measure(config: str, num_runs: int, names: Sequence[str]) -> dict[str, Any]:
    """Sectors and seconds of each trace on one machine; making the traces is not counted."""
    compile_loops_s()
    gpu = CONFIGS[config].gpu()
    # What only this machine uses is loaded before the clock starts.
    run_once(oracle_trace("chase"), gpu)
    rows = []
    for name in names:
        trace = oracle_trace(name)
        runs = [run_once(trace, gpu) for _ in range(num_runs)]
        rows.append(
            {
                "trace": name,
                "sectors": sectors(runs[0].quantities),
                "seconds": median(run.seconds for run in runs),
                "cpu_s": median(run.cpu_s for run in runs),
            }
        )
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"rows": rows, "peak_gib": peak_kib / 2**20}


def speed_frame(found: dict[str, dict[str, Any]], results: pd.DataFrame) -> pd.DataFrame:
    """A row per machine, and one for all: sums of sectors and seconds, ours and Accel-Sim's.

    found: of each config, as `measure` returns it. results: as `accel_sim_oracle.read_results`.
    """
    import pandas as pd

    rows = []
    for config, measured in found.items():
        names = [row["trace"] for row in measured["rows"]]
        rows.append(
            {
                "config": config,
                "num_traces": len(names),
                **{
                    name: sum(row[name] for row in measured["rows"])
                    for name in ("sectors", "seconds", "cpu_s")
                },
                "accel_sim_s": float(results.loc[config].loc[names, "wall_s"].sum()),
                "peak_gib": measured["peak_gib"],
            }
        )
    if len(rows) > 1:
        sums = ("num_traces", "sectors", "seconds", "cpu_s", "accel_sim_s")
        total = {name: sum(row[name] for row in rows) for name in sums}
        rows.append({"config": ALL, **total, "peak_gib": max(r["peak_gib"] for r in rows)})
    frame = pd.DataFrame(rows)
    frame["msectors_per_s"] = frame["sectors"] / frame["seconds"] / 1e6
    frame["accel_sim_sectors_per_s"] = frame["sectors"] / frame["accel_sim_s"]
    frame["ratio"] = frame["accel_sim_s"] / frame["seconds"]
    return frame


def speed_table(
    frame: pd.DataFrame, num_runs: int, first_s: float, loading_s: float, machine: str
) -> Table:
    """The timing model's speed.

    first_s: of compilation with an empty cache. loading_s: with a full one.
    """
    columns = (
        Column("config", "oracle traces on"),
        Column("num_traces", "traces"),
        Column("sectors", "sectors"),
        Column("seconds", "s", ".2f"),
        Column("cpu_s", "CPU s", ".2f"),
        Column("msectors_per_s", "M sectors/s, one core", ".2f"),
        Column("accel_sim_s", "Accel-Sim s", ",.0f"),
        Column("accel_sim_sectors_per_s", "Accel-Sim sectors/s", ",.0f"),
        Column("ratio", "times as fast", ".0f"),
        Column("peak_gib", "peak GiB", ".2f"),
    )
    runs = f"median of {num_runs} runs" if num_runs > 1 else "one run"
    notes = (
        machine,
        "Sum of sector requests of loads (at the L1, or the L2 where loads skip the L1) / sum of "
        f"seconds, one thread, {runs} of each trace, compilation excluded. First compilation of "
        f"the timing model: {first_s:.1f} s; afterwards {loading_s:.1f} s to load it. Where "
        "CPU s is below s, other work had the core in between.",
        "Accel-Sim's seconds are those of its runs in tests/oracles/accel-sim, on another machine; "
        "`bench --accel-sim PATH` measures both on this one.",
        f"Asked: {ASKED_MSECTORS} M sectors/s, the aim {AIM_MSECTORS}; compilation under 30 s.",
    )
    return Table("Speed of the timing model", frame, columns, notes)


def main(job: str, num_runs: str = "1", names: str = "") -> None:
    """Measure and print."""
    if job == COMPILE:
        found: dict[str, Any] = {"seconds": compile_loops_s()}
    else:
        chosen = choose(names.split(",") if names else None, ORACLE_TRACES, "oracle trace")
        found = measure(job, int(num_runs), chosen)
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
