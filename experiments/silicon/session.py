"""What a task gets: the GPU, the PTX, where its rows go, and a way to go on after a failure."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import c_uint64
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TextIO

from experiments.silicon.build import committed_ptx
from experiments.silicon.driver import DriverError, Gpu, Module
from experiments.silicon.rows import RowWriter
from traces.errors import InputError

#: Idle GPUs clock low, and take tens of milliseconds to rise; short launches keep desktops alive.
WARM_UP_LAUNCHES, WARM_UP_NS = 30, 10_000_000


@dataclass
class Session:
    """One process that measures.

    rows: where numbers go. failures: a file that gets a line of JSON for each thing that failed.
    ptx_folder: PTX that nvcc made, or "" for the committed. inputs: folder of prepared pictures.
    """

    rows: RowWriter
    failures: TextIO
    ptx_folder: str = ""
    inputs: str = ""
    num_failures: int = 0
    _modules: dict[str, Module] = field(default_factory=dict)

    @cached_property
    def gpu(self) -> Gpu:
        return Gpu()

    def ptx(self, name: str) -> str:
        """The PTX of a source."""
        if self.ptx_folder:
            return (Path(self.ptx_folder) / f"{name}.ptx").read_text(encoding="utf-8")
        return committed_ptx(name)

    def micro(self) -> Module:
        """The micro-measurements' kernels."""
        if "micro" not in self._modules:
            self._modules["micro"] = Module(self.gpu, self.ptx("micro"))
        return self._modules["micro"]

    def warm_up(self) -> None:
        """Keep every SM busy until the clocks have risen."""
        out = self.gpu.allocate(32)
        function = self.micro().function("clock_rate")
        num_ctas = self.gpu.attributes().get("num_sms", 1)
        for _ in range(WARM_UP_LAUNCHES):
            self.gpu.launch(function, num_ctas, 1, c_uint64(WARM_UP_NS), c_uint64(out.address))
        self.gpu.synchronise()
        self.gpu.free(out)

    @contextmanager
    def attempt(self, what: str) -> Iterator[None]:
        """Do something whose failure is noted and ends nothing but itself."""
        try:
            yield
        except (
            DriverError,
            InputError,
            MemoryError,
            OSError,
            ValueError,
            ArithmeticError,
        ) as error:
            self.num_failures += 1
            note = {"what": what, "why": f"{type(error).__name__}: {error}"}
            self.failures.write(json.dumps(note) + "\n")
            self.failures.flush()
