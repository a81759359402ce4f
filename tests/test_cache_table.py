"""The chapter 4 table: end to end at a tiny size, and what it says of each fetch path."""

from pathlib import Path

import pandas as pd
import pytest

from cachesim import presets
from experiments import cache_table_study as study
from experiments.cli import run_command
from experiments.tables import markdown

GPU = "titan-x-pascal-gpgpusim"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder that `cachesim cache-table` filled at 64x36."""
    folder = tmp_path_factory.mktemp("cache-table")
    assert run_command(["cache-table", "--size", "64x36", "--frames", "6", "-o", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def totals(finished):
    keys = ["fetch_path", "mips", "passes", "method"]
    return pd.read_csv(finished / "cache-table.csv").set_index(keys).sort_index()


@pytest.mark.opencl
def test_there_are_two_tables_and_three_bar_charts_per_fetch_path(finished: Path):
    names = {f"cache-table{t}{s}" for t in ("", "-mips") for s in (".csv", ".md", ".tex")}
    names |= {f"cache-table-{p}{s}" for p in study.FETCH_PATHS for s in (".png", ".pdf")}
    assert names == {p.name for p in finished.iterdir()}


@pytest.mark.opencl
def test_plain_loads_ask_nothing_of_the_l1_and_the_table_says_so(finished: Path, totals):
    of_global = totals.loc["global"]
    assert (of_global["l1_accesses"] == 0).all() and of_global["l1_miss_rate"].isna().all()
    for path in ("texture", "readonly"):
        assert (totals.loc[path, "l1_accesses"] > 0).all()
    notes = (finished / "cache-table.md").read_text()
    assert "global: the L1 columns mean nothing" in notes
    assert "91,541 vs 151,356" in notes and "no reproduction" in notes


@pytest.mark.opencl
def test_what_bypasses_the_l1_is_asked_of_the_l2(totals):
    # Without an L1 the L2 is asked for every sector that an L1 is asked for elsewhere.
    for method in study.METHODS:
        key = ("Eq 5.12", "frame", method)
        assert (
            totals.loc[("global", *key), "l2_accesses"]
            == (totals.loc[("readonly", *key), "l1_accesses"])
        )


@pytest.mark.opencl
def test_adaptive_asks_less_in_the_sampling_pass_and_takes_hardly_more_cycles(totals):
    # So small a frame takes as long as its hungriest warp, which has 64 samples either way.
    sampling = totals.xs("sampling", level="passes")
    fixed, adaptive = (sampling.xs(m, level="method") for m in study.METHODS)
    assert (adaptive["cycles"] < 1.02 * fixed["cycles"]).all()
    assert (adaptive["l2_accesses"] <= fixed["l2_accesses"]).all()
    whole = totals.xs("frame", level="passes")
    assert (whole["cycles"] > sampling["cycles"]).all()


@pytest.mark.opencl
def test_mips_and_the_other_textures_sum_to_the_frame(finished: Path, totals):
    mips = pd.read_csv(finished / "cache-table-mips.csv")
    names = ["l1_accesses", "l1_misses", "l2_accesses", "l2_misses"]
    sums = mips.groupby(["fetch_path", "method"])[names].sum()
    frame = totals.xs("Eq 5.12", level="mips").xs("frame", level="passes")
    for key in sums.index:
        assert (sums.loc[key] == frame.loc[key, names]).all()


def made_totals():
    rows = [
        {
            "fetch_path": "global", "mips": "Eq 5.12", "passes": passes, "method": method,
            "cycles": cycles, "l1_accesses": 0, "l1_misses": 0, "l1_miss_rate": None,
            "l2_accesses": cycles * 2, "l2_misses": cycles, "l2_miss_rate": rate, "dram_bytes": 1,
        }
        for passes in study.PASSES
        for method, cycles, rate in (("fixed", 1000, 0.2), ("adaptive", 250, 0.5))
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_ratios_are_adaptive_over_fixed_and_missing_where_nothing_was_asked():
    ratios = study.ratio_rows(made_totals())
    assert (ratios["cycles"] == 0.25).all() and (ratios["l2_miss_rate"] == 2.5).all()
    assert ratios["l1_accesses"].isna().all() and ratios["l1_miss_rate"].isna().all()
    frame, sampling, why = study.findings(ratios)
    assert frame.startswith("Adaptive / fixed of the frame: Cycles 0.25 to 0.25 (lower in all)")
    assert "L2 miss rate 2.50 to 2.50 (lower in 0 of 1)" in sampling and "L1" not in sampling
    assert "no first touches" in why


def test_the_table_shows_a_dash_where_there_is_no_rate():
    table = study.totals_table(made_totals(), presets.load(GPU), "made")
    assert [row["l1_miss_rate"] for _, row in table.frame.iterrows()] == ["-"] * 6
    assert "| ratio    |  0.250 |" in markdown(table)


def test_each_fetch_path_has_its_word_on_the_l1():
    gpgpusim, card = presets.load(GPU), presets.load("titan-x-pascal")
    assert "separate texture L1" in study.l1_verdict(gpgpusim, "texture", 5)
    assert "through which these loads go" in study.l1_verdict(card, "texture", 5)
    assert "L1 data cache" in study.l1_verdict(gpgpusim, "readonly", 5)
    assert "mean nothing" in study.l1_verdict(gpgpusim, "global", 0)
    on = presets.load(GPU, ["l1.bypass_loads=false"])
    assert "through which these loads go" in study.l1_verdict(on, "global", 5)
