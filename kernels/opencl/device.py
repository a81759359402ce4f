"""The OpenCL device: a probe kernel built and run on each candidate, the first that works.

Order: a device named by argument or by `CACHESIM_DEVICE`, else GPUs, PoCL (newest first), any
other CPU, anything else. A driver that loads may still be unable to compile (PoCL's wheel on CPUs
that its LLVM does not know), so listing devices is not enough.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kernels.opencl.driver_noise import noise_kept, short_reason
from kernels.opencl.icd import use_all_drivers
from traces.errors import WorkError, unknown

if TYPE_CHECKING:
    import pyopencl as cl

DEVICE_VARIABLE = "CACHESIM_DEVICE"
CORRECT_ROUNDING = "-cl-fp32-correctly-rounded-divide-sqrt"

#: Uses what the real kernels use: 8x8 work-groups, local memory, a barrier, integers and floats.
_PROBE_SOURCE = """
#pragma OPENCL FP_CONTRACT OFF
kernel __attribute__((reqd_work_group_size(8, 8, 1)))
void probe(global const float *value, global float *out, global uint *bits) {
  local float tile[64];
  uint lane = get_local_id(1) * 8u + get_local_id(0);
  uint i = get_group_id(0) * 64u + lane;
  tile[lane] = value[i];
  barrier(CLK_LOCAL_MEM_FENCE);
  out[i] = sqrt(tile[63u - lane]) / 3.0f + tile[lane] * tile[lane];
  bits[i] = (i * 747796405u + 2891336453u) >> (i & 31u);
}
"""


class DeviceError(WorkError):
    """The OpenCL device failed while working. The command line prints it and exits with code 1."""


class NoDeviceError(DeviceError):
    """No OpenCL device works: the message says which were tried, why each failed, what to do."""


@dataclass(frozen=True, eq=False)
class Device:
    """A device on which the probe kernel has run.

    name: platform and device, for people, tables and traces. version: OpenCL and driver version.
    kind: "gpu", "cpu" or "other". build_options: pass to every build; `build` does.
    """

    name: str
    version: str
    kind: str
    context: cl.Context
    queue: cl.CommandQueue
    build_options: tuple[str, ...]

    def build(
        self, source: str, options: Sequence[str] = (), include: Sequence[Path] = ()
    ) -> cl.Program:
        """Compile a program with this device's options, quietly.

        Args:
            source: OpenCL C.
            options: further options, such as `-D NAME=1`.
            include: folders searched by `#include`.

        Raises:
            DeviceError: it does not compile; the message holds the compiler's output.
        """
        import pyopencl as cl

        folders = [word for folder in include for word in ("-I", str(folder))]
        with warnings.catch_warnings():
            # Intel's compiler prints a log on success too, which pyopencl reports as a warning.
            warnings.simplefilter("ignore")
            try:
                program: cl.Program = cl.Program(self.context, source).build(
                    [*self.build_options, *options, *folders]
                )
            except cl.Error as error:
                raise DeviceError(f"{self.name}: build failed: {error}") from None
        return program

    @property
    def correctly_rounded(self) -> bool:
        """Whether the device promises correctly rounded float division and square root."""
        return CORRECT_ROUNDING in self.build_options


@dataclass(frozen=True)
class Probe:
    """What probing one device said. reason: one line, "" where it works."""

    name: str
    version: str
    kind: str
    works: bool
    reason: str


def open_device(name: str | None = None) -> Device:
    """The first working device, in the order stated above.

    Args:
        name: words that the device's name or version contains, in any case ("intel", "PoCL 3.1");
            None takes `CACHESIM_DEVICE`, or where that is unset any device.

    Raises:
        NoDeviceError: no device, or none of that name, works.
        InputError: no device has that name.
    """
    wanted = name or os.environ.get(DEVICE_VARIABLE) or None
    tried: list[Probe] = []
    for candidate in _candidates(wanted, "--device" if name else DEVICE_VARIABLE):
        result = _probe(candidate)
        if isinstance(result, Device):
            return result
        tried.append(result)
    raise NoDeviceError(_no_device_message(tried, wanted))


def all_devices() -> list[Device]:
    """Every working device, in order; empty where there is none."""
    results = [_probe(candidate) for candidate in _candidates(None)]
    return [result for result in results if isinstance(result, Device)]


def device_names() -> list[str]:
    """The names of the devices that the drivers list, in order, unprobed."""
    return [_describe(candidate)[0] for candidate in _candidates(None)]


def probe_device(index: int) -> Probe:
    """The verdict on device `index` of `device_names`."""
    result = _probe(_candidates(None)[index])
    if isinstance(result, Probe):
        return result
    return Probe(result.name, result.version, result.kind, True, "")


def is_named(wanted: str, name: str, version: str) -> bool:
    """Whether each word of `wanted` stands in the device's name or version, in any case."""
    return all(word in f"{name} {version}".lower() for word in wanted.lower().split())


def _no_device_message(tried: Sequence[Probe], wanted: str | None) -> str:
    """What was tried, why each failed and what to do, one line each."""
    lines = [f"no OpenCL device{f' named {wanted!r}' if wanted else ''} works on this machine"]
    lines += [f"  tried {probe.name}: {probe.reason}" for probe in tried]
    lines += ["  tried nothing: the OpenCL loader lists no device"] * (not tried)
    return "\n".join([*lines, "  to install one without root, run: cachesim doctor --install"])


def _candidates(wanted: str | None, source: str = "") -> list[cl.Device]:
    """The devices to try, in order."""
    devices = sorted(_listed_devices(), key=_rank)
    if wanted is None:
        return devices
    chosen = [device for device in devices if is_named(wanted, *_describe(device)[:2])]
    if devices and not chosen:
        raise unknown("OpenCL device", wanted, [_describe(d)[0] for d in devices], source)
    return chosen


@functools.cache
def _listed_devices() -> tuple[cl.Device, ...]:
    """Every device of every platform, once."""
    use_all_drivers()
    import pyopencl as cl

    devices: dict[int, cl.Device] = {}
    with noise_kept(), contextlib.suppress(cl.Error):
        for platform in cl.get_platforms():
            with contextlib.suppress(cl.Error):
                devices |= {device.int_ptr: device for device in platform.get_devices()}
    return tuple(devices.values())


def _describe(device: cl.Device) -> tuple[str, str, str]:
    """(name, version, kind) of a device, as in `Device`."""
    import pyopencl as cl

    pocl = _pocl_version(device)
    platform = f"PoCL {pocl}" if pocl else device.platform.name.strip()
    version = f"{device.version.strip()}, driver {device.driver_version.strip()}"
    is_cpu, is_gpu = device.type & cl.device_type.CPU, device.type & cl.device_type.GPU
    return (
        f"{platform}: {device.name.strip()}",
        version,
        "cpu" if is_cpu else "gpu" if is_gpu else "other",
    )


def _pocl_version(device: cl.Device) -> str:
    """For example "3.1+debian"; "" if the platform is not PoCL."""
    match = re.search(r"PoCL (\S+)", device.platform.version, re.IGNORECASE)
    return match[1] if match else ""


def _rank(device: cl.Device) -> tuple[int, list[int]]:
    """Sort key: GPU, PoCL (newest first), other CPUs, the rest."""
    kind = _describe(device)[2]
    pocl = _pocl_version(device)
    if kind == "cpu" and pocl:
        return 1, [-int(number) for number in re.findall(r"\d+", pocl)[:2]]
    return {"gpu": 0, "cpu": 2}.get(kind, 3), []


@functools.cache
def _probe(device: cl.Device) -> Device | Probe:
    """Build and run the probe kernel: the opened device, or why it does not work."""
    import pyopencl as cl

    name, version, kind = _describe(device)
    noise: list[str] = []
    try:
        with noise_kept(noise):
            rounds = device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
            options = (CORRECT_ROUNDING,) if rounds else ()
            context = cl.Context([device])
            opened = Device(name, version, kind, context, cl.CommandQueue(context), options)
            _run_probe(opened)
    # A broken driver may fail in any way, and the next candidate is to be tried whatever it was.
    except Exception as error:
        reason = short_reason("\n".join(noise), str(error) or type(error).__name__)
        return Probe(name, version, kind, False, reason)
    return opened


def _run_probe(device: Device) -> None:
    """Run the probe on two work-groups and compare with NumPy.

    Raises:
        DeviceError: it does not build or gives wrong results.
    """
    import pyopencl as cl

    value = np.arange(128, dtype=np.float32)
    out, bits = np.empty(128, np.float32), np.empty(128, np.uint32)
    kernel = device.build(_PROBE_SOURCE).probe
    flags = cl.mem_flags
    source = cl.Buffer(device.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=value)
    targets = [cl.Buffer(device.context, flags.WRITE_ONLY, array.nbytes) for array in (out, bits)]
    kernel(device.queue, (16, 8), (8, 8), source, *targets)
    for array, buffer in zip((out, bits), targets, strict=True):
        cl.enqueue_copy(device.queue, array, buffer)
    i = np.arange(128, dtype=np.uint32)
    mirrored = value.reshape(2, 64)[:, ::-1].reshape(-1)
    expected = np.sqrt(mirrored) / np.float32(3) + value * value
    expected_bits = (i * np.uint32(747796405) + np.uint32(2891336453)) >> (i & np.uint32(31))
    # Division may be off by 2.5 ulp where the device does not promise better; integers may not.
    if not (np.array_equal(bits, expected_bits) and np.allclose(out, expected, rtol=1e-6)):
        raise DeviceError("the probe kernel gives wrong results")
