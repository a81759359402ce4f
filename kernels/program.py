"""The OpenCL program of a method: the passes' sources joined, with the method's choices as
macros.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from kernels.maths.sequence import HASHES
from kernels.method import Method
from kernels.opencl.device import Device

if TYPE_CHECKING:
    import pyopencl as cl

#: Each program's files behind the functions of `maths`, in the order in which they need each other.
#: The passes with a loop stand alone: their work-items hold more lanes.
_FILES = {
    "sampling": ("common", "patch", "work_items", "sampling"),
    "pilot": ("common", "patch", "work_items", "sampling"),
    "separable_h": ("common", "patch", "work_items", "separable"),
    "separable_v": ("common", "patch", "work_items", "separable"),
    "other": (
        *("common", "history", "covariance"),
        *("setup", "prefilter", "classify", "estimate", "update", "combine"),
        *("overlay", "taa"),
    ),
}
#: What stands before the files of a program.
_PREFIX = {
    "sampling": "#define PATCH LDS",
    "pilot": "#define PILOT 1",
    "separable_h": "#define VERTICAL 0",
    "separable_v": "#define VERTICAL 1",
}
#: The kernel function of a pass, where its name is another.
FUNCTIONS = {"pilot": "sampling"}
_CONTROLS = {"none": 0, "constant": 1, "online": 2}
_DISOCCLUSIONS = {"variance": 0, "offscreen": 1, "none": 2}
_MIP_RULES = {"mip0": 0, "eq-5.12": 1, "textbook": 2}
#: Programs by device, file list and macros: a build takes about a second.
_built: dict[tuple[Device, str, tuple[str, ...]], cl.Program] = {}


def _program_of(kernel: str) -> str:
    return kernel if kernel in _FILES else "other"


def lanes_per_item(device: Device, kernel: str) -> int:
    """Lanes of a warp that one work-item of a kernel works on: 8 in the passes with a loop on CPUs,
    else 1.

    PoCL does not vectorise over the work-items of a kernel with a loop: written-out vectors make it
    8 times as fast.
    """
    return 8 if kernel in _FILES and device.kind == "cpu" else 1


@cache
def source(name: str, native: bool = False) -> str:
    """The text of a program: "other", or that of a pass with a loop. native: with the functions of
    native.cl in place of polynomial.cl's; such a text is counted, not run.
    """
    maths = resources.files("kernels.maths").joinpath("native.cl" if native else "polynomial.cl")
    folder = resources.files("kernels.passes")
    texts = [
        maths.read_text(),
        *(folder.joinpath(f"{file}.cl").read_text() for file in _FILES[name]),
    ]
    return "\n".join([*([_PREFIX[name]] if name in _PREFIX else []), *texts])


def source_hash(native: bool = False) -> str:
    """SHA-256 of the kernels' text, for the manifest of a trace. native: see `source`."""
    text = "".join(source(name, native) for name in _FILES)
    return hashlib.sha256(text.encode()).hexdigest()


def macros(method: Method, traced: bool) -> tuple[str, ...]:
    """The `-D` options that select the method's branches."""
    multiplier, increment = HASHES[method.hash]
    values = {
        "TRACED": traced,
        "TRACE_COLOUR": traced and "colour" in method.planes,
        "TRACE_NORMAL": traced and "normal" in method.planes,
        "TRACE_PROFILE_ID": traced and "profile_id" in method.planes,
        "ADAPTIVE": method.adaptive,
        "RULE_PAPER": method.rule in ("paper", "o1"),
        "RULE_SLIDING": method.counts_past_frames,
        "TWO_PASS": method.takes_pilots,
        "LAST_FRAME": method.guided_by_last_frame,
        "CONTROL": _CONTROLS[method.control] if method.updates_history else 0,
        "DISOCCLUSION": 0 if method.takes_pilots else _DISOCCLUSIONS[method.disocclusion],
        "SEPARATION": method.separates,
        "INVERSE_EXACT": method.inverse_cdf == "exact",
        "MIP_RULE": _MIP_RULES[method.mip_rule] if method.prefilter else 0,
        "SELF_NORMALISED": method.weights == "self-normalised",
        "CENTRE_REWEIGHTING": method.centre_reweighting,
        "BILATERAL": method.bilateral,
        "NORMAL_WEIGHTS": method.normal_weights,
        "PAINTED": method.hybrid and "painted" in method.hybrid_rules,
        "LISTED": method.hybrid,
        "LDS": method.lds and method.samples,
        "HASH_MULTIPLIER": f"{multiplier}u",
        "HASH_INCREMENT": f"{increment}u",
    }
    return tuple(f"-D{name}={int(v) if isinstance(v, bool) else v}" for name, v in values.items())


def build(device: Device, method: Method, kernel: str, traced: bool) -> cl.Program:
    """The program that holds a kernel, for a method on a device; built once per process.

    Raises:
        DeviceError: it does not compile.
    """
    name = _program_of(kernel)
    width = f"-DWIDTH={lanes_per_item(device, kernel)}"
    key = (device, name, (width, *macros(method, traced)))
    if key not in _built:
        _built[key] = device.build(source(name), key[2])
    return _built[key]
