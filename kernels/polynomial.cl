// Our own float32 log, exp, cbrt and sine/cosine, so that every device computes the same bits as polynomial.py.
//
// Only +, -, *, correctly rounded / and sqrt, integer operations and bit casts; contraction is off; no result is
// denormal for the stated arguments. Each function has its twin of the same name in polynomial.py: change both.
#pragma OPENCL FP_CONTRACT OFF

#define LN2_HIGH 0x1.62ep-1f         // 12 bits of ln 2: exact when multiplied by an exponent
#define LN2_LOW 0x1.0bfbe8p-15f      // ln 2 - LN2_HIGH
#define LOG2_E 0x1.715476p+0f
#define SQRT_HALF_BITS 0x3f3504f3
#define TURN_TO_RADIANS 0x1.921fb6p-30f  // 2 pi / 2^32

// Natural logarithm of a positive normal number: ln x = e ln 2 + 2 artanh((m - 1) / (m + 1)), m in [sqrt 1/2, sqrt 2).
float poly_log(float x)
{
    const int exponent = (as_int(x) - SQRT_HALF_BITS) >> 23;
    const float f = as_float(as_int(x) - (exponent << 23)) - 1.0f;
    const float e = (float)exponent;
    const float s = f / (f + 2.0f);
    const float z = s * s;
    // Taylor series of artanh(s) / s - 1; the first term left out is below 2e-9.
    const float series = z * (1.0f / 3.0f + z * (1.0f / 5.0f + z * (1.0f / 7.0f + z * (1.0f / 9.0f))));
    const float log_m = 2.0f * s + 2.0f * s * series;
    return e * LN2_HIGH + (log_m + e * LN2_LOW);
}

// e^x for x in [-86, 86]; other arguments are clamped to that range.
float poly_exp(float x)
{
    x = x < -86.0f ? -86.0f : x;
    x = x > 86.0f ? 86.0f : x;
    const float n = floor(x * LOG2_E + 0.5f);
    const float r = (x - n * LN2_HIGH) - n * LN2_LOW;
    // Taylor series up to r^7 / 7!, abs(r) <= ln 2 / 2.
    float series = 1.0f / 720.0f + r * (1.0f / 5040.0f);
    series = 1.0f / 120.0f + r * series;
    series = 1.0f / 24.0f + r * series;
    series = 1.0f / 6.0f + r * series;
    series = 0.5f + r * series;
    series = 1.0f + r * series;
    series = 1.0f + r * series;
    return series * as_float(((int)n + 127) << 23);
}

// Cube root of a positive normal number: a third of the exponent, then two Halley steps.
float poly_cbrt(float x)
{
    float y = as_float(as_int(x) / 3 + 0x2a514067);
    for (int step = 0; step < 2; ++step) {
        const float cube = y * y * y;
        y = y * ((cube + 2.0f * x) / (2.0f * cube + x));
    }
    return y;
}

// x^(1/2.2) for x >= 0; 0 below 2^-24.
float poly_gamma(float x)
{
    const float safe = x < 0x1p-24f ? 0x1p-24f : x;
    const float power = poly_exp(poly_log(safe) * (1.0f / 2.2f));
    return x < 0x1p-24f ? 0.0f : power;
}

// (cosine, sine) of the angle 2 pi turn / 2^32.
float2 poly_cos_sin(uint turn)
{
    // The nearest quarter turn, and the rest in [-pi/4, pi/4).
    const uint shifted = turn + 0x20000000u;
    const uint quadrant = shifted >> 30;
    const int rest = (int)(shifted & 0x3fffffffu) - 0x20000000;
    const float a = (float)rest * TURN_TO_RADIANS;
    const float z = a * a;
    float s = 1.0f / 362880.0f * z - 1.0f / 5040.0f;
    s = 1.0f / 120.0f + z * s;
    s = z * s - 1.0f / 6.0f;
    s = a + a * (z * s);
    float c = 1.0f / 40320.0f * z - 1.0f / 720.0f;
    c = 1.0f / 24.0f + z * c;
    c = z * c - 0.5f;
    c = 1.0f + z * c;
    // Swap in odd quadrants, flip signs: on bits, as a branch would be mispredicted half the time.
    const uint swap = (as_uint(s) ^ as_uint(c)) & (0u - (quadrant & 1u));
    const uint cosine = (as_uint(c) ^ swap) ^ (((quadrant + 1u) & 2u) << 30);
    const uint sine = (as_uint(s) ^ swap) ^ ((quadrant & 2u) << 30);
    return (float2)(as_float(cosine), as_float(sine));
}
