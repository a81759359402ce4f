"""Nsight Compute for tests: runs the program and prints a raw page of what it launched.

The launches' names and the sectors of their loads come from the fake driver's list; all other
numbers are made up. FAKE_NCU_BLOCKED=1 refuses the counters, as
a driver does that keeps them for administrators.
"""

import itertools
import os
import re
import subprocess
import sys
import tempfile

AVAILABLE = """\
Device NVIDIA H100 80GB HBM3 of a test (GH100)
------------------------------------ ------------ ---------
Metric Name                          Metric Type  Metric Unit
------------------------------------ ------------ ---------
gpc__cycles_elapsed                  Counter      cycle
gpu__time_duration                   Counter      ns
l1tex__t_sectors_pipe_tex_mem_texture Counter     sector
l1tex__t_sectors_pipe_tex_mem_texture_lookup_hit Counter sector
l1tex__t_sectors_pipe_lsu_mem_global_op_ld Counter sector
l1tex__t_sectors_pipe_lsu_mem_global_op_ld_lookup_hit Counter sector
lts__t_sectors_srcunit_tex_op_read   Counter      sector
lts__t_sectors_srcunit_tex_op_read_lookup_hit Counter sector
dram__sectors_read                   Counter      sector
"""
UNITS = {"gpu__time_duration.sum": "ns", "gpc__cycles_elapsed.max": "cycle"}
HEAD = ["ID", "Process ID", "Process Name", "Host Name", "Kernel Name", "Context", "Stream"]


def value_of(metric, number, name, sectors):
    """The launch's own sectors, or some number; hits stay below sectors."""
    pipe = "tex" if "texture" in name or name.startswith("texels") else "lsu"
    if metric.startswith("l1tex__t_sectors_pipe"):
        mine = f"_pipe_{pipe}_" in metric
        return (sectors // 2 if "lookup_hit" in metric else sectors) if mine else 0
    return (1000 if "lookup_hit" in metric else 2000) * (number + 1)


def line(cells):
    return ",".join(f'"{cell}"' for cell in cells) + "\n"


def main():
    arguments = sys.argv[1:]
    if arguments == ["--version"]:
        print("NVIDIA (R) Nsight Compute Command Line Profiler\nVersion 2025.3.1.0 (build 1)")
        return 0
    if arguments == ["--query-metrics"]:
        print(AVAILABLE)
        return 0
    cut = next(k for k, word in enumerate(arguments) if os.path.basename(word).startswith("python"))
    options, program = arguments[:cut], arguments[cut:]
    told = dict(itertools.pairwise(options))
    assert told["--clock-control"] == "none" and told["--page"] == "raw"
    metrics = told["--metrics"].split(",")
    pattern = re.compile(told["--kernel-name"].removeprefix("regex:"))
    with tempfile.NamedTemporaryFile("r") as launches:
        environment = dict(os.environ, FAKE_CUDA_LAUNCHES=launches.name)
        done = subprocess.run(program, env=environment, check=False)
        shown = [line.split() for line in launches if pattern.search(line)]
    with open(told["--log-file"], "w") as log:
        log.write("==PROF== Connected to process 7\n")
        if os.environ.get("FAKE_NCU_BLOCKED"):
            log.write("==ERROR== ERR_NVGPUCTRPERM - The user does not have permission\n")
            return 1
        log.write("==PROF== Disconnected from process 7\n")
        log.write(line([*HEAD, *metrics]))
        log.write(line([*("" for _ in HEAD), *(UNITS.get(m, "sector") for m in metrics)]))
        for number, (name, sectors) in enumerate(shown):
            values = [f"{value_of(m, number, name, int(sectors)):,}" for m in metrics]
            log.write(line([number, 7, "python", "127.0.0.1", name, 1, 7, *values]))
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
