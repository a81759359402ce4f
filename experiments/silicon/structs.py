"""The driver API's structures and constants that we use, as `cuda.h` lays them out."""

from __future__ import annotations

import ctypes
from ctypes import c_float, c_int, c_size_t, c_uint, c_uint64, c_void_p

#: CUarray_format by our name of the component.
COMPONENTS = {"u8": 0x01, "u16": 0x02, "u32": 0x03, "half": 0x10, "float": 0x20}
COMPONENT_BYTES = {"u8": 1, "u16": 2, "u32": 4, "half": 2, "float": 4}

ARRAY_SURFACE_LOAD_STORE = 0x02
RESOURCE_ARRAY, RESOURCE_MIPMAPPED, RESOURCE_LINEAR = 0, 1, 2
ADDRESS_CLAMP = 1
FILTER_POINT, FILTER_LINEAR = 0, 1
READ_AS_INTEGER, NORMALISED_COORDINATES = 0x01, 0x02
MEMORY_HOST, MEMORY_ARRAY = 1, 3
#: CUfunction_attribute: the share of the SM's memory that is kept for shared memory, in percent.
PREFERRED_SHARED_MEMORY_CARVEOUT = 9

#: CUdevice_attribute by our name.
ATTRIBUTES = {
    "max_threads_per_block": 1,
    "max_shared_memory_per_block_bytes": 8,
    "total_constant_memory_bytes": 9,
    "warp_size": 10,
    "max_registers_per_block": 12,
    "clock_rate_khz": 13,
    "num_sms": 16,
    "memory_clock_rate_khz": 36,
    "memory_bus_width_bits": 37,
    "l2_cache_bytes": 38,
    "max_threads_per_sm": 39,
    "compute_capability_major": 75,
    "compute_capability_minor": 76,
    "global_l1_cache_supported": 79,
    "max_shared_memory_per_sm_bytes": 81,
    "max_registers_per_sm": 82,
    "max_shared_memory_per_block_optin_bytes": 97,
    "max_blocks_per_sm": 106,
    "max_persisting_l2_cache_bytes": 108,
    "reserved_shared_memory_per_block_bytes": 111,
}


class ArrayDescriptor(ctypes.Structure):
    """CUDA_ARRAY3D_DESCRIPTOR."""

    _fields_ = (
        ("width", c_size_t),
        ("height", c_size_t),
        ("depth", c_size_t),
        ("format", c_int),
        ("num_channels", c_uint),
        ("flags", c_uint),
    )


class LinearResource(ctypes.Structure):
    """The part of CUDA_RESOURCE_DESC that describes plain memory."""

    _fields_ = (
        ("pointer", c_uint64),
        ("format", c_int),
        ("num_channels", c_uint),
        ("size_bytes", c_size_t),
    )


class ResourceUnion(ctypes.Union):
    """The union inside CUDA_RESOURCE_DESC: an array's or mip-mapped array's handle, or memory."""

    _fields_ = (("handle", c_void_p), ("linear", LinearResource), ("reserved", c_int * 32))


class ResourceDescriptor(ctypes.Structure):
    """CUDA_RESOURCE_DESC."""

    _fields_ = (("type", c_int), ("resource", ResourceUnion), ("flags", c_uint))


class TextureDescriptor(ctypes.Structure):
    """CUDA_TEXTURE_DESC."""

    _fields_ = (
        ("address_mode", c_int * 3),
        ("filter_mode", c_int),
        ("flags", c_uint),
        ("max_anisotropy", c_uint),
        ("mipmap_filter_mode", c_int),
        ("mipmap_level_bias", c_float),
        ("min_mipmap_level_clamp", c_float),
        ("max_mipmap_level_clamp", c_float),
        ("border_colour", c_float * 4),
        ("reserved", c_int * 12),
    )


class Copy2D(ctypes.Structure):
    """CUDA_MEMCPY2D_v2."""

    _fields_ = (
        ("source_x_bytes", c_size_t),
        ("source_y", c_size_t),
        ("source_type", c_int),
        ("source_host", c_void_p),
        ("source_device", c_uint64),
        ("source_array", c_void_p),
        ("source_pitch", c_size_t),
        ("target_x_bytes", c_size_t),
        ("target_y", c_size_t),
        ("target_type", c_int),
        ("target_host", c_void_p),
        ("target_device", c_uint64),
        ("target_array", c_void_p),
        ("target_pitch", c_size_t),
        ("width_bytes", c_size_t),
        ("height", c_size_t),
    )
