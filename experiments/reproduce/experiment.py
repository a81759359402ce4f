"""What an experiment is, what it is given and what it hands back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.reproduce.parts import Parts

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import pandas as pd
    from matplotlib.figure import Figure

    from experiments.tables import Table
    from kernels.opencl.device import Device

    #: A picture: (h, w) grey or (h, w, 3) colour, uint8.
    Image = npt.NDArray[np.uint8]


def _say_nothing(text: str, share: float) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class Settings:
    """What a run of an experiment is given.

    quick: whether seconds must do; the full sizes otherwise. out: folder of the results; exists.
    progress: is told what is being done and the share of the experiment that is done, 0 to 1.
    device: part of the OpenCL device's name, or None for the first that works.
    """

    quick: bool
    out: Path
    progress: Callable[[str, float], None] = _say_nothing
    device: str | None = None

    def open_device(self) -> Device:
        """The OpenCL device, opened once per process; pure maths never asks for it.

        Raises:
            WorkError: no device works here.
            InputError: none has that name.
        """
        return _open_device(self.device)

    def parts(self, name: str, *sources: str) -> Parts:
        """The finished cells of the experiment `name`, apart for quick and full runs.

        sources: dotted names of the packages and modules whose change makes cells void.
        """
        return Parts(self.out / ".parts" / name / ("quick" if self.quick else "full"), sources)


@cache
def _open_device(name: str | None) -> Device:
    from kernels.opencl.device import open_device

    return open_device(name)


@dataclass(frozen=True)
class Comparison:
    """One number of the paper beside ours.

    quantity: what it is. paper: as printed; None where the sources print none. ours: a number, or
    text such as "0.032 +- 0.003". unit: "" for a pure number. verdict: in words. agrees: whether
    the two agree; None where nothing can be claimed either way.
    """

    quantity: str
    paper: str | float | None
    ours: str | float
    unit: str = ""
    verdict: str = ""
    agrees: bool | None = None


def compare(
    quantity: str,
    paper: float,
    ours: float,
    unit: str = "",
    *,
    relative: float | None = None,
    spread: float | None = None,
    note: str = "",
) -> Comparison:
    """A comparison of two numbers whose verdict follows from a stated tolerance.

    Args:
        quantity, paper, ours, unit: as in `Comparison`.
        relative: agreement is a relative difference of at most this.
        spread: agreement is a difference of at most two of these standard deviations.
        note: appended to the verdict.
    """
    if (relative is None) == (spread is None):
        raise ValueError("give one of relative, spread")
    if spread is not None:
        deviations = abs(ours - paper) / spread if spread else math.inf * abs(ours - paper)
        agrees = deviations <= 2
        told = f"{deviations:.1f} standard deviations apart"
    else:
        assert relative is not None
        difference = (ours - paper) / paper if paper else math.copysign(math.inf, ours)
        agrees = abs(difference) <= relative
        told = f"{100 * difference:+.2g} %, within {100 * relative:.2g} %"
        if not agrees:
            told = f"{100 * difference:+.3g} %, more than {100 * relative:.2g} %"
    words = f"{'agrees' if agrees else 'differs'}: {told}"
    return Comparison(quantity, paper, ours, unit, f"{words}; {note}" if note else words, agrees)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an experiment found.

    tables: by name; a `Table` is shown as it says, a frame with all its columns; the CSV has every
    column. figures: by name, a matplotlib figure or a picture. comparisons: the paper's numbers
    beside ours. words: paragraphs of the page: what was done, what it shows, what stays unknown.
    verdict: one sentence for the index; made from the comparisons where empty. captions: what
    stands under a figure, by its name; attributions belong here.
    """

    tables: Mapping[str, pd.DataFrame | Table] = field(default_factory=dict)
    figures: Mapping[str, Figure | Image] = field(default_factory=dict)
    comparisons: tuple[Comparison, ...] = ()
    words: tuple[str, ...] = ()
    verdict: str = ""
    captions: Mapping[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """The verdict, or how many comparisons agree and which do not."""
        if self.verdict:
            return self.verdict
        judged = [c for c in self.comparisons if c.agrees is not None]
        if not judged:
            if any(c.paper is not None for c in self.comparisons):
                return "computed; no claim can be made, see the page"
            return "computed; the sources print no number to compare with"
        differing = [c.quantity for c in judged if not c.agrees]
        told = f"{len(judged) - len(differing)} of {len(judged)} comparisons agree"
        return f"{told}; differing: {'; '.join(differing)}" if differing else told


@dataclass(frozen=True)
class Experiment:
    """An entry of the catalogue.

    name: on the command line; its module is named alike. title: what it shows, one line. chapter,
    figure: where in the dissertation ("5", "slide: sampling function"). minutes, quick_minutes: how
    long a run takes on a laptop's four cores. run: None where the sources do not allow the result,
    and `reason` then says why. after_others: whether it shows what the others have written, and so
    has to wait for them.
    """

    name: str
    title: str
    chapter: str
    figure: str
    minutes: float = 0.0
    quick_minutes: float = 0.0
    run: Callable[[Settings], Outcome] | None = None
    reason: str = ""
    after_others: bool = False

    def __post_init__(self) -> None:
        if (self.run is None) != bool(self.reason):
            raise ValueError(f"experiment {self.name!r}: needs either run or reason")

    def expected_minutes(self, quick: bool) -> float:
        return self.quick_minutes if quick else self.minutes


def as_plain(value: Any) -> Any:
    """A NumPy scalar as the Python number that JSON can hold; anything else as it is."""
    return value.item() if hasattr(value, "item") and getattr(value, "ndim", 1) == 0 else value
