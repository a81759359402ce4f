"""Experiments in several processes: do they give what they give alone, and what if one fails?"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.cli import run_command
from experiments.reproduce import catalogue, jobs
from traces.errors import WorkError

QUICK = ["sampling-function", "cv-toy"]


def work(name: str, tell: Callable[[str, float], None]) -> str:
    """Stands for experiments: what it does is in the name."""
    tell("at it", 0.5)
    if name.startswith("fail"):
        raise WorkError(f"{name} has no device")
    if name.startswith("mistake"):
        raise IndexError("by one")
    if name.startswith("die"):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("sleep"):
        time.sleep(60)
    return f"{name} in {os.getpid()}"


def events(names: list[str], num_jobs: int) -> list[jobs.Event]:
    return list(jobs.run_in_processes(names, num_jobs, work))


def test_names_are_started_in_order_and_processes_used_again() -> None:
    names = [f"n{i}" for i in range(6)]
    told = events(names, 2)
    assert [e.name for e in told if e.kind == jobs.STARTED] == names
    lines = [e.text for e in told if e.kind == jobs.DONE]
    assert sorted(line.split()[0] for line in lines) == names
    processes = {line.split()[-1] for line in lines}
    assert 1 <= len(processes) <= 2 and str(os.getpid()) not in processes
    assert any(e.kind == jobs.PROGRESS and (e.text, e.share) == ("at it", 0.5) for e in told)


def test_what_fails_or_dies_is_named_and_the_others_go_on(
    capfd: pytest.CaptureFixture[str],
) -> None:
    told = events(["fail", "one", "mistake", "die", "two", "three"], 1)
    failed = {e.name: e.text for e in told if e.kind == jobs.FAILED}
    assert failed == {
        "fail": "fail has no device",
        "mistake": "IndexError: by one",
        "die": "its process died: SIGKILL",
    }
    assert [e.name for e in told if e.kind == jobs.DONE] == ["one", "two", "three"]
    assert "in work" in capfd.readouterr().err, "a mistake shows where it is"


def test_processes_leave_with_a_caller_that_stops() -> None:
    running = jobs.run_in_processes(["sleep", "sleep again"], 2, work)
    assert [next(running).kind for _ in range(2)] == [jobs.STARTED, jobs.STARTED]
    assert all(next(running).kind == jobs.PROGRESS for _ in range(2)), "both are at it"
    start = time.monotonic()
    running.close()
    assert time.monotonic() - start < 8, "told to leave, not waited for and not killed"


def tables(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*.csv"))}


def test_experiments_at_once_write_what_they_write_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone, together = tmp_path / "alone", tmp_path / "together"
    assert run_command(["reproduce", *QUICK, "--quick", "-o", str(alone)]) == 0
    capsys.readouterr()
    command = ["reproduce", *QUICK, "--quick", "--jobs", "2", "-o", str(together)]
    assert run_command(command) == 0
    said = capsys.readouterr().err
    assert "2 at once" in said and "[1/2]" in said and "[2/2]" in said
    assert tables(alone) == tables(together) and tables(alone)
    index = (together / "index.md").read_text()
    assert all(f"[{name}]({name}.md)" in index for name in QUICK)


def test_a_failure_in_a_process_is_the_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ["reproduce", "cv-toy", "jittering", "--quick", "--jobs", "2"]
    assert run_command([*names, "--device", "warp drive", "-o", str(tmp_path)]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "1 of 2 experiments failed: jittering:" in said and "warp drive" in said
    assert (tmp_path / "cv-toy.md").exists() and not (tmp_path / "jittering.md").exists()
    assert "failed:" in (tmp_path / "index.md").read_text()


def test_the_pictures_of_all_wait_for_the_others() -> None:
    last = [e.name for e in catalogue.all_experiments() if e.after_others]
    assert last == ["gallery"] and catalogue.NAMES[-1] == "gallery"


def test_no_jobs_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["reproduce", "cv-toy", "--jobs", "0", "-o", str(tmp_path)]) == 2
    assert "--jobs" in capsys.readouterr().err


def is_left(group: int) -> bool:
    """Whether a process group still has processes."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_an_interrupt_ends_every_process_and_is_the_exit_code(tmp_path: Path) -> None:
    code = "from experiments.cli import main; main()"
    arguments = ["reproduce", "cv-toy", "taxonomy", "--jobs", "2", "-o", str(tmp_path)]
    process = [sys.executable, "-c", code, *arguments]
    with subprocess.Popen(
        process, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as running:
        assert running.stderr is not None
        said = ""
        while "[2/2]" not in said:
            said += running.stderr.readline()
        os.killpg(running.pid, signal.SIGINT)
        said += running.stderr.read()
    assert running.returncode == 130, said
    assert "Traceback" not in said
    # Python's own helper of such processes leaves a moment after them.
    deadline = time.monotonic() + 10
    while is_left(running.pid):
        assert time.monotonic() < deadline
        time.sleep(0.05)
