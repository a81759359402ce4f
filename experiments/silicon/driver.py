"""The CUDA driver by ctypes: memory, arrays, textures, modules, launches and events.

Only what every driver since CUDA 11 offers under the names used here; nothing changes the card's
settings. Everything that is taken lives until the process ends: measurements run in processes of
their own.
"""

from __future__ import annotations

import ctypes
import os
import statistics
from collections.abc import Callable, Sequence
from ctypes import byref, c_int, c_size_t, c_uint, c_uint64, c_void_p
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.silicon import structs
from traces.errors import WorkError

#: Names of the driver's library; the variable names another one.
LIBRARIES = ("libcuda.so.1", "libcuda.so", "nvcuda.dll")
LIBRARY_VARIABLE = "CACHESIM_CUDA_DRIVER"


class DriverError(WorkError):
    """A call of the driver failed, or there is no driver."""


def load_library() -> ctypes.CDLL:
    """The driver's library.

    Raises:
        DriverError: none can be loaded; the message says what was tried.
    """
    named = os.environ.get(LIBRARY_VARIABLE)
    names = (named,) if named else LIBRARIES
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise DriverError(f"no NVIDIA driver: none of {', '.join(names)} can be loaded")


@dataclass(frozen=True)
class Array:
    """A two-dimensional array or one level of a mip-mapped one; handle: CUarray."""

    handle: int
    width: int
    height: int
    component: str
    num_channels: int

    @property
    def row_bytes(self) -> int:
        return self.width * self.num_channels * structs.COMPONENT_BYTES[self.component]


@dataclass(frozen=True)
class MipmappedArray:
    """handle: CUmipmappedArray. levels: from the largest down."""

    handle: int
    levels: tuple[Array, ...]


@dataclass(frozen=True)
class Memory:
    """Plain device memory."""

    address: int
    size_bytes: int


class Module:
    """Kernels that were loaded from PTX."""

    def __init__(self, gpu: Gpu, ptx: str) -> None:
        self._gpu = gpu
        self._functions: dict[str, c_void_p] = {}
        self._handle = c_void_p()
        log = ctypes.create_string_buffer(8192)
        # CU_JIT_ERROR_LOG_BUFFER and its size.
        options = (c_int * 2)(5, 6)
        values = (c_void_p * 2)(ctypes.addressof(log), len(log))
        code = gpu.call_unchecked(
            "cuModuleLoadDataEx", byref(self._handle), ptx.encode() + b"\0", 2, options, values
        )
        if code:
            told = " ".join(log.value.decode(errors="replace").split())
            raise DriverError(f"the driver does not take the PTX: {gpu.describe(code)} {told}")

    def function(self, name: str) -> c_void_p:
        """A kernel, asked to leave the L1 as large as it gets."""
        if name not in self._functions:
            found = c_void_p()
            self._gpu.call("cuModuleGetFunction", byref(found), self._handle, name.encode())
            # A wish that some GPUs do not know; the measurement shows what came of it.
            self._gpu.call_unchecked(
                "cuFuncSetAttribute", found, structs.PREFERRED_SHARED_MEMORY_CARVEOUT, 0
            )
            self._functions[name] = found
        return self._functions[name]

    def write_constant(self, name: str, value: ctypes.Structure) -> None:
        """Fill a variable in constant memory."""
        address, size = c_uint64(), c_size_t()
        self._gpu.call(
            "cuModuleGetGlobal_v2", byref(address), byref(size), self._handle, name.encode()
        )
        if size.value != ctypes.sizeof(value):
            raise DriverError(
                f"{name}: {size.value} bytes on the GPU, {ctypes.sizeof(value)} bytes here"
            )
        self._gpu.call("cuMemcpyHtoD_v2", address, byref(value), size)


class Driver:
    """The driver, and the first GPU that it sees (CUDA_VISIBLE_DEVICES says which that is).

    Raises:
        DriverError: there is no driver, no GPU, or the driver refuses.
    """

    def __init__(self) -> None:
        self._library = load_library()
        self.call("cuInit", c_uint(0))
        count = c_int()
        self.call("cuDeviceGetCount", byref(count))
        if not count.value:
            raise DriverError("the NVIDIA driver sees no GPU")
        self._device = c_int()
        self.call("cuDeviceGet", byref(self._device), 0)

    def call_unchecked(self, name: str, *arguments: Any) -> int:
        """Call the driver; its result code. Plain ints are C ints."""
        try:
            function = getattr(self._library, name)
        except AttributeError as error:
            raise DriverError(f"this driver has no {name}: it is older than CUDA 11") from error
        return int(function(*arguments))

    def call(self, name: str, *arguments: Any) -> None:
        """The same; anything but success is a `DriverError`."""
        code = self.call_unchecked(name, *arguments)
        if code:
            raise DriverError(f"{name}: {self.describe(code)}")

    def describe(self, code: int) -> str:
        """The driver's own name of a result code."""
        text = ctypes.c_char_p()
        known = self._library.cuGetErrorName(code, byref(text)) == 0 and text.value
        return f"{text.value.decode()} ({code})" if known and text.value else f"error {code}"

    @property
    def name(self) -> str:
        text = ctypes.create_string_buffer(256)
        self.call("cuDeviceGetName", text, len(text), self._device)
        return text.value.decode(errors="replace")

    @property
    def driver_version(self) -> str:
        """The newest CUDA that the driver runs, as "13.0"."""
        version = c_int()
        self.call("cuDriverGetVersion", byref(version))
        return f"{version.value // 1000}.{version.value % 1000 // 10}"

    def attributes(self) -> dict[str, int]:
        """Every attribute of `structs.ATTRIBUTES` that the driver knows."""
        found = {}
        for name, number in structs.ATTRIBUTES.items():
            value = c_int()
            if not self.call_unchecked("cuDeviceGetAttribute", byref(value), number, self._device):
                found[name] = value.value
        return found


class Gpu(Driver):
    """The GPU with its primary context current on this thread.

    Raises:
        DriverError: as `Driver`.
    """

    def __init__(self) -> None:
        super().__init__()
        context = c_void_p()
        self.call("cuDevicePrimaryCtxRetain", byref(context), self._device)
        self.call("cuCtxSetCurrent", context)

    def memory_bytes(self) -> tuple[int, int]:
        """(free, total) bytes of device memory."""
        free, total = c_size_t(), c_size_t()
        self.call("cuMemGetInfo_v2", byref(free), byref(total))
        return free.value, total.value

    def allocate(self, size_bytes: int) -> Memory:
        """Uninitialised device memory."""
        address = c_uint64()
        self.call("cuMemAlloc_v2", byref(address), c_size_t(size_bytes))
        return Memory(address.value, size_bytes)

    def free(self, memory: Memory) -> None:
        self.call("cuMemFree_v2", c_uint64(memory.address))

    def upload(self, array: npt.NDArray[Any]) -> Memory:
        """Device memory that holds the array."""
        array = np.ascontiguousarray(array)
        memory = self.allocate(max(array.nbytes, 16))
        self.write(memory, array)
        return memory

    def write(self, memory: Memory, array: npt.NDArray[Any]) -> None:
        array = np.ascontiguousarray(array)
        assert array.nbytes <= memory.size_bytes
        self.call(
            "cuMemcpyHtoD_v2",
            c_uint64(memory.address),
            c_void_p(array.ctypes.data),
            c_size_t(array.nbytes),
        )

    def read(self, memory: Memory, dtype: Any, count: int) -> npt.NDArray[Any]:
        """The first `count` elements; waits for the work before."""
        array = np.empty(count, dtype)
        assert array.nbytes <= memory.size_bytes
        self.call(
            "cuMemcpyDtoH_v2",
            c_void_p(array.ctypes.data),
            c_uint64(memory.address),
            c_size_t(array.nbytes),
        )
        return array

    def clear(self, memory: Memory) -> None:
        self.call(
            "cuMemsetD8_v2",
            c_uint64(memory.address),
            ctypes.c_ubyte(0),
            c_size_t(memory.size_bytes),
        )

    def make_array(self, width: int, height: int, component: str, num_channels: int) -> Array:
        """An array that textures read and surfaces write."""
        handle = c_void_p()
        self.call(
            "cuArray3DCreate_v2",
            byref(handle),
            byref(_array_descriptor(width, height, component, num_channels)),
        )
        return Array(handle.value or 0, width, height, component, num_channels)

    def make_mipmapped(
        self, width: int, height: int, component: str, num_channels: int, num_levels: int
    ) -> MipmappedArray:
        """A mip-mapped array; each side of a level is half the one before, rounded down."""
        handle = c_void_p()
        self.call(
            "cuMipmappedArrayCreate",
            byref(handle),
            byref(_array_descriptor(width, height, component, num_channels)),
            c_uint(num_levels),
        )
        levels = []
        for level in range(num_levels):
            array = c_void_p()
            self.call("cuMipmappedArrayGetLevel", byref(array), handle, c_uint(level))
            sides = max(1, width >> level), max(1, height >> level)
            levels.append(Array(array.value or 0, *sides, component, num_channels))
        return MipmappedArray(handle.value or 0, tuple(levels))

    def write_array(self, array: Array, texels: npt.NDArray[Any]) -> None:
        """Fill an array. texels: (height, width, …) of as many bytes as a texel has."""
        texels = np.ascontiguousarray(texels)
        assert texels.shape[0] == array.height
        assert texels.nbytes == array.row_bytes * array.height
        copy = structs.Copy2D(
            source_type=structs.MEMORY_HOST,
            source_host=texels.ctypes.data,
            source_pitch=array.row_bytes,
            target_type=structs.MEMORY_ARRAY,
            target_array=array.handle,
            width_bytes=array.row_bytes,
            height=array.height,
        )
        self.call("cuMemcpy2D_v2", byref(copy))

    def read_array(self, array: Array, dtype: Any) -> npt.NDArray[Any]:
        """(height, elements of a row) of an array; waits for the work before."""
        self.synchronise()
        texels = np.empty((array.height, array.row_bytes // np.dtype(dtype).itemsize), dtype)
        copy = structs.Copy2D(
            source_type=structs.MEMORY_ARRAY,
            source_array=array.handle,
            target_type=structs.MEMORY_HOST,
            target_host=texels.ctypes.data,
            target_pitch=array.row_bytes,
            width_bytes=array.row_bytes,
            height=array.height,
        )
        self.call("cuMemcpy2D_v2", byref(copy))
        return texels

    def texture(
        self,
        resource: Array | MipmappedArray,
        *,
        filtered: str = "point",
        normalised: bool = False,
        as_integer: bool = False,
    ) -> int:
        """A texture object, clamped at its border.

        filtered: "point", "bilinear", or "trilinear" of a mip-mapped array. normalised: coordinates
            are shares of the sides, as a mip-mapped array needs. as_integer: integer components
            stay integers.
        """
        mipmapped = isinstance(resource, MipmappedArray)
        described = structs.ResourceDescriptor(
            type=structs.RESOURCE_MIPMAPPED if mipmapped else structs.RESOURCE_ARRAY
        )
        described.resource.handle = resource.handle
        sampled = structs.TextureDescriptor(
            filter_mode=structs.FILTER_POINT if filtered == "point" else structs.FILTER_LINEAR,
            flags=(structs.NORMALISED_COORDINATES if normalised else 0)
            | (structs.READ_AS_INTEGER if as_integer else 0),
            mipmap_filter_mode=(
                structs.FILTER_LINEAR if filtered == "trilinear" else structs.FILTER_POINT
            ),
        )
        if isinstance(resource, MipmappedArray):
            sampled.max_mipmap_level_clamp = float(len(resource.levels) - 1)
        return self._texture(described, sampled)

    def linear_texture(self, memory: Memory, num_texels: int) -> int:
        """A texture of 32-bit integers over plain memory, fetched by texel number."""
        described = structs.ResourceDescriptor(type=structs.RESOURCE_LINEAR)
        described.resource.linear = structs.LinearResource(
            memory.address, structs.COMPONENTS["u32"], 1, num_texels * 4
        )
        sampled = structs.TextureDescriptor(flags=structs.READ_AS_INTEGER)
        return self._texture(described, sampled)

    def _texture(
        self, described: structs.ResourceDescriptor, sampled: structs.TextureDescriptor
    ) -> int:
        for axis in range(3):
            sampled.address_mode[axis] = structs.ADDRESS_CLAMP
        handle = c_uint64()
        self.call("cuTexObjectCreate", byref(handle), byref(described), byref(sampled), None)
        return handle.value

    def surface(self, array: Array) -> int:
        """A surface object that stores texels of an array."""
        described = structs.ResourceDescriptor(type=structs.RESOURCE_ARRAY)
        described.resource.handle = array.handle
        handle = c_uint64()
        self.call("cuSurfObjectCreate", byref(handle), byref(described))
        return handle.value

    def launch(
        self, function: c_void_p, num_ctas: int, threads_per_cta: int, *arguments: Any
    ) -> None:
        """Enqueue a kernel on the default stream. arguments: ctypes values or structures."""
        values = (c_void_p * max(1, len(arguments)))(*(ctypes.addressof(a) for a in arguments))
        grid = (
            c_uint(num_ctas),
            c_uint(1),
            c_uint(1),
            c_uint(threads_per_cta),
            c_uint(1),
            c_uint(1),
        )
        self.call("cuLaunchKernel", function, *grid, c_uint(0), None, values, None)

    def synchronise(self) -> None:
        self.call("cuCtxSynchronize")

    def time_ms(self, work: Callable[[], None]) -> float:
        """Milliseconds between two events around what `work` enqueues."""
        events = (c_void_p(), c_void_p())
        for event in events:
            self.call("cuEventCreate", byref(event), c_uint(0))
        self.call("cuEventRecord", events[0], None)
        work()
        self.call("cuEventRecord", events[1], None)
        self.call("cuEventSynchronize", events[1])
        elapsed = ctypes.c_float()
        self.call("cuEventElapsedTime", byref(elapsed), *events)
        for event in events:
            self.call("cuEventDestroy_v2", event)
        return float(elapsed.value)

    def median_ms(
        self, work: Callable[[], None], repeats: int, before: Callable[[], None] | None = None
    ) -> tuple[float, Sequence[float]]:
        """(median, all) of `repeats` times; `before` is run ahead of each and not timed."""
        times = []
        for _ in range(repeats):
            if before is not None:
                before()
                self.synchronise()
            times.append(self.time_ms(work))
        return statistics.median(times), times


def _array_descriptor(
    width: int, height: int, component: str, num_channels: int
) -> structs.ArrayDescriptor:
    return structs.ArrayDescriptor(
        width,
        height,
        0,
        structs.COMPONENTS[component],
        num_channels,
        structs.ARRAY_SURFACE_LOAD_STORE,
    )
