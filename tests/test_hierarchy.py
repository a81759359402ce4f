"""The whole counting model: against one that is slow and obvious, and against what must hold for
any trace on any GPU.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_simulator import slow_simulate
from strategies import lane_address_traces, texel_traces, traces

from cachesim import Gpu, presets, simulate, simulate_all
from cachesim.addressing import FETCH_PATHS
from cachesim.coalesce import groups_of
from cachesim.level import Level
from cachesim.stream import GROUP_BITS, LOAD
from traces.synthetic import gather, pixel_pass, scatter, stream
from traces.texture import MAX_MIPS, Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, Trace, from_chunks

SETS = st.sampled_from([1, 2, 3, 16])
POLICIES = st.sampled_from(["lru", "fifo", "tree-plru", "random", "srrip"])
WRITES = st.sampled_from(["write-back", "write-back", "write-through", "write-evict", "read-only"])
ALLOCATIONS = st.sampled_from(["lazy-fetch-on-read", "fetch-on-write", "write-allocate", "none"])


@st.composite
def small_gpus(draw) -> Gpu:
    """GPUs with two to four levels, a few lines each."""
    base = presets.load(draw(st.sampled_from(["titan-x-pascal-gpgpusim", "rx-6900-xt"])))
    amd = base.gl1 is not None
    fields: dict[str, object] = {"sm.count": draw(st.integers(1, 5))}
    fields |= {"sm.max_ctas": draw(st.integers(1, 3)), "sm.max_warps": draw(st.integers(4, 9))}
    fields |= {"l1.units_per_sm": draw(st.integers(1, 2)), "dram.sector_bytes": 16}
    if amd and draw(st.booleans()):
        fields["llc"] = None
    if amd:
        fields["gl1.sms_per_instance"] = draw(st.integers(1, 3))
    sector_bytes = 128
    for path in ("l1", "l1_texture", "gl1", "l2", "llc"):
        if getattr(base, path) is None or path in fields:
            continue
        smaller = [size for size in (128, 64, 32, 16) if size <= sector_bytes]
        sector = draw(st.sampled_from(smaller))
        if path != "l1_texture":
            sector_bytes = min(sector_bytes, sector)
        line = draw(st.sampled_from([size for size in (64, 128) if sector <= size <= 8 * sector]))
        sets, ways, slices = draw(SETS), draw(st.integers(1, 6)), 1
        fields |= {f"{path}.line_bytes": line, f"{path}.sector_bytes": sector}
        fields |= {f"{path}.set_hash": "linear", f"{path}.replacement": draw(POLICIES)}
        writes = "read-only" if path == "gl1" else draw(WRITES)
        fields |= {f"{path}.write_policy": writes, f"{path}.write_allocate": draw(ALLOCATIONS)}
        if path in ("l2", "llc"):
            channels, per_channel = draw(st.integers(1, 5)), draw(st.integers(1, 3))
            slices = channels * per_channel
            fields |= {f"{path}.num_channels": channels, f"{path}.slices_per_channel": per_channel}
            fields |= {f"{path}.channel_interleave": 256 * per_channel}
            fields |= {f"{path}.partition_hash": draw(st.sampled_from(["linear", "random"]))}
        fields |= {f"{path}.ways": ways, f"{path}.capacity": slices * sets * ways * line}
    # The texture L1 stands above the same L2.
    if not amd:
        fields["l1_texture.sector_bytes"] = fields["l1.sector_bytes"]
        fields["l1_texture.line_bytes"] = fields["l1.line_bytes"]
        fields["l1_texture.capacity"] = fields["l1.line_bytes"] * fields["l1_texture.ways"] * 3
        fields["l1_texture.units_per_sm"] = 1
    if "write-back" in (fields["l1.write_policy"], fields.get("l1_texture.write_policy")):
        # A launch's end may write back in any order, so nothing below may depend on it.
        for path in ("l2", "llc"):
            if f"{path}.ways" in fields:
                fields[f"{path}.capacity"] *= 600
                fields[f"{path}.ways"] *= 600
                fields[f"{path}.replacement"] = "lru"
    return presets.with_fields(base, fields)


@settings(max_examples=120)
@given(
    # A few KiB, so that lines come back and are shared.
    st.one_of(
        texel_traces(max_rows_per_warp=6, max_side=24, bilinear=False),
        texel_traces(max_rows_per_warp=2, max_side=60),
        lane_address_traces(max_rows_per_warp=5, address_bits=11),
    ),
    small_gpus(),
    st.sampled_from(FETCH_PATHS),
)
def test_reports_equal_those_of_the_slow_simulator(trace, gpu, fetch_path) -> None:
    # Names that tell which texture a part is of.
    named = [dataclasses.replace(t, name=str(k)) for k, t in enumerate(trace.textures)]
    trace = dataclasses.replace(trace, textures=named)
    report = simulate(trace, gpu, fetch_path=fetch_path, threaded=False)
    levels, fetches = slow_simulate(trace, gpu, fetch_path)
    assert report.levels == tuple(levels)
    assert report.lane_fetches == fetches.total()
    pairs = groups_of(trace)
    for name, level in levels.items():
        dirty = level.caches.dirty_sectors()
        counters = report.counters[name]
        for field in dataclasses.fields(counters):
            if field.name in ("sector_bytes", "merged", "dirty_at_end"):
                continue
            by_group = {g: n for (g, counter), n in level.counters.items() if counter == field.name}
            assert getattr(counters, field.name) == sum(by_group.values()), (name, field.name)
            for part in report.parts or ():
                pair = pairs.index((part.pass_name, int(part.texture)))
                assert getattr(part.counters[name], field.name) == by_group.get(
                    pair * MAX_MIPS + part.mip, 0
                ), (name, field.name, part.mip)
        assert counters.dirty_at_end == dirty.total()


@pytest.mark.parametrize("name", presets.names())
@pytest.mark.parametrize("fetch_path", FETCH_PATHS)
@settings(max_examples=3)
@given(trace=traces(max_rows_per_warp=4))
def test_the_laws_hold_on_every_preset_and_fetch_path(name, fetch_path, trace) -> None:
    gpu = presets.load(name)
    if gpu.llc is not None:
        # 128 MiB of tags take longer to make than to use.
        gpu = presets.with_fields(gpu, {"llc.capacity": 1 << 20})
    report = simulate(trace, gpu, fetch_path=fetch_path)
    report.check()
    lanes = sum(chunk.num_lane_fetches for chunk in trace.chunks())
    assert report.lane_fetches == report.demand["lane_fetches"] == lanes
    assert report.num_rows == sum(chunk.num_rows for chunk in trace.chunks())
    demand = report.by_frame()
    if len(demand):
        sums = demand.groupby("level")["bytes"].sum()
        for level in (*report.levels, "dram"):
            assert sums[level] == report.demand[f"{level}_bytes"], level


class Sectors:
    """The distinct sectors that each cache instance is asked for by loads, since its last flush."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: dict[str, set[tuple[int, int, int]]] = {}
        access = Level.access

        def noting_access(level, requests, sets, outcome) -> None:
            seen = self.seen.setdefault(level.name, set())
            instance = np.repeat(requests.instance, np.diff(requests.segments))
            for i in range(requests.num_requests):
                assert requests.meta[i] >> GROUP_BITS == LOAD
                for s in range(8):
                    if requests.mask[i] >> s & 1:
                        seen.add((int(instance[i]), int(requests.line[i]), s))
            access(level, requests, sets, outcome)

        monkeypatch.setattr(Level, "access", noting_access)


@pytest.mark.parametrize("name", ["titan-x-pascal", "titan-x-pascal-gpgpusim", "rx-5700-xt"])
def test_misses_are_at_least_the_distinct_sectors_and_equal_them_at_infinite_capacity(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace = gather(Texture("t", "RGBA16F", 160, 96), 12, 6)
    sectors = Sectors(monkeypatch)
    gpu = presets.load(name)
    report = simulate(trace, gpu)
    for level, seen in sectors.seen.items():
        assert report.counters[level].misses >= len(seen) > 0
    assert report.counters["l1"].misses > len(sectors.seen["l1"])
    sectors.seen.clear()
    levels = {
        path: level
        for path in ("l1", "l1_texture", "gl1", "l2")
        if (level := getattr(gpu, path)) is not None
    }
    huge = {f"{path}.ways": 64 * level.ways for path, level in levels.items()}
    huge |= {f"{path}.capacity": 64 * level.capacity for path, level in levels.items()}
    report = simulate(trace, presets.with_fields(gpu, huge))
    for level, seen in sectors.seen.items():
        assert report.counters[level].misses == len(seen)


def one_set(gpu: Gpu, ways: int) -> Gpu:
    fields = {"l1.set_hash": "linear", "l1.ways": ways, "l1.capacity": ways * gpu.l1.line_bytes}
    return presets.with_fields(gpu, fields)


@pytest.mark.parametrize("name", ["titan-x-pascal", "rx-5700-xt"])
def test_misses_of_a_fully_associative_lru_cache_never_grow_with_its_capacity(name: str) -> None:
    gpu = presets.load(name)
    gpus = [one_set(gpu, ways) for ways in (1, 2, 3, 8, 20, 50, 128, 400)]
    trace = scatter(96, 64, 12.0, 6)
    misses = [report.counters["l1"].misses for report in simulate_all(trace, gpus)]
    assert misses == sorted(misses, reverse=True)
    assert misses[0] > misses[-1]


def recut(trace: Trace, ctas_per_chunk: int) -> Trace:
    """The same rows in other chunks."""
    chunks = []
    for chunk in trace.chunks():
        warps = trace.launches[chunk.launch].warps_per_cta * ctas_per_chunk
        for first in range(0, chunk.num_warps, warps):
            offsets = chunk.warp_offsets[first : first + warps + 1]
            rows = slice(offsets[0], offsets[-1])
            chunks.append(
                Chunk(
                    chunk.launch,
                    chunk.first_cta + first // (warps // ctas_per_chunk),
                    offsets - offsets[0],
                    chunk.instruction[rows],
                    chunk.lanes[rows],
                )
            )
    return from_chunks(chunks, trace.textures, trace.instructions, trace.launches, trace.manifest)


@pytest.mark.parametrize("name", ["titan-x-pascal", "rtx-2060-gpgpusim", "rx-5700-xt", "h100-sxm"])
def test_threads_chunks_and_company_change_nothing(name: str) -> None:
    trace = scatter(136, 100, 10.0, 12, adaptive=True, frames=2)
    report = simulate(trace, name)
    assert simulate(trace, name, threaded=False) == report
    assert simulate(recut(trace, 1), name) == report
    assert simulate(recut(trace, 7), name, threaded=False) == report
    assert simulate_all(trace, ["rtx-2060", name])[1] == report
    assert report.counters["l1"].hits > 0


TEXTURE = Texture("t", "RGBA16F", 128, 64)


def passes(*operations: str, names: tuple[str, ...] | None = None) -> Trace:
    """One launch per operation, each over every texel of the same texture once."""
    names = names or tuple(f"pass {k}" for k in range(len(operations)))
    chunks = []
    for k, operation in enumerate(operations):
        for chunk in pixel_pass(TEXTURE, operation).chunks():
            index = np.full_like(chunk.instruction, k)
            chunks.append(dataclasses.replace(chunk, launch=k, instruction=index))
    launch = pixel_pass(TEXTURE).launches[0]
    return from_chunks(
        chunks,
        [TEXTURE],
        [Instruction(n, 0, o) for n, o in zip(names, operations, strict=True)],
        [dataclasses.replace(launch, pass_name=n) for n in names],
    )


def test_l1_and_gl1_start_empty_at_each_launch_and_l2_is_kept() -> None:
    for name in ("titan-x-pascal", "rx-5700-xt"):
        once, twice = (simulate(passes(*["load"] * n), name) for n in (1, 2))
        for level in set(once.levels) - {"l2"}:
            assert twice.counters[level].misses == 2 * once.counters[level].misses, level
        assert twice.counters["l2"].misses == once.counters["l2"].misses
        assert twice.dram == once.dram


def test_a_write_back_belongs_to_the_pass_that_dirtied_the_sector() -> None:
    """Two passes write the same texture; a third reads another one until the first is gone."""
    gpu = presets.with_fields(
        presets.load("titan-x-pascal"), {"l2.capacity": 24 * 64 * 128, "l2.ways": 1}
    )
    small = presets.with_fields(gpu, {"l2.set_hash": "linear"})
    report = simulate(passes("store", "store", "load"), small)
    sectors = 128 * 64 * 8 // 32
    first, second, third = (p.counters["l2"] for p in report.parts or ())
    # What the second pass finds dirty becomes its own; the first wrote back the rest.
    assert first.writebacks + second.writebacks + second.dirty_at_end >= sectors
    assert third.writebacks == third.dirty_at_end == third.writes == 0
    assert first.dirty_at_end == 0
    assert report.dram.sectors_written == first.writebacks + second.writebacks

    # With room for all of it nothing is written back, and all is the second pass's.
    first, second, _ = (
        p.counters["l2"] for p in simulate(passes("store", "store", "load"), "titan-x-pascal").parts
    )
    assert (first.writebacks, first.dirty_at_end) == (0, 0)
    assert (second.writebacks, second.dirty_at_end) == (0, sectors)
    assert (first.hits, second.hits) == (0, sectors)


def test_a_line_that_two_passes_dirtied_is_written_back_as_theirs() -> None:
    """The first writes sectors 0 and 2 of each line, the second sector 1; loads push them out."""
    written, read = Texture("written", "RGBA16F", 512, 1), Texture("read", "RGBA16F", 512, 64)
    chunks, launches = [], []
    for k, sectors in enumerate(([0, 2], [1])):
        x = np.flatnonzero(np.isin(np.arange(512) // 4 % 4, sectors))
        lanes = pack_texel(0, np.zeros_like(x), x).reshape(-1, 32)
        index = np.full(len(lanes), k, np.uint16)
        chunks.append(Chunk(k, 0, np.array([0, len(lanes)]), index, lanes))
        launches.append(Launch(0, f"pass {k}", 1, 1))
    for chunk in pixel_pass(read).chunks():
        index = np.full_like(chunk.instruction, 2)
        chunks.append(dataclasses.replace(chunk, launch=2, instruction=index))
    launches.append(dataclasses.replace(pixel_pass(read).launches[0], pass_name="pass 2"))
    kinds = ((0, "store"), (0, "store"), (1, "load"))
    instructions = [Instruction(f"pass {k}", *kind) for k, kind in enumerate(kinds)]
    trace = from_chunks(chunks, [written, read], instructions, launches)
    fields = {f"{level}.sector_bytes": 32 for level in ("l1", "gl1", "l2", "llc")}
    fields |= {"llc.line_bytes": 128, "llc.capacity": 1 << 20}
    fields |= {"l2.capacity": 16 * 128 * 4, "l2.ways": 4}
    gpu = presets.with_fields(presets.load("rx-6900-xt"), fields)
    report = simulate(trace, gpu, layout="row-major")
    for level, counter in (("l2", "writebacks"), ("llc", "writes"), ("llc", "dirty_at_end")):
        found = {p.pass_name: getattr(p.counters[level], counter) for p in report.parts}
        assert found == {"pass 0": 2 * 32, "pass 1": 32, "pass 2": 0}, (level, counter)


def test_plain_loads_go_around_the_l1_of_the_paper_s_tool() -> None:
    trace = gather(TEXTURE, 4, 2)
    around = simulate(trace, "titan-x-pascal-gpgpusim", fetch_path="global")
    l1, l2 = around.counters["l1"], around.counters["l2"]
    assert (l1.accesses, l1.requests, around.demand["l1_bytes"]) == (0, 0, 0)
    assert l1.bypasses == l2.accesses > 0
    through = simulate(trace, "titan-x-pascal-gpgpusim", fetch_path="readonly")
    assert through.counters["l1"].accesses == l2.accesses
    assert through.counters["l1"].bypasses == 0
    # Texture fetches have an L1 of their own, of whole lines.
    texture = simulate(trace, "titan-x-pascal-gpgpusim").counters["l1"]
    assert (texture.sector_bytes, texture.bypasses) == (128, 0)
    assert texture.accesses == texture.requests > 0


def test_stores_go_around_read_only_levels_and_end_in_the_l2() -> None:
    sectors = 128 * 64 * 8 // 32
    report = simulate(passes("store"), "rtx-2060-gpgpusim", layout="block-linear")
    l1, l2 = report.counters["l1"], report.counters["l2"]
    assert (l1.bypasses, l1.bypassed_writes, l1.accesses) == (sectors // 4, sectors // 4, 0)
    assert (l2.writes, l2.dirty_at_end, report.dram.bytes) == (sectors, sectors, 0)
    report = simulate(passes("store"), "rx-5700-xt")
    gl1, l2 = report.counters["gl1"], report.counters["l2"]
    assert (gl1.accesses, gl1.bypassed_writes, l2.writes) == (0, sectors // 4, sectors // 4)


def test_atomics_are_done_in_the_l2() -> None:
    report = simulate(passes("atomic"), "titan-x-pascal")
    l1, l2 = report.counters["l1"], report.counters["l2"]
    assert (l1.accesses, l1.bypassed_writes) == (0, 2048)
    # Each reads its sector first.
    assert (l2.writes, l2.write_misses, l2.write_fills, l2.dirty_at_end) == (2048,) * 4
    assert report.dram.sectors_read == 2048


def test_levels_of_other_line_and_sector_sizes_are_converted() -> None:
    gpu = presets.with_fields(presets.load("rx-6900-xt"), {"llc.capacity": 1 << 20})
    report = simulate(passes("load"), gpu)
    lines = 128 * 64 * 8 // 128
    l2, llc = report.counters["l2"], report.counters["llc"]
    assert (l2.misses, l2.sector_bytes) == (lines, 128)
    # 128 B of an L2 line are two lines of 64 B below, 64 B are two sectors of DRAM.
    assert (llc.requests, llc.accesses, llc.misses) == (2 * lines, 2 * lines, 2 * lines)
    assert report.dram.sectors_read == 4 * lines
    report = simulate(passes("load"), "rtx-2060-gpgpusim")
    l1, l2 = report.counters["l1"], report.counters["l2"]
    # A whole line of the texture L1 is one request of four sectors to the L2.
    assert l1.misses * 4 == l2.accesses == 4 * l2.requests


def test_partial_stores_fetch_what_the_rule_says() -> None:
    """Eight bytes of each sector, stored once: nothing is fetched lazily, all of it on write."""
    lanes = pack_texel(0, 2 * np.arange(32), np.zeros(32))[None]
    chunk = Chunk(0, 0, np.array([0, 1]), np.zeros(1, np.uint16), lanes)
    trace = from_chunks([chunk], [TEXTURE], [Instruction("p", 0, "store")], [Launch(0, "p", 1, 1)])
    fetched = {}
    for rule in ("none", "write-allocate", "fetch-on-write", "lazy-fetch-on-read"):
        gpu = presets.load("titan-x-pascal", [f"l2.write_allocate={rule}"])
        report = simulate(trace, gpu)
        fetched[rule] = report.dram.sectors_read, report.dram.sectors_written
    assert fetched == {
        "none": (0, 32),
        "write-allocate": (32, 32),
        "fetch-on-write": (32, 0),
        "lazy-fetch-on-read": (0, 0),
    }


def test_progress_counts_lane_fetches() -> None:
    told: list[int] = []
    report = simulate(stream(8192, 4), "titan-x-pascal", progress=told.append)
    assert told == sorted(told)
    assert 0 < told[-1] <= report.lane_fetches
