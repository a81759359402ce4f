"""Which kernels there are to count: the passes, and the choices of the method that change code."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from kernels import program
from kernels.method import PLANES, Method

_ESTIMATOR = (
    "INVERSE_EXACT",
    "MIP_RULE",
    "SELF_NORMALISED",
    "CENTRE_REWEIGHTING",
    "BILATERAL",
    "NORMAL_WEIGHTS",
)
#: The program of each counted kernel, and the macros that its code depends on.
KERNELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "setup": ("other", ()),
    "prefilter": ("other", ()),
    "estimate": ("other", ("RULE_PAPER",)),
    "update": ("other", ()),
    "combine": ("other", ()),
    "overlay": ("other", ()),
    "taa": ("other", ()),
    "classify": ("other", ()),
    "separable_h": ("separable_h", ()),
    "separable_v": ("separable_v", ()),
    "pilot": ("pilot", _ESTIMATOR),
    "sampling": ("sampling", ("ADAPTIVE", *_ESTIMATOR)),
}
#: Macros that a variant's name holds only where they are not 0. Left out: what separation adds to
#: the sampling kernel, three selections.
OPTIONS: dict[str, tuple[str, ...]] = {
    "estimate": ("RULE_SLIDING", "TWO_PASS", "LAST_FRAME", "DISOCCLUSION", "SEPARATION"),
    "update": ("RULE_SLIDING", "CONTROL", "DISOCCLUSION", "SEPARATION"),
    "sampling": ("LAST_FRAME", "LDS"),
    "classify": ("PAINTED",),
}


def macros_of(method: Method) -> tuple[str, ...]:
    """The options that compile the kernels that make the picture, a lane per work-item."""
    return ("-DWIDTH=1", *program.macros(method, traced=False))


def variant(kernel: str, method: Method) -> str:
    """The name of a kernel's variant for a method, such as "ADAPTIVE=0 INVERSE_EXACT=0 ..."."""
    values = dict(option[2:].split("=") for option in macros_of(method))
    options = OPTIONS.get(kernel, ())
    names = (*KERNELS[kernel][1], *(name for name in options if values[name] != "0"))
    return " ".join(f"{name}={values[name]}" for name in names)


def methods() -> Iterator[Method]:
    """A method for every combination of the choices that change code."""
    for kind, rule in product(("fixed", "adaptive"), ("paper", "engine")):
        yield from _sampled(replace(Method(), kind=kind, rule=rule, planes=PLANES))
    yield from _sampled(Method(kind="adaptive", estimator="last-frame", planes=PLANES))
    for estimator, rule, control, disocclusion, epsilon_u in product(
        ("history", "two-pass", "last-frame"),
        ("paper", "engine", "sliding"),
        ("none", "constant", "online"),
        ("variance", "offscreen", "none"),
        (None, 0.05),
    ):
        if estimator == "history" or (control == "none" and rule != "sliding"):
            yield Method(
                kind="adaptive",
                estimator=estimator,
                rule=rule,
                control=control,
                disocclusion=disocclusion,
                epsilon_u=epsilon_u,
                planes=PLANES,
            )
    yield Method(kind="hybrid", hybrid_rules=("painted",), planes=PLANES)
    for kind, mip_rule, normals in product(
        ("fixed", "adaptive"), ("eq-5.12", "textbook", "mip0"), (True, False)
    ):
        yield Method(kind=kind, mip_rule=mip_rule, normal_weights=normals, lds=True, planes=PLANES)


def _sampled(method: Method) -> Iterator[Method]:
    """The method with every combination of the sampling kernel's choices."""
    for inverse, mip_rule, weights, centre, bilateral, normals in product(
        ("approximate", "exact"),
        ("eq-5.12", "textbook", "mip0"),
        ("self-normalised", "mean"),
        (True, False),
        (True, False),
        (True, False),
    ):
        yield replace(
            method,
            inverse_cdf=inverse,
            mip_rule=mip_rule,
            weights=weights,
            centre_reweighting=centre,
            bilateral=bilateral,
            normal_weights=normals,
        )


def all_variants(kernel: str) -> dict[str, Method]:
    """Every variant of a kernel, with a method that selects it."""
    found: dict[str, Method] = {}
    for method in methods():
        found.setdefault(variant(kernel, method), method)
    return found
