"""The workload's cases, and the names under which the profiler shows their kernels.

afis__close__1920x1080__fixed64__texture__sampling__0__sampling_fixed_texture
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from experiments.silicon.rows import case_of

WORKLOAD, TEXELS = "afis", "texels"
#: Kernels that prepare or clean up: never profiled.
OTHER = "other"
FETCHES = ("texture", "load")
#: What a count is: the same for all pixels, or from the count map.
COUNTS = ("fixed64", "adaptive")
NUM_SAMPLES = 64
#: Frames that the adaptive method has rendered before the one that is measured.
HISTORY_FRAMES = 8
#: The pictures that are measured: (scene, width, height). The small one is for quick comparisons.
PICTURES = (
    ("front", 480, 270),
    ("close", 1920, 1080),
    ("ear", 1920, 1080),
    ("front", 1920, 1080),
    ("front", 3840, 2160),
)
_KERNEL = re.compile(
    rf"{WORKLOAD}__([a-z0-9]+)__(\d+)x(\d+)__([a-z0-9]+)__([a-z]+)__([a-z]+)__(\d+)__"
)


@dataclass(frozen=True, order=True)
class Case:
    """One launch of the workload. counts: of `COUNTS`. level: the pre-filter's source, else 0."""

    scene: str
    width: int
    height: int
    counts: str
    fetch: str
    pass_name: str
    level: int

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"

    @property
    def prefix(self) -> str:
        """Of the kernel's name."""
        words = (WORKLOAD, self.scene, self.size, self.counts, self.fetch, self.pass_name)
        return "__".join((*words, str(self.level)))

    @property
    def text(self) -> str:
        """As a row's case."""
        return case_of(
            scene=self.scene,
            size=self.size,
            counts=self.counts,
            fetch=self.fetch,
            **{"pass": self.pass_name},
            level=self.level,
        )

    @staticmethod
    def of_words(words: dict[str, str]) -> Case | None:
        """The case that `text` told; None where these words are no workload's."""
        try:
            width, height = words["size"].split("x")
            return Case(
                words["scene"],
                int(width),
                int(height),
                words["counts"],
                words["fetch"],
                words["pass"],
                int(words["level"]),
            )
        except (KeyError, ValueError):
            return None

    @staticmethod
    def of_kernel(name: str) -> Case | None:
        """The case that a kernel's name tells; None where it is no such name."""
        found = _KERNEL.search(name)
        if found is None:
            return None
        scene, width, height, counts, fetch, pass_name, level = found.groups()
        return Case(scene, int(width), int(height), counts, fetch, pass_name, int(level))


def passes_of(counts: str, fetch: str, num_levels: int) -> list[tuple[str, int]]:
    """(pass, level) of the launches that are measured.

    Set-up and pre-filter are the same for both counts, and measured once. By plain loads the
    pre-filter makes four fetches, where the model and shaders make one of a bilinear footprint: it
    is not measured.
    """
    found: list[tuple[str, int]] = []
    if counts != "adaptive":
        found.append(("setup", 0))
        if fetch == "texture":
            found += [("prefilter", level) for level in range(num_levels - 1)]
    found.append(("sampling", 0))
    if counts == "adaptive":
        found.append(("update", 0))
    return [*found, ("combine", 0)]


def kernel_of(case: Case) -> str:
    """The kernel of a case, in passes.cu."""
    if case.pass_name == "prefilter":
        return "prefilter_texture"
    if case.pass_name == "sampling":
        kind = "adaptive" if case.counts == "adaptive" else "fixed"
        return f"sampling_{kind}_{case.fetch}"
    return f"{case.pass_name}_{case.fetch}"
