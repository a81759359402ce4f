"""Where texels lie: which share a sector, by time; and sectors and hits for the profiler."""

from __future__ import annotations

import re
from ctypes import c_float, c_uint, c_uint64

import numpy as np

from experiments.silicon import build
from experiments.silicon.cases import TEXELS
from experiments.silicon.driver import Module
from experiments.silicon.rows import case_of
from experiments.silicon.session import Session
from experiments.silicon.structs import COMPONENT_BYTES
from experiments.silicon.texels import FILTERS, FORMATS, TextureMaker

#: Offsets below ACROSS and DOWN are measured; each pair of texels has a tile of its own.
ACROSS, DOWN, TILE = 20, 10, 64
MIPS = (0, 2)
#: Lanes to a row of the one warp whose sectors are counted.
SHAPES = (32, 16, 8, 4, 2, 1)
SIDE, SWEEP_SIDE = 512, 1024
_CASE = re.compile(
    rf"{TEXELS}__([a-z]+)__([A-Z0-9]+[A-Z0-9a-z]*)__([a-z]+)__mip(\d)__across(\d+)__"
)


def measure_neighbours(session: Session, words: str) -> None:
    """Cycles of fetching a texel right after one to its left and above."""
    gpu = session.gpu
    textures, out = TextureMaker(gpu), gpu.allocate(4 * (ACROSS * DOWN + 1))
    for name in FORMATS:
        for mip in MIPS:
            with session.attempt(f"neighbours {name} mip {mip}"):
                side = ACROSS * TILE << mip
                component, channels = FORMATS[name]
                texel_bytes = channels * COMPONENT_BYTES[component]
                if 2 * side * side * texel_bytes > gpu.memory_bytes()[0]:
                    raise ValueError("not enough device memory")
                texture = textures.make(name, "point", side, mip + 1)
                for _ in range(2):
                    # The second time the L2 holds what the L1, emptied at the launch, does not.
                    gpu.launch(
                        session.micro().function("neighbours"),
                        1,
                        1,
                        c_uint64(texture),
                        c_uint(TILE),
                        c_uint(ACROSS),
                        c_uint(ACROSS),
                        c_uint(DOWN),
                        c_float(mip),
                        c_float(1 / (ACROSS * TILE)),
                        c_float(1 / (ACROSS * TILE)),
                        c_uint64(out.address),
                    )
                    cycles = gpu.read(out, np.uint32, ACROSS * DOWN).reshape(DOWN, ACROSS)
                for y, row in enumerate(cycles):
                    for x, value in enumerate(row):
                        case = case_of(format=name, mip=mip, x=x, y=y)
                        session.rows.add(
                            "neighbours", case, "latency", float(value), "cycles", "clock"
                        )


def _profile_cases() -> list[tuple[str, str, str, int, int]]:
    """(kind, format, filter, mip, lanes to a row): one warp of each shape, and a sweep of 8x4."""
    cases = []
    for name in FORMATS:
        for filtered in FILTERS:
            for mip in MIPS:
                cases += [("warp", name, filtered, mip, across) for across in SHAPES]
                cases.append(("sweep", name, filtered, mip, 8))
    return cases


def profile_texels(session: Session, words: str) -> None:
    """Fetches whose number is known, under names that tell what they are."""
    gpu = session.gpu
    cases = _profile_cases()
    names = [f"{TEXELS}__{k}__{f}__{t}__mip{m}__across{a}" for k, f, t, m, a in cases]
    module = Module(gpu, build.copy_kernel(session.ptx("micro"), "footprint", names))
    textures, out = TextureMaker(gpu), gpu.allocate(16)
    for prefix, (kind, name, filtered, mip, across) in zip(names, cases, strict=True):
        with session.attempt(f"texels {prefix}"):
            side = (SIDE if kind == "warp" else SWEEP_SIDE) << mip
            texture = textures.make(name, filtered, side, mip + 2)
            shown = side >> mip
            offset, between = FILTERS[filtered]
            tiles_across = 1 if kind == "warp" else shown // across
            num_warps = 1 if kind == "warp" else shown * shown // 32
            at = 64 if kind == "warp" else 0
            gpu.launch(
                module.function(f"{prefix}__footprint"),
                num_warps,
                32,
                c_uint64(texture),
                c_uint(across),
                c_uint(tiles_across),
                c_uint(at),
                c_uint(at),
                c_float(offset),
                c_float(mip + between),
                c_float(1 / shown),
                c_float(1 / shown),
                c_uint64(out.address),
            )
            gpu.synchronise()


def case_of_kernel(name: str) -> str | None:
    """The row's case that a profiled kernel's name tells; None where it is none of these."""
    match = _CASE.search(name)
    if match is None:
        return None
    kind, texel_format, filtered, mip, across = match.groups()
    return case_of(kind=kind, format=texel_format, filter=filtered, mip=mip, across=across)
