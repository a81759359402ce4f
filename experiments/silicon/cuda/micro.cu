// The micro-measurements: each kernel answers one question about the machine by its clock, or makes
// requests whose number is known, for the profiler to count.
#include "portable.h"

// Spins for a while: both clocks at its begin and end give the SM's clock rate.
KERNEL clock_rate(u64 ns, u64 *out)
{
    const u64 begin_ns = read_timer(), begin = read_clock();
    u64 now;
    do
        now = read_timer();
    while (now - begin_ns < ns);
    out[0] = begin_ns;
    out[1] = now;
    out[2] = begin;
    out[3] = read_clock();
}

KERNEL nothing() {}

// When its only thread began and ended, by the shared timer.
KERNEL stamp(u64 *out, u32 at)
{
    out[2 * at] = read_timer();
    out[2 * at + 1] = read_timer();
}

// A ring of pointers: `order` lists places in units of stride_bytes, each points to the next.
KERNEL build_ring(u64 base, const u32 *order, u64 count, u64 stride_bytes)
{
    const u64 i = (u64)blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count)
        return;
    const u64 next = i + 1 < count ? i + 1 : 0;
    *(u64 *)(base + order[i] * stride_bytes) = base + order[next] * stride_bytes;
}

#define CHASE(name, LOAD) \
    KERNEL name(u64 start, u32 warm_steps, u32 steps, u64 *out) \
    { \
        u64 at = start; \
        for (u32 i = 0; i < warm_steps; ++i) \
            at = LOAD((const u64 *)at); \
        const u64 begin = read_clock(); \
        _Pragma("unroll 8") for (u32 i = 0; i < steps; ++i) at = LOAD((const u64 *)at); \
        out[0] = read_clock_after(at) - begin; \
        out[1] = at; \
    }

CHASE(chase_load, load_through_l1)
CHASE(chase_readonly, load_read_only)
CHASE(chase_past_l1, load_past_l1)

// Rings of texel numbers. linear: a texture over plain memory, of 4-byte texels. array: a texture on an
// array `width` texels wide; a texel holds y << 16 | x of the next.
KERNEL build_ring_linear(u32 *memory, const u32 *order, u64 count, u32 stride_texels)
{
    const u64 i = (u64)blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count)
        return;
    const u64 next = i + 1 < count ? i + 1 : 0;
    memory[(u64)order[i] * stride_texels] = order[next] * stride_texels;
}

KERNEL chase_linear(u64 texture, u32 start, u32 warm_steps, u32 steps, u64 *out)
{
    u32 at = start;
    for (u32 i = 0; i < warm_steps; ++i)
        at = tex1Dfetch<u32>(texture, (int)at);
    const u64 begin = read_clock();
#pragma unroll 8
    for (u32 i = 0; i < steps; ++i)
        at = tex1Dfetch<u32>(texture, (int)at);
    out[0] = read_clock_after(at) - begin;
    out[1] = at;
}

KERNEL chase_array(u64 texture, u32 start, u32 warm_steps, u32 steps, u64 *out)
{
    u32 at = start;
    for (u32 i = 0; i < warm_steps; ++i)
        at = tex2D<u32>(texture, (float)(at & 0xffffu) + 0.5f, (float)(at >> 16) + 0.5f);
    const u64 begin = read_clock();
#pragma unroll 8
    for (u32 i = 0; i < steps; ++i)
        at = tex2D<u32>(texture, (float)(at & 0xffffu) + 0.5f, (float)(at >> 16) + 0.5f);
    out[0] = read_clock_after(at) - begin;
    out[1] = at;
}

// The latency from one SM to each of `count` lines of the L2; only the CTA on that SM works. Each line
// points to itself.
KERNEL near_far(u64 base, u64 stride_bytes, u32 count, u32 sm, u32 steps, u32 *taken, u64 *out)
{
    if (read_sm() != sm || threadIdx.x != 0 || atomicAdd(taken, 1u) != 0u)
        return;
    for (u32 k = 0; k < count; ++k) {
        u64 at = base + k * stride_bytes;
        for (u32 i = 0; i < 4; ++i)
            at = load_past_l1((const u64 *)at);
        const u64 begin = read_clock();
        for (u32 i = 0; i < steps; ++i)
            at = load_past_l1((const u64 *)at);
        out[2 * k] = read_clock_after(at) - begin;
        out[2 * k + 1] = at;
    }
}

// Each CTA reads its own `count` vectors of 16 B over and over; out: cycles of each CTA.
#define READ_OWN(name, LOAD) \
    KERNEL name(const uint4 *memory, u32 count, u32 rounds, u32 *sink, u64 *out) \
    { \
        const uint4 *own = memory + (u64)blockIdx.x * count; \
        const u32 step = blockDim.x % count; \
        u32 at = threadIdx.x % count; \
        u32 mixed = 0; \
        __syncthreads(); \
        const u64 begin = read_clock(); \
        _Pragma("unroll 4") for (u32 i = 0; i < rounds; ++i) \
        { \
            const uint4 value = LOAD(own + at); \
            mixed ^= value.x ^ value.y ^ value.z ^ value.w; \
            at += step; \
            at = at >= count ? at - count : at; \
        } \
        if (mixed == 0x9e3779b9u) \
            *sink = mixed; \
        __syncthreads(); \
        if (threadIdx.x == 0) \
            out[blockIdx.x] = read_clock() - begin; \
    }

READ_OWN(read_own_l1, load4_through_l1)
READ_OWN(read_own_l2, load4_past_l1)

// All CTAs read the same `count` vectors, `rounds` times in all, each vector once a round.
KERNEL read_shared(const uint4 *memory, u64 count, u32 rounds, u32 *sink)
{
    const u64 threads = (u64)gridDim.x * blockDim.x;
    const u64 first = (u64)blockIdx.x * blockDim.x + threadIdx.x;
    u32 mixed = 0;
    for (u32 round = 0; round < rounds; ++round) {
#pragma unroll 4
        for (u64 i = first; i < count; i += threads) {
            const uint4 value = load4_past_l1(memory + i);
            mixed ^= value.x ^ value.y ^ value.z ^ value.w;
        }
    }
    if (mixed == 0x9e3779b9u)
        *sink = mixed;
}

KERNEL write_shared(uint4 *memory, u64 count, u32 rounds)
{
    const u64 threads = (u64)gridDim.x * blockDim.x;
    for (u32 round = 0; round < rounds; ++round) {
        for (u64 i = (u64)blockIdx.x * blockDim.x + threadIdx.x; i < count; i += threads) {
            uint4 value;
            value.x = (u32)i;
            value.y = round;
            value.z = value.w = 1u;
            memory[i] = value;
        }
    }
}

// One pass over a ring after warm-up: how many steps took less than each of three bounds, and the sum.
KERNEL scan(u64 start, u32 warm_steps, u32 steps, u32 bound_a, u32 bound_b, u32 bound_c, u32 past_l1, u64 *out)
{
    u64 at = start;
    for (u32 i = 0; i < warm_steps; ++i)
        at = past_l1 ? load_past_l1((const u64 *)at) : load_through_l1((const u64 *)at);
    u32 below_a = 0, below_b = 0, below_c = 0;
    u64 sum = 0;
    for (u32 i = 0; i < steps; ++i) {
        const u64 begin = read_clock();
        at = past_l1 ? load_past_l1((const u64 *)at) : load_through_l1((const u64 *)at);
        const u32 took = (u32)(read_clock_after(at) - begin);
        below_a += took < bound_a ? 1u : 0u;
        below_b += took < bound_b ? 1u : 0u;
        below_c += took < bound_c ? 1u : 0u;
        sum += took;
    }
    out[0] = below_a;
    out[1] = below_b;
    out[2] = below_c;
    out[3] = sum;
    out[4] = at;
}

// The cycles of fetching a texel right after another, to whose right and below it stands: few where
// both share a sector, for a cold sector is fetched alone. Each pair has a tile of `side` x `side`
// texels to itself, of which `tiles_across` stand in a row.
KERNEL neighbours(u64 texture, u32 side, u32 tiles_across, u32 across, u32 down, float level, float texel_u, float texel_v, u32 *out)
{
    u32 x = 0, y = 0;
    float mixed = 0.0f;
    for (u32 below = 0; below < down; ++below) {
        for (u32 right = 0; right < across; ++right) {
            const float u = ((float)x + 0.5f) * texel_u, v = ((float)y + 0.5f) * texel_v;
            const float u2 = ((float)(x + right) + 0.5f) * texel_u, v2 = ((float)(y + below) + 0.5f) * texel_v;
            const float first = tex2DLod<float>(texture, u, v, level);
            // No texel is as large: the second fetch only waits for the first.
            const float after = first > 1e30f ? 1.0f : 0.0f;
            const u64 begin = read_clock();
            const float second = tex2DLod<float>(texture, u2 + after, v2 + after, level);
            *out++ = (u32)(read_clock_after((u64)(u32)__float_as_int(second)) - begin);
            mixed += second;
            x += side;
            y += x == tiles_across * side ? side : 0u;
            x = x == tiles_across * side ? 0u : x;
        }
    }
    if (mixed == 12345.678f)
        *out = 0u;
}

// One fetch by each lane, lanes `across` to a row: what the profiler counts for one warp tells which
// texels share a sector. The CTAs are warps, `tiles_across` of them side by side from (x, y) on.
KERNEL footprint(u64 texture, u32 across, u32 tiles_across, u32 x, u32 y, float offset, float level, float texel_u,
                 float texel_v, float *out)
{
    const u32 lane = threadIdx.x, down = 32u / across;
    x += blockIdx.x % tiles_across * across + lane % across;
    y += blockIdx.x / tiles_across * down + lane / across;
    const float4 value =
        tex2DLod<float4>(texture, ((float)x + offset) * texel_u, ((float)y + offset) * texel_v, level);
    const float sum = value.x + value.y + value.z + value.w;
    // Texels are no such number: the fetch must stay, and nothing else is to be counted.
    if (sum == 12345.678f)
        out[0] = sum;
}

// Every thread fetches over and over from a window of `window` x `window` texels; out: cycles of each
// CTA.
KERNEL fetch_rate(u64 texture, u32 window, u32 rounds, float offset, float level, float texel_u, float texel_v,
                  float *sink, u64 *out)
{
    u32 x = threadIdx.x & 7u, y = (threadIdx.x >> 3) & 3u;
    float mixed = 0.0f;
    const u64 begin = read_clock();
#pragma unroll 4
    for (u32 i = 0; i < rounds; ++i) {
        const float4 value = tex2DLod<float4>(
            texture, ((float)x + offset) * texel_u, ((float)y + offset) * texel_v, level);
        mixed += value.x + value.y + value.z + value.w;
        x = (x + 8u) & (window - 1u);
        y = (y + 4u) & (window - 1u);
    }
    if (mixed == 12345.678f)
        *sink = mixed;
    __syncthreads();
    if (threadIdx.x == 0)
        out[blockIdx.x] = read_clock() - begin;
}
