"""Run the tasks, each in a process of its own, and keep one file of all that was measured."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.silicon import build, ncu
from experiments.silicon.cases import PICTURES, Case
from experiments.silicon.inputs import file_name
from experiments.silicon.rows import Measurements, Row, read_parts, write_measurements
from experiments.silicon.tasks import Task, list_tasks
from experiments.silicon.tasks_texels import case_of_kernel
from experiments.silicon.tools import Tools, read_card
from traces.errors import InputError, WorkError

#: Seconds after which no further task is begun.
BUDGET_S = 540.0
#: What the profiler tells of every launch, asked or not, that is kept.
LAUNCH_FACTS = (
    "launch__registers_per_thread",
    "launch__shared_mem_config_size",
    "launch__occupancy_limit_registers",
)
Say = Callable[[str], None]


def choose_tasks(only: Sequence[str]) -> list[Task]:
    """The tasks to run. only: names or beginnings of names; all where empty.

    Raises:
        InputError: a name that no task has.
    """
    tasks = list_tasks()
    for name in only:
        if not any(task.name.startswith(name) for task in tasks):
            raise InputError(f"--only {name!r}: choose from {', '.join(t.name for t in tasks)}")
    return [t for t in tasks if not only or any(t.name.startswith(n) for n in only)]


def pictures_of(tasks: Sequence[Task]) -> list[str]:
    """The pictures that tasks need, as "front_480x270"."""
    names = [f"{scene}_{width}x{height}" for scene, width, height in PICTURES]
    return [name for name in names if any(task.words == name for task in tasks)]


def drop_unprepared(tasks: Sequence[Task], inputs: str) -> tuple[list[Task], list[str]]:
    """(tasks whose picture is there, remarks on those whose is not). inputs: the folder, or ""."""
    chosen, missing = list(tasks), []
    for scene, width, height in PICTURES:
        name = f"{scene}_{width}x{height}"
        if name in pictures_of(chosen) and not (
            inputs and (Path(inputs) / file_name(scene, width, height)).is_file()
        ):
            chosen = [t for t in chosen if t.words != name]
            missing.append(
                f"{name}: not measured: no file {file_name(scene, width, height)} in --inputs"
            )
    return chosen, missing


@dataclass
class Run:
    """One measurement of a GPU. path: the file. failures: what went wrong, for the manifest."""

    path: Path
    tools: Tools
    inputs: str
    say: Say
    budget_s: float = BUDGET_S
    rows: list[Row] = field(default_factory=list)
    failures: list[dict[str, str]] = field(default_factory=list)
    manifest: dict[str, Any] = field(default_factory=dict)
    ptx_folder: str = ""
    _metrics: list[str] | None = None
    _blocked: bool = False

    def run(self, tasks: Sequence[Task]) -> None:
        """Run the tasks within the budget; the file is written after each.

        Raises:
            WorkError: nothing at all could be measured.
        """
        begin = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="silicon-") as scratch:
            folder = Path(scratch)
            self._describe()
            self._compile(folder)
            for task in tasks:
                left = self.budget_s - (time.monotonic() - begin)
                if left < 5:
                    self._fail(task.name, f"not begun: the {self.budget_s:.0f} s were used up")
                    continue
                if task.profiled and (not self.tools.ncu or self._blocked):
                    continue
                self._run_task(task, folder, min(task.timeout_s, left))
                self._write()
        self.manifest["seconds"] = round(time.monotonic() - begin, 1)
        self._write()
        if not self.rows:
            why = self.failures[0]["why"] if self.failures else "no task was chosen"
            raise WorkError(f"nothing was measured: {why}")

    def _describe(self) -> None:
        self.manifest.update(
            device=self.tools.gpu,
            driver_cuda=self.tools.driver,
            card=read_card(),
            nvcc=self.tools.nvcc_version,
            ncu=self.tools.ncu_version,
            compiler=f"nvcc {self.tools.nvcc_version}" if self.tools.nvcc else "committed PTX",
            counters="ncu" if self.tools.ncu else "none: ncu is missing",
            date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            commit=_commit(),
            sources={name: build.source_hash(name) for name in build.SOURCES},
            python=platform.python_version(),
        )

    def _compile(self, folder: Path) -> None:
        """PTX by nvcc where it is; else, or where it fails, the committed PTX."""
        if not self.tools.nvcc:
            return
        if _version(self.tools.nvcc_version) > _version(self.tools.driver):
            self.manifest["compiler"] = "committed PTX: nvcc is newer than the driver"
            return
        made = folder / "ptx"
        made.mkdir()
        try:
            target = self._target()
            for name in build.SOURCES:
                text = build.compile_ptx(self.tools.nvcc, name, target)
                (made / f"{name}.ptx").write_text(text, encoding="utf-8")
        except WorkError as error:
            self._fail("nvcc", str(error))
            self.manifest["compiler"] = "committed PTX: nvcc failed"
            return
        self.ptx_folder = str(made)
        self.manifest["compiler"] = f"nvcc {self.tools.nvcc_version} for {target}"

    def _target(self) -> str:
        from experiments.silicon.driver import Driver

        attributes = Driver().attributes()
        major = attributes["compute_capability_major"]
        return f"compute_{major}{attributes['compute_capability_minor']}"

    def _run_task(self, task: Task, folder: Path, timeout_s: float) -> None:
        begin, before = time.monotonic(), len(self.rows)
        rows, failures = folder / f"{task.name}.csv", folder / f"{task.name}.failures"
        command = [
            *(sys.executable, "-m", "experiments.silicon", "child", task.name),
            *("--rows", str(rows), "--failures", str(failures)),
            *("--ptx", self.ptx_folder, "--inputs", self.inputs),
        ]
        if task.profiled:
            why = self._profile(task, command, folder / f"{task.name}.log", timeout_s)
        else:
            why = _run_process(command, timeout_s)
        if rows.is_file():
            self.rows += read_parts(rows.read_text(encoding="utf-8"))
        if failures.is_file():
            for line in failures.read_text(encoding="utf-8").splitlines():
                self._fail(task.name, "{what}: {why}".format(**json.loads(line)))
        if why:
            self._fail(task.name, why)
        seconds, found = time.monotonic() - begin, len(self.rows) - before
        self.say(f"{task.name}: {found} numbers in {seconds:.1f} s" + (f"; {why}" if why else ""))

    def _profile(self, task: Task, command: list[str], log: Path, timeout_s: float) -> str:
        """Run a task under the profiler; "" or what went wrong. Counters that the profiler does not
        take are left out, and it is asked again.
        """
        if self._metrics is None:
            self._metrics = ncu.choose_metrics(ncu.query_available(self.tools.ncu))
        begin, refused = time.monotonic(), ["any"]
        why = ""
        while refused and self._metrics:
            called = ncu.command(self.tools.ncu, self._metrics, log, task.profiled) + command
            failed = _run_process(called, max(1.0, timeout_s - (time.monotonic() - begin)))
            told = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
            why = self._take_counters(task, told) or failed
            refused = ncu.refused_metrics(f"{told}\n{failed}", self._metrics) if why else []
            for name in refused:
                self._fail(task.name, f"the profiler does not take {name}")
            self._metrics = [name for name in self._metrics if name not in refused]
        return why

    def _take_counters(self, task: Task, text: str) -> str:
        """Rows of what the profiler wrote; what went wrong, or ""."""
        if ncu.BLOCKED in text:
            self._blocked = True
            self.manifest["counters"] = f"none: blocked by the driver ({ncu.BLOCKED}); times alone"
            return str(self.manifest["counters"])
        try:
            launches = ncu.parse_raw_page(text, task.name)
        except InputError as error:
            lines = [line for line in text.splitlines() if line.startswith("==ERROR==")]
            return f"{error}" + (f": {lines[0]}" if lines else "")
        seen = {
            (row.measurement, row.case, row.quantity) for row in self.rows if row.source == "ncu"
        }
        for launch in launches:
            case = Case.of_kernel(launch.kernel)
            text_case = case.text if case else case_of_kernel(launch.kernel)
            if text_case is None:
                continue
            measurement = "workload" if case else "texels"
            for name, value in launch.values.items():
                if name not in (self._metrics or ()) and name not in LAUNCH_FACTS:
                    continue
                key = measurement, text_case, name
                if key not in seen:
                    seen.add(key)
                    self.rows.append(Row(measurement, text_case, name, value, "base", "ncu"))
        return ""

    def _fail(self, what: str, why: str) -> None:
        self.failures.append({"task": what, "why": " ".join(why.split())[:500]})

    def _write(self) -> None:
        self.manifest["failures"] = self.failures
        write_measurements(self.path, Measurements(self.manifest, tuple(self.rows)))


def _run_process(command: Sequence[str], timeout_s: float) -> str:
    """Run a process; "" or why it failed. When its time is up it is ended, with all it started."""
    with tempfile.TemporaryFile("w+", errors="replace") as told:
        try:
            process = subprocess.Popen(
                list(command),
                cwd=Path(build.folder()).parents[2],
                stdin=subprocess.DEVNULL,
                stdout=told,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            return f"{command[0]}: {error.strerror}"
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return f"ended after {timeout_s:.0f} s"
        finally:
            _end_group(process)
        if code == 0:
            return ""
        told.seek(0)
        lines = [line.strip() for line in told.read().splitlines() if line.strip()]
    return f"exit code {code}: {lines[-1][:300] if lines else 'no message'}"


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """End a process of ours, and what it started, where any of them still runs."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _version(text: str) -> tuple[int, ...]:
    """(12, 4) of "12.4"."""
    return tuple(int(part) for part in text.split(".") if part.isdigit())


def _commit() -> str:
    """The checkout's commit; "" outside of one."""
    folder = Path(build.folder()).parents[2]
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=False
        )
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def measure(
    path: Path, tools: Tools, inputs: str, only: Sequence[str], budget_s: float, say: Say
) -> Run:
    """Measure this machine's GPU into a file.

    Raises:
        WorkError: there is no GPU, or nothing could be measured. InputError: an unknown task.
    """
    if not tools.gpu:
        raise WorkError("; ".join(tools.reasons))
    tasks, remarks = drop_unprepared(choose_tasks(only), inputs)
    run = Run(path, tools, str(Path(inputs).resolve()) if inputs else "", say, budget_s)
    for remark in remarks:
        say(remark)
        run.failures.append({"task": "pictures", "why": remark})
    run.run(tasks)
    return run


def merge(parts: Sequence[Measurements], names: Sequence[str]) -> Measurements:
    """Measurements of one GPU from several runs; of the same number the first counts.

    Raises:
        InputError: they are of different GPUs.
    """
    devices = {str(part.manifest["device"]) for part in parts}
    if len(devices) != 1:
        raise InputError(f"{', '.join(names)}: of different GPUs: {', '.join(sorted(devices))}")
    rows: dict[tuple[str, str, str, str], Row] = {}
    for part in parts:
        for row in part.rows:
            rows.setdefault((row.measurement, row.case, row.quantity, row.source), row)
    manifest = dict(parts[0].manifest)
    manifest["merged"] = [dict(part.manifest) for part in parts[1:]]
    return Measurements(manifest, tuple(rows.values()))
