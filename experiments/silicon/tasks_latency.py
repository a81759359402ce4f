"""Latencies: what the driver says of the card, pointer chases, near and far L2, cyclic scans."""

from __future__ import annotations

from ctypes import c_uint, c_uint64

import numpy as np
import numpy.typing as npt

from experiments.silicon.clock import measure_clock
from experiments.silicon.driver import Memory
from experiments.silicon.rings import (
    LINE_BYTES,
    MAX_STEPS,
    chase,
    make_ring,
    num_steps,
    random_order,
)
from experiments.silicon.rows import case_of
from experiments.silicon.session import Session

KIB, MIB = 1 << 10, 1 << 20
LARGEST = 1 << 30
#: Widths of a texture in which a chase goes from 128 B line to line of 8x4 texels of 4 B.
ARRAY_WIDTH, LINE_WIDTH, LINE_HEIGHT = 2048, 8, 4
NEAR_FAR_LINES, NEAR_FAR_STRIDE = 16, 33 * 32 * KIB + 256
UNITS = {"_khz": "kHz", "_bytes": "B", "_bits": "bit"}


def measure_properties(session: Session, words: str) -> None:
    """Device attributes, memory, and the SM's clock as it runs."""
    gpu = session.gpu
    for name, value in gpu.attributes().items():
        unit = next((u for ending, u in UNITS.items() if name.endswith(ending)), "1")
        session.rows.add("properties", "", name, value, unit, "driver")
    free, total = gpu.memory_bytes()
    session.rows.add("properties", "", "memory_bytes", total, "B", "driver")
    session.rows.add("properties", "", "free_memory_bytes", free, "B", "driver")
    for turn in range(5):
        with session.attempt("clock"):
            hertz = measure_clock(session)
            session.rows.add("properties", case_of(turn=turn), "sm_clock", hertz, "Hz", "clock")


def footprints(largest: int, smallest: int = 2 * KIB) -> list[int]:
    """Two per octave, and closer ones about an L1 of 256 KiB and an L2 of 50 or 60 MiB."""
    sizes = [s for k in range(11, 31) for s in (1 << k, 3 << (k - 1))]
    sizes += [k * KIB for k in (160, 176, 208, 216, 224, 232, 240, 248, 288, 320)]
    sizes += [k * MIB for k in (20, 22, 25, 28, 30, 36, 40, 44, 52, 56, 60, 72, 80)]
    return sorted({s for s in sizes if smallest <= s <= largest})


def _largest_footprint(session: Session) -> int:
    return min(LARGEST, session.gpu.memory_bytes()[0] // 3)


def measure_chase(session: Session, words: str) -> None:
    """Pointer chases by load. words: "load", "past_l1", "readonly", and "load-32" for places 32 B
    apart.
    """
    path, _, stride_text = words.partition("-")
    stride = int(stride_text or LINE_BYTES)
    largest = min(_largest_footprint(session), LARGEST if stride == LINE_BYTES else 64 * MIB)
    memory = session.gpu.allocate(largest)
    for footprint in footprints(largest):
        case = case_of(path=path, stride_bytes=stride, footprint_bytes=footprint)
        with session.attempt(f"chase {case}"):
            ring = make_ring(session, memory, random_order(footprint // stride), stride)
            cycles = chase(session, f"chase_{path}", ring)
            session.rows.add("chase", case, "latency", cycles, "cycles", "clock")


def measure_chase_linear(session: Session, words: str) -> None:
    """Chases through a texture over plain memory, of 4-byte texels, 128 B apart."""
    gpu = session.gpu
    # A texture over memory has at most 2^27 texels.
    largest = min(_largest_footprint(session), 1 << 29)
    memory, out = gpu.allocate(largest), gpu.allocate(16)
    texture = gpu.linear_texture(memory, largest // 4)
    stride = LINE_BYTES // 4
    for footprint in footprints(largest):
        case = case_of(path="texture_linear", stride_bytes=LINE_BYTES, footprint_bytes=footprint)
        with session.attempt(f"chase {case}"):
            order = random_order(footprint // LINE_BYTES)
            places = gpu.upload(order)
            gpu.launch(
                session.micro().function("build_ring_linear"),
                -(-len(order) // 256),
                256,
                c_uint64(memory.address),
                c_uint64(places.address),
                c_uint64(len(order)),
                c_uint(stride),
            )
            gpu.synchronise()
            gpu.free(places)
            _chase_texels(
                session, case, "chase_linear", texture, int(order[0]) * stride, len(order), out
            )


def measure_chase_array(session: Session, words: str) -> None:
    """Chases through a texture on an array: from one 8x4 block of 4-byte texels to another."""
    gpu, out = session.gpu, session.gpu.allocate(16)
    for footprint in footprints(64 * MIB, 8 * KIB):
        if footprint % (16 * KIB) and footprint > 64 * KIB:
            continue
        case = case_of(path="texture_array", stride_bytes=LINE_BYTES, footprint_bytes=footprint)
        with session.attempt(f"chase {case}"):
            height = LINE_HEIGHT * max(1, footprint // (4 * ARRAY_WIDTH * LINE_HEIGHT))
            width = footprint // (4 * height) // LINE_WIDTH * LINE_WIDTH
            across = width // LINE_WIDTH
            order = random_order(across * (height // LINE_HEIGHT)).astype(np.int64)
            x, y = order % across * LINE_WIDTH, order // across * LINE_HEIGHT
            texels = np.zeros((height, width), np.uint32)
            texels[y, x] = np.roll(y << 16 | x, -1)
            array = gpu.make_array(width, height, "u32", 1)
            gpu.write_array(array, texels)
            texture = gpu.texture(array, as_integer=True)
            start = int(y[0]) << 16 | int(x[0])
            _chase_texels(session, case, "chase_array", texture, start, len(order), out)


def _chase_texels(
    session: Session, case: str, kernel: str, texture: int, start: int, count: int, out: Memory
) -> None:
    warm, timed = num_steps(count)
    session.gpu.launch(
        session.micro().function(kernel),
        1,
        1,
        c_uint64(texture),
        c_uint(start),
        c_uint(warm),
        c_uint(timed),
        c_uint64(out.address),
    )
    cycles = int(session.gpu.read(out, np.uint64, 2)[0])
    session.rows.add("chase", case, "latency", cycles / timed, "cycles", "clock")


def measure_near_far(session: Session, words: str) -> None:
    """From every SM to some lines of the L2: which half of it is near shows in the cycles."""
    gpu = session.gpu
    num_sms = gpu.attributes()["num_sms"]
    size = NEAR_FAR_LINES * NEAR_FAR_STRIDE
    memory = gpu.allocate(size + 8)
    own = np.zeros(size // 8 + 1, np.uint64)
    places = np.arange(NEAR_FAR_LINES) * NEAR_FAR_STRIDE
    own[places // 8] = memory.address + places
    gpu.write(memory, own)
    taken, out = gpu.allocate(16), gpu.allocate(16 * NEAR_FAR_LINES)
    steps = 64
    found = {}
    for sm in range(num_sms):
        for _ in range(4):
            gpu.clear(taken)
            gpu.launch(
                session.micro().function("near_far"),
                16 * num_sms,
                32,
                c_uint64(memory.address),
                c_uint64(NEAR_FAR_STRIDE),
                c_uint(NEAR_FAR_LINES),
                c_uint(sm),
                c_uint(steps),
                c_uint64(taken.address),
                c_uint64(out.address),
            )
            if int(gpu.read(taken, np.uint32, 1)[0]):
                found[sm] = gpu.read(out, np.uint64, 2 * NEAR_FAR_LINES)[::2] / steps
                break
    for sm, cycles in found.items():
        for line, latency in enumerate(cycles):
            case = case_of(sm=sm, line=line)
            session.rows.add("near_far", case, "latency", float(latency), "cycles", "clock")
    if not found:
        raise ValueError("near_far: no CTA met the SM that it was to run on")
    near, far, share = split_in_two(np.concatenate(list(found.values())))
    session.rows.add("near_far", "", "num_sms", len(found), "1", "clock")
    session.rows.add("near_far", "", "near", near, "cycles", "clock")
    session.rows.add("near_far", "", "far", far, "cycles", "clock")
    session.rows.add("near_far", "", "near_rate", share, "1", "clock")


def split_in_two(values: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    """(mean of the lower, mean of the upper, share of the lower): two groups of least variance."""
    ordered = np.sort(np.asarray(values, np.float64))
    if len(ordered) < 2 or ordered[0] == ordered[-1]:
        return float(ordered[0]), float(ordered[0]), 1.0
    sizes = np.arange(1, len(ordered))
    lower = np.cumsum(ordered)[:-1]
    upper = ordered.sum() - lower
    # The variance within the groups is least where that between them is largest.
    between = lower**2 / sizes + upper**2 / (len(ordered) - sizes)
    cut = int(sizes[int(between.argmax())])
    return float(ordered[:cut].mean()), float(ordered[cut:].mean()), cut / len(ordered)


def measure_scan(session: Session, words: str) -> None:
    """Cyclic scans of more and more lines: what a cache of some replacement keeps of them. words:
    "l1" or "l2".
    """
    gpu = session.gpu
    l2_bytes = gpu.attributes().get("l2_cache_bytes", 0) or 50 * MIB
    memory = gpu.allocate(max(4 * l2_bytes, 64 * MIB))
    hit = _scan(session, memory, 16 * KIB, 0, (1, 1, 1))[3]
    l2 = _scan(session, memory, min(8 * MIB, l2_bytes // 4), 1, (1, 1, 1))[3]
    far = _scan(session, memory, memory.size_bytes, 1, (1, 1, 1))[3]
    for name, value in (("l1_hit", hit), ("l2_hit", l2), ("memory", far)):
        session.rows.add("scan", case_of(level=words), name, value, "cycles", "clock")
    bounds = (int((hit + l2) / 2), int(l2 + 0.75 * (far - l2)), int(2 * far))
    if words == "l1":
        sizes = [k * KIB for k in range(96, 289, 4)]
    else:
        sizes = [int(l2_bytes * share / 24) // LINE_BYTES * LINE_BYTES for share in range(9, 37)]
    for size in sizes:
        case = case_of(level=words, footprint_bytes=size)
        with session.attempt(f"scan {case}"):
            below_l1, below_l2, _, mean = _scan(session, memory, size, int(words == "l2"), bounds)
            held = below_l1 if words == "l1" else below_l2
            session.rows.add("scan", case, "hit_rate", held, "1", "clock")
            session.rows.add("scan", case, "latency", mean, "cycles", "clock")


def _scan(
    session: Session, memory: Memory, size: int, past_l1: int, bounds: tuple[int, int, int]
) -> tuple[float, float, float, float]:
    """(shares of steps below each bound, mean cycles) of a scan of that many bytes."""
    gpu = session.gpu
    count = size // LINE_BYTES
    ring = make_ring(session, memory, np.arange(count, dtype=np.uint32), LINE_BYTES)
    steps = min(max(2 * count, 1024), 20 * MAX_STEPS)
    out = gpu.allocate(40)
    gpu.launch(
        session.micro().function("scan"),
        1,
        1,
        c_uint64(ring.start),
        c_uint(min(2 * count, 1 << 20)),
        c_uint(steps),
        *(c_uint(bound) for bound in bounds),
        c_uint(past_l1),
        c_uint64(out.address),
    )
    a, b, c, total, _ = (int(v) for v in gpu.read(out, np.uint64, 5))
    gpu.free(out)
    return a / steps, b / steps, c / steps, total / steps
