"""`cachesim record`: render a scene and write the trace of its texel fetches."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments import method_options as options
from experiments.options import (
    AlbedoMap,
    CameraName,
    DeviceName,
    ImageSize,
    NormalMap,
    SceneName,
)

#: Bytes of the file per lane that a row has, at the least and at the most that we have measured.
FILE_BYTES_PER_LANE = (0.25, 1.0)
OUTPUT_HELP = "The recording."
FRAMES_HELP = "Frames to render, which build up the history."
INSTRUCTIONS_HELP = (
    "Whose machine code the arithmetic is taken from: sm_61, sm_75, sm_90, gfx1010 or gfx1030, "
    "exact as the kernels run here, or with -native behind it as a shader's compiler has it."
)
TRACED_HELP = "Which frames to record: the last, all, or a list of numbers from 0."


def command(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE.parquet", help=OUTPUT_HELP)
    ],
    scene: SceneName = "close",
    camera: CameraName = None,
    albedo_map: AlbedoMap = None,
    normal_map: NormalMap = None,
    size: ImageSize = "1920x1080",
    frames: Annotated[int, typer.Option("--frames", metavar="N", help=FRAMES_HELP)] = 1,
    traced: Annotated[
        str, typer.Option("--traced-frames", metavar="last|all|LIST", help=TRACED_HELP)
    ] = "last",
    device: DeviceName = None,
    method: options.Kind = "fixed",
    samples: options.Samples = 64,
    b_min: options.SamplesMin = 8,
    b_max: options.SamplesMax = 64,
    estimator: options.Estimator = "history",
    pilots: options.Pilots = 8,
    control: options.Control = "none",
    eta_cov: options.EtaCov = 0.05,
    epsilon_a: options.EpsilonA = 1e-4,
    disocclusion: options.Disocclusion = "variance",
    epsilon_u: options.EpsilonU = None,
    rule: options.Rule = "paper",
    kappa: options.Kappa = 0.2,
    alpha: options.Alpha = 0.2,
    sigma0_sq: options.Sigma0Sq = 0.001,
    scale: options.Scale = "physical",
    mip_rule: options.MipRule = "eq-5.12",
    inverse_cdf: options.InverseCdf = "approximate",
    weights: options.Weights = "self-normalised",
    taps: options.Taps = 27,
    separable_profile: options.SeparableProfile = "burley",
    hybrid_count: options.HybridCount = "adaptive",
    hybrid_rules: options.HybridRules = "count,radius",
    count_threshold: options.CountThreshold = 16.0,
    radius_threshold: options.RadiusThreshold = 64.0,
    importance_threshold: options.ImportanceThreshold = 0.5,
    passthrough: options.Passthrough = 1.0,
    overlay: options.Overlay = False,
    taa: options.Taa = False,
    taa_weight: options.TaaWeight = 0.04,
    lds: options.Lds = False,
    hash_constants: options.Hash = "jcgt",
    prefilter: options.Prefilter = True,
    centre: options.Centre = True,
    bilateral: options.Bilateral = True,
    normal_weights: options.NormalWeights = True,
    planes: options.Planes = options.ALL_PLANES,
    passes: options.Passes = None,
    tile_order: options.TileOrder = "raster",
    lane_map: options.LaneMap = "linear",
    instructions: Annotated[
        str, typer.Option("--instructions", metavar="NAME", help=INSTRUCTIONS_HELP)
    ] = "sm_61-native",
) -> None:
    """Render a scene and record every texel fetch into a Parquet file."""
    from experiments.console import progress, remark
    from experiments.options import parse_image_size, scene_arguments
    from experiments.output import output_file
    from kernels.instruction_counts.data import check_target

    output_file(output, ".parquet")
    width, height = parse_image_size(size)
    mesh = scene_arguments(scene, camera, albedo_map, normal_map)
    check_target(instructions)
    traced_frames = parse_traced_frames(traced, frames)
    chosen = options.make_method(
        {
            "kind": method,
            "num_samples": samples,
            "b_min": b_min,
            "b_max": b_max,
            "estimator": estimator,
            "num_pilots": pilots,
            "control": control,
            "eta_cov": eta_cov,
            "epsilon_a": epsilon_a,
            "disocclusion": disocclusion,
            "epsilon_u": epsilon_u,
            "rule": rule,
            "kappa": kappa,
            "alpha": alpha,
            "sigma0_sq": sigma0_sq,
            "scale": scale,
            "mip_rule": mip_rule,
            "inverse_cdf": inverse_cdf,
            "weights": weights,
            "num_taps": taps,
            "separable_profile": separable_profile,
            "hybrid_count": hybrid_count,
            "hybrid_rules": hybrid_rules,
            "count_threshold": count_threshold,
            "radius_threshold_px": radius_threshold,
            "importance_threshold": importance_threshold,
            "passthrough_px": passthrough,
            "overlay": overlay,
            "taa": taa,
            "taa_weight": taa_weight,
            "lds": lds,
            "hash": hash_constants,
            "prefilter": prefilter,
            "centre_reweighting": centre,
            "bilateral": bilateral,
            "normal_weights": normal_weights,
            "planes": planes,
            "passes": passes,
            "tile_order": tile_order,
            "lane_map": lane_map,
        }
    )
    from kernels.frame import gbuffer_of
    from kernels.opencl.device import open_device
    from kernels.record import estimate_rows
    from kernels.record import record as record_trace
    from kernels.scene import open_scene
    from traces.parquet import write_parquet

    opened = open_device(device)
    view = open_scene(scene, width, height, overlay=overlay, device=opened, **mesh)
    gbuffer = gbuffer_of(view, 0)
    num_traced = {"last": 1, "all": frames}.get(traced, len(traced_frames))
    num_lanes = estimate_rows(gbuffer, chosen, num_traced) * 32
    low, high = (num_lanes * b / 1e6 for b in FILE_BYTES_PER_LANE)
    remark(
        f"{gbuffer.name} {width}x{height} on {opened.name}: up to {num_lanes / 1e6:,.1f} million "
        "lane fetches, "
        f"about {low:,.1f} to {high:,.1f} MB"
    )
    trace = record_trace(
        view,
        chosen,
        num_frames=frames,
        traced_frames=traced_frames,
        device=opened,
        instruction_target=instructions,
    )
    num_fetches = 0

    def count(done: int) -> None:
        nonlocal num_fetches
        num_fetches = done
        bar.update(done)

    with progress(f"recording {gbuffer.name}", num_lanes) as bar:
        write_parquet(trace, output, progress=count)
    size_bytes = output.stat().st_size
    remark(
        f"wrote {output}: {num_fetches:,} lane fetches in {size_bytes / 1e6:,.1f} MB, "
        f"{size_bytes / max(num_fetches, 1):.3f} B each"
    )


def parse_traced_frames(text: str, num_frames: int) -> str | tuple[int, ...]:
    """What `kernels.record.record` takes: "last", "all", or frame numbers.

    Raises:
        InputError: anything else, a frame outside 0..num_frames - 1, or no frames to render.
    """
    from experiments.options import parse_names
    from traces.errors import InputError

    if num_frames < 1:
        raise InputError(f"--frames {num_frames}: allowed are 1 and up")
    if text in ("last", "all"):
        return text
    numbers = parse_names(text, "--traced-frames")
    for number in numbers:
        if not number.isdecimal() or int(number) >= num_frames:
            raise InputError(
                f"--traced-frames {text!r}: frame {number!r}: allowed are last, all, or numbers "
                "from 0 "
                f"to {num_frames - 1}"
            )
    return tuple(sorted(int(number) for number in numbers))
