"""Changing light without control variate, with the online and with the constant one: counts and
PSNR over the frames, cycles and traffic of some of them. What `light-flash` and `regular-lighting`
have in common.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.reproduce.experiment import Comparison

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from cachesim import Report
    from cachesim.config import Gpu
    from experiments.reproduce.experiment import Settings
    from experiments.reproduce.parts import Arrays
    from kernels.method import Method
    from kernels.opencl.device import Device

    #: The G-buffer of each frame.
    Lit = Callable[[int], Any]

SCENE, GPU = "front", "quadro-p4000"
REFERENCE_SAMPLES = 1024
NO_CV, ONLINE, CONSTANT = "no CV", "online CV", "constant CV"
SOURCES = ("kernels", "cachesim", "traces", "experiments.reproduce.changing_light")
COLUMNS = ("count", "psnr_db")


@dataclass(frozen=True, eq=False)
class Film:
    """What is played. name: of the experiment. size: (width, height). frames: their number.
    make_scene: the light; made anew for every cell, deterministic. key: all that decides it.
    reference_of: frame to the number of the frame whose reference it shares, None where no PSNR is
    taken. traced: label to the frame that is traced and timed. marks: frames that figures mark.
    """

    name: str
    size: tuple[int, int]
    frames: int
    make_scene: Callable[[Device], Lit]
    key: Mapping[str, Any]
    reference_of: Callable[[int], int | None]
    traced: Mapping[str, int]
    marks: Mapping[float, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Measured:
    """frames: control to (frames, 2) `COLUMNS`, PSNR NaN where none was taken. counts: control and
    label to (h, w) uint16. traffic: control and label to what `measure_traffic` found.
    """

    film: Film
    frames: dict[str, Any]
    counts: dict[str, dict[str, Any]]
    traffic: dict[str, dict[str, dict[str, float]]]


def list_methods() -> dict[str, Method]:
    """The controls, by name."""
    from kernels.method import Method

    plain = Method(kind="adaptive", scale="legacy")
    return {
        NO_CV: plain,
        ONLINE: replace(plain, control="online"),
        CONSTANT: replace(plain, control="constant"),
    }


def measure(film: Film, settings: Settings) -> Measured:
    """Every control over all frames, then the traced frames; each is a finished part of its own."""
    from cachesim import presets
    from cachesim.first_use import compile_loops

    settings.progress("references", 0.0)
    device, gpu, methods = settings.open_device(), presets.load(GPU), list_methods()
    parts = settings.parts(
        film.name, *SOURCES, f"experiments.reproduce.{film.name.replace('-', '_')}"
    )
    view = dict(film.key) | {"size": list(film.size), "frames": film.frames}
    needed = sorted({r for f in range(film.frames) if (r := film.reference_of(f)) is not None})
    references: dict[int, Any] = {}
    for done, frame in enumerate(needed):
        settings.progress(f"reference {done + 1} of {len(needed)}", 0.3 * done / len(needed))

        def refer(frame: int = frame) -> Arrays:
            return make_reference(film, methods[NO_CV], frame, device)

        inputs = view | {"frame": frame, "samples": REFERENCE_SAMPLES}
        references[frame] = parts.arrays(f"reference-{frame}", inputs, refer)["picture"]
    frames: dict[str, Any] = {}
    counts: dict[str, dict[str, Any]] = {}
    for done, (name, method) in enumerate(methods.items()):
        settings.progress(name, 0.3 + 0.3 * done / len(methods))

        def play_all(method: Method = method) -> Arrays:
            return measure_frames(film, method, references, device)

        inputs = view | {"method": method.as_dict(), "traced": dict(film.traced)}
        inputs |= {"references": {str(f): film.reference_of(f) for f in range(film.frames)}}
        found = parts.arrays(f"frames-{done}", inputs, play_all)
        frames[name] = found["frames"]
        counts[name] = {label: found[str(frame)] for label, frame in film.traced.items()}
    compile_loops(timing=True)
    traffic: dict[str, dict[str, dict[str, float]]] = {name: {} for name in methods}
    cells = [(name, label) for name in methods for label in film.traced]
    for done, (name, label) in enumerate(cells):
        settings.progress(f"timing {name}, {label}", 0.6 + 0.4 * done / len(cells))
        method, frame = methods[name], film.traced[label]

        def trace(method: Method = method, frame: int = frame) -> dict[str, float]:
            return measure_traffic(film, method, frame, gpu, device)

        inputs = view | {
            "method": method.as_dict(), "frame": frame, "gpu": gpu.model_dump(mode="json"),
        }  # fmt: skip
        cell = f"traffic-{list(methods).index(name)}-{frame}"
        traffic[name][label] = parts.json(cell, inputs, trace)
    return Measured(film, frames, counts, traffic)


def make_reference(film: Film, method: Method, frame: int, device: Device) -> Arrays:
    """The finished picture of a frame, (h, w, 3) half floats."""
    from experiments.reproduce.film import render_reference

    view = film.make_scene(device)(frame)
    found = render_reference(view, method, REFERENCE_SAMPLES, device)
    return {"picture": found.combined.astype(np.float16)}


def measure_frames(
    film: Film, method: Method, references: dict[int, Any], device: Device
) -> Arrays:
    """`frames`: (frames, 2) `COLUMNS`; and by the number of each traced frame its counts."""
    from experiments.reproduce.film import play
    from kernels.quality import psnr

    rows, kept = [], {}
    for shot in play(film.make_scene(device), method, film.frames, device):
        skin, count = shot.gbuffer.subsurface, shot.scattered[..., 3]
        reference = film.reference_of(shot.index)
        quality = np.nan
        if reference is not None:
            exact = references[reference].astype(np.float32)
            quality = psnr(shot.combined, exact, skin)
        rows.append([float(count[skin].mean()), quality])
        if shot.index in film.traced.values():
            kept[str(shot.index)] = count.astype(np.uint16)
    return {"frames": np.array(rows), **kept}


def measure_traffic(
    film: Film, method: Method, frame: int, gpu: Gpu, device: Device
) -> dict[str, float]:
    """Cycles and bytes of one frame, all passes traced."""
    from cachesim import simulate
    from kernels.record import record

    trace = record(
        film.make_scene(device), method, num_frames=frame + 1, device=device, self_check=False
    )
    return read_report(simulate(trace, gpu, timing=True))


def read_report(report: Report) -> dict[str, float]:
    """Cycles of the sampling and the update pass and milliseconds of the frame; bytes asked of L2
    and moved by DRAM: of the frame, the sampling and the update pass, the online control's texture
    (covariance) and the control read by the update pass (sampled G: the lighting, and the result
    once more).
    """
    from cachesim.report import sum_parts

    assert report.timing is not None
    parts = report.parts or ()
    cycles = {p.name: p.cycles for p in report.timing.passes}
    found: dict[str, float] = {
        "sampling_cycles": cycles["sampling"],
        "update_cycles": cycles["update"],
        "frame_ms": report.timing.time_ms,
    }
    chosen = {
        "frame": list(parts),
        "sampling": [p for p in parts if p.pass_name == "sampling"],
        "update": [p for p in parts if p.pass_name == "update"],
        "extra_texture": [p for p in parts if p.texture.startswith("covariance")],
        "sampled_g": [p for p in parts if p.pass_name == "update" and p.texture == "setup"],
    }
    for name, some in chosen.items():
        found[f"{name}_l2_bytes"] = sum_parts(some, "l2").demand_bytes if some else 0
        found[f"{name}_dram_bytes"] = sum(p.dram.bytes for p in some)
        found[f"{name}_lane_fetches"] = sum(p.lane_fetches for p in some)
    return found


def frame_table(measured: Measured) -> pd.DataFrame:
    """Every frame of every control."""
    from experiments.reproduce.film import long_table

    cells = {(name,): rows for name, rows in measured.frames.items()}
    return long_table(cells.items(), ("control",), COLUMNS, "frame")


def traffic_table(measured: Measured) -> Any:
    """Cycles and bytes of the traced frames."""
    import pandas as pd

    from experiments.tables import Column, Table

    rows = []
    for label, frame in measured.film.traced.items():
        for name, cells in measured.traffic.items():
            cell = cells[label]
            rows.append(
                {
                    "moment": f"{label} (frame {frame})",
                    "control": name,
                    "count": float(measured.frames[name][frame, 0]),
                    **cell,
                    **{
                        f"{k.removesuffix('_bytes')}_mb": v / 1e6
                        for k, v in cell.items()
                        if k.endswith("_bytes")
                    },
                    "sampling_kcycles": cell["sampling_cycles"] / 1e3,
                    "update_kcycles": cell["update_cycles"] / 1e3,
                }
            )
    columns = (
        Column("moment", "moment"),
        Column("control", "control"),
        Column("count", "samples per pixel", ".1f"),
        Column("sampling_kcycles", "sampling (1000 cycles)", ",.1f"),
        Column("update_kcycles", "update (1000 cycles)", ",.1f"),
        Column("frame_ms", "frame (ms)", ".3f"),
        Column("frame_l2_mb", "L2 (MB)", ",.2f"),
        Column("frame_dram_mb", "DRAM (MB)", ",.2f"),
        Column("extra_texture_l2_mb", "extra texture, L2", ".3f"),
        Column("extra_texture_dram_mb", "DRAM", ".3f"),
        Column("sampled_g_l2_mb", "sampled G, L2", ".3f"),
        Column("sampled_g_dram_mb", "DRAM", ".3f"),
    )
    notes = (
        f"On {GPU}, all planes; the frame's bytes include the extra texture of the online control "
        "and the control that the update pass reads.",
    )
    size = "x".join(str(side) for side in measured.film.size)
    title = f"Cycles and traffic of single frames, {SCENE}, {size}"
    return Table(title, pd.DataFrame(rows), columns, notes)


def judge_textures(measured: Measured) -> Comparison:
    """One additional texture for the online control, none for the constant one."""
    fetches = {
        name: sum(int(cell["extra_texture_lane_fetches"]) for cell in cells.values())
        for name, cells in measured.traffic.items()
    }
    agrees = fetches[ONLINE] > 0 and fetches[CONSTANT] == 0
    return Comparison(
        "fetches of an additional texture, online and constant CV",
        "one texture, even none",
        f"{fetches[ONLINE]:,} and {fetches[CONSTANT]:,}",
        verdict="agrees" if agrees else "differs",
        agrees=agrees,
    )


def ratio(measured: Measured, label: str, key: str, control: str) -> float:
    """A control's cycles or bytes over those without one."""
    traffic = measured.traffic
    return traffic[control][label][key] / traffic[NO_CV][label][key]


def compare_net(measured: Measured, label: str) -> list[Comparison]:
    """What the controls save and cost in bytes of the whole frame, their own reads included."""
    found = []
    for key, level in (("frame_l2_bytes", "L2"), ("frame_dram_bytes", "DRAM")):
        shares = {name: ratio(measured, label, key, name) for name in (ONLINE, CONSTANT)}
        saves = [name for name, share in shares.items() if share < 1]
        told = f"net saving with {' and '.join(saves)}" if saves else "no net saving"
        found.append(
            Comparison(
                f"{level} bytes of the frame, {label}: online and constant CV / none",
                None,
                f"{shares[ONLINE]:.3f} and {shares[CONSTANT]:.3f}",
                verdict=f"{told}; the extra texture and the sampled G are included",
            )
        )
    return found


def frame_figure(measured: Measured) -> Figure:
    """Counts and PSNR over the frames, cycles and bytes of the traced ones."""
    from experiments.reproduce.film_plots import Panel, line_figure

    film = measured.film
    taken = [f for f in range(film.frames) if film.reference_of(f) is not None]
    at = list(film.traced.values())

    def of_traced(key: str, scale: float) -> dict[str, list[float]]:
        return {
            name: [cells[label][key] / scale for label in film.traced]
            for name, cells in measured.traffic.items()
        }

    panels = [
        Panel(
            "mean sample count",
            "samples per pixel",
            {name: rows[:, 0] for name, rows in measured.frames.items()},
            marks=film.marks,
        ),
        Panel(
            "PSNR of each frame",
            "dB",
            {name: rows[taken, 1] for name, rows in measured.frames.items()},
            x=taken,
            marks=film.marks,
        ),
    ]
    for key, scale, title, label in (
        ("sampling_cycles", 1e6, "sampling pass", "million cycles"),
        ("frame_ms", 1.0, "frame, all passes", "ms"),
        ("frame_l2_bytes", 1e6, "demand on L2, all passes", "MB"),
        ("frame_dram_bytes", 1e6, "DRAM traffic, all passes", "MB"),
    ):
        lines = of_traced(key, scale)
        highest = max(value for values in lines.values() for value in values)
        panels.append(
            Panel(
                title, label, lines, x=at, marker="o", marks=film.marks, limits=(0, 1.15 * highest)
            )
        )
    return line_figure(panels)


def count_figure(measured: Measured, label: str) -> Figure:
    """The counts of each control at one moment."""
    from experiments.reproduce.film_plots import map_figure

    maps = {
        name: np.where(cells[label] > 0, cells[label].astype(np.float64), np.nan)
        for name, cells in measured.counts.items()
    }
    title = f"samples per pixel, {label} (frame {measured.film.traced[label]})"
    return map_figure(maps, title, limits=(8, 64))
