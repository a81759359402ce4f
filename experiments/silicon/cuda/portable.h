// What the kernels need of CUDA, gathered here so that the same sources also run on a processor: the
// tests compile them with SILICON_ON_HOST and a header of their own that offers these names.
#pragma once

#ifdef SILICON_ON_HOST
#include "host_cuda.h"
#else

typedef unsigned int u32;
typedef unsigned long long u64;
typedef unsigned short u16;

#define KERNEL extern "C" __global__ void
#define CONSTANT __constant__
#define DEVICE static __device__ __forceinline__
#define DEVICE_METHOD __device__ __forceinline__

// Cycles of this SM's clock.
DEVICE u64 read_clock()
{
    u64 cycles;
    asm volatile("mov.u64 %0, %%clock64;" : "=l"(cycles)::"memory");
    return cycles;
}

// The same, once `value` has arrived: whether the clock is read at all depends on it.
DEVICE u64 read_clock_after(u64 value)
{
    u64 cycles;
    asm volatile("{\n\t"
                 ".reg .pred arrived;\n\t"
                 "setp.ne.u64 arrived, %1, 0xffffffffffffffff;\n\t"
                 ".reg .u64 now;\n\t"
                 "mov.u64 now, 0;\n\t"
                 "@arrived mov.u64 now, %%clock64;\n\t"
                 "mov.u64 %0, now;\n\t"
                 "}"
                 : "=l"(cycles)
                 : "l"(value)
                 : "memory");
    return cycles;
}

// Nanoseconds of the timer that all SMs share.
DEVICE u64 read_timer()
{
    u64 ns;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(ns)::"memory");
    return ns;
}

DEVICE u32 read_sm()
{
    u32 sm;
    asm volatile("mov.u32 %0, %%smid;" : "=r"(sm));
    return sm;
}

DEVICE float half_to_float(u16 bits)
{
    float value;
    asm("cvt.f32.f16 %0, %1;" : "=f"(value) : "h"(bits));
    return value;
}

// To nearest, ties to even.
DEVICE u16 float_to_half(float value)
{
    u16 bits;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(bits) : "f"(value));
    return bits;
}

// A load that goes to the L2, past the L1.
DEVICE u64 load_past_l1(const u64 *at)
{
    u64 value;
    asm volatile("ld.global.cg.u64 %0, [%1];" : "=l"(value) : "l"(at) : "memory");
    return value;
}

DEVICE uint4 load4_past_l1(const uint4 *at)
{
    uint4 value;
    asm volatile("ld.global.cg.v4.u32 {%0, %1, %2, %3}, [%4];"
                 : "=r"(value.x), "=r"(value.y), "=r"(value.z), "=r"(value.w)
                 : "l"(at)
                 : "memory");
    return value;
}

// A plain load, cached in the L1 where the GPU caches those.
DEVICE u64 load_through_l1(const u64 *at)
{
    u64 value;
    asm volatile("ld.global.u64 %0, [%1];" : "=l"(value) : "l"(at) : "memory");
    return value;
}

DEVICE uint4 load4_through_l1(const uint4 *at)
{
    uint4 value;
    asm volatile("ld.global.v4.u32 {%0, %1, %2, %3}, [%4];"
                 : "=r"(value.x), "=r"(value.y), "=r"(value.z), "=r"(value.w)
                 : "l"(at)
                 : "memory");
    return value;
}

// Plain loads and stores of global memory, which the GPU caches as it does by default.
DEVICE u32 load_byte(u64 at)
{
    u32 value;
    asm("ld.global.u8 %0, [%1];" : "=r"(value) : "l"(at));
    return value;
}

DEVICE u32 load_word(u64 at)
{
    u32 value;
    asm("ld.global.u32 %0, [%1];" : "=r"(value) : "l"(at));
    return value;
}

DEVICE ushort4 load_halves(u64 at)
{
    ushort4 value;
    asm("ld.global.v4.u16 {%0, %1, %2, %3}, [%4];"
        : "=h"(value.x), "=h"(value.y), "=h"(value.z), "=h"(value.w)
        : "l"(at));
    return value;
}

DEVICE void store_byte_at(u64 at, u32 value)
{
    asm volatile("st.global.u8 [%0], %1;" ::"l"(at), "r"(value) : "memory");
}

DEVICE void store_halves(u64 at, ushort4 value)
{
    asm volatile("st.global.v4.u16 [%0], {%1, %2, %3, %4};" ::"l"(at), "h"(value.x), "h"(value.y), "h"(value.z),
                 "h"(value.w)
                 : "memory");
}

// A load that is told its memory does not change.
DEVICE u64 load_read_only(const u64 *at)
{
    u64 value;
    asm volatile("ld.global.nc.u64 %0, [%1];" : "=l"(value) : "l"(at) : "memory");
    return value;
}
#endif
