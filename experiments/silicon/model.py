"""The model's side of the comparison: the workload's launches, each from empty caches, as the
profiler runs them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from cachesim import simulate
from experiments.silicon.cases import HISTORY_FRAMES, Case
from experiments.silicon.prepare import method_of
from kernels.record import record
from kernels.scene import load_scene
from traces.trace import Chunk, Trace

if TYPE_CHECKING:
    from cachesim.config import Gpu
    from cachesim.report import Report
    from kernels.opencl.device import Device

#: How each way to fetch enters the model: (fetch path, layout; None takes the GPU's own).
PATHS: dict[str, tuple[str, str | None]] = {
    "texture": ("texture", None),
    "load": ("global", "row-major"),
}
#: On the GPU, albedo has the precision that the OpenCL kernel's has: 8 B a texel.
_WIDENED = {"albedo": "RGBA16F"}
INSTRUCTION_TARGET = "sm_90"


@dataclass(frozen=True)
class Group:
    """Cases that one recording answers: a picture with one kind of counts and one way to fetch."""

    scene: str
    width: int
    height: int
    counts: str
    fetch: str

    @staticmethod
    def of(case: Case) -> Group:
        return Group(case.scene, case.width, case.height, case.counts, case.fetch)

    @property
    def name(self) -> str:
        return f"{self.scene} {self.width}x{self.height} {self.counts} {self.fetch}"


def launches_of(trace: Trace) -> Iterator[tuple[int, Trace]]:
    """(index, trace) of each launch by itself; to be used up in order: the recording runs once.

    Rows refer to the same textures and instructions as before.
    """
    textures = [replace(t, format=_WIDENED.get(t.name, t.format)) for t in trace.textures]
    for launch, chunks in itertools.groupby(trace.chunks(), key=lambda chunk: chunk.launch):
        alone = partial(_renumber, chunks)
        launches = [trace.launches[launch]]
        yield launch, Trace(trace.manifest, textures, trace.instructions, launches, alone)


def _renumber(chunks: Iterator[Chunk]) -> Iterator[Chunk]:
    return (replace(chunk, launch=0) for chunk in chunks)


def simulate_group(
    group: Group,
    gpu: Gpu,
    *,
    timing: bool,
    device: Device | None = None,
    wanted: Sequence[Case] = (),
    step: Callable[[str], None] = lambda text: None,
) -> dict[Case, Report]:
    """Record a group's frame and run each launch that is wanted through the model.

    wanted: cases; all where empty. step: told what is run next.

    Raises:
        InputError: an unknown scene, or a GPU that cannot be timed. DeviceError: no OpenCL device.
    """
    method = method_of(group.counts)
    gbuffer = load_scene(group.scene, group.width, group.height, device=device)
    frames = HISTORY_FRAMES if method.adaptive else 1
    passes = tuple(
        name for name in method.passes if not wanted or any(c.pass_name == name for c in wanted)
    )
    trace = record(
        gbuffer,
        replace(method, passes=passes),
        num_frames=frames,
        device=device,
        self_check=False,
        instruction_target=INSTRUCTION_TARGET,
    )
    fetch_path, layout = PATHS[group.fetch]
    levels: dict[str, int] = {}
    found: dict[Case, Report] = {}
    for launch, alone in launches_of(trace):
        name = trace.launches[launch].pass_name
        level = levels.get(name, 0)
        levels[name] = level + 1
        case = Case(group.scene, group.width, group.height, group.counts, group.fetch, name, level)
        if wanted and case not in wanted:
            for _ in alone.chunks():
                pass
            continue
        step(f"{group.name} {name} {level}")
        found[case] = simulate(
            alone, gpu, fetch_path=fetch_path, layout=layout, timing=timing, threaded=False
        )
    return found
