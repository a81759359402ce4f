// Separable scattering: one of the two passes of a filter that is the product of a filter along x
// and one along y. VERTICAL says which; taps are bilinear. [JZJ15]
//
// source: half-float texels as two words, red | green << 16 and blue | depth << 16. taps: offset in
// mm and weight of red, green and blue of each, the centre first. depth_falloff: 1/cm.
#if VERTICAL
#define SOURCE tex
#define TARGET scattered
#define STORE store_half
#define WORDS(at, texel_y) (2 * (at))
__kernel __attribute__((reqd_work_group_size(32 / WIDTH, 1, 1))) void separable_v(
    WARP_ARGS, __global const uint *tex, __global const uchar *profile_id, __global half *scattered,
    __global const float *taps, const float texels_per_mm_at_cm, const float depth_falloff TRACE_ARGS)
#else
#define SOURCE setup_texture
#define TARGET tex
#define STORE store_setup
#define WORDS(at, texel_y) (2 * ((at) + (texel_y) * (width >> 1)))  // the levels stand beside it
__kernel __attribute__((reqd_work_group_size(32 / WIDTH, 1, 1))) void separable_h(
    WARP_ARGS, __global const uint *setup_texture, __global const uchar *profile_id, __global half *tex,
    __global const float *taps, const float texels_per_mm_at_cm, const float depth_falloff TRACE_ARGS)
#endif
{
    FIND_LANES
    const whole own = inside ? WORDS(pixel, y) : zero;
    const word centre_low = GATHER(uint, SOURCE, own);
    const word centre_high = GATHER(uint, SOURCE, own + 1);
    const real centre_depth = decode_half(centre_high >> 16);
    const whole scatters = inside & (centre_depth > 0.0f);
    TRACE_LANES(TRACE_COLOUR, inside, pack_texels(zero, y, x))

    real result_r = none, result_g = none, result_b = none;
    if (steps > 0) {
        // The centre tap stands alone.
        const float4 centre = vload4(0, taps);
        real sum_r = centre.y * decode_half(centre_low);
        real sum_g = centre.z * decode_half(centre_low >> 16);
        real sum_b = centre.w * decode_half(centre_high);
        real total_r = centre.y, total_g = centre.z, total_b = centre.w;

        const real texels_per_mm = texels_per_mm_at_cm / (scatters ? centre_depth : (real)(1.0f));
#if VERTICAL
        const int size = height;
        const real middle = to_real(y) + 0.5f;
#else
        const int size = width;
        const real middle = to_real(x) + 0.5f;
#endif
        for (int i = 1; i <= steps; ++i) {
            const float4 tap = vload4(i, taps);

            // Find the two texels that the tap lies between; beyond the frame there is nothing.
            const real at = middle + tap.x * texels_per_mm;
            const whole active = scatters & (at >= 0.0f) & (at < (float)size);
            const real clamped = at_most(at_least(at, (real)(0.5f)), (real)((float)size - 0.5f)) - 0.5f;
            const whole first = to_whole(clamped);
            const whole second = min(first + 1, (whole)(size - 1));
            const real of_second = clamped - to_real(first);
            const real of_first = 1.0f - of_second;
#if VERTICAL
            const whole column = inside ? x : zero;
            const whole first_x = column, second_x = column, first_y = first, second_y = second;
#else
            const whole row = inside ? y : zero;
            const whole first_x = first, second_x = second, first_y = row, second_y = row;
#endif

            // Fetch. Texels that do not scatter are 0, so that the filtered texel is theirs that do,
            // times the share of those: its coverage.
            const whole pixel_a = first_y * width + first_x;
            const whole pixel_b = second_y * width + second_x;
            const whole at_a = WORDS(pixel_a, first_y);
            const whole at_b = WORDS(pixel_b, second_y);
            const word low_a = GATHER(uint, SOURCE, at_a);
            const word high_a = GATHER(uint, SOURCE, at_a + 1);
            const word low_b = GATHER(uint, SOURCE, at_b);
            const word high_b = GATHER(uint, SOURCE, at_b + 1);
            TRACE_LANES(TRACE_COLOUR, active, pack_texels(zero, first_y, first_x))
            const whole id_a = to_whole(GATHER(uchar, profile_id, pixel_a));
            const whole id_b = to_whole(GATHER(uchar, profile_id, pixel_b));
            TRACE_LANES(TRACE_PROFILE_ID, active, pack_texels(zero, first_y, first_x))
            const real coverage = (id_a > 0 ? of_first : none) + (id_b > 0 ? of_second : none);

            // Weigh: less the further the tap lies in front or behind.
            const real depth = decode_half(high_a >> 16) * of_first + decode_half(high_b >> 16) * of_second;
            const whole counts = active & (coverage > 0.0f);
            const real behind = depth / (counts ? coverage : (real)(1.0f)) - centre_depth;
            const real apart = behind < 0.0f ? -behind : behind;
            const real kept = 1.0f - at_most(depth_falloff * apart, (real)(1.0f));
            const real near = counts ? kept : none;
            const real weight_r = tap.y * near;
            const real weight_g = tap.z * near;
            const real weight_b = tap.w * near;
            sum_r += weight_r * (decode_half(low_a) * of_first + decode_half(low_b) * of_second);
            sum_g += weight_g * (decode_half(low_a >> 16) * of_first + decode_half(low_b >> 16) * of_second);
            sum_b += weight_b * (decode_half(high_a) * of_first + decode_half(high_b) * of_second);
            total_r += weight_r * coverage;
            total_g += weight_g * coverage;
            total_b += weight_b * coverage;
        }
        result_r = sum_r / total_r;
        result_g = sum_g / total_g;
        result_b = sum_b / total_b;
    }

    // Store colour, and the depth for the second pass or its number of fetches, texel by texel.
    TRACE_LANES(1, inside, pack_texels(zero, y, x))
#if VERTICAL
    const real fourth = (real)(2.0f * (float)(steps + 1));
#else
    const real fourth = centre_depth;
#endif
    const whole target = inside ? pixel : (whole)(-1);
#if WIDTH == 1
    if (target >= 0)
        STORE(TARGET, target, scatters ? (float4)(result_r, result_g, result_b, fourth) : (float4)(0.0f));
#else
    float red[8], green[8], blue[8], alpha[8];
    int targets[8], kept[8];
    vstore8(result_r, 0, red);
    vstore8(result_g, 0, green);
    vstore8(result_b, 0, blue);
    vstore8(fourth, 0, alpha);
    vstore8(target, 0, targets);
    vstore8(scatters, 0, kept);
    for (int k = 0; k < 8; ++k) {
        if (targets[k] >= 0) {
            const float4 result = (float4)(red[k], green[k], blue[k], alpha[k]);
            STORE(TARGET, targets[k], kept[k] ? result : (float4)(0.0f));
        }
    }
#endif
}
