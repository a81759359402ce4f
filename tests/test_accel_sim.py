"""Accel-Sim's own counters for traces that both read: sectors asked of the L1, and of the L2 where
loads skip the L1.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from cachesim import presets, simulate
from traces.oracle_traces import oracle_trace
from traces.trace import Trace

RESULTS = Path(__file__).parent / "oracles" / "accel-sim" / "results.csv"
#: Small ones: no reuse, one warp, one line for all, scattered reads with stores, wide scatter.
NAMES = ("stream", "chase", "latency_l1", "l1_throughput", "blur16_store", "far200_morton")


@functools.cache
def trace_of(name: str) -> Trace:
    return oracle_trace(name)


def result(config: str, name: str) -> dict[str, Any]:
    table = pd.read_csv(RESULTS)
    (row,) = table[(table["config"] == config) & (table["trace"] == name)].to_dict("records")
    return row


@pytest.mark.parametrize("name", NAMES)
def test_l1_accesses_are_accel_sims(name: str) -> None:
    """Distinct 32 B sectors per warp load; stores are counted apart there."""
    for config, gpu in (
        ("SM6_TITANX_L1", "titan-x-pascal-gpgpusim"),
        ("SM75_RTX2060", "rtx-2060-gpgpusim"),
    ):
        theirs = result(config, name)
        l1 = simulate(trace_of(name), gpu, fetch_path="readonly").counters["l1"]
        assert l1.accesses - l1.writes == theirs["l1_accesses"], config
        assert l1.writes == theirs["l1_writes"], config


@pytest.mark.parametrize("name", NAMES)
def test_l2_accesses_are_accel_sims_where_loads_skip_the_l1(name: str) -> None:
    theirs = result("SM6_TITANX", name)
    trace = trace_of(name)
    assert presets.load("titan-x-pascal-gpgpusim").lane_address_path == "global"
    report = simulate(trace, "titan-x-pascal-gpgpusim")
    l1, l2 = report.counters["l1"], report.counters["l2"]
    assert l1.accesses == theirs["l1_accesses"] == 0
    assert l2.accesses - l2.writes == theirs["l2_accesses"]
    assert l2.writes == theirs["l2_writes"]


@pytest.mark.parametrize("name", ["stream", "chase", "latency_l1", "l1_throughput"])
def test_dram_reads_are_accel_sims_where_the_l2_holds_everything(name: str) -> None:
    """Without stores and with a footprint below 3 MiB, or without reuse, order does not matter."""
    theirs = result("SM6_TITANX", name)
    assert (
        simulate(trace_of(name), "titan-x-pascal-gpgpusim").dram.sectors_read
        == theirs["dram_reads"]
    )
