"""The OpenCL program of a method: the passes' sources joined, with the method's choices as macros."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from kernels.device import Device
from kernels.method import Method
from kernels.sequence import HASHES

if TYPE_CHECKING:
    import pyopencl as cl

_SOURCES = ("polynomial", "common", "setup", "prefilter", "estimate", "sampling", "update", "combine")
_MIP_RULES = {"mip0": 0, "eq-5.12": 1, "textbook": 2}
#: Programs by device and macros: a build takes about a second.
_built: dict[tuple[Device, tuple[str, ...]], cl.Program] = {}


@cache
def source() -> str:
    """The text of every pass, in the order in which they need each other."""
    folder = resources.files("kernels")
    return "\n".join(folder.joinpath(f"{name}.cl").read_text() for name in _SOURCES)


def source_hash() -> str:
    """SHA-256 of the kernels' text, for the manifest of a trace."""
    return hashlib.sha256(source().encode()).hexdigest()


def macros(method: Method, traced: bool) -> tuple[str, ...]:
    """The `-D` options that select the method's branches."""
    multiplier, increment = HASHES[method.hash]
    values = {
        "TRACED": traced,
        "TRACE_COLOUR": traced and "colour" in method.planes,
        "TRACE_NORMAL": traced and "normal" in method.planes,
        "TRACE_PROFILE_ID": traced and "profile_id" in method.planes,
        "ADAPTIVE": method.adaptive,
        "RULE_PAPER": method.rule == "paper",
        "INVERSE_EXACT": method.inverse_cdf == "exact",
        "MIP_RULE": _MIP_RULES[method.mip_rule] if method.prefilter else 0,
        "SELF_NORMALISED": method.weights == "self-normalised",
        "CENTRE_REWEIGHTING": method.centre_reweighting,
        "BILATERAL": method.bilateral,
        "NORMAL_WEIGHTS": method.normal_weights,
        "HASH_MULTIPLIER": f"{multiplier}u",
        "HASH_INCREMENT": f"{increment}u",
    }
    return tuple(
        f"-D{name}={int(v) if isinstance(v, bool) else v}" for name, v in values.items()
    )


def build(device: Device, method: Method, traced: bool) -> cl.Program:
    """The program for a method on a device; built once per process.

    Raises:
        DeviceError: it does not compile.
    """
    key = (device, macros(method, traced))
    if key not in _built:
        _built[key] = device.build(source(), key[1])
    return _built[key]
