"""Which kernels there are to count: the passes, and the choices of the method that change code."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from kernels import program
from kernels.method import PLANES, Method

#: The program of each counted kernel, and the macros that its code depends on.
KERNELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "setup": ("other", ()),
    "prefilter": ("other", ()),
    "estimate": ("other", ("RULE_PAPER",)),
    "update": ("other", ()),
    "combine": ("other", ()),
    "sampling": (
        "sampling",
        (
            "ADAPTIVE",
            "INVERSE_EXACT",
            "MIP_RULE",
            "SELF_NORMALISED",
            "CENTRE_REWEIGHTING",
            "BILATERAL",
            "NORMAL_WEIGHTS",
        ),
    ),
}


def macros_of(method: Method) -> tuple[str, ...]:
    """The options that compile the kernels that make the picture, a lane per work-item."""
    return ("-DWIDTH=1", *program.macros(method, traced=False))


def variant(kernel: str, method: Method) -> str:
    """The name of a kernel's variant for a method, such as "ADAPTIVE=0 INVERSE_EXACT=0 ..."."""
    names = KERNELS[kernel][1]
    values = dict(option[2:].split("=") for option in macros_of(method))
    return " ".join(f"{name}={values[name]}" for name in names)


def methods() -> Iterator[Method]:
    """A method for every combination of the choices that change code."""
    for kind, rule, inverse, mip_rule, weights, centre, bilateral, normals in product(
        ("fixed", "adaptive"),
        ("paper", "engine"),
        ("approximate", "exact"),
        ("eq-5.12", "textbook", "mip0"),
        ("self-normalised", "mean"),
        (True, False),
        (True, False),
        (True, False),
    ):
        yield replace(
            Method(),
            kind=kind,
            rule=rule,
            inverse_cdf=inverse,
            mip_rule=mip_rule,
            weights=weights,
            centre_reweighting=centre,
            bilateral=bilateral,
            normal_weights=normals,
            planes=PLANES,
        )


def all_variants(kernel: str) -> dict[str, Method]:
    """Every variant of a kernel, with a method that selects it."""
    found: dict[str, Method] = {}
    for method in methods():
        found.setdefault(variant(kernel, method), method)
    return found
