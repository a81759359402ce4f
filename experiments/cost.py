"""`cachesim cost`: fit the bandwidth-demand cost function to recordings; predict frames with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from experiments import method_options as options
from experiments.options import (
    AlbedoMap,
    CameraName,
    DeviceName,
    ImageSize,
    NormalMap,
)
from traces.errors import InputError, unknown

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.cost.fit import Observation
    from cachesim.cost.model import CostModel, Prediction
    from experiments.tables import Table

TRACES_HELP = "Recordings to fit to."
FIT_HELP = "Fit a model to the recordings: each is counted, and timed, on each GPU."
TEST_HELP = "A recording to predict that is not fitted to; may be repeated."
OUTPUT_HELP = "With --fit: the fitted model."
MODEL_HELP = "Predict a frame with this model."
SCENE_HELP = "Scene to predict: as of `cachesim record`."
BUDGET_HELP = "Samples of the fixed count, or the most of the adaptive."
FRAMES_HELP = "Frames that the adaptive estimator runs for, at least."
GPU_HELP = "Presets to fit, with commas between; with --model, one of the model's."
TIMING_HELP = "Fit cycles too, which takes a timed run of each recording."
JSON_HELP = "Write the prediction as JSON; - writes only that to stdout."


def command(
    traces: Annotated[
        list[Path] | None, typer.Argument(metavar="[TRACE]...", help=TRACES_HELP)
    ] = None,
    fit: Annotated[bool, typer.Option("--fit", help=FIT_HELP)] = False,
    test: Annotated[list[Path], typer.Option("--test", metavar="TRACE", help=TEST_HELP)] = [],  # noqa: B006 -- Typer makes a new list for each run
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE.json", help=OUTPUT_HELP)
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="FILE.json", help=MODEL_HELP)
    ] = None,
    gpu: Annotated[str | None, typer.Option("--gpu", metavar="LIST", help=GPU_HELP)] = None,
    timing: Annotated[bool, typer.Option("--timing/--no-timing", help=TIMING_HELP)] = True,
    scene: Annotated[
        str | None, typer.Option("--scene", metavar="NAME|FILE", help=SCENE_HELP)
    ] = None,
    camera: CameraName = None,
    albedo_map: AlbedoMap = None,
    normal_map: NormalMap = None,
    size: ImageSize = "1920x1080",
    budget: Annotated[int, typer.Option("--budget", metavar="N", help=BUDGET_HELP)] = 64,
    frames: Annotated[int, typer.Option("--frames", metavar="N", help=FRAMES_HELP)] = 8,
    device: DeviceName = None,
    method: options.Kind = "fixed",
    sigma0_sq: options.Sigma0Sq = 0.001,
    rule: options.Rule = "paper",
    estimator: options.Estimator = "history",
    scale: options.Scale = "physical",
    mip_rule: options.MipRule = "eq-5.12",
    taps: options.Taps = 27,
    json: Annotated[str | None, typer.Option("--json", metavar="FILE|-", help=JSON_HELP)] = None,
) -> None:
    """Fit the bandwidth-demand cost function to recordings (--fit), or predict a frame's demand on
    L1, L2 and DRAM and its cycles without simulating it (--model).
    """
    from experiments.output import output_file

    if fit == (model is not None):
        raise InputError("cost: give one of --fit TRACES... -o FILE.json and --model FILE.json")
    if fit:
        if not traces:
            raise InputError("cost --fit: no recordings; name two or more")
        if output is None:
            raise InputError("cost --fit: -o is missing; name the file for the model")
        for option, value in (("--scene", scene), ("--json", json)):
            if value is not None:
                raise InputError(f"{option} {value}: goes with --model, not with --fit")
        output_file(output, ".json")
        _fit(traces, test, output, gpu or "quadro-p4000", timing)
        return
    assert model is not None
    if traces or test or output is not None:
        given = [*(traces or ()), *test, *([output] if output else ())][0]
        raise InputError(f"{given}: recordings and -o go with --fit, not with --model")
    if scene is None:
        raise InputError("cost --model: --scene is missing; name what to predict")
    if json is not None and json != "-":
        output_file(Path(json))
    shared = {"sigma0_sq": sigma0_sq, "rule": rule, "scale": scale, "mip_rule": mip_rule}
    fields = {"kind": method, "estimator": estimator, "num_taps": taps, **shared}
    # The engine's least count is above small budgets.
    fields |= {"num_samples": budget, "b_max": budget, "b_min": min(8, budget)}
    meshes = {"camera": camera, "albedo_map": albedo_map, "normal_map": normal_map}
    _predict(model, gpu, scene, meshes, size, frames, device, fields, json)


def _fit(
    traces: Sequence[Path], test: Sequence[Path], output: Path, gpus: str, timing: bool
) -> None:
    from cachesim import presets
    from cachesim.cost.file import write_models
    from cachesim.cost.fit import fit
    from cachesim.first_use import compile_loops
    from experiments.console import progress, remark
    from experiments.options import parse_names
    from experiments.tables import print_table
    from traces.open import open_trace

    if len(traces) < 2:
        raise InputError(f"cost --fit: {len(traces)} recording: need two or more")
    machines = [presets.load(name) for name in parse_names(gpus, "--gpu")]
    for path in (*traces, *test):
        if open_trace(path).is_lane_address:
            raise InputError(f"{path}: a trace of byte addresses: the cost function needs texels")
    with progress("compiling the simulator") as bar:
        compile_loops(timing=timing)
        observed = {"fitted": _observe(traces, machines, timing, bar.describe)}
        if test:
            observed["held out"] = _observe(test, machines, timing, bar.describe)
        models = []
        for k, machine in enumerate(machines):
            bar.describe(f"fitting {machine.name}")
            models.append(fit([of_gpu[k] for of_gpu in observed["fitted"]], machine))
    write_models(models, output)
    for k, (machine, found) in enumerate(zip(machines, models, strict=True)):
        print_table(coefficient_table(found))
        for kind, frames in observed.items():
            from cachesim.cost.model import predict

            rows = [of_gpu[k] for of_gpu in frames]
            predicted = [predict(o.workload, machine, found) for o in rows]
            title = f"{machine.name}: {kind} frames, predicted / simulated - 1, %"
            print_table(error_table(title, rows, predicted))
    remark(f"model of {', '.join(m.gpu for m in models)}: {output}")


def _observe(
    paths: Sequence[Path], machines: Sequence[Any], timing: bool, tell: Any
) -> list[list[Observation]]:
    """Per recording, per GPU, what a simulation of it says."""
    from cachesim import simulate_all
    from cachesim.cost.cycles import has_timing
    from cachesim.cost.fit import Observation
    from cachesim.cost.machine import Machine
    from cachesim.cost.measure import measure_workload
    from traces.open import open_trace

    found = []
    for path in paths:
        trace = open_trace(path)
        tell(f"describing {path.name}")
        workload = measure_workload(trace, str(path))
        tell(f"counting {path.name}")
        counted = simulate_all(trace, machines)
        clocked: list[Any] = [None] * len(machines)
        for k, machine in enumerate(machines):
            if timing and has_timing(Machine.of(machine)):
                tell(f"timing {path.name} on {machine.name}")
                clocked[k] = simulate_all(trace, [machine], timing=True)[0]
        pairs = zip(counted, clocked, strict=True)
        found.append([Observation.of(workload, report, timed) for report, timed in pairs])
    return found


def _predict(
    model: Path,
    gpu: str | None,
    scene: str,
    meshes: dict[str, Any],
    size: str,
    frames: int,
    device: str | None,
    fields: dict[str, Any],
    json: str | None,
) -> None:
    from json import dumps
    from time import monotonic

    from cachesim import presets
    from cachesim.cost.file import read_models
    from cachesim.cost.model import predict
    from experiments.console import progress, remark
    from experiments.cost_frames import scene_workload
    from experiments.options import parse_image_size, scene_arguments
    from experiments.output import write_text
    from experiments.tables import print_table

    models = read_models(model)
    chosen = next(iter(models)) if gpu is None else gpu
    if chosen not in models:
        raise unknown("GPU", chosen, models, str(model))
    machine = presets.load(chosen)
    given = scene_arguments(scene, **meshes)
    width, height = parse_image_size(size)
    settings = options.make_method(fields)
    if frames < 1:
        raise InputError(f"--frames {frames}: allowed are 1 and more")
    from kernels.opencl.device import open_device
    from kernels.scene import load_scene

    with progress("rendering the scene") as bar:
        opened = open_device(device)
        gbuffer = load_scene(scene, width, height, device=opened, **given)
        bar.describe("counting the samples")
        num_frames = frames if settings.adaptive else 1
        workload = scene_workload(gbuffer, settings, num_frames, opened)
        bar.describe(f"predicting {chosen}")
        start = monotonic()
        predicted = predict(workload, machine, models[chosen])
        took = monotonic() - start
    text = dumps(_as_json(predicted, machine.clock_hz), indent=1)
    if json == "-":
        print(text)
        return
    if json is not None:
        write_text(Path(json), text + "\n")
    print_table(prediction_table(predicted, machine.clock_hz, f"{scene}, {width}x{height}"))
    remark(f"predicted in {took:.2f} s, without a recording")


def _as_json(predicted: Prediction, clock_hz: int) -> dict[str, Any]:
    demand = {f"{level}_bytes": round(v) for level, v in predicted.demand_bytes.items()}
    cycles = predicted.cycles
    return {
        "gpu": predicted.gpu,
        "scene": predicted.workload,
        "samples": predicted.num_samples,
        "demand": {"lane_fetches": predicted.lane_fetches, **demand},
        "cycles": None if cycles is None else round(cycles),
        "time_ms": None if cycles is None else cycles / clock_hz * 1e3,
    }


def coefficient_table(model: CostModel) -> Table:
    """A model's coefficients with their intervals."""
    from experiments.tables import Column, Table

    columns = (
        Column("coefficient", "coefficient"),
        Column("value", "value", ".3f"),
        Column("low", "95 % from", ".3f"),
        Column("high", "to", ".3f"),
        Column("meaning", "meaning", wraps=True),
    )
    title = f"Cost function of {model.gpu}, fitted to {model.frames} frames"
    return Table(title, model.frame(), columns)


def errors_of(rows: Sequence[Observation], predicted: Sequence[Prediction]) -> pd.DataFrame:
    """One row per frame: frame, and per level and for cycles predicted / simulated - 1."""
    import pandas as pd

    found = []
    for observation, prediction in zip(rows, predicted, strict=True):
        cycles = sum(observation.pass_cycles.values())
        row: dict[str, Any] = {"frame": observation.workload.name}
        for level, value in prediction.demand_bytes.items():
            row[level] = value / max(observation.demand_bytes[level], 1.0) - 1.0
        timed = prediction.cycles is not None and cycles
        row["cycles"] = prediction.cycles / cycles - 1.0 if timed else None  # type: ignore[operator]
        found.append(row)
    return pd.DataFrame(found).astype({"cycles": "float64"})


def error_table(title: str, rows: Sequence[Observation], predicted: Sequence[Prediction]) -> Table:
    """The relative errors of some predictions in per cent, and their mean size as the last row."""
    import pandas as pd

    from experiments.tables import Column, Table

    errors = errors_of(rows, predicted)
    numbers = [c for c in errors.columns if c != "frame"]
    mean = errors[numbers].abs().mean()
    shown = pd.concat([errors, pd.DataFrame([{"frame": "mean size", **mean}])], ignore_index=True)
    shown[numbers] *= 100.0
    columns = (Column("frame", "frame"), *(Column(n, n, "+.1f") for n in numbers))
    return Table(title, shown, columns)


def prediction_table(predicted: Prediction, clock_hz: int, title: str) -> Table:
    """A predicted frame: demand per level, and cycles where they are known."""
    import pandas as pd

    from experiments.tables import Column, Table

    rows: list[tuple[str, str, str]] = [
        ("lane fetches", f"{predicted.lane_fetches:,}", ""),
        ("samples", f"{predicted.num_samples:,}", ""),
    ]
    rows += [
        (f"{k.upper()} demand", f"{v / 1e6:,.2f}", "MB") for k, v in predicted.demand_bytes.items()
    ]
    if predicted.cycles is not None:
        rows.append(("cycles", f"{predicted.cycles:,.0f}", ""))
        rows.append(("time", f"{predicted.cycles / clock_hz * 1e3:.3f}", "ms"))
    frame = pd.DataFrame(rows, columns=["quantity", "value", "unit"])
    columns = (
        Column("quantity", "quantity"), Column("value", "predicted"), Column("unit", "unit")
    )  # fmt: skip
    return Table(f"{title} on {predicted.gpu}, predicted", frame, columns)
