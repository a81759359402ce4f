"""A user's own Accel-Sim beside ours: the oracle traces exported, run in turn, both timed.

Accel-Sim's tree, in which its configurations are looked for:

    gpu-simulator/bin/release/accel-sim.out
    gpu-simulator/gpgpu-sim/configs/tested-cfgs/NAME/gpgpusim.config, and what it includes
    gpu-simulator/configs/tested-cfgs/NAME/trace.config
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from experiments.accel_sim_oracle import CONFIGS, parsed, sectors
from experiments.bench_timing import ALL, compile_loops_s, run_once
from experiments.gpgpusim_format import parse_stat_lines
from experiments.tables import Column, Table
from experiments.validate_accel_sim import compare_run, verdicts
from traces.accel_sim.writer import LIST_NAME, Settings, write_accel_sim
from traces.errors import InputError, WorkError
from traces.oracle_traces import oracle_trace

if TYPE_CHECKING:
    import pandas as pd

    from traces.trace import Trace

BINARY = "accel-sim.out"
GPGPUSIM_CONFIG, TRACE_CONFIG = "gpgpusim.config", "trace.config"
COMMAND_FILE, OUTPUT_FILE = "run.sh", "output.txt"
#: Where the binary is below the folders that a user may name.
_BINARY_FOLDERS = ("", "bin/release", "gpu-simulator/bin/release")
#: Where a configuration is below one of the folders that hold the binary.
_CONFIG_FOLDERS = ("gpgpu-sim/configs/tested-cfgs", "configs/tested-cfgs")


@dataclass(frozen=True)
class AccelSim:
    """A built Accel-Sim. configs: folder's name -> its files, `gpgpusim.config` among them."""

    binary: Path
    configs: Mapping[str, tuple[Path, ...]]

    def arguments(self, config: str, trace_list: Path) -> list[str]:
        """The command line for a config of `CONFIGS`, in a folder that holds its files."""
        oracle = CONFIGS[config]
        names = {path.name for path in self.configs[oracle.folder]}
        made = [str(self.binary), "-trace", str(trace_list)]
        for name in (GPGPUSIM_CONFIG, TRACE_CONFIG):
            made += ["-config", name] if name in names else []
        # Later settings win over those of the files.
        return [*made, *oracle.options]


def find_accel_sim(path: Path, configs: Path | None, names: Sequence[str]) -> AccelSim:
    """The binary, and the configurations that the configs `names` need.

    path: the binary, or a folder of Accel-Sim's tree above it. configs: a folder with a folder per
    configuration; None looks in Accel-Sim's tree.

    Raises:
        InputError: one of them is not there.
    """
    places = [path] if path.is_file() else [path / below / BINARY for below in _BINARY_FOLDERS]
    binary = next((place.resolve() for place in places if place.is_file()), None)
    if binary is None:
        raise InputError(f"--accel-sim {path}: no {BINARY} there: name the binary or its tree")
    if not os.access(binary, os.X_OK):
        raise InputError(f"--accel-sim {binary}: is not executable")
    folders = {CONFIGS[name].folder for name in names}
    return AccelSim(binary, {folder: _config_files(binary, configs, folder) for folder in folders})


def _config_files(binary: Path, configs: Path | None, name: str) -> tuple[Path, ...]:
    """All files of the configuration's folders; the first of each name counts."""
    if configs is not None:
        folders = [configs / name]
    else:
        folders = [parent / below / name for parent in binary.parents for below in _CONFIG_FOLDERS]
    found: dict[str, Path] = {}
    for folder in folders:
        if folder.is_dir():
            for file in sorted(folder.iterdir()):
                if file.is_file():
                    found.setdefault(file.name, file)
    if GPGPUSIM_CONFIG not in found:
        where = str(configs) if configs is not None else f"the tree above {binary}"
        raise InputError(
            f"--accel-sim: no {name}/{GPGPUSIM_CONFIG} in {where}: "
            "name the folder of the configurations with --accel-sim-configs"
        )
    return tuple(found.values())


def run_beside(
    accel_sim: AccelSim,
    configs: Sequence[str],
    names: Sequence[str],
    kept: Path | None,
    step: Callable[[str], None] = lambda text: None,
) -> pd.DataFrame:
    """Run every trace on every machine, ours and then theirs, once each.

    kept: a folder for traces, command lines and output; None keeps nothing. step: told what runs.

    Returns the rows of `validate_accel_sim.compare_run` with "sectors", "seconds" and
    "accel_sim_s".
    """
    import pandas as pd

    step("compiling the simulator")
    compile_loops_s()
    gpus = {config: CONFIGS[config].gpu() for config in configs}
    for gpu in gpus.values():
        run_once(oracle_trace("chase"), gpu)
    rows = []
    for name in names:
        trace = oracle_trace(name)
        with _folder(kept) as folder:
            for config in configs:
                trace_list = _exported(trace, folder, name, CONFIGS[config].binary_version)
                step(f"{config} {name}: ours")
                found, seconds, _ = run_once(trace, gpus[config])
                step(f"{config} {name}: Accel-Sim")
                run = folder / config / name
                expected, accel_sim_s = run_accel_sim(accel_sim, config, trace_list, run)
                times = {"sectors": sectors(found), "seconds": seconds, "accel_sim_s": accel_sim_s}
                rows.append(compare_run(config, name, found, expected) | times)
    return pd.DataFrame(rows)


@contextmanager
def _folder(kept: Path | None) -> Iterator[Path]:
    """A folder with an absolute path, taken away afterwards unless it is kept."""
    if kept is not None:
        yield kept.resolve()
        return
    with TemporaryDirectory(prefix="cachesim-accel-sim-") as folder:
        yield Path(folder)


def _exported(trace: Trace, folder: Path, name: str, binary_version: int) -> Path:
    """The list of a trace's files, which are written where they are not there yet."""
    exported = folder / f"traces-sm{binary_version}" / name
    if not (exported / LIST_NAME).is_file():
        exported.parent.mkdir(exist_ok=True)
        write_accel_sim(trace, exported, Settings(binary_version=binary_version))
    return exported / LIST_NAME


def run_accel_sim(
    accel_sim: AccelSim, config: str, trace_list: Path, folder: Path
) -> tuple[dict[str, int], float]:
    """Run Accel-Sim in `folder`, which then holds its configuration, command line and output.

    Returns the quantities that it printed, and its seconds of wall-clock time.

    Raises:
        WorkError: it failed, or printed no cycle count.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for file in accel_sim.configs[CONFIGS[config].folder]:
        shutil.copyfile(file, folder / file.name)
    arguments = accel_sim.arguments(config, trace_list)
    command = f'#!/bin/sh\ncd "$(dirname "$0")" && exec {shlex.join(arguments)}\n'
    (folder / COMMAND_FILE).write_text(command, encoding="utf-8")
    (folder / COMMAND_FILE).chmod(0o755)
    with (folder / OUTPUT_FILE).open("wb") as output:
        start = time.perf_counter()
        done = subprocess.run(
            arguments,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            check=False,
        )
        seconds = time.perf_counter() - start
    text = (folder / OUTPUT_FILE).read_text(encoding="utf-8", errors="replace")
    last = (text.strip() or "no output").splitlines()[-1]
    what = f"{accel_sim.binary}: {config} {trace_list.parent.name}"
    if done.returncode:
        raise WorkError(f"{what}: exit code {done.returncode}: {last}")
    try:
        return parsed(parse_stat_lines(text)), seconds
    except KeyError as error:
        raise WorkError(f"{what}: printed no {error.args[0]}: {last}") from error


def with_totals(frame: pd.DataFrame) -> pd.DataFrame:
    """The runs, and a last row per machine with its sums; speeds and their ratio for all."""
    import pandas as pd

    parts = []
    for config, part in frame.groupby("config", sort=False):
        sums = {name: part[name].sum() for name in ("sectors", "seconds", "accel_sim_s")}
        parts += [part, pd.DataFrame([{"config": config, "trace": ALL, **sums}])]
    made = pd.concat(parts, ignore_index=True)
    made["msectors_per_s"] = made["sectors"] / made["seconds"] / 1e6
    made["accel_sim_sectors_per_s"] = made["sectors"] / made["accel_sim_s"]
    made["ratio"] = made["accel_sim_s"] / made["seconds"]
    return made


def beside_table(frame: pd.DataFrame, binary: Path, machine: str) -> Table:
    """Both times of every run, their sums, and both cycle counts.

    frame: as `run_beside` returns it.
    """
    columns = (
        Column("config", "config"),
        Column("trace", "trace"),
        Column("sectors", "sectors"),
        Column("seconds", "ours s", ".2f"),
        Column("accel_sim_s", "Accel-Sim s", ",.2f"),
        Column("msectors_per_s", "ours M sectors/s", ".2f"),
        Column("accel_sim_sectors_per_s", "Accel-Sim sectors/s", ",.0f"),
        Column("ratio", "times as fast", ",.0f"),
        Column("cycles_ours", "cycles, ours"),
        Column("cycles_theirs", "Accel-Sim"),
        Column("cycles_error", "error", "+.1%"),
    )
    notes = (
        f"{machine}; {binary}",
        "One run each, in turn, on one core; compilation and the export of the traces excluded, "
        "Accel-Sim's reading of them included.",
        *verdicts(frame),
    )
    return Table("Beside Accel-Sim", with_totals(frame), columns, notes)
