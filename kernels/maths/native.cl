// polynomial.cl's functions as a shader computes them, on the GPU's special function units.
//
// Only counted, never run: those units round each in its own way, and pictures and traces are the
// same bits on every device. See instruction_counts. One lane per work-item, and the functions of
// the same names as in polynomial.cl, so that the passes' text is the same. What compiles it defines
// UNIT_LOG2 and UNIT_EXP2, and UNIT_COS and UNIT_SIN of an angle in turns.
#pragma OPENCL FP_CONTRACT ON

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

#define LN2 0x1.62e43p-1f
#define LOG2_E 0x1.715476p+0f

real at_least(real x, real low)
{
    return x < low ? low : x;
}

real at_most(real x, real high)
{
    return x > high ? high : x;
}

real poly_log(real x)
{
    return UNIT_LOG2(x) * LN2;
}

real poly_exp(real x)
{
    return UNIT_EXP2(x * LOG2_E);
}

real poly_cbrt(real x)
{
    return UNIT_EXP2(UNIT_LOG2(x) * (1.0f / 3.0f));
}

real poly_gamma(real x)
{
    const real power = UNIT_EXP2(UNIT_LOG2(at_least(x, 0x1p-24f)) * (1.0f / 2.2f));
    return x < 0x1p-24f ? 0.0f : power;
}

// No bound on x: an exponential that is too small is 0 here.
real burley(real x, float w_wide, float w_narrow)
{
    const real wide = poly_exp(x);
    return w_narrow * (wide * wide * wide) + w_wide * wide;
}

void poly_cos_sin(word turn, real *cosine, real *sine)
{
    const real turns = to_real(turn) * 0x1p-32f;
    *cosine = UNIT_COS(turns);
    *sine = UNIT_SIN(turns);
}
