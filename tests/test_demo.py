"""The studies end to end at a tiny size, and the sentences under their tables."""

import csv
import json
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from experiments.cli import run_command

SCENES, GPUS = ["close", "front"], ["titan-x-pascal", "rx-5700-xt"]


def read(path: Path) -> pd.DataFrame:
    return pd.read_csv(path)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `cachesim demo` filled at 96x54."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    arguments = ["demo", "--size", "96x54", "--scenes", ",".join(SCENES), "--gpus", ",".join(GPUS)]
    assert run_command([*arguments, "-o", str(folder)]) == 0
    return folder


@pytest.mark.opencl
def test_the_demo_writes_every_result(demo: Path) -> None:
    names = {f"{t}{s}" for t in ("quality", "demand", "mips") for s in (".csv", ".md", ".tex")}
    names |= {f"{f}{s}" for f in ("demand", "miss-rates", "mips") for s in (".png", ".pdf")}
    for scene in SCENES:
        names |= {f"{scene}-{p}.png" for p in ("unscattered", "fixed", "adaptive")}
        names |= {f"{scene}-adaptive-blended.png", f"{scene}-adaptive-counts.png"}
    assert names | {"ratios.csv"} == {p.name for p in demo.iterdir()}


@pytest.mark.opencl
def test_adaptive_reads_fewer_texels_than_fixed_on_every_scene(demo: Path) -> None:
    ratios = read(demo / "ratios.csv")
    assert set(zip(ratios["scene"], ratios["gpu"], strict=True)) == {
        (scene, gpu) for scene in SCENES for gpu in GPUS
    }
    # Frame 7: the counts have settled, the mean changes by less than a twentieth afterwards.
    assert (ratios["lane_fetches"] < 1).all()
    assert (ratios["l1_bytes"] < 1).all()


@pytest.mark.opencl
def test_ratios_are_those_of_the_demand_table(demo: Path) -> None:
    demand = read(demo / "demand.csv").set_index(["scene", "gpu", "passes", "method"])
    for _, row in read(demo / "ratios.csv").iterrows():
        key = (row["scene"], row["gpu"], row["passes"])
        fixed, adaptive = demand.loc[(*key, "fixed")], demand.loc[(*key, "adaptive")]
        for name in ("lane_fetches", "l1_bytes", "l2_bytes", "dram_bytes", "l1_miss_rate"):
            assert row[name] == pytest.approx(adaptive[name] / fixed[name])


@pytest.mark.opencl
def test_the_parts_of_the_mip_table_sum_to_the_totals(demo: Path) -> None:
    names = ["lane_fetches", "l1_bytes", "l2_bytes", "dram_bytes"]
    keys = ["scene", "gpu", "method"]
    demand = read(demo / "demand.csv")
    totals = demand[demand["passes"] == "all"].set_index(keys)[names].sort_index()
    mips = read(demo / "mips.csv").groupby(keys)[names].sum().sort_index()
    pd.testing.assert_frame_equal(totals, mips)


@pytest.mark.opencl
def test_more_samples_are_nearer_to_the_reference(demo: Path) -> None:
    quality = read(demo / "quality.csv")
    assert (quality["samples_fixed"] == 64).all()
    assert quality["samples_adaptive"].between(8, 64).all()
    assert (quality["psnr_fixed_db"] > quality["psnr_adaptive_db"]).all()
    assert (quality["psnr_accumulated_db"] > quality["psnr_adaptive_db"]).all()
    assert (quality["psnr_adaptive_db"] > 25).all()


@pytest.mark.opencl
def test_the_tables_state_frame_resolution_and_paper(demo: Path) -> None:
    assert "frame 7, after 7 frames of history" in (demo / "quality.md").read_text()
    notes = (demo / "demand.md").read_text()
    assert "depend on the resolution: at 96x54" in notes
    assert "as the paper shows" in notes or "Disagrees with the paper" in notes
    for name in ("quality", "demand", "mips"):
        assert r"\begin{tabular}" in (demo / f"{name}.tex").read_text()


@pytest.mark.opencl
def test_the_pictures_are_of_the_frame_size_and_not_blank(demo: Path) -> None:
    for scene in SCENES:
        for kind in ("unscattered", "fixed", "adaptive", "adaptive-blended"):
            picture = Image.open(demo / f"{scene}-{kind}.png")
            assert picture.size == (96, 54)
            assert len(picture.getcolors(96 * 54) or ()) > 100


@pytest.mark.opencl
def test_the_demo_prints_its_times_and_fits_a_hundred_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["demo", "--size", "48x27", "--scenes", "front", "--gpus", "titan-x-pascal"]
    assert run_command([*arguments, "-o", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "s on two cores" in said.err and "reference, 1024 samples" in said.err
    assert said.err.strip().splitlines()[-1].startswith("total ")
    assert max(map(len, said.out.splitlines())) <= 100
    assert "…" not in said.out


@pytest.mark.opencl
def test_prefilter_states_the_effect_per_scene_count_plane_and_scale(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["prefilter", "--scenes", "close", "--size", "128x72", "--counts", "8,64"]
    assert run_command([*arguments, "-o", str(tmp_path)]) == 0
    frame = read(tmp_path / "prefilter.csv")
    keys = set(zip(frame["scale"], frame["count"], frame["planes"], strict=True))
    assert keys == {
        (scale, count, planes)
        for scale in ("legacy", "physical")
        for count in (8, 64)
        for planes in ("irradiance", "all")
    }
    # Eq 5.12: fewer samples and a wider scatter mean coarser levels.
    level = frame[frame["planes"] == "irradiance"].set_index(["scale", "count"])["mean_level"]
    assert level["legacy", 8] > level["legacy", 64]
    assert level["legacy", 8] > level["physical", 8]
    assert "Eq 5.12" in capsys.readouterr().out


@pytest.mark.opencl
def test_a_recorded_file_counts_like_the_live_recording(tmp_path: Path) -> None:
    from cachesim import simulate
    from kernels.method import Method
    from kernels.record import record
    from kernels.scene import load_scene
    from traces.open import open_trace

    path = tmp_path / "ear.parquet"
    arguments = ["--scene", "ear", "--method", "adaptive", "--frames", "3", "--size", "96x54"]
    assert run_command(["record", *arguments, "-o", str(path)]) == 0
    live = record(load_scene("ear", 96, 54), Method(kind="adaptive"), num_frames=3)
    counted = [simulate(trace, "rtx-2080-ti") for trace in (open_trace(path), live)]
    # JSON, as the file's manifest has lists where the live one has tuples.
    assert len({json.dumps(report.to_json()) for report in counted}) == 1


@pytest.mark.opencl
def test_render_writes_three_pictures(tmp_path: Path) -> None:
    arguments = ["render", "--scene", "side", "--size", "64x36", "--frames", "2"]
    assert run_command([*arguments, "-o", str(tmp_path)]) == 0
    names = ["side-adaptive-counts.png", "side-adaptive.png", "side-preview.png"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names


def test_findings_name_where_the_paper_is_contradicted() -> None:
    from experiments.adaptive_tables import findings

    names = ["l1_bytes", "l2_bytes", "dram_bytes", "l1_miss_rate", "l2_miss_rate"]
    rows = [
        {"scene": scene, "gpu": gpu, "passes": passes, **dict.fromkeys(names, 0.5)}
        for scene in ("close", "front")
        for gpu in ("a", "b")
        for passes in ("all", "sampling")
    ]
    ratios = pd.DataFrame(rows)
    agreeing = " ".join(findings(ratios, "960x540"))
    assert "Disagrees" not in agreeing and "Higher" not in agreeing
    front = (ratios["scene"] == "front") & (ratios["passes"] == "all")
    ratios.loc[front, ["dram_bytes", "l2_bytes"]] = 1.5
    ratios.loc[front & (ratios["gpu"] == "b"), "l2_miss_rate"] = 2.0
    told = findings(ratios, "960x540")
    # The paper shows L1 and L2 demand, no DRAM traffic.
    disagreeing = [line for line in told if "Disagrees" in line]
    assert [line[:9] for line in disagreeing] == ["L2 demand"]
    for line in disagreeing + [line for line in told if line.startswith("DRAM demand")]:
        assert "0.50 to 1.50" in line and "front on all GPUs" in line and "close on" not in line
    rate = next(line for line in told if line.startswith("L2 miss rate"))
    assert "Higher for adaptive: front on b." in rate


def test_bench_tables_carry_the_machine_and_the_aims() -> None:
    from experiments.bench import figures_table, machine_line

    row = {
        "measured": "stream close",
        "lane_fetches_m": 1.0,
        "seconds": 2.0,
        "requests_m_per_s": 3.0,
        "peak_gib": 0.5,
        "bytes_per_fetch": None,
    }
    table = figures_table(pd.DataFrame([row]))
    assert machine_line() in table.notes and "cores" in machine_line()


@pytest.mark.opencl
@pytest.mark.slow
def test_bench_quick_measures_everything(tmp_path: Path) -> None:
    assert run_command(["bench", "--quick", "-o", str(tmp_path / "bench")]) == 0
    with (tmp_path / "bench.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [r["measured"].split()[0] for r in rows] == ["stream"] * 2 + ["pipeline"] * 2 + [
        "file"
    ] * 2
    assert all(float(r["requests_m_per_s"]) > 1 for r in rows[:2])
    assert all(0 < float(r["bytes_per_fetch"]) < 4 for r in rows[4:])
