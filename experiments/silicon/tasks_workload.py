"""The workload's tasks: its kernels' times with cold caches, the pictures they make, and the same
launches for the profiler.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.silicon.cases import COUNTS, FETCHES, PICTURES
from experiments.silicon.clock import measure_clock
from experiments.silicon.inputs import Picture, compare_picture, file_name, read_picture
from experiments.silicon.rows import case_of
from experiments.silicon.session import Session
from experiments.silicon.workload import CacheFiller, Workload
from traces.errors import InputError

REPEATS = 7
#: What each kind of counts makes.
MADE = {
    "fixed64": ("scattered", "output"),
    "adaptive": ("scattered", "resolved", "history", "output"),
}


def find_picture(session: Session, words: str) -> Picture:
    """The picture of "SCENE WxH".

    Raises:
        InputError: no such picture, or its file is missing or damaged.
    """
    for scene, width, height in PICTURES:
        if words == f"{scene}_{width}x{height}":
            return read_picture(Path(session.inputs) / file_name(scene, width, height))
    known = ", ".join(f"{s}_{w}x{h}" for s, w, h in PICTURES)
    raise InputError(f"picture {words!r}: choose from {known}")


def measure_times(session: Session, words: str) -> None:
    """Times with cold caches, and whether the pictures are right."""
    gpu, picture = session.gpu, find_picture(session, words)
    ptx = session.ptx("passes")
    filler = CacheFiller(gpu, ptx)
    for fetch in FETCHES:
        for counts in COUNTS:
            with session.attempt(f"workload {words} {counts} {fetch}"):
                workload = Workload(gpu, picture, counts, fetch, ptx)
                _time_launches(session, workload, filler)
                _compare(session, workload, picture)


def _time_launches(session: Session, workload: Workload, filler: CacheFiller) -> None:
    for launch in workload.launches():
        launch.run()
        session.gpu.synchronise()
        if not launch.measured:
            continue
        median, times = session.gpu.median_ms(launch.run, REPEATS, filler.fill)
        hertz = measure_clock(session)
        add = session.rows.add
        add("workload", launch.case.text, "time", median * 1e6, "ns", "event")
        add("workload", launch.case.text, "fastest_time", min(times) * 1e6, "ns", "event")
        add("workload", launch.case.text, "cycles", median * 1e-3 * hertz, "cycles", "event")


def _compare(session: Session, workload: Workload, picture: Picture) -> None:
    """Hold what was made to the OpenCL kernels' pictures."""
    names = {name: f"{workload.counts}/{name}" for name in MADE[workload.counts]}
    if workload.counts == "fixed64":
        names |= {f"setup/{k}": f"setup/{k}" for k in range(workload.num_levels)}
    for name, expected in names.items():
        case = case_of(
            scene=picture.scene,
            size=f"{picture.width}x{picture.height}",
            counts=workload.counts,
            fetch=workload.fetch,
            array=name,
        )
        found = compare_picture(workload.read(name), picture.expected[expected])
        for quantity, value in found.items():
            session.rows.add(
                "picture", case, quantity, value, "dB" if quantity == "psnr" else "1", "host"
            )


def measure_filtering(session: Session, words: str) -> None:
    """How far the texture unit's bilinear pre-filter is from the same filter in float32."""
    gpu, picture = session.gpu, find_picture(session, words)
    workload = Workload(gpu, picture, "fixed64", "texture", session.ptx("passes"))
    for launch in workload.launches():
        if launch.case.pass_name == "exact":
            break
        launch.run()
    gpu.synchronise()
    for level in range(1, workload.num_levels):
        case = case_of(scene=picture.scene, size=words.partition("_")[2], level=level)
        found = workload.read(f"setup/{level}").view(np.float16).astype(np.float64)
        expected = picture.expected[f"setup/{level}"]
        kept = np.ascontiguousarray(expected.kept).view(np.float16).astype(np.float64)
        ours = found.reshape(-1, 4)[:: expected.stride]
        relative = np.abs(ours - kept) / np.maximum(np.abs(kept), 1e-3)
        add = session.rows.add
        add("filtering", case, "largest_relative_difference", float(relative.max()), "1", "host")
        add("filtering", case, "mean_relative_difference", float(relative.mean()), "1", "host")


def profile_launches(session: Session, words: str) -> None:
    """Every measured launch once, for the profiler to look at."""
    gpu, picture = session.gpu, find_picture(session, words)
    ptx = session.ptx("passes")
    for fetch in FETCHES:
        for counts in COUNTS:
            with session.attempt(f"profile {words} {counts} {fetch}"):
                for launch in Workload(gpu, picture, counts, fetch, ptx).launches():
                    launch.run()
                    gpu.synchronise()
