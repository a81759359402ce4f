"""The settings of the rendering method, checked once and immutable after."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from kernels.profile import SKIN, Profile
from kernels.sequence import HASHES
from traces.errors import InputError, unknown

PLANES = ("colour", "normal", "profile_id")
PASSES = ("setup", "prefilter", "sampling", "update", "combine")
MAX_SAMPLES = 2048  # the result texture's half-float alpha counts exactly up to here

_CHOICES: dict[str, tuple[str, ...]] = {
    "kind": ("fixed", "adaptive"),
    "rule": ("paper", "engine"),
    "inverse_cdf": ("approximate", "exact"),
    "mip_rule": ("eq-5.12", "textbook", "mip0"),
    "weights": ("self-normalised", "mean"),
    "scale": ("physical", "legacy"),
    "hash": tuple(HASHES),
    "tile_order": ("raster", "morton"),
    "lane_map": ("linear", "quad2x2", "morton8x8"),
}


@dataclass(frozen=True)
class Method:
    """Adaptive filtered importance sampling, fixed or adaptive in its count; all lengths in mm.

    kind: "fixed" takes num_samples, 1 to 2048, everywhere; "adaptive" takes the count from the
        history.
    b_min, b_max: bounds of the adaptive count.
    kappa: damping of the paper's correction, in [0, 1].
    alpha: weight of the newest frame in the history, in [0.001, 1].
    sigma0_sq: target variance of the tracked luminance: the paper's 0.001 for its rule, the
        engine's 0.0001 for its own. Counts leave b_min = 8 at about the same variance with either
        pair (0.001 and 0.0008); mixing them moves it tenfold.
    rule: "paper" is kappa Delta + E, "engine" clamps variance / sigma0_sq.
    inverse_cdf: of the radius. mip_rule: "mip0" forces level 0.
    weights: "mean" is the dissertation's Algorithm 2.
    scale: "legacy" is the wider screen step of the engine that Eq 5.12 was tuned on.
    centre_reweighting: no sample lands on the centre pixel, whose share is added in closed form.
    bilateral: distances include the depth difference.
    normal_weights: samples count less the further their normal turns away.
    prefilter: build the mip chain.
    hash: constants of pcg3d16.
    profile: the material of every scattering pixel.
    planes, passes: what a recording holds; the picture does not depend on them. Normals are only
        read with normal_weights.
    tile_order, lane_map: CTA to 8x8 tile, and lane to pixel inside it.
    """

    kind: str = "fixed"
    num_samples: int = 64
    b_min: int = 8
    b_max: int = 64
    kappa: float = 0.2
    alpha: float = 0.2
    sigma0_sq: float = 0.001
    rule: str = "paper"
    inverse_cdf: str = "approximate"
    mip_rule: str = "eq-5.12"
    weights: str = "self-normalised"
    scale: str = "physical"
    centre_reweighting: bool = True
    bilateral: bool = True
    normal_weights: bool = True
    prefilter: bool = True
    hash: str = "jcgt"
    profile: Profile = SKIN
    planes: tuple[str, ...] = PLANES
    passes: tuple[str, ...] = PASSES
    tile_order: str = "raster"
    lane_map: str = "linear"

    def __post_init__(self) -> None:
        for field, allowed in _CHOICES.items():
            if getattr(self, field) not in allowed:
                raise unknown(field, str(getattr(self, field)), allowed, "method")
        for field, known in (("planes", PLANES), ("passes", PASSES)):
            for name in getattr(self, field):
                if name not in known:
                    raise unknown(field, str(name), known, "method")
        for field in ("num_samples", "b_min", "b_max"):
            value = getattr(self, field)
            if not isinstance(value, int) or not 1 <= value <= MAX_SAMPLES:
                raise InputError(f"method: {field} {value}: allowed are 1 to {MAX_SAMPLES}")
        if self.b_min > self.b_max:
            raise InputError(f"method: b_min {self.b_min}: allowed are 1 to b_max = {self.b_max}")
        self._check_range("kappa", 0.0, 1.0)
        self._check_range("alpha", 1e-3, 1.0)
        self._check_range("sigma0_sq", 1e-7, 1e3)

    def _check_range(self, field: str, low: float, high: float) -> None:
        value = getattr(self, field)
        if not low <= value <= high:
            raise InputError(f"method: {field} {value}: allowed are {low:g} to {high:g}")

    @property
    def adaptive(self) -> bool:
        return self.kind == "adaptive"

    @property
    def max_samples(self) -> int:
        """The largest count a pixel can get."""
        return self.b_max if self.adaptive else self.num_samples

    def as_dict(self) -> dict[str, Any]:
        """The settings as JSON-able values, for manifests and tables."""
        values = asdict(self)
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
