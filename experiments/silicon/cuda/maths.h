// The float32 functions of kernels/maths/polynomial.cl and the parts of the passes that kernels/passes/sampling.cl
// and kernels/passes/common.cl spell out, for one lane and in the same order of operations: built without
// contraction (-fmad=false), they give the same bits.
#pragma once
#include "portable.h"

#define LN2_HIGH 0x1.62ep-1f
#define LN2_LOW 0x1.0bfbe8p-15f
#define LOG2_E 0x1.715476p+0f
#define ROUND_TO_INTEGER 0x1.8p+23f
#define SQRT_HALF_BITS 0x3f3504f3
#define TURN_TO_RADIANS 0x1.921fb6p-30f
#define HALF_MAX 65504.0f
#define HALF_NORMAL_MIN 0x1p-14f
#define R2_X 0xC13FA9A9u
#define R2_Y 0x91E10DA5u
#define HASH_MULTIPLIER 12829u
#define HASH_INCREMENT 47989u
#define EXPONENT_MIN -28.0f
#define APPROXIMATE_C 2.5715f

DEVICE float at_least(float x, float low) { return x < low ? low : x; }

DEVICE float at_most(float x, float high) { return x > high ? high : x; }

DEVICE float poly_log(float x)
{
    const int exponent = (__float_as_int(x) - SQRT_HALF_BITS) >> 23;
    const float f = __int_as_float(__float_as_int(x) - (exponent << 23)) - 1.0f;
    const float e = (float)exponent;
    const float s = f / (f + 2.0f);
    const float z = s * s;
    const float series = z * (1.0f / 3.0f + z * (1.0f / 5.0f + z * (1.0f / 7.0f + z * (1.0f / 9.0f))));
    const float log_m = 2.0f * s + 2.0f * s * series;
    return e * LN2_HIGH + (log_m + e * LN2_LOW);
}

DEVICE float poly_exp(float x)
{
    const float shifted = x * LOG2_E + ROUND_TO_INTEGER;
    const float n = shifted - ROUND_TO_INTEGER;
    const float r = (x - n * LN2_HIGH) - n * LN2_LOW;
    float series = 1.0f / 720.0f + r * (1.0f / 5040.0f);
    series = 1.0f / 120.0f + r * series;
    series = 1.0f / 24.0f + r * series;
    series = 1.0f / 6.0f + r * series;
    series = 0.5f + r * series;
    series = 1.0f + r * series;
    series = 1.0f + r * series;
    return series * __int_as_float((int)((u32)__float_as_int(shifted) << 23) + 0x3f800000);
}

// x^(1/2.2) for x in [0, 2^17]; 0 below 2^-24.
DEVICE float poly_gamma(float x)
{
    const float power = poly_exp(poly_log(at_least(x, 0x1p-24f)) * (1.0f / 2.2f));
    return x < 0x1p-24f ? 0.0f : power;
}

// Cosine and sine of the angle 2 pi turn / 2^32.
DEVICE void poly_cos_sin(u32 turn, float *cosine, float *sine)
{
    const u32 shifted = turn + 0x20000000u;
    const u32 quadrant = shifted >> 30;
    const float a = (float)((int)(shifted & 0x3fffffffu) - 0x20000000) * TURN_TO_RADIANS;
    const float z = a * a;
    float s = 1.0f / 362880.0f * z - 1.0f / 5040.0f;
    s = 1.0f / 120.0f + z * s;
    s = z * s - 1.0f / 6.0f;
    s = a + a * (z * s);
    float c = 1.0f / 40320.0f * z - 1.0f / 720.0f;
    c = 1.0f / 24.0f + z * c;
    c = z * c - 0.5f;
    c = 1.0f + z * c;
    const u32 bits_s = (u32)__float_as_int(s), bits_c = (u32)__float_as_int(c);
    const u32 swap = (bits_s ^ bits_c) & (0u - (quadrant & 1u));
    *cosine = __int_as_float((int)((bits_c ^ swap) ^ (((quadrant + 1u) & 2u) << 30)));
    *sine = __int_as_float((int)((bits_s ^ swap) ^ ((quadrant & 2u) << 30)));
}

// The first component of the hash of three integers, 16 bits.
DEVICE u32 pcg3d16(u32 x, u32 y, u32 z)
{
    x = x * HASH_MULTIPLIER + HASH_INCREMENT;
    y = y * HASH_MULTIPLIER + HASH_INCREMENT;
    z = z * HASH_MULTIPLIER + HASH_INCREMENT;
    x += y * z;
    y += z * x;
    z += x * y;
    x += y * z;
    return x >> 16;
}

// w_wide e^x + w_narrow e^3x, x at least -28.
DEVICE float burley(float x, float w_wide, float w_narrow)
{
    const float wide = poly_exp(at_least(x, EXPONENT_MIN));
    return w_narrow * (wide * wide * wide) + w_wide * wide;
}

// Radius over d for a random number's complement, in (0, 1].
DEVICE float invert_cdf(float complement)
{
    return ((2.0f - APPROXIMATE_C) * (1.0f - complement) - 2.0f) * poly_log(complement);
}

DEVICE int normal_component(u32 packed, int shift) { return (int)((packed >> shift) & 1023u) * 2 - 1023; }

// 0.5 + 0.5 N.M of two packed normals.
DEVICE float half_cosine(u32 n, u32 m)
{
    const int product = normal_component(n, 0) * normal_component(m, 0) +
                        normal_component(n, 10) * normal_component(m, 10) +
                        normal_component(n, 20) * normal_component(m, 20);
    const float cosine = (float)product * (1.0f / 1046529.0f);
    return at_most(at_least(0.5f + 0.5f * cosine, 0.0f), 1.0f);
}

// Level ceil(max(-log2 q, 0) / 2): it exceeds k exactly where q < 4^-k.
DEVICE int find_level(float q, int num_levels)
{
    const int level = (q < 1.0f ? 1 : 0) + (q < 0x1p-2f ? 1 : 0) + (q < 0x1p-4f ? 1 : 0) +
                      (q < 0x1p-6f ? 1 : 0) + (q < 0x1p-8f ? 1 : 0);
    return level < num_levels - 1 ? level : num_levels - 1;
}

// One coordinate of the pixel that showed this surface in the previous frame.
DEVICE int reproject(int at, float velocity)
{
    const float past = at_most(at_least((float)at + 0.5f + velocity, -1.0f), 32768.0f);
    return (int)floorf(past);
}

// The texel left of the centre of destination texel `at`, its right neighbour, and that one's weight.
DEVICE int find_tap(int at, int source_size, int size, int *right, float *weight)
{
    const int twice = (2 * at + 1) * source_size - size;
    const int left = twice / (2 * size);
    *weight = (float)(twice - left * 2 * size) / (float)(2 * size);
    *right = left + 1 < source_size - 1 ? left + 1 : source_size - 1;
    return left;
}
