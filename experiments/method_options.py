"""The rendering method's options on the command line: one per field of `kernels.method.Method`
but the profile.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from experiments.options import parse_names
from traces.errors import InputError

if TYPE_CHECKING:
    from kernels.method import Method

Kind = Annotated[
    str,
    typer.Option(
        "--method",
        metavar="fixed|adaptive|separable|hybrid",
        help="How many samples a pixel takes; or a filter instead; or either by 8x8 tile.",
    ),
]
Samples = Annotated[int, typer.Option("--samples", metavar="N", help="Samples of the fixed count.")]
SamplesMin = Annotated[int, typer.Option("--b-min", metavar="N", help="Least adaptive count.")]
SamplesMax = Annotated[int, typer.Option("--b-max", metavar="N", help="Largest adaptive count.")]
Rule = Annotated[
    str,
    typer.Option("--rule", metavar="paper|o1|sliding|engine", help="Rule of the adaptive count."),
]
Estimator = Annotated[
    str,
    typer.Option(
        "--estimator",
        metavar="history|two-pass|last-frame",
        help="Where the adaptive count comes from.",
    ),
]
Pilots = Annotated[
    int, typer.Option("--pilots", metavar="N", help="Discarded samples of the two-pass estimator.")
]
Control = Annotated[
    str,
    typer.Option(
        "--control",
        metavar="none|constant|online",
        help="Control variate of the tracked luminance; it changes counts, never colours.",
    ),
]
EtaCov = Annotated[
    float, typer.Option("--eta-cov", help="Weight of the newest frame in the covariance, 0 to 1.")
]
EpsilonA = Annotated[
    float, typer.Option("--epsilon-a", help="Pulls the online coefficient to 1 where all is still.")
]
Disocclusion = Annotated[
    str,
    typer.Option(
        "--disocclusion",
        metavar="variance|offscreen|none",
        help="Which pixels have no history: off the screen or off in depth, the first, or none.",
    ),
]
EpsilonU = Annotated[
    float | None,
    typer.Option(
        "--epsilon-u",
        help="Separate distant light; pixels whose share of it is at most this stay diffuse.",
    ),
]
Kappa = Annotated[float, typer.Option("--kappa", help="Damping of the paper's rule, 0 to 1.")]
Alpha = Annotated[float, typer.Option("--alpha", help="Weight of the newest frame, 0 to 1.")]
Sigma0Sq = Annotated[
    float, typer.Option("--sigma0-sq", help="Target variance: paper 0.001, engine 0.0001.")
]
Scale = Annotated[
    str, typer.Option("--scale", metavar="physical|legacy", help="What 1 mm is on the screen.")
]
MipRule = Annotated[
    str, typer.Option("--mip-rule", metavar="eq-5.12|textbook|mip0", help="Mip level of a sample.")
]
InverseCdf = Annotated[
    str, typer.Option("--inverse-cdf", metavar="approximate|exact", help="Radius of a sample.")
]
Weights = Annotated[
    str,
    typer.Option("--weights", metavar="self-normalised|mean", help="Weights; mean: Algorithm 2."),
]
Hash = Annotated[
    str, typer.Option("--hash", metavar="jcgt|unreal", help="Constants of the seed's pcg3d16.")
]
Prefilter = Annotated[bool, typer.Option("--prefilter/--no-prefilter", help="Build the mip chain.")]
Centre = Annotated[
    bool, typer.Option("--centre/--no-centre", help="Add the centre pixel's share in closed form.")
]
Bilateral = Annotated[
    bool, typer.Option("--bilateral/--no-bilateral", help="Count depth differences as distance.")
]
NormalWeights = Annotated[
    bool, typer.Option("--normal-weights/--no-normal-weights", help="Weigh samples by normals.")
]
Taps = Annotated[
    int, typer.Option("--taps", metavar="N", help="Taps of a pass of the separable filter, odd.")
]
SeparableProfile = Annotated[
    str,
    typer.Option("--separable-profile", metavar="burley|skin", help="Weights of the taps."),
]
HybridCount = Annotated[
    str,
    typer.Option(
        "--hybrid-count", metavar="adaptive|fixed", help="Samples of the tiles that are sampled."
    ),
]
HybridRules = Annotated[
    str,
    typer.Option(
        "--hybrid-rules",
        metavar="LIST",
        help="Which tiles are sampled: those above the count, above the radius, or painted.",
    ),
]
CountThreshold = Annotated[
    float, typer.Option("--count-threshold", help="Mean count above which a tile is sampled.")
]
RadiusThreshold = Annotated[
    float,
    typer.Option("--radius-threshold", help="Mean radius, pixels, above which a tile is sampled."),
]
ImportanceThreshold = Annotated[
    float,
    typer.Option("--importance-threshold", help="Painted importance from which a tile is sampled."),
]
Passthrough = Annotated[
    float,
    typer.Option("--passthrough", help="Mean radius, pixels, below which a tile keeps its light."),
]
Overlay = Annotated[
    bool,
    typer.Option(
        "--overlay/--no-overlay",
        help="Draw the scene's transparent layer over the picture; where it has none, a moving "
        "veil.",
    ),
]
Taa = Annotated[
    bool, typer.Option("--taa/--no-taa", help="Accumulate the finished picture over the frames.")
]
TaaWeight = Annotated[
    float,
    typer.Option("--taa-weight", help="Weight of the newest frame in it at rest, 0.001 to 1."),
]
Lds = Annotated[
    bool,
    typer.Option("--lds/--no-lds", help="Serve near samples from a 10x10 patch in local memory."),
]
Planes = Annotated[
    str, typer.Option("--planes", metavar="LIST", help="Planes of the sampling pass to record.")
]
Passes = Annotated[
    str | None,
    typer.Option(
        "--passes",
        metavar="LIST",
        help="Passes to record, of those that the method runs; all of them unless given.",
    ),
]
TileOrder = Annotated[
    str, typer.Option("--tile-order", metavar="raster|morton", help="Order of the 8x8 tiles.")
]
LaneMap = Annotated[
    str,
    typer.Option("--lane-map", metavar="linear|quad2x2|morton8x8", help="Lane to pixel in a tile."),
]

ALL_PLANES = "colour,normal,profile_id"


def make_method(fields: dict[str, Any]) -> Method:
    """A `Method` of a command's arguments; tuples of names come as comma-separated text. Without
    `passes`, a recording holds every pass that the method runs.

    Raises:
        InputError: a field has a value that is not allowed, or a pass that the method does not run.
    """
    from kernels.launches import names_run
    from kernels.method import Method

    fields = {name: value for name, value in fields.items() if value is not None}
    for name in ("planes", "passes", "hybrid_rules"):
        if name in fields:
            option = "--" + name.replace("_", "-")
            fields = {**fields, name: tuple(parse_names(fields[name], option))}
    method = Method(**fields)
    for name in fields.get("passes", ()):
        if name not in names_run(method):
            raise InputError(
                f"--passes: {name!r}: this method does not run it; it runs "
                f"{', '.join(names_run(method))}"
            )
    return method
