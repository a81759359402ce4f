"""A Trace as Accel-Sim's files: `kernelslist.g` and one `kernel-N.traceg` per launch, CTA by CTA.

What Accel-Sim then runs is the Trace's accesses, in its order, with the arithmetic and the waits
between them; texel fetches are global loads, since its texture instructions make no traffic.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from traces.accel_sim.accesses import MODES, Accesses, Lines
from traces.accel_sim.addresses import encode
from traces.accel_sim.code import Code, State
from traces.accel_sim.header import TRACER_VERSION, KernelHeader
from traces.accel_sim.opcodes import DEFAULT_BINARY_VERSION, check_binary_version
from traces.check import Checker
from traces.files import replacing_folder, writing
from traces.placement import place
from traces.texture import WARP_SIZE
from traces.trace import Chunk, Trace

LIST_NAME = "kernelslist.g"
DEFAULT_LAYOUT = "block-linear-turing"
#: Rows whose lines are made at once; bounds memory.
_ROWS_AT_ONCE = 1 << 12
#: CTAs of a chunk that an estimate writes.
_SAMPLED_CTAS = 4


@dataclass(frozen=True)
class Settings:
    """How a trace is exported.

    mode: one of `MODES`. binary_version: one of `BINARY_VERSIONS`, which Accel-Sim takes the
        opcodes of. layout: of the textures; a lane-address trace has none.
    """

    mode: str = MODES[0]
    binary_version: int = DEFAULT_BINARY_VERSION
    layout: str = DEFAULT_LAYOUT


@dataclass(frozen=True)
class Size:
    """How large an export is going to be. num_bytes: estimated from a sample of CTAs."""

    num_kernels: int
    num_rows: int
    num_lane_fetches: int
    num_bytes: int


def write_accel_sim(
    trace: Trace,
    folder: str | Path,
    settings: Settings | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write a trace, chunk by chunk; every chunk is checked on its way.

    Launch n becomes `kernel-<n + 1>.traceg`; one without CTAs is left out, as Accel-Sim cannot
    start it.

    folder: new or empty. progress: told the number of lane fetches written so far, after each
        chunk.

    Raises:
        InputError: a broken trace, settings that are not allowed, or a folder that holds anything
            or cannot be written to.
        WorkError: writing failed, for example for want of space. Nothing is left behind.
    """
    export = _Export(trace, settings or Settings())
    checker = Checker(trace, str(folder))
    with replacing_folder(folder) as part:
        launches: list[int] = []
        for chunk in _checked(trace, checker, progress):
            texts = export.ctas(chunk)
            name = part / f"kernel-{chunk.launch + 1}.traceg"
            if chunk.launch not in launches[-1:]:
                launches.append(chunk.launch)
                texts = chain([export.header(chunk.launch).text()], texts)
            with writing(folder), name.open("a", encoding="utf-8", newline="\n") as file:
                file.writelines(texts)
        listed = "".join(f"kernel-{launch + 1}.traceg\n" for launch in launches)
        with writing(folder):
            (part / LIST_NAME).write_text(listed, encoding="utf-8", newline="\n")


def estimate_size(
    trace: Trace, settings: Settings | None = None, progress: Callable[[int], None] | None = None
) -> Size:
    """How large `write_accel_sim` would make it; reads the trace once. Arguments and errors are as
    there.
    """
    export = _Export(trace, settings or Settings())
    checker = Checker(trace)
    num_bytes = num_rows = 0
    launches = set()
    for chunk in _checked(trace, checker, progress):
        num_rows += chunk.num_rows
        launches.add(chunk.launch)
        sampled = export.sample(chunk)
        written = sum(len(text) for text in export.ctas(sampled))
        # Every warp has lines of its own besides those of its rows.
        weight, sampled_weight = (part.num_rows + part.num_warps for part in (chunk, sampled))
        num_bytes += written * weight // sampled_weight
    num_bytes += sum(len(export.header(launch).text()) for launch in launches)
    return Size(len(launches), num_rows, checker.num_lane_fetches, num_bytes)


def _checked(
    trace: Trace, checker: Checker, progress: Callable[[int], None] | None
) -> Iterator[Chunk]:
    """The chunks that have CTAs."""
    for chunk in trace.chunks():
        checker.chunk(chunk)
        if chunk.num_warps:
            yield chunk
        if progress:
            progress(checker.num_lane_fetches)
    checker.finish()


class _Export:
    """Makes the text of CTAs."""

    def __init__(self, trace: Trace, settings: Settings) -> None:
        check_binary_version(settings.binary_version)
        self._trace = trace
        self._settings = settings
        address_map = None if trace.is_lane_address else place(trace.textures, settings.layout)
        self._accesses = Accesses(trace, settings.mode, address_map)
        self._code: Code | None = None
        self._code_of = -1
        # Warps that only fill up the last CTA of a lane-address trace run nothing.
        padding = trace.manifest.get("padding_warps", 0) if trace.is_lane_address else 0
        self._num_padding = padding if isinstance(padding, int) and len(trace.launches) == 1 else 0

    def header(self, launch: int) -> KernelHeader:
        described = self._trace.launches[launch]
        name = re.sub(r"\s+", "_", described.pass_name) or "kernel"
        if not self._trace.is_lane_address or self._settings.mode != MODES[0]:
            name = f"{name}.{self._settings.mode}"
        return KernelHeader(
            name,
            launch + 1,
            (described.num_ctas, 1, 1),
            (described.warps_per_cta * WARP_SIZE, 1, 1),
            described.shared_bytes_per_cta,
            described.registers_per_thread,
            self._settings.binary_version,
            tracer_version=TRACER_VERSION,
        )

    def sample(self, chunk: Chunk) -> Chunk:
        """A few CTAs of a chunk, evenly spread."""
        warps_per_cta = self._trace.launches[chunk.launch].warps_per_cta
        num_ctas = chunk.num_warps // warps_per_cta
        chosen = np.unique(np.linspace(0, num_ctas - 1, _SAMPLED_CTAS).astype(np.int64))
        warps = (chosen[:, None] * warps_per_cta + np.arange(warps_per_cta)).ravel()
        rows = [np.arange(chunk.warp_offsets[warp], chunk.warp_offsets[warp + 1]) for warp in warps]
        index = np.concatenate(rows)
        offsets = np.cumsum([0, *map(len, rows)], dtype=np.int64)
        return Chunk(
            chunk.launch, chunk.first_cta, offsets, chunk.instruction[index], chunk.lanes[index]
        )

    def ctas(self, chunk: Chunk) -> Iterator[str]:
        """The text of each CTA of a chunk."""
        launch = self._trace.launches[chunk.launch]
        if self._code is None or self._code_of != chunk.launch:
            # Program counters start anew in every kernel.
            self._code = Code(
                self._trace.instructions,
                self._accesses.access_bytes,
                self._settings.binary_version,
            )
            self._code_of = chunk.launch
        num_running = launch.num_ctas * launch.warps_per_cta - self._num_padding
        for first, part in _slices(chunk, launch.warps_per_cta):
            made = self._accesses.lines(part)
            warps = self._warps(part, self._code, made, launch.trailing_arithmetic)
            for cta in range(first, first + part.num_warps // launch.warps_per_cta):
                texts = [f"\n#BEGIN_TB\n\nthread block = {cta},0,0\n"]
                for warp in range(launch.warps_per_cta):
                    text, num_lines = next(warps)
                    if cta * launch.warps_per_cta + warp >= num_running:
                        text, num_lines = self._code.exit()
                    texts.append(f"\nwarp = {warp}\ninsts = {num_lines}\n{text}")
                texts.append("\n#END_TB\n")
                yield "".join(texts)

    def _warps(
        self, part: Chunk, code: Code, lines: Lines, trailing: tuple[tuple[str, int], ...]
    ) -> Iterator[tuple[str, int]]:
        """The lines of each warp of a part of a chunk, and how many."""
        masks, fields = encode(lines.addresses)
        instruction, offsets = part.instruction.tolist(), lines.offsets.tolist()
        ends = part.warp_offsets.tolist()
        for begin, end in pairwise(ends):
            state, num_lines = State(), 0
            texts: list[str] = []
            for row in range(begin, end):
                line, next_line = offsets[row], offsets[row + 1]
                case = code.access(state, instruction[row], next_line - line)
                texts.append(case.before)
                for (head, middle), at in zip(case.accesses, range(line, next_line), strict=True):
                    texts += (head, masks[at], middle, fields[at], " 0\n")
                state, num_lines = case.state, num_lines + case.num_lines
            text, num_last = code.end(state, trailing)
            texts.append(text)
            yield "".join(texts), num_lines + num_last


def _slices(chunk: Chunk, warps_per_cta: int) -> Iterator[tuple[int, Chunk]]:
    """The chunk in pieces of whole CTAs of about `_ROWS_AT_ONCE` rows, with their first CTAs."""
    starts = chunk.warp_offsets[::warps_per_cta]
    num_ctas = len(starts) - 1
    begin = 0
    while begin < num_ctas:
        end = int(np.searchsorted(starts, starts[begin] + _ROWS_AT_ONCE, side="right")) - 1
        # CTAs without rows cost lines as well.
        end = min(max(end, begin + 1), begin + _ROWS_AT_ONCE, num_ctas)
        low, high = int(starts[begin]), int(starts[end])
        offsets = chunk.warp_offsets[begin * warps_per_cta : end * warps_per_cta + 1] - low
        first = chunk.first_cta + begin
        rows = slice(low, high)
        yield (
            first,
            Chunk(chunk.launch, first, offsets, chunk.instruction[rows], chunk.lanes[rows]),
        )
        begin = end
