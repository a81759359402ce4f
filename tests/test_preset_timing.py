"""The hardware presets' timing tables hold what is known of their cards."""

import re
from math import ceil
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from cachesim import presets, simulate
from cachesim.config import Gpu
from cachesim.timing_config import CacheTiming, DramTiming, Icnt, L1Timing, L2Timing, SmTiming
from experiments.microbench import bandwidth_of, latency_of
from traces.lane_address import lane_address_trace
from traces.synthetic import gather
from traces.texture import Texture

BASE = 0x7F40_0000_0000

#: Published peak of the memory (makers' specifications): GB/s, and its size in GiB.
MEMORY = {
    "titan-x-pascal": (480.0, 12),
    "quadro-p4000": (243.0, 8),
    "rtx-2060": (336.0, 6),
    "rtx-2080-ti": (616.0, 11),
    "rx-5700-xt": (448.0, 8),
    "rx-6900-xt": (512.0, 16),
    "h100-sxm": (3350.0, 80),
    "h200": (4800.0, 144),
}
#: Peak bytes per core cycle of the whole L2: 32 B in each half of a Pascal's or Turing's partition
#: (1536 B on a TITAN V's 48), 64 and 128 B per slice of Navi 10 and 21, 64 B per slice of a GH100.
L2_BYTES_PER_CYCLE = {
    "titan-x-pascal": 768,
    "quadro-p4000": 512,
    "rtx-2060": 768,
    "rtx-2080-ti": 1408,
    "rx-5700-xt": 1024,
    "rx-6900-xt": 2048,
    "h100-sxm": 5120,
    "h200": 6144,
}
#: Load-to-use latency in core cycles as measured or published, lowest and highest: the sources are
#: those in the head of each preset.
LATENCIES = {
    "titan-x-pascal": {"l1": (80, 82), "l2": (216, 238), "dram": (430, 480)},
    "quadro-p4000": {"l1": (80, 82), "l2": (216, 238), "dram": (430, 480)},
    "rtx-2060": {"l1": (32, 32), "l2": (226, 236), "dram": (472, 472)},
    "rtx-2080-ti": {"l1": (32, 32), "l2": (226, 236), "dram": (472, 472)},
    "rx-5700-xt": {"l1": (73, 73), "gl1": (123, 123), "l2": (220, 227)},
    "rx-6900-xt": {"l1": (73, 73), "gl1": (123, 123), "l2": (220, 227), "llc": (407, 423)},
    "h100-sxm": {"l1": (32, 34), "l2": (280, 280), "dram": (680, 689)},
    "h200": {"l1": (32, 34), "l2": (280, 280), "dram": (680, 689)},
}
TABLES: dict[str, type[BaseModel]] = {
    "sm_timing": SmTiming,
    "l1_timing": L1Timing,
    "gl1_timing": CacheTiming,
    "icnt": Icnt,
    "l2_timing": L2Timing,
    "llc_timing": CacheTiming,
    "dram_timing": DramTiming,
}
every_preset = pytest.mark.parametrize("name", sorted(MEMORY))


def test_the_hardware_presets_are_all_here() -> None:
    assert [name for name in presets.names() if not name.endswith("-gpgpusim")] == sorted(MEMORY)


@every_preset
def test_every_level_has_its_timing_table(name: str) -> None:
    gpu = presets.load(name)
    given = {table for table in TABLES if getattr(gpu, table) is not None}
    expected = set(TABLES) - {f"{lv}_timing" for lv in ("gl1", "llc") if getattr(gpu, lv) is None}
    assert given == expected
    assert gpu.l1_texture_timing is None


@every_preset
def test_every_timing_field_has_a_source_and_what_is_unknown_says_assumed(name: str) -> None:
    entries = presets.sources(name)
    for table, model in TABLES.items():
        if getattr(presets.load(name), table) is None:
            continue
        for field in model.model_fields:
            entry = entries[f"{table}.{field}"]
            assert entry.source != "assumed: the model's default", f"{field} is not in the file"
            assert (entry.confidence == "?") == entry.source.startswith("assumed: "), field
    assumed = {path for path, entry in entries.items() if entry.confidence == "?"}
    assert {"l1_timing.num_mshrs", "l2_timing.queue_in"} <= assumed  # nobody has published these


@every_preset
def test_an_assumed_number_may_be_doubled_and_halved(name: str) -> None:
    """The sensitivity table does so; what depends on another field is left out of it."""
    gpu = presets.load(name)
    for path, entry in presets.sources(name).items():
        table, _, field = path.partition(".")
        is_number = isinstance(entry.value, int) and not isinstance(entry.value, bool)
        if table not in TABLES or entry.confidence != "?" or not is_number:
            continue
        for value in (2 * entry.value, ceil(entry.value / 2)):
            changed = presets.with_fields(gpu, {path: value})
            assert getattr(getattr(changed, table), field) == value


# ---- bandwidth


def dram_bytes_per_second(gpu: Gpu) -> float:
    """Peak of all channels together; the last cache level has one slice group per channel."""
    assert gpu.dram_timing is not None
    channels = (gpu.llc or gpu.l2).num_channels
    dram = gpu.dram_timing
    return channels * dram.bus_bytes * dram.data_rate * dram.clock_hz


@every_preset
def test_the_memory_has_the_published_bandwidth_and_size(name: str) -> None:
    gpu = presets.load(name)
    bandwidth, size_gib = MEMORY[name]
    assert dram_bytes_per_second(gpu) == pytest.approx(bandwidth * 1e9, rel=0.01)
    assert gpu.dram_timing is not None
    bits = gpu.dram_timing.address_map.partition(";")[2].replace(".", "").lstrip("0")
    # A channel's part is a power of two, which six stacks of 24 GB do not fill.
    channels = (gpu.llc or gpu.l2).num_channels
    assert 1 << len(bits) == 1 << ((size_gib << 30) // channels - 1).bit_length()


@every_preset
def test_one_burst_is_the_atom_and_can_follow_the_last(name: str) -> None:
    gpu = presets.load(name)
    dram = gpu.dram_timing
    assert dram is not None
    assert dram.atom_bytes == gpu.dram.sector_bytes
    assert dram.ccd == dram.burst_cycles  # the data bus can be full
    assert dram.address_map.endswith("S" * (dram.atom_bytes.bit_length() - 1))


@every_preset
def test_the_memory_devices_timing_is_that_of_dram_in_nanoseconds(name: str) -> None:
    """The array of a DRAM takes the same time in every standard since GDDR5 (data sheets)."""
    dram = presets.load(name).dram_timing
    assert dram is not None
    typical = {
        "rcd": (11, 16),
        "rp": (11, 16),
        "cl": (11, 16),
        "ras": (27, 33),
        "rc": (40, 47),
        "rrd": (2, 7),
        "wr": (11, 16),
        "cdlr": (3.5, 6),
    }
    for field, (low, high) in typical.items():
        nanoseconds = getattr(dram, field) / dram.clock_hz * 1e9
        assert low <= nanoseconds <= high, (field, nanoseconds)
    assert abs(dram.rc - dram.ras - dram.rp) <= 1
    assert dram.ccdl > dram.ccd


@every_preset
def test_the_l2_has_its_cards_peak_bandwidth(name: str) -> None:
    gpu = presets.load(name)
    assert gpu.l2_timing is not None
    per_second = gpu.l2.num_slices * gpu.l2_timing.port_bytes * gpu.l2_timing.clock_hz
    assert per_second / gpu.clock_hz == pytest.approx(L2_BYTES_PER_CYCLE[name])


def test_navi_21s_caches_have_their_peak_bandwidths() -> None:
    """GL1: 256 B a cycle and array; Infinity Cache: 1024 B a cycle of a 1.94 GHz fabric."""
    gpu = presets.load("rx-6900-xt")
    assert gpu.gl1_timing is not None and gpu.llc is not None and gpu.llc_timing is not None
    assert gpu.gl1_timing.port_bytes * gpu.gl1_timing.clock_hz == 256 * gpu.clock_hz
    llc = gpu.llc.num_slices * gpu.llc_timing.port_bytes * gpu.llc_timing.clock_hz
    assert llc == pytest.approx(1.99e12, rel=0.01)


@every_preset
def test_misses_in_flight_cover_the_bandwidth_below(name: str) -> None:
    """Little's law: misses x bytes >= bandwidth x latency, so that no MSHR binds a stream."""
    gpu, totals = presets.load(name), unloaded_latencies(name)
    assert gpu.l1_timing is not None and gpu.l2_timing is not None
    l1_bytes = gpu.sm.count * gpu.l1.units_per_sm * gpu.l1_timing.num_mshrs * gpu.l1.sector_bytes
    assert l1_bytes >= L2_BYTES_PER_CYCLE[name] * (totals["l2"] - totals["l1"])
    last, timing = (gpu.llc, gpu.llc_timing) if gpu.llc else (gpu.l2, gpu.l2_timing)
    assert timing is not None
    in_flight = last.num_slices * timing.num_mshrs * last.sector_bytes
    per_cycle = dram_bytes_per_second(gpu) / gpu.clock_hz
    assert in_flight >= per_cycle * (totals["dram"] - totals["llc" if gpu.llc else "l2"])


@every_preset
def test_queues_hold_what_their_latency_keeps_in_flight(name: str) -> None:
    gpu = presets.load(name)
    assert gpu.icnt is not None
    for level in ("gl1", "l2", "llc"):
        cache, timing = getattr(gpu, level), getattr(gpu, f"{level}_timing")
        if cache is None:
            continue
        per_cycle = timing.port_bytes * timing.clock_hz / gpu.clock_hz / cache.sector_bytes
        assert timing.queue_in > timing.latency_cycles * per_cycle, level
    packet = gpu.l2.sector_bytes + gpu.icnt.header_bytes
    in_flight = gpu.icnt.reply_latency_cycles * gpu.icnt.flit_bytes / packet
    assert gpu.icnt.output_packets > 2 * in_flight


# ---- latency


def unloaded_latencies(name: str) -> dict[str, int]:
    """Core cycles of a lone load that hits each level: the tables' latencies and the pipeline's own
    stages (one cycle each to leave the miss queue, cross a network, look up, answer; two to fill).
    In the memory another row is open.
    """
    gpu = presets.load(name)
    sm, l1, l2, icnt, dram = (
        gpu.sm_timing, gpu.l1_timing, gpu.l2_timing, gpu.icnt, gpu.dram_timing
    )  # fmt: skip
    assert sm and l1 and l2 and icnt and dram
    totals = {"l1": sm.memory_cycles + l1.latency_cycles}
    totals["l2"] = (
        totals["l1"] + 9 + icnt.request_latency_cycles + icnt.reply_latency_cycles
        + l2.latency_cycles
    )  # fmt: skip
    if gpu.gl1_timing:
        totals["gl1"] = totals["l1"] + 6 + gpu.gl1_timing.latency_cycles
        totals["l2"] += gpu.gl1_timing.latency_cycles + 4
    last = totals["l2"]
    if gpu.llc_timing:
        last = totals["llc"] = totals["l2"] + 5 + gpu.llc_timing.latency_cycles
    # The bursts of one sector follow each other in one bank.
    more = ((gpu.llc or gpu.l2).sector_bytes // dram.atom_bytes - 1) * dram.ccdl
    commands = (dram.rp + dram.rcd + dram.cl + more + 4) * gpu.clock_hz / dram.clock_hz
    totals["dram"] = last + dram.fixed_latency_cycles + round(commands)
    return totals


@every_preset
def test_the_stages_sum_to_the_measured_latencies(name: str) -> None:
    totals = unloaded_latencies(name)
    for level, (low, high) in LATENCIES[name].items():
        assert 0.95 * low <= totals[level] <= 1.05 * high, (level, totals[level])


@every_preset
def test_the_sums_in_a_presets_head_are_those_of_its_tables(name: str) -> None:
    path = Path(presets.__file__).parent / f"{name}.toml"
    head = path.read_text(encoding="utf-8").partition("\nname")[0]
    told = {level: int(total) for level, total in re.findall(r"^#   (\w+) .*= +(\d+)", head, re.M)}
    rename = {"L0": "l1", "L1": "l1", "GL1": "gl1", "L2": "l2", "LLC": "llc", "memory": "dram"}
    assert {rename[level]: total for level, total in told.items()} == unloaded_latencies(name)


@pytest.mark.parametrize(("name", "clock_hz"), [("rx-5700-xt", 1.755e9), ("rx-6900-xt", 2.015e9)])
def test_memory_is_150_ns_beyond_the_last_cache_of_an_amd_card(name: str, clock_hz: float) -> None:
    totals = unloaded_latencies(name)
    beyond = totals["dram"] - totals.get("llc", totals["l2"])
    assert beyond / clock_hz == pytest.approx(150e-9, rel=0.02)


# ---- on the machine itself


@every_preset
def test_a_chase_takes_the_sum_of_the_stages_at_every_level(name: str) -> None:
    gpu = presets.load(name)
    for level, total in unloaded_latencies(name).items():
        # A memory access waits for the edge of its clock, and may find its row open.
        allowed = 0.02 * total if level == "dram" else 0.01
        assert latency_of(gpu, level, 100) == pytest.approx(total, abs=allowed), level


def test_a_chase_on_navi_21_reads_what_silicon_does() -> None:
    gpu = presets.load("rx-6900-xt")
    for level, cycles in {"l1": 73, "gl1": 123, "l2": 220, "llc": 415}.items():
        assert latency_of(gpu, level, 100) == pytest.approx(cycles, rel=0.05), level


@pytest.mark.parametrize(
    ("level", "measured"),
    [
        ("l1", 128),  # a warp's whole line a cycle and CU
        ("l2", 4.65e12 / 2.57e9),
        ("llc", 1.95e12 / 2.015e9),
        ("dram", 475e9 / 2.015e9),  # reads of 450 to 500 GB/s
    ],
)
def test_a_stream_on_navi_21_reaches_what_silicon_does(level: str, measured: float) -> None:
    gpu = presets.load("rx-6900-xt")
    assert bandwidth_of(gpu, level) == pytest.approx(measured, rel=0.1)


def test_a_gl1_gives_its_four_banks_bandwidth() -> None:
    for name in ("rx-5700-xt", "rx-6900-xt"):
        assert bandwidth_of(presets.load(name), "gl1") == pytest.approx(256, rel=0.05)


@pytest.mark.parametrize(("stride", "bytes_per_cycle"), [(1, 128), (2, 64), (4, 32), (8, 16)])
def test_strided_loads_share_navi_21s_one_line_a_cycle(stride: int, bytes_per_cycle: int) -> None:
    """gpu-benches, RX 6900 XT: lanes `stride` floats apart."""
    gpu = presets.load("rx-6900-xt", ["sm.count=1"])
    loads, warps = 256, gpu.sm.max_warps
    # The warps start at the same 8 lines and stay in 8 KiB.
    line = np.arange(loads)[:, None] * stride % 64
    lanes = line * 128 + np.arange(32) * 4 * stride
    trace = lane_address_trace(
        np.tile((BASE + lanes).astype(np.uint64), (warps, 1, 1)),
        warps_per_cta=8,
        loads_in_flight=loads,
        compute_per_load=0,
        bytes_per_lane=4,
    )
    timing = simulate(trace, gpu, timing=True).timing
    assert timing is not None
    total = timing.total
    rate = loads * warps * 128 / (total.cycles - total.launch_cycles)
    start = unloaded_latencies("rx-6900-xt")["dram"] / (loads * warps * stride)
    assert bytes_per_cycle * (1 - 1.5 * start) < rate <= bytes_per_cycle


@pytest.mark.parametrize("name", sorted(set(MEMORY) - {"h100-sxm", "h200", "rx-6900-xt"}))
def test_streams_reach_most_of_a_cards_peaks(name: str) -> None:
    gpu = presets.load(name)
    assert 0.8 < bandwidth_of(gpu, "l2") / L2_BYTES_PER_CYCLE[name] <= 1
    peak = dram_bytes_per_second(gpu) / gpu.clock_hz
    assert 0.8 < bandwidth_of(gpu, "dram") / peak <= 1


@pytest.mark.parametrize(
    ("name", "bytes_per_cycle"),
    [("titan-x-pascal", 64), ("rtx-2060", 64), ("h100-sxm", 127)],
)
def test_an_sm_gets_the_published_bandwidth_out_of_its_l1(name: str, bytes_per_cycle: int) -> None:
    assert bandwidth_of(presets.load(name), "l1") == pytest.approx(bytes_per_cycle, rel=0.05)


@pytest.mark.parametrize("name", ["titan-x-pascal", "rtx-2060"])
def test_four_lines_of_any_banks_enter_an_nvidia_l1_in_a_cycle(name: str) -> None:
    """32 lanes in 32 lines take 8 cycles, wherever the lines lie."""
    gpu = presets.load(name, ["sm.count=1"])
    assert gpu.l1_timing is not None
    loads, warps = 24, gpu.sm.max_warps
    rng = np.random.default_rng(0)
    lanes = (rng.permutation(32) * 128)[None, :] + rng.integers(0, 4, (loads, 32)) * 32
    trace = lane_address_trace(
        np.tile((BASE + lanes).astype(np.uint64), (warps, 1, 1)),
        warps_per_cta=8,
        loads_in_flight=loads,
        compute_per_load=0,
        bytes_per_lane=1,
    )
    timing = simulate(trace, gpu, timing=True).timing
    assert timing is not None
    cycles = timing.total.cycles - timing.total.launch_cycles
    needed = loads * warps * 8 / gpu.l1.units_per_sm
    assert needed <= cycles < 1.1 * needed + 3 * unloaded_latencies(name)["dram"]


@pytest.mark.parametrize(("units", "quads"), [(1, 1), (1, 2), (2, 2)])
def test_the_sms_filters_are_shared_by_its_l1_units(units: int, quads: int) -> None:
    """An SM filters `texture_quads_per_cycle` quads a cycle, whatever it has of L1 units."""
    gpu = presets.load(
        "titan-x-pascal",
        ["sm.count=1", f"l1.units_per_sm={units}", f"sm_timing.texture_quads_per_cycle={quads}"],
    )
    samples = 32
    trace = gather(Texture("t", "RGBA8", 32, 32), 1, samples)
    timing = simulate(trace, gpu, fetch_path="texture", timing=True).timing
    assert timing is not None
    cycles = timing.total.cycles - timing.total.launch_cycles
    needed = 32 * 32 * samples / 4 / quads
    assert needed <= cycles < needed + 3 * unloaded_latencies("titan-x-pascal")["dram"]


# ---- the SM


@pytest.mark.parametrize(
    ("name", "fp32", "sfu", "dependent", "quads"),
    [
        ("titan-x-pascal", 128, 32, 6, 2),
        ("quadro-p4000", 128, 32, 6, 2),
        ("rtx-2060", 64, 16, 4, 1),
        ("rtx-2080-ti", 64, 16, 4, 1),
        ("h100-sxm", 128, 16, 4, 1),
        ("h200", 128, 16, 4, 1),
        ("rx-5700-xt", 64, 16, 5, 1),
        ("rx-6900-xt", 64, 16, 5, 1),
    ],
)
def test_an_sm_has_its_cards_lanes(
    name: str, fp32: int, sfu: int, dependent: int, quads: int
) -> None:
    """Results per cycle and SM as the makers' tables have them; cycles to a dependent addition."""
    sm = presets.load(name).sm_timing
    assert sm is not None
    assert 32 * sm.num_schedulers / sm.fp32_initiation_cycles == fp32
    assert 32 * sm.num_schedulers / sm.sfu_initiation_cycles == sfu
    assert sm.fp32_latency_cycles + sm.result_cycles == dependent
    assert sm.texture_quads_per_cycle == quads


def test_cards_of_one_generation_share_their_sm() -> None:
    for one, other in (
        ("titan-x-pascal", "quadro-p4000"),
        ("rtx-2060", "rtx-2080-ti"),
        ("rx-5700-xt", "rx-6900-xt"),
    ):
        a, b = presets.load(one), presets.load(other)
        assert (a.sm_timing, a.l1_timing) == (b.sm_timing, b.l1_timing)
