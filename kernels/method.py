"""The settings of the rendering method, checked once and immutable after."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from kernels.maths.profile import SKIN, Profile
from kernels.maths.sequence import HASHES
from traces.errors import InputError, unknown

PLANES = ("colour", "normal", "profile_id")
PASSES = (
    "setup",
    "prefilter",
    "classify",
    "pilot",
    "sampling",
    "separable_h",
    "separable_v",
    "update",
    "combine",
    "overlay",
    "taa",
)
MAX_SAMPLES = 2048  # the result texture's half-float alpha counts exactly up to here
MAX_PAST_FRAMES = 16  # the exact sliding rule keeps a byte per frame
MAX_PAST_SAMPLES = 255
MAX_TAPS = 511
HYBRID_RULES = ("count", "radius", "painted")

_CHOICES: dict[str, tuple[str, ...]] = {
    "kind": ("fixed", "adaptive", "separable", "hybrid"),
    "estimator": ("history", "two-pass", "last-frame"),
    "rule": ("paper", "o1", "sliding", "engine"),
    "control": ("none", "constant", "online"),
    "disocclusion": ("variance", "offscreen", "none"),
    "separable_profile": ("burley", "skin"),
    "hybrid_count": ("adaptive", "fixed"),
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
        history; "separable" filters along x and y instead; "hybrid" does one or the other by 8x8
        tile.
    b_min, b_max: bounds of the adaptive count.
    kappa: damping of the paper's correction, in [0, 1].
    alpha: weight of the newest frame in the history, in [0.001, 1].
    sigma0_sq: target variance of the tracked luminance: the paper's 0.001 for its rule, the
        engine's 0.0001 for its own. Counts leave b_min = 8 at about the same variance with either
        pair (0.001 and 0.0008); mixing them moves it tenfold.
    estimator: where the adaptive count comes from. "history" is the mean count and variance of the
        frames before; "two-pass" takes num_pilots samples first, which only measure the variance;
        "last-frame" is variance x count / sigma0_sq of the previous frame's samples alone. The last
        two take the variance between a frame's own samples and have no update pass.
    num_pilots: 2 to 2048.
    rule: "paper" is kappa Delta + E; "o1" the slides' form of it, kappa = 1; "sliding" the exact
        form, which keeps the counts of the last 2 / alpha - 1 frames, 1 to 16, of at most 255
        samples; "engine" clamps variance / sigma0_sq.
    control: what the history tracks is the luminance less `a` times the lighting's: "none", a = 0;
        "constant", a = 1; "online", a from the covariance of the two. It decides counts, never
        colours.
    eta_cov: weight of the newest frame in the covariance, in [0.001, 1]; the residual's is alpha.
    epsilon_a: added to the covariance and the variance whose ratio is `a`, 0 to 1.
    disocclusion: which pixels have no history: those that lie off the previous screen or more than
        a tenth off in depth ("variance": they take the target variance and this frame alone), those
        off the screen alone ("offscreen": variance 0 and this frame alone), or none ("none": they
        blend with 0).
    epsilon_u: separates the light that leaves its own pixel from distant light, whose variance
        alone is tracked; a pixel whose distant share is at most epsilon_u takes no samples and
        stays diffuse. In [0, 1); None: no separation. Of adaptive counts; needs centre_reweighting.
    num_taps: of each pass of the separable filter, odd, 3 to 511: 13, 19 and 27 are the engine's,
        11, 17 and 25 those of its authors' demo.
    separable_profile: where the taps' weights come from, see `separable_taps`: "burley" is that of
        `profile`, "skin" a sum of Gaussians.
    hybrid_count: of the tiles that are sampled. hybrid_rules: a tile is sampled where one of them
        holds, else filtered: "count", the mean estimated count is above count_threshold; "radius",
        the mean radius of the scatter is above radius_threshold_px pixels; "painted", the
        G-buffer's importance is at least importance_threshold somewhere.
    passthrough_px: tiles whose scatter has a smaller mean radius, in pixels, keep their light.
    inverse_cdf: of the radius. mip_rule: "mip0" forces level 0.
    weights: "mean" is the dissertation's Algorithm 2.
    scale: "legacy" is the wider screen step of the engine that Eq 5.12 was tuned on.
    centre_reweighting: no sample lands on the centre pixel, whose share is added in closed form.
    bilateral: distances include the depth difference.
    normal_weights: samples count less the further their normal turns away.
    prefilter: build the mip chain.
    hash: constants of pcg3d16.
    profile: the material of every scattering pixel.
    overlay: draw the scene's transparent layer over the finished picture, before the TAA.
    taa: accumulate the picture as shown; its weight of the newest frame grows with the speed from
        taa_weight, in [0.001, 1], to alpha.
    lds: samples at level 0 within a texel of their own 8x8 tile come from local memory, which the
        tile fills first. The picture does not depend on it. Of the history estimator and the
        estimator's usual form: approximate inverse, self-normalised, centre_reweighting, bilateral.
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
    estimator: str = "history"
    num_pilots: int = 8
    rule: str = "paper"
    control: str = "none"
    eta_cov: float = 0.05
    epsilon_a: float = 1e-4
    disocclusion: str = "variance"
    epsilon_u: float | None = None
    num_taps: int = 27
    separable_profile: str = "burley"
    hybrid_count: str = "adaptive"
    hybrid_rules: tuple[str, ...] = ("count", "radius")
    count_threshold: float = 16.0
    radius_threshold_px: float = 64.0
    importance_threshold: float = 0.5
    passthrough_px: float = 1.0
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
    overlay: bool = False
    taa: bool = False
    taa_weight: float = 0.04
    lds: bool = False
    planes: tuple[str, ...] = PLANES
    passes: tuple[str, ...] = PASSES
    tile_order: str = "raster"
    lane_map: str = "linear"

    def __post_init__(self) -> None:
        for field, allowed in _CHOICES.items():
            if getattr(self, field) not in allowed:
                raise unknown(field, str(getattr(self, field)), allowed, "method")
        for field, known in (
            ("planes", PLANES),
            ("passes", PASSES),
            ("hybrid_rules", HYBRID_RULES),
        ):
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
        self._check_range("taa_weight", 1e-3, 1.0)
        self._check_range("sigma0_sq", 1e-7, 1e3)
        self._check_range("eta_cov", 1e-3, 1.0)
        self._check_range("epsilon_a", 0.0, 1.0)
        if self.epsilon_u is not None and not 0 <= self.epsilon_u < 1:
            raise InputError(f"method: epsilon_u {self.epsilon_u}: allowed are 0 to below 1")
        self._check_range("count_threshold", 0.0, MAX_SAMPLES)
        self._check_range("radius_threshold_px", 0.0, 1e6)
        self._check_range("importance_threshold", 0.0, 1.0)
        self._check_range("passthrough_px", 0.0, 1e6)
        taps = self.num_taps
        if not isinstance(taps, int) or not 3 <= taps <= MAX_TAPS or taps % 2 == 0:
            raise InputError(f"method: num_taps {taps}: allowed are odd numbers, 3 to {MAX_TAPS}")
        usual = self.inverse_cdf == "approximate" and self.weights == "self-normalised"
        usual = usual and self.centre_reweighting and self.bilateral
        if self.lds and not (usual and self.estimator == "history" and self.epsilon_u is None):
            raise InputError(
                "method: lds True: allowed with it are inverse_cdf 'approximate', weights "
                "'self-normalised', centre_reweighting, bilateral, estimator 'history' and "
                "epsilon_u None"
            )
        if self.adaptive:
            self._check_adaptive()

    def _check_adaptive(self) -> None:
        """What adaptive counts alone ask of the fields."""
        if not isinstance(self.num_pilots, int) or not 2 <= self.num_pilots <= MAX_SAMPLES:
            raise InputError(
                f"method: num_pilots {self.num_pilots}: allowed are 2 to {MAX_SAMPLES}"
            )
        if self.estimator == "last-frame" and self.b_min < 2:
            raise InputError(
                f"method: b_min {self.b_min}: the last-frame estimator needs 2 or more, for a "
                "variance"
            )
        if self.estimator != "history" and self.control != "none":
            raise InputError(
                f"method: control {self.control!r}: allowed with the {self.estimator} estimator is "
                "'none'; others need the history"
            )
        if self.epsilon_u is not None and not self.centre_reweighting:
            raise InputError(
                f"method: epsilon_u {self.epsilon_u}: allowed is None without centre_reweighting"
            )
        if self.hybrid and not (
            self.estimator == "history" and self.rule != "sliding" and self.epsilon_u is None
        ):
            raise InputError(
                "method: kind 'hybrid': allowed with it are the estimator 'history', rules but "
                "'sliding', and no epsilon_u"
            )
        if self.counts_past_frames:
            if not 1 <= self.num_past_frames <= MAX_PAST_FRAMES:
                raise InputError(
                    f"method: alpha {self.alpha}: the sliding rule needs 2 / alpha - 1 in 1 to "
                    f"{MAX_PAST_FRAMES}"
                )
            if self.b_max > MAX_PAST_SAMPLES:
                raise InputError(
                    f"method: b_max {self.b_max}: allowed with the sliding rule are 1 to "
                    f"{MAX_PAST_SAMPLES}"
                )

    def _check_range(self, field: str, low: float, high: float) -> None:
        value = getattr(self, field)
        if not low <= value <= high:
            raise InputError(f"method: {field} {value}: allowed are {low:g} to {high:g}")

    @property
    def adaptive(self) -> bool:
        """Whether counts come from an estimate."""
        return self.kind == "adaptive" or (self.hybrid and self.hybrid_count == "adaptive")

    @property
    def hybrid(self) -> bool:
        return self.kind == "hybrid"

    @property
    def samples(self) -> bool:
        """Whether there is a sampling pass."""
        return self.kind != "separable"

    @property
    def filters(self) -> bool:
        """Whether there are separable passes."""
        return self.kind in ("separable", "hybrid")

    @property
    def takes_pilots(self) -> bool:
        """Whether a pass of pilot samples comes before the sampling pass."""
        return self.adaptive and self.estimator == "two-pass"

    @property
    def guided_by_last_frame(self) -> bool:
        """Whether the sampling pass writes the history."""
        return self.adaptive and self.estimator == "last-frame"

    @property
    def updates_history(self) -> bool:
        """Whether there is an update pass."""
        return self.adaptive and self.estimator == "history"

    @property
    def counts_past_frames(self) -> bool:
        """Whether the count of each of the last frames is kept."""
        return self.updates_history and self.rule == "sliding"

    @property
    def num_past_frames(self) -> int:
        """Frames of the simple moving average that the history's alpha stands for, rounded."""
        return round(2.0 / self.alpha - 1.0)

    @property
    def separates(self) -> bool:
        """Whether distant light is told from direct."""
        return self.adaptive and self.epsilon_u is not None

    @property
    def max_samples(self) -> int:
        """The largest count a pixel can get."""
        return self.b_max if self.adaptive else self.num_samples

    def as_dict(self) -> dict[str, Any]:
        """The settings as JSON-able values, for manifests and tables."""
        values = asdict(self)
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
