"""The traces that Accel-Sim was run on: ours are the runs' own, and agree with their numbers."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from traces.check import check
from traces.errors import InputError
from traces.oracle_traces import ORACLE_TRACES, oracle_trace

RESULTS = Path(__file__).parent / "oracles" / "accel-sim" / "results.csv"
#: Where the runs' own generator is, beside the checkout.
GENERATOR = Path(__file__).resolve().parents[2] / "shared/oracles/accel-sim/traces.py"


@pytest.fixture(scope="module")
def results() -> pd.DataFrame:
    return pd.read_csv(RESULTS).set_index(["config", "trace"])


def generator() -> ModuleType:
    """The program that made the traces of the runs."""
    spec = importlib.util.spec_from_file_location("accel_sim_generator", GENERATOR)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(not GENERATOR.exists(), reason=f"{GENERATOR} is not beside the repository")
def test_traces_are_those_of_the_runs_bit_for_bit() -> None:
    theirs = generator().TRACES
    assert list(theirs) == list(ORACLE_TRACES)
    for name, make in theirs.items():
        fields = {"stores": None} | make()
        ours = vars(ORACLE_TRACES[name]())
        assert set(ours) == set(fields), name
        for field, value in fields.items():
            assert np.array_equal(ours[field], value), (name, field)


def test_every_trace_was_run_under_every_config(results: pd.DataFrame) -> None:
    assert set(results.index.get_level_values("trace")) == set(ORACLE_TRACES)
    assert len(results) == len(ORACLE_TRACES) * 3
    assert results.index.is_unique


@pytest.mark.parametrize("name", ORACLE_TRACES)
def test_a_trace_has_the_runs_sectors_and_instructions(name: str, results: pd.DataFrame) -> None:
    """Distinct 32 B sectors of every load and store; an integer instruction, the accesses, their
    FMAs and the exit of every warp.
    """
    made = ORACLE_TRACES[name]()
    sectors = np.sort(made.addresses // np.uint64(32), axis=2)
    distinct = (np.diff(sectors, axis=2, prepend=np.uint64(0)) != 0).sum(axis=2)
    stores = np.zeros(distinct.shape[1], bool) if made.stores is None else made.stores
    num_warps, num_loads = len(distinct), int((~stores).sum())
    issued = num_warps * (2 + len(stores) + num_loads * made.compute_per_load)
    for config in ("SM6_TITANX_L1", "SM75_RTX2060"):
        theirs = results.loc[config, name]
        assert distinct[:, ~stores].sum() == theirs["l1_accesses"]
        assert distinct[:, stores].sum() == theirs["l1_writes"]
        assert issued == theirs["warp_instructions"]


def test_an_oracle_trace_is_sound() -> None:
    trace = oracle_trace("blur16_store")
    assert check(trace).num_rows == 4096 * 8
    assert trace.manifest["name"] == "blur16_store"
    with pytest.raises(InputError, match="unknown oracle trace 'strem'; did you mean 'stream'"):
        oracle_trace("strem")
