// Our own float32 log, exp, cbrt and sine/cosine, so that every device computes the same bits as
// polynomial.py.
//
// Only +, -, *, correctly rounded / and sqrt, integer operations and bit casts; contraction is off;
// no result is denormal for the stated arguments. Each function has its twin of the same name in
// polynomial.py: change both.
//
// The types real, whole and word are float, int and uint, or vectors of them with one element per
// lane: a work-item works on WIDTH lanes. Compilers for GPUs want one; those for CPUs make better
// code of vectors that are written out.
#pragma OPENCL FP_CONTRACT OFF

#if WIDTH == 1
typedef float real;
typedef int whole;
typedef uint word;
#define as_real as_float
#define as_whole as_int
#define as_word as_uint
#define to_real convert_float
#define to_whole convert_int
#define to_word convert_uint
#define GATHER(type, memory, at) ((memory)[at])
#else
typedef float8 real;
typedef int8 whole;
typedef uint8 word;
#define as_real as_float8
#define as_whole as_int8
#define as_word as_uint8
#define to_real convert_float8
#define to_whole convert_int8
#define to_word convert_uint8
#define GATHER(type, memory, at) \
    ((type##8)((memory)[(at).s0], (memory)[(at).s1], (memory)[(at).s2], (memory)[(at).s3], \
               (memory)[(at).s4], (memory)[(at).s5], (memory)[(at).s6], (memory)[(at).s7]))
#endif

#define LN2_HIGH 0x1.62ep-1f             // 12 bits of ln 2: exact when multiplied by an exponent
#define LN2_LOW 0x1.0bfbe8p-15f          // ln 2 - LN2_HIGH
#define LOG2_E 0x1.715476p+0f
#define ROUND_TO_INTEGER 0x1.8p+23f      // added, it leaves the nearest integer in the low bits
#define SQRT_HALF_BITS 0x3f3504f3
#define TURN_TO_RADIANS 0x1.921fb6p-30f  // 2 pi / 2^32
#define EXPONENT_MIN -28.0f              // keeps the cube of an exponential above the denormals

real at_least(real x, real low)
{
    return x < low ? low : x;
}

real at_most(real x, real high)
{
    return x > high ? high : x;
}

// Natural logarithm of a positive normal number: ln x = e ln 2 + 2 artanh((m - 1) / (m + 1)), m in
// [sqrt 1/2, sqrt 2).
real poly_log(real x)
{
    const whole exponent = (as_whole(x) - SQRT_HALF_BITS) >> 23;
    const real f = as_real(as_whole(x) - (exponent << 23)) - 1.0f;
    const real e = to_real(exponent);
    const real s = f / (f + 2.0f);
    const real z = s * s;
    // Taylor series of artanh(s) / s - 1; the first term left out is below 2e-9.
    const real series = z * (1.0f / 3.0f + z * (1.0f / 5.0f + z * (1.0f / 7.0f + z * (1.0f / 9.0f))));
    const real log_m = 2.0f * s + 2.0f * s * series;
    return e * LN2_HIGH + (log_m + e * LN2_LOW);
}

// e^x for x in [-86, 86]; the caller keeps to that range.
real poly_exp(real x)
{
    const real shifted = x * LOG2_E + ROUND_TO_INTEGER;
    const real n = shifted - ROUND_TO_INTEGER;
    const real r = (x - n * LN2_HIGH) - n * LN2_LOW;
    // Taylor series up to r^7 / 7!, abs(r) <= ln 2 / 2.
    real series = 1.0f / 720.0f + r * (1.0f / 5040.0f);
    series = 1.0f / 120.0f + r * series;
    series = 1.0f / 24.0f + r * series;
    series = 1.0f / 6.0f + r * series;
    series = 0.5f + r * series;
    series = 1.0f + r * series;
    series = 1.0f + r * series;
    return series * as_real((as_whole(shifted) << 23) + 0x3f800000);
}

// Cube root of a positive normal number: a third of the exponent, then two Halley steps.
real poly_cbrt(real x)
{
    real y = as_real(as_whole(x) / 3 + 0x2a514067);
    for (int step = 0; step < 2; ++step) {
        const real cube = y * y * y;
        y = y * ((cube + 2.0f * x) / (2.0f * cube + x));
    }
    return y;
}

// x^(1/2.2) for x in [0, 2^17]; 0 below 2^-24.
real poly_gamma(real x)
{
    const real power = poly_exp(poly_log(at_least(x, (real)(0x1p-24f))) * (1.0f / 2.2f));
    return x < 0x1p-24f ? (real)(0.0f) : power;
}

// w_wide e^x + w_narrow e^3x, x at least -28: with x = -r / (3 d) and weights 1, Burley's profile
// but for its factor; with weights 3/4 and 1/4, the share of the energy scattered beyond r.
real burley(real x, float w_wide, float w_narrow)
{
    const real wide = poly_exp(at_least(x, (real)(EXPONENT_MIN)));
    return w_narrow * (wide * wide * wide) + w_wide * wide;
}

// Cosine and sine of the angle 2 pi turn / 2^32.
void poly_cos_sin(word turn, real *cosine, real *sine)
{
    // The nearest quarter turn, and the rest in [-pi/4, pi/4).
    const word shifted = turn + 0x20000000u;
    const word quadrant = shifted >> 30;
    const real a = to_real(as_whole(shifted & 0x3fffffffu) - 0x20000000) * TURN_TO_RADIANS;
    const real z = a * a;
    real s = 1.0f / 362880.0f * z - 1.0f / 5040.0f;
    s = 1.0f / 120.0f + z * s;
    s = z * s - 1.0f / 6.0f;
    s = a + a * (z * s);
    real c = 1.0f / 40320.0f * z - 1.0f / 720.0f;
    c = 1.0f / 24.0f + z * c;
    c = z * c - 0.5f;
    c = 1.0f + z * c;
    // Swap in odd quadrants, flip signs: on bits, as a branch would be mispredicted half the time.
    const word swap = (as_word(s) ^ as_word(c)) & (0u - (quadrant & 1u));
    *cosine = as_real((as_word(c) ^ swap) ^ (((quadrant + 1u) & 2u) << 30));
    *sine = as_real((as_word(s) ^ swap) ^ ((quadrant & 2u) << 30));
}
