"""Time the cases of `experiments.p4000_cases`, one JSON file per finished case.

A case is one frame under the timing model. The files let a long run go on where it was stopped; one
that other inputs or another version of the simulator made is timed again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cachesim import simulate
from cachesim.report import sum_parts
from experiments.output import write_text
from experiments.p4000_cases import Case
from kernels.frame import render
from kernels.grid import Grid
from kernels.record import record
from traces.trace import Trace

if TYPE_CHECKING:
    from cachesim import Report
    from cachesim.config import Gpu
    from cachesim.timing.results import PassTiming
    from kernels.gbuffer import GBuffer
    from kernels.opencl.device import Device

Cell = dict[str, Any]
Counts = npt.NDArray[np.uint16]

#: Lane fetches that a host second times, until the first case has told.
FETCHES_PER_S = 2e6


def run_cases(
    cases: Sequence[Case],
    gbuffers: dict[str, GBuffer],
    gpu: Gpu,
    folder: Path,
    *,
    device: Device | None = None,
    told: Callable[[str], None] = lambda _: None,
    progress: Callable[[float], None] = lambda _: None,
    show_counts: Callable[[Case, Counts], None] = lambda case, counts: None,
) -> list[Cell]:
    """Every case's cell, in order: read where a finished one of the same inputs and sources lies in
    `folder`, measured and written there otherwise.

    Args:
        cases: what to time.
        gbuffers: by scene; all of one size.
        gpu: with timing.
        folder: of the cells; exists.
        device: where to render.
        told: is given a line before the first case, and one after each that was measured.
        progress: is given the share of the work that is done, 0 to 1, also within a case.
        show_counts: is given each adaptive count map that was rendered.
    """
    digests = {name: digest(gbuffer) for name, gbuffer in gbuffers.items()}
    counts: dict[tuple[str, str, str], Counts] = {}
    found: dict[str, Cell] = {}
    prints: dict[str, str] = {}
    for case in cases:
        trace = _trace(case, gbuffers[case.scene], device)
        prints[case.name] = fingerprint(trace, digests[case.scene], gpu)
        cell = read_cell(folder / f"{case.name}.json", prints[case.name])
        if cell is not None:
            found[case.name] = cell
    work = {c.name: c.work(gbuffers[c.scene]) for c in cases if c.name not in found}
    total = left = sum(work.values())
    rate = FETCHES_PER_S
    told(f"{len(found)} of {len(cases)} cases lie finished in {folder}; {_minutes(left / rate)}")
    measured, spent = 0.0, 0.0
    for case in cases:
        if case.name in found:
            continue
        start, own = monotonic(), work[case.name]

        def advance(share: float, left: float = left, own: float = own) -> None:
            progress((total - left + own * min(share, 1.0)) / total)

        key = case.scene, case.scale, case.method
        if key not in counts:
            counts[key] = count_samples(case, gbuffers[case.scene], device)
            if case.settings.adaptive:
                show_counts(case, counts[key])
        cell = measure(case, gbuffers[case.scene], counts[key], gpu, device, advance)
        seconds = monotonic() - start
        cell |= {"fingerprint": prints[case.name], "seconds": seconds}
        write_text(folder / f"{case.name}.json", json.dumps(cell, indent=1) + "\n")
        found[case.name] = cell
        left, measured, spent = left - own, measured + own, spent + seconds
        rate = measured / spent
        progress((total - left) / total)
        told(
            f"{len(found)} of {len(cases)}: {case.name}: {cell['time_ms']:.2f} ms, timed in "
            f"{seconds:,.0f} s; {_minutes(left / rate)}"
        )
    return [found[case.name] for case in cases]


def _minutes(seconds: float) -> str:
    return (
        f"about {seconds / 60:,.0f} min left" if seconds >= 90 else f"about {seconds:,.0f} s left"
    )


def count_samples(case: Case, gbuffer: GBuffer, device: Device | None = None) -> Counts:
    """(h, w) uint16: the samples of each pixel of the timed frame, 0 where nothing scatters."""
    if case.settings.adaptive:
        return render(gbuffer, case.settings, case.num_frames, device).counts
    return np.where(gbuffer.subsurface, case.settings.num_samples, 0).astype(np.uint16)


def measure(
    case: Case,
    gbuffer: GBuffer,
    counts: Counts,
    gpu: Gpu,
    device: Device | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Cell:
    """Record and time one case. counts: from `count_samples`.

    Times in ms; `mean_count` samples per scattering pixel, `warp_count` the mean over the warps
    that scatter of their hungriest lane's. `passes`: per pass the time, the bound and its share of
    the cycles without launch, bytes and miss rates per level, and the DRAM's share of its peak.
    """
    method = case.settings
    grid = Grid(gbuffer.width, gbuffer.height, method.tile_order, method.lane_map)
    expected = case.work(gbuffer)
    report = simulate(
        _trace(case, gbuffer, device),
        gpu,
        timing=True,
        progress=lambda fetches: progress(fetches / expected),
    )
    timing = report.timing
    assert timing is not None
    return {
        "scene": case.scene,
        "scale": case.scale,
        "planes": case.planes,
        "method": case.method,
        "gpu": gpu.name,
        "size": f"{gbuffer.width}x{gbuffer.height}",
        "coverage_rate": gbuffer.coverage_rate,
        "pixels_per_mm": gbuffer.pixels_per_mm() * (10 / 3 if case.scale == "legacy" else 1),
        "mean_count": float(counts.sum(dtype=np.int64) / gbuffer.subsurface.sum()),
        "warp_count": _warp_count(counts, grid),
        "lane_fetches": report.lane_fetches,
        "time_ms": timing.time_ms,
        "passes": [
            {"pass": p.name, "time_ms": timing.milliseconds(p), **_pass_row(p, report)}
            for p in timing.passes
        ],
    }


def _warp_count(counts: Counts, grid: Grid) -> float:
    largest = np.where(grid.inside, grid.gather(counts), 0).max(axis=1)
    return float(largest[largest > 0].mean())


def _pass_row(part: PassTiming, report: Report) -> Cell:
    """A pass's bound and traffic."""
    running = max(1, part.cycles - part.launch_cycles)
    row: Cell = {
        "cycles": part.cycles,
        "launch_cycles": part.launch_cycles,
        "bound": part.bottleneck,
        "bound_share": part.where.get(part.bottleneck, 0) / running,
        "where": dict(part.where),
        "occupancy": part.occupancy,
        "warp_instructions": dict(part.warp_instructions),
    }
    parts = [p for p in report.parts or () if p.pass_name == part.name]
    for level in report.levels if parts else ():
        counts = sum_parts(parts, level)
        row[f"{level}_mb"] = counts.demand_bytes / 1e6
        row[f"{level}_miss_rate"] = counts.miss_rate
    row["dram_mb"] = sum(p.dram.bytes for p in parts) / 1e6
    row["dram_of_peak"] = part.utilisation("dram") if "dram" in part.levels else None
    row["rows_opened"] = part.rows_opened
    return row


def _trace(case: Case, gbuffer: GBuffer, device: Device | None) -> Trace:
    return record(
        gbuffer, case.settings, num_frames=case.num_frames, device=device, self_check=False
    )


def read_cell(path: Path, wanted: str) -> Cell | None:
    """A finished cell with this fingerprint; None where there is none, or one of another run."""
    try:
        cell = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    matches = isinstance(cell, dict) and cell.get("fingerprint") == wanted
    return cell if matches else None


def digest(gbuffer: GBuffer) -> str:
    """SHA-256 of a G-buffer's content."""
    hashed = hashlib.sha256(repr((gbuffer.name, gbuffer.projection_x)).encode())
    for name in ("irradiance", "albedo", "non_subsurface", "depth_cm", "normal", "profile_id"):
        hashed.update(np.ascontiguousarray(getattr(gbuffer, name)).data)
    return hashed.hexdigest()


def fingerprint(trace: Trace, scene_digest: str, gpu: Gpu) -> str:
    """SHA-256 of all that decides a case's times: picture, method, what the passes execute, the
    machine, and the simulator's own sources.
    """
    keys = ("width", "height", "method", "num_frames", "traced_frames", "kernel_source_sha256")
    told = json.dumps({k: trace.manifest[k] for k in keys}, sort_keys=True)
    program = repr((list(trace.instructions), list(trace.launches)))
    parts = (told, program, scene_digest, gpu.model_dump_json(), _simulator_hash())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@cache
def _simulator_hash() -> str:
    hashed = hashlib.sha256()
    for path in _simulator_files():
        hashed.update(f"{path.name}\0".encode() + path.read_bytes())
    return hashed.hexdigest()


def _simulator_files() -> Iterator[Path]:
    """The sources between a trace and its times: the simulator's, and those of the layouts."""
    import cachesim
    import traces

    for package in (cachesim, traces):
        assert package.__file__ is not None
        yield from sorted(Path(package.__file__).parent.rglob("*.py"))
