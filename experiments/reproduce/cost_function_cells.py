"""The frames of `cost-function`: which are fitted to, and which are held out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kernels.method import Method


@dataclass(frozen=True)
class Cell:
    """A frame. kind: of the method. budget: m. sigma0_sq: of the adaptive count. held_out: it is
    predicted only.
    """

    scene: str
    width: int
    height: int
    kind: str
    budget: int
    scale: str
    held_out: bool
    sigma0_sq: float = 0.001

    @property
    def name(self) -> str:
        return f"{self.scene} {self.width}x{self.height} {self.kind} {self.budget} {self.scale}" + (
            f" {self.sigma0_sq:g}" if self.kind == "adaptive" else ""
        )

    @property
    def timed(self) -> bool:
        """Whether the frame is timed too, which takes ten times as long as counting it."""
        return self.kind != "hybrid" and self.width <= (480 if self.kind == "adaptive" else 320)

    @property
    def method(self) -> Method:
        from kernels.method import Method

        shared: dict[str, Any] = {"scale": self.scale, "sigma0_sq": self.sigma0_sq}
        return Method(kind=self.kind, num_samples=self.budget, b_max=self.budget, **shared)


def list_cells(quick: bool) -> tuple[Cell, ...]:
    """The frames that are fitted to, then those held out: other views, sizes and budgets."""
    small, larger = ((160, 90), (240, 136)) if quick else ((320, 180), (480, 270))
    kinds = (("fixed", 8), ("adaptive", 64)) if quick else (
        ("fixed", 8), ("fixed", 32), ("adaptive", 64), ("separable", 64), ("hybrid", 64),
    )  # fmt: skip
    cells = []
    for k, scene in enumerate(("close", "front")):
        for j, (width, height) in enumerate((small,) if quick else (small, larger)):
            for i, (kind, budget) in enumerate(kinds):
                scale = ("legacy", "physical")[(i + j + k) % 2]
                cells.append(Cell(scene, width, height, kind, budget, scale, False))
    others: list[tuple[tuple[int, int], str, int]] = [
        (small, "fixed", 16), (larger, "adaptive", 48)
    ]  # fmt: skip
    if not quick:
        others += [
            (small, "fixed", 64), (small, "hybrid", 48), ((640, 360), "fixed", 16),
            ((960, 540), "adaptive", 32),
        ]  # fmt: skip
    for k, scene in enumerate(("ear", "side")):
        for j, ((width, height), kind, budget) in enumerate(others):
            scale = ("legacy", "physical")[(j + k) % 2]
            cells.append(Cell(scene, width, height, kind, budget, scale, True, 0.0004))
    return tuple(cells)
