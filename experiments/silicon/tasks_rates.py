"""Rates: bandwidth of each level against footprint, texture units, launches."""

from __future__ import annotations

import time
from ctypes import c_float, c_uint, c_uint64
from functools import partial

import numpy as np

from experiments.silicon.clock import measure_clock
from experiments.silicon.rows import case_of
from experiments.silicon.session import Session
from experiments.silicon.texels import FILTERS, FORMATS, TextureMaker

KIB, MIB = 1 << 10, 1 << 20
VECTOR_BYTES = 16
THREADS = 1024
#: Bytes that a measurement of the whole GPU moves at least.
MOVED_BYTES = 2 << 30
WINDOW, RATE_THREADS, RATE_ROUNDS = 16, 256, 512


def measure_own_bandwidth(session: Session, words: str) -> None:
    """Each SM reads its own footprint over and over. words: "l1", or "l2" for loads past the L1."""
    gpu = session.gpu
    num_sms = gpu.attributes()["num_sms"]
    sizes = [
        s * KIB for s in (4, 8, 16, 32, 64, 96, 128, 160, 192, 208, 224, 240, 256, 320, 512, 1024)
    ]
    if words == "l2":
        sizes = [s * KIB for s in (4, 16, 64, 128, 192, 256, 320, 384, 512, 1024, 2048)]
    memory, sink = gpu.allocate(num_sms * sizes[-1]), gpu.allocate(16)
    out = gpu.allocate(8 * num_sms)
    gpu.clear(memory)
    for size in sizes:
        count = size // VECTOR_BYTES
        case = case_of(level=words, footprint_per_sm_bytes=size)
        with session.attempt(f"bandwidth {case}"):
            rounds = max(1024, 8 * count // THREADS)
            arguments = (
                c_uint64(memory.address),
                c_uint(count),
                c_uint(rounds),
                c_uint64(sink.address),
                c_uint64(out.address),
            )
            for _ in range(2):
                gpu.launch(
                    session.micro().function(f"read_own_{words}"), num_sms, THREADS, *arguments
                )
            cycles = float(np.median(gpu.read(out, np.uint64, num_sms)))
            moved = rounds * THREADS * VECTOR_BYTES
            session.rows.add(
                "bandwidth", case, "bytes_per_cycle_and_sm", moved / cycles, "B", "clock"
            )


def measure_shared_bandwidth(session: Session, words: str) -> None:
    """All SMs read, or write, one footprint. words: "read" or "write"."""
    gpu = session.gpu
    num_sms = gpu.attributes()["num_sms"]
    largest = min(2 << 30, gpu.memory_bytes()[0] // 3)
    sizes = [s * MIB for s in (2, 4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60, 64)]
    sizes += [s * MIB for s in (80, 96, 128, 192, 256, 512, 1024, 2048)]
    memory, sink = gpu.allocate(largest), gpu.allocate(16)
    gpu.clear(memory)
    for size in sizes:
        if size > largest:
            break
        case = case_of(kind=words, footprint_bytes=size)
        with session.attempt(f"bandwidth {case}"):
            rounds = max(1, MOVED_BYTES // size)
            arguments = [c_uint64(memory.address), c_uint64(size // VECTOR_BYTES), c_uint(rounds)]
            if words == "read":
                arguments.append(c_uint64(sink.address))
            function = session.micro().function(f"{words}_shared")

            work = partial(gpu.launch, function, 4 * num_sms, 512, *arguments)
            work()
            median, _ = gpu.median_ms(work, 3)
            rate = rounds * size / (median * 1e-3)
            session.rows.add("bandwidth", case, "bytes_per_second", rate, "B/s", "event")
            hertz = measure_clock(session)
            session.rows.add("bandwidth", case, "bytes_per_cycle", rate / hertz, "B", "event")


def measure_texture_rate(session: Session, words: str) -> None:
    """Fetches that hit, by every SM: how many lanes a cycle and SM get a texel, per format and
    filter.
    """
    gpu = session.gpu
    attributes = gpu.attributes()
    num_sms = attributes["num_sms"]
    per_sm = max(1, attributes.get("max_threads_per_sm", 2048) // RATE_THREADS)
    num_ctas = num_sms * per_sm
    textures, sink, out = TextureMaker(gpu), gpu.allocate(16), gpu.allocate(8 * num_ctas)
    for name in FORMATS:
        for filtered, (offset, level) in FILTERS.items():
            case = case_of(format=name, filter=filtered)
            with session.attempt(f"texture_rate {case}"):
                texture = textures.make(name, filtered, 256, 3)
                work = partial(
                    gpu.launch,
                    session.micro().function("fetch_rate"),
                    num_ctas,
                    RATE_THREADS,
                    c_uint64(texture),
                    c_uint(WINDOW),
                    c_uint(RATE_ROUNDS),
                    c_float(offset),
                    c_float(level),
                    c_float(1 / 256),
                    c_float(1 / 256),
                    c_uint64(sink.address),
                    c_uint64(out.address),
                )
                work()
                median, _ = gpu.median_ms(work, 5)
                hertz = measure_clock(session)
                fetches = num_ctas * RATE_THREADS * RATE_ROUNDS
                rate = fetches / (median * 1e-3 * hertz * num_sms)
                session.rows.add(
                    "texture_rate", case, "texels_per_cycle_and_sm", rate, "1", "event"
                )


def measure_launch(session: Session, words: str) -> None:
    """What a launch costs: between two in a row, until the host knows, and per CTA."""
    gpu = session.gpu
    nothing = session.micro().function("nothing")
    add = session.rows.add

    def launch(num_ctas: int, times: int) -> None:
        for _ in range(times):
            gpu.launch(nothing, num_ctas, 64)

    launch(1, 10)
    gpu.synchronise()
    hertz = measure_clock(session)
    median, _ = gpu.median_ms(partial(launch, 1, 1000), 5)
    add("launch", "kind=back_to_back", "time", median * 1e6 / 1000, "ns", "event")
    add("launch", "kind=back_to_back", "cycles", median * 1e-6 * hertz, "cycles", "event")
    trips = []
    for _ in range(100):
        begin = time.perf_counter_ns()
        launch(1, 1)
        gpu.synchronise()
        trips.append(time.perf_counter_ns() - begin)
    add("launch", "kind=round_trip", "time", float(np.median(trips)), "ns", "host")

    count = 64
    out = gpu.allocate(16 * count)
    stamp = session.micro().function("stamp")
    for k in range(count):
        gpu.launch(stamp, 1, 1, c_uint64(out.address), c_uint(k))
    times = gpu.read(out, np.uint64, 2 * count).astype(np.int64).reshape(count, 2)
    gaps = times[1:, 0] - times[:-1, 1]
    add("launch", "kind=end_to_begin", "time", float(np.median(gaps)), "ns", "clock")

    for num_ctas in (1, 132, 1320, 8100, 32400, 129600):
        median, _ = gpu.median_ms(partial(launch, num_ctas, 20), 5)
        case = case_of(kind="empty", num_ctas=num_ctas)
        add("launch", case, "time", median * 1e6 / 20, "ns", "event")
