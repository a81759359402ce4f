"""The rendering method's options on the command line: one per field of `kernels.method.Method`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from experiments.options import parse_names

if TYPE_CHECKING:
    from kernels.method import Method

Kind = Annotated[
    str, typer.Option("--method", metavar="fixed|adaptive", help="How many samples a pixel takes.")
]
Samples = Annotated[int, typer.Option("--samples", metavar="N", help="Samples of the fixed count.")]
SamplesMin = Annotated[int, typer.Option("--b-min", metavar="N", help="Least adaptive count.")]
SamplesMax = Annotated[int, typer.Option("--b-max", metavar="N", help="Largest adaptive count.")]
Rule = Annotated[
    str, typer.Option("--rule", metavar="paper|engine", help="Rule of the adaptive count.")
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
Planes = Annotated[
    str, typer.Option("--planes", metavar="LIST", help="Planes of the sampling pass to record.")
]
Passes = Annotated[str, typer.Option("--passes", metavar="LIST", help="Passes to record.")]
TileOrder = Annotated[
    str, typer.Option("--tile-order", metavar="raster|morton", help="Order of the 8x8 tiles.")
]
LaneMap = Annotated[
    str,
    typer.Option("--lane-map", metavar="linear|quad2x2|morton8x8", help="Lane to pixel in a tile."),
]

ALL_PLANES = "colour,normal,profile_id"
ALL_PASSES = "setup,prefilter,sampling,update,combine"


def make_method(fields: dict[str, Any]) -> Method:
    """A `Method` of a command's arguments; `planes` and `passes` may be comma-separated text.

    Raises:
        InputError: a field has a value that is not allowed.
    """
    from kernels.method import Method

    for name in ("planes", "passes"):
        if name in fields:
            fields = {**fields, name: tuple(parse_names(fields[name], f"--{name}"))}
    return Method(**fields)
