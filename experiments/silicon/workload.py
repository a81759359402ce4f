"""The workload on the GPU: textures or plain memory filled from a picture's inputs, the passes
launched in order, and what they made read back.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from ctypes import c_float, c_int, c_uint, c_uint64
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.silicon import build
from experiments.silicon.cases import OTHER, Case, kernel_of, passes_of
from experiments.silicon.driver import Array, Gpu, Memory, MipmappedArray, Module
from experiments.silicon.inputs import Picture

MAX_LEVELS = 6
THREADS_PER_CTA = 64
#: Rows in plain memory start at multiples of this, as in the model's row-major layout.
PITCH_ALIGNMENT = 256

#: (component, channels) of each texture; the counts are a texel of four half floats, as the history
#: in whose place they stand.
TEXTURES: dict[str, tuple[str, int]] = {
    "scene_light": ("half", 4),
    "depth": ("float", 1),
    "gbuffer_id": ("u8", 1),
    "normal": ("u32", 1),
    "velocity": ("half", 2),
    "profile_id": ("u8", 1),
    "old_history": ("half", 4),
    "history": ("half", 4),
    "counts": ("half", 4),
    "scattered": ("half", 4),
    "resolved": ("half", 4),
    "albedo": ("half", 4),
    "scene_colour": ("half", 4),
    "output": ("half", 4),
}
_BYTES = {"half": 2, "float": 4, "u8": 1, "u32": 4}
#: The textures of each pass in the order of its kernel's arguments; the setup texture stands in
#: constant memory.
ARGUMENTS = {
    "setup": ("scene_light", "depth", "gbuffer_id", "profile_id"),
    "sampling": ("normal", "profile_id", "velocity", "counts", "scattered"),
    "update": ("scattered", "velocity", "depth", "old_history", "resolved", "history"),
    "combine": ("scene_colour", "profile_id", "scattered", "albedo", "output"),
}


class Image(ctypes.Structure):
    """Image of passes.h."""

    _fields_ = (("fetch", c_uint64), ("store", c_uint64))


class Levels(ctypes.Structure):
    """Levels of passes.h."""

    _fields_ = (
        ("fetch", c_uint64),
        ("filtered", c_uint64),
        ("level", c_uint64 * MAX_LEVELS),
        ("pitch", c_uint64 * MAX_LEVELS),
    )


class Constants(ctypes.Structure):
    """Constants of passes.h."""

    _fields_ = (
        ("width", c_int),
        ("height", c_int),
        ("num_levels", c_int),
        ("fixed_count", c_int),
        ("frame", c_uint),
        ("texels_per_mm_at_cm", c_float),
        ("d", c_float),
        ("mip_scale", c_float),
        ("alpha", c_float),
        ("sigma0_sq", c_float),
        ("rate", c_float * 4),
        ("density", c_float * 4),
        ("ratio", c_float * (2 * MAX_LEVELS)),
        ("texel", c_float * (2 * MAX_LEVELS)),
    )

    @staticmethod
    def of(picture: Picture, counts: str) -> Constants:
        """The constants of one method of a picture."""
        told = picture.constants[counts]
        made = Constants(width=picture.width, height=picture.height)
        for name in ("num_levels", "fixed_count", "frame"):
            setattr(made, name, told[name])
        for name in ("texels_per_mm_at_cm", "d", "mip_scale", "alpha", "sigma0_sq"):
            setattr(made, name, told[name])
        for name in ("rate", "density", "ratio"):
            for k, value in enumerate(told[name]):
                getattr(made, name)[k] = value
        for level in range(told["num_levels"]):
            made.texel[2 * level] = 1.0 / (picture.width >> level)
            made.texel[2 * level + 1] = 1.0 / (picture.height >> level)
        return made


@dataclass(frozen=True)
class Launch:
    """One launch. measured: whether it is one of the workload's; others only prepare."""

    case: Case
    run: Callable[[], None]
    measured: bool


class Workload:
    """A picture's textures on the GPU, for one way to fetch and one kind of counts.

    fetch: "texture" or "load". module: of passes.ptx, kernels unprefixed.
    """

    def __init__(self, gpu: Gpu, picture: Picture, counts: str, fetch: str, ptx: str) -> None:
        self._gpu, self._picture, self._ptx = gpu, picture, ptx
        self.counts, self.fetch = counts, fetch
        self.constants = Constants.of(picture, counts)
        self.num_levels = int(self.constants.num_levels)
        self._arrays: dict[str, Array] = {}
        self._memories: dict[str, Memory] = {}
        self._images: dict[str, Image] = {}
        for name in TEXTURES:
            self._make(name)
        self._chain, self._level_memory, self._levels = self._make_levels()

    @property
    def _size(self) -> tuple[int, int]:
        return self._picture.width, self._picture.height

    def _content(self, name: str) -> npt.NDArray[Any] | None:
        """(h, w, …) texels of an input."""
        if name == "counts":
            texels = np.zeros((self._picture.height, self._picture.width, 4), np.float16)
            texels[..., 0] = self._picture.arrays["counts"]
            return texels.view(np.uint16)
        if name == "velocity":
            return np.zeros((self._picture.height, self._picture.width, 2), np.uint16)
        return self._picture.arrays.get(name)

    def _make(self, name: str) -> None:
        component, channels = TEXTURES[name]
        content = self._content(name)
        if self.fetch == "texture":
            array = self._gpu.make_array(*self._size, component, channels)
            if content is not None:
                self._gpu.write_array(array, content)
            integer = component in ("u8", "u32")
            fetched = self._gpu.texture(array, as_integer=integer)
            self._arrays[name] = array
            self._images[name] = Image(fetched, self._gpu.surface(array))
            return
        texel_bytes = channels * _BYTES[component]
        memory = self._gpu.allocate(self._pitch(self._picture.width, texel_bytes) * self._size[1])
        if content is not None:
            self._gpu.write(memory, self._padded(content, texel_bytes))
        self._memories[name] = memory
        pitch = self._pitch(self._picture.width, texel_bytes)
        self._images[name] = Image(memory.address, pitch)

    @staticmethod
    def _pitch(width: int, texel_bytes: int) -> int:
        return -(-width * texel_bytes // PITCH_ALIGNMENT) * PITCH_ALIGNMENT

    def _padded(self, content: npt.NDArray[Any], texel_bytes: int) -> npt.NDArray[np.uint8]:
        """Rows of bytes as long as the pitch."""
        height, width = content.shape[:2]
        rows = np.zeros((height, self._pitch(width, texel_bytes)), np.uint8)
        flat = np.ascontiguousarray(content).reshape(height, -1).view(np.uint8)
        rows[:, : width * texel_bytes] = flat
        return rows

    def _make_levels(self) -> tuple[MipmappedArray | None, list[Memory], Levels]:
        levels, memories = Levels(), []
        if self.fetch == "texture":
            chain = self._gpu.make_mipmapped(*self._size, "half", 4, self.num_levels)
            levels.fetch = self._gpu.texture(chain, normalised=True)
            levels.filtered = self._gpu.texture(chain, filtered="bilinear", normalised=True)
            for level, array in enumerate(chain.levels):
                levels.level[level] = self._gpu.surface(array)
            return chain, [], levels
        for level in range(self.num_levels):
            width, height = self._picture.width >> level, self._picture.height >> level
            pitch = self._pitch(width, 8)
            memories.append(self._gpu.allocate(pitch * height))
            levels.level[level], levels.pitch[level] = memories[-1].address, pitch
        return None, memories, levels

    def _module(self, ptx: str) -> Module:
        module = Module(self._gpu, ptx)
        module.write_constant("setup_levels", self._levels)
        return module

    def launches(self) -> Iterator[Launch]:
        """The frame's launches in order. Each measured kernel is loaded under its case's name."""
        picture = self._picture
        measured = set(passes_of(self.counts, self.fetch, self.num_levels))
        other = self._module(build.prefix_kernels(self._ptx, OTHER))
        order = [("setup", 0)]
        order += [("prefilter", level) for level in range(self.num_levels - 1)]
        order += [("exact", level) for level in range(self.num_levels - 1)]
        order += [("sampling", 0)]
        order += [("update", 0)] if self.counts == "adaptive" else []
        order += [("combine", 0)]
        for name, level in order:
            if name == "prefilter" and self.fetch != "texture":
                continue
            case = Case(
                picture.scene, picture.width, picture.height, self.counts, self.fetch, name, level
            )
            is_measured = (name, level) in measured
            module, prefix = other, OTHER
            if is_measured:
                prefix = case.prefix
                module = self._module(build.copy_kernel(self._ptx, kernel_of(case), [prefix]))
            yield Launch(case, self._runner(module, prefix, case), is_measured)

    def _runner(self, module: Module, prefix: str, case: Case) -> Callable[[], None]:
        width, height = self._size
        arguments: list[Any]
        if case.pass_name in ("prefilter", "exact"):
            width, height = width >> (case.level + 1), height >> (case.level + 1)
            arguments = [self.constants, c_int(case.level)]
        else:
            names = list(ARGUMENTS[case.pass_name])
            if case.pass_name == "combine" and self.counts == "adaptive":
                names[names.index("scattered")] = "resolved"
            arguments = [self.constants, *(self._images[name] for name in names)]
        kernel = f"prefilter_exact_{self.fetch}" if case.pass_name == "exact" else kernel_of(case)
        function = module.function(f"{prefix}__{kernel}")
        num_ctas = -(-width // 8) * -(-height // 8)

        def run() -> None:
            self._gpu.launch(function, num_ctas, THREADS_PER_CTA, *arguments)

        return run

    def read(self, name: str) -> npt.NDArray[np.uint16]:
        """(h, w, 4) uint16: the half floats of a texture, or of "setup/LEVEL"."""
        kind, _, level = name.partition("/")
        width, height = self._size
        if kind == "setup":
            width, height = width >> int(level), height >> int(level)
        if self.fetch == "texture":
            array = self._arrays[name] if kind != "setup" else self._level_array(int(level))
            return self._gpu.read_array(array, np.uint16).reshape(height, width, 4)
        memory = self._memories[name] if kind != "setup" else self._level_memory[int(level)]
        pitch = self._pitch(width, 8)
        rows = self._gpu.read(memory, np.uint8, pitch * height).reshape(height, pitch)
        texels = np.ascontiguousarray(rows[:, : width * 8]).view(np.uint16)
        return texels.reshape(height, width, 4)

    def _level_array(self, level: int) -> Array:
        assert self._chain is not None
        return self._chain.levels[level]


class CacheFiller:
    """Fills the L2 with lines that the next kernel does not ask for, as clean as they get."""

    def __init__(self, gpu: Gpu, ptx: str) -> None:
        self._gpu = gpu
        module = Module(gpu, build.prefix_kernels(ptx, OTHER))
        self._function = module.function(f"{OTHER}__fill_caches")
        attributes = gpu.attributes()
        size = 3 * (attributes.get("l2_cache_bytes", 0) or 64 << 20)
        self._memory, self._sink = gpu.allocate(size), gpu.allocate(16)
        self._num_ctas = 8 * attributes.get("num_sms", 1)

    def fill(self) -> None:
        """Write the memory once, then read it."""
        for write in (1, 0):
            self._gpu.launch(
                self._function,
                self._num_ctas,
                256,
                c_uint64(self._memory.address),
                c_uint64(self._memory.size_bytes // 16),
                c_uint(write),
                c_uint64(self._sink.address),
            )
