"""`cachesim render`: a scene without scattering, with it, and where the samples go."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments import method_options as options
from experiments.options import (
    AlbedoMap,
    CameraName,
    DeviceName,
    Folder,
    ImageSize,
    NormalMap,
    SceneName,
)


def command(
    scene: SceneName = "front",
    camera: CameraName = None,
    albedo_map: AlbedoMap = None,
    normal_map: NormalMap = None,
    size: ImageSize = "1920x1080",
    output: Folder = Path("out"),
    frames: Annotated[int, typer.Option("--frames", metavar="N", min=1)] = 8,
    device: DeviceName = None,
    method: options.Kind = "adaptive",
    samples: options.Samples = 64,
    estimator: options.Estimator = "history",
    pilots: options.Pilots = 8,
    control: options.Control = "none",
    eta_cov: options.EtaCov = 0.05,
    epsilon_a: options.EpsilonA = 1e-4,
    disocclusion: options.Disocclusion = "variance",
    epsilon_u: options.EpsilonU = None,
    rule: options.Rule = "paper",
    kappa: options.Kappa = 0.2,
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
) -> None:
    """Render a scene: without scattering, with it, and the map of sample counts."""
    from experiments.console import progress, remark
    from experiments.options import parse_image_size, scene_arguments
    from experiments.output import output_folder, write_figure, write_text

    width, height = parse_image_size(size)
    mesh = scene_arguments(scene, camera, albedo_map, normal_map)
    chosen = options.make_method(
        {
            "kind": method,
            "num_samples": samples,
            "estimator": estimator,
            "num_pilots": pilots,
            "control": control,
            "eta_cov": eta_cov,
            "epsilon_a": epsilon_a,
            "disocclusion": disocclusion,
            "epsilon_u": epsilon_u,
            "rule": rule,
            "kappa": kappa,
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
        }
    )
    folder = output_folder(output)
    from experiments.plots import count_map
    from kernels.frame import gbuffer_of
    from kernels.frame import render as render_frames
    from kernels.opencl.device import open_device
    from kernels.picture import preview, save_png, tone_map
    from kernels.scene import open_scene

    opened = open_device(device)
    view = open_scene(scene, width, height, overlay=overlay, device=opened, **mesh)
    gbuffer = gbuffer_of(view, 0)
    with progress(f"rendering {gbuffer.name}", 1) as bar:
        frame = render_frames(view, chosen, num_frames=frames, device=opened, progress=bar.update)
    stem = gbuffer.name.replace(":", "-")
    gbuffer = gbuffer_of(view, frame.index)
    shown = frame.combined if frame.shown is None else frame.shown
    save_png(folder / f"{stem}-preview.png", preview(gbuffer))
    save_png(folder / f"{stem}-{method}.png", tone_map(shown))
    figure = count_map(frame.counts, f"{gbuffer.name}, frame {frame.index}", gbuffer.attribution)
    write_figure(folder / f"{stem}-{method}-counts.png", figure)
    if gbuffer.attribution:
        write_text(folder / "attribution.txt", gbuffer.attribution + "\n")
    mean = frame.num_samples / int(gbuffer.subsurface.sum())
    for line in (
        f"{gbuffer.name} {width}x{height} on {opened.name}: coverage "
        f"{gbuffer.coverage_rate:.1%}, "
        f"{gbuffer.pixels_per_mm():.2f} pixels per mm, "
        f"{mean:.1f} samples per pixel in frame {frame.index}",
        gbuffer.attribution,
        f"wrote {stem}-preview.png, {stem}-{method}.png and {stem}-{method}-counts.png to {folder}",
    ):
        if line:
            remark(line)
