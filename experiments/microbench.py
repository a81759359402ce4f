"""`cachesim microbench`: the latency and bandwidth of each level of a GPU as the timing model has
them, beside what is known of the card.

A pointer chase whose footprint sits in the level gives its load-to-use latency, a stream over such
a footprint by all warps its bandwidth (`traces.microbench`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.options import GpuName, Overrides

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from cachesim.timing.results import PassTiming
    from experiments.tables import Table
    from traces.trace import Trace

OUTPUT_HELP = "Write the table as CSV."
LEVELS = ("l1", "gl1", "l2", "llc", "dram")
_KIB, _MIB = 1 << 10, 1 << 20
_WARPS_PER_CTA = 8


def command(
    gpu: GpuName,
    overrides: Overrides = [],  # noqa: B006 -- Typer makes a new list for each run
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE.csv", help=OUTPUT_HELP)
    ] = None,
) -> None:
    """Measure the latency and bandwidth of each level of a GPU in the timing model."""
    from experiments.console import progress
    from experiments.output import output_file, write_text
    from experiments.tables import print_table

    if output is not None:
        output_file(output, ".csv")
    from cachesim import presets
    from cachesim.first_use import compile_loops

    machine = presets.load(gpu, overrides)
    names = levels_of(machine)
    rows = []
    with progress("compiling the simulator", 1 + 2 * len(names)) as bar:
        compile_loops(lane_address=True, timing=True)
        bar.advance()
        for level in names:
            bar.describe(f"chasing and streaming in {level}")
            latency = latency_of(machine, level)
            bar.advance()
            rows.append((level, latency, bandwidth_of(machine, level)))
            bar.advance()
    frame = microbench_frame(machine, rows)
    if output is not None:
        write_text(output, frame.to_csv(index=False))
    print_table(microbench_table(frame, machine))


def levels_of(gpu: Gpu) -> list[str]:
    """The levels that a GPU has, the nearest first."""
    return [name for name in LEVELS if name == "dram" or getattr(gpu, name) is not None]


def latency_of(gpu: Gpu, level: str, num_loads: int = 300) -> float:
    """Core cycles from a lone load that finds its data in `level` to the next that depends on it.

    Raises:
        InputError: a GPU that timing cannot run.
    """
    from traces.microbench import chase

    footprint = _footprint(gpu, level)
    if level in ("l1", "gl1"):
        trace = chase(footprint, num_loads, "self")
    elif level == "dram":
        trace = chase(footprint, num_loads, "rest")
    else:
        # Slices are hashed: one of them may hold less than its share of half the L2's capacity.
        trace = chase(min(footprint, _MIB) if level == "l2" else footprint, num_loads, "whole")
    runs = _run(trace, gpu)
    return (runs["twice"].cycles - runs["once"].cycles) / num_loads


def bandwidth_of(gpu: Gpu, level: str, loads_per_warp: int = 8, num_waves: int = 0) -> float:
    """Bytes per core cycle that a kernel streams out of one SM's L1, one GL1, or all of another
    level, its start and end included.

    num_waves: as many warps as the machine holds, so many times; 0 = enough for a steady state.

    Raises:
        InputError: a GPU that timing cannot run.
    """
    from cachesim.presets import with_fields
    from traces.microbench import stream

    if level in ("l1", "gl1"):
        sharers = gpu.gl1.sms_per_instance if level == "gl1" and gpu.gl1 else 1
        gpu = with_fields(gpu, {"sm.count": sharers})
    waves = num_waves or {"l1": 24, "gl1": 16}.get(level, 4)
    trace = stream(
        1024 * _MIB if level == "dram" else _footprint(gpu, level),
        gpu.sm.count * gpu.sm.max_warps // _WARPS_PER_CTA * _WARPS_PER_CTA,
        loads_per_warp,
        waves,
        is_warm=level != "dram",
        # Warps that walk through a GL1's footprint by their CTA's width leave nothing in an L0.
        shift=_WARPS_PER_CTA if level == "gl1" else None,
    )
    run = _run(trace, gpu)["stream"]
    return run.levels[level].bytes / (run.cycles - run.launch_cycles)


def _footprint(gpu: Gpu, level: str) -> int:
    """Bytes that fit into a level, and not into the one before it."""
    if level == "l1":
        return min(8 * _KIB, gpu.l1.capacity // 2)
    if level == "gl1":
        assert gpu.gl1 is not None
        return gpu.gl1.capacity // 2
    if level == "l2":
        return gpu.l2.capacity // 2
    if level == "llc":
        assert gpu.llc is not None
        return min(3 * gpu.l2.capacity, gpu.llc.capacity // 2)
    return 64 * _MIB


def _run(trace: Trace, gpu: Gpu) -> dict[str, PassTiming]:
    """The timing of a benchmark's passes, by name."""
    from cachesim import simulate

    report = simulate(trace, gpu, fetch_path="readonly", timing=True)
    assert report.timing is not None
    return {one.name: one for one in report.timing.passes}


def microbench_frame(gpu: Gpu, rows: list[tuple[str, float, float]]) -> pd.DataFrame:
    """One row per level. rows: (level, latency in cycles, bytes per cycle)."""
    import pandas as pd

    from experiments.microbench_figures import BANDWIDTH, LATENCY

    found = []
    for level, cycles, moved in rows:
        latency, bandwidth = LATENCY.get((gpu.name, level)), BANDWIDTH.get((gpu.name, level))
        rate = moved * gpu.clock_hz / 1e9 if level == "dram" else moved
        found.append(
            {
                "level": level,
                "latency_cycles": cycles,
                "known_latency": latency and latency.value,
                "latency_error_percent": latency and 100 * (cycles / latency.value - 1),
                "bandwidth": rate,
                "unit": {"l1": "B/cycle/SM", "gl1": "B/cycle/GL1", "dram": "GB/s"}.get(
                    level, "B/cycle"
                ),
                "known_bandwidth": bandwidth and bandwidth.value,
                "bandwidth_error_percent": bandwidth and 100 * (rate / bandwidth.value - 1),
                "known_is": bandwidth and ("peak" if bandwidth.is_peak else "attained"),
                "latency_source": latency and latency.source,
                "bandwidth_source": bandwidth and bandwidth.source,
            }
        )
    return pd.DataFrame(found)


def microbench_table(frame: pd.DataFrame, gpu: Gpu) -> Table:
    """What is printed of `microbench_frame`."""
    from experiments.tables import Column, Table

    notes = [
        f"{row.level}: {kind} from {source}."
        for row in frame.itertuples()
        for kind, source in (("latency", row.latency_source), ("bandwidth", row.bandwidth_source))
        if isinstance(source, str)
    ]
    return Table(
        f"Latency and bandwidth of {gpu.name}'s levels",
        frame,
        (
            Column("level", "level"),
            Column("latency_cycles", "cycles", ".1f"),
            Column("known_latency", "card", "g", numeric=True),
            Column("latency_error_percent", "error %", "+.1f", numeric=True),
            Column("bandwidth", "bandwidth", ",.1f"),
            Column("unit", "unit"),
            Column("known_bandwidth", "card", ",g", numeric=True),
            Column("bandwidth_error_percent", "error %", "+.1f", numeric=True),
            Column("known_is", "card is"),
        ),
        tuple(notes),
    )
