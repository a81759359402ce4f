// Sampling: filtered importance sampling of the diffusion profile around each scattering pixel.
//
// Legend: d profile scale in mm; xi_1 -> radius r in mm, xi_2 -> angle; p density of the radius;
// reach r' with the depth difference. rate = -1 / (3 d) and density = 1 / (4 d) of red, green, blue
// and the sampled channel.

#define R2_X 0xC13FA9A9u
#define R2_Y 0x91E10DA5u
#define PDF_MIN 1e-5f        // 1/mm
#define RADIUS_MIN 1e-5f     // mm
#define APPROXIMATE_C 2.5715f
#define MM_PER_CM 10.0f


// [JO20] The first component of the hash of three integers, 16 bits.
word pcg3d16(word x, word y, word z)
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

// Radius over d for xi_1, given its complement 1 - xi_1 in (0, 1].
real invert_cdf(real complement)
{
#if INVERSE_EXACT
    const real root = sqrt(1.0f + 4.0f * complement * complement);
    const real g = poly_cbrt(1.0f + 4.0f * complement * (2.0f * complement + root));
    return 3.0f * poly_log((1.0f + 1.0f / g + g) / (4.0f * complement));
#else
    return ((2.0f - APPROXIMATE_C) * (1.0f - complement) - 2.0f) * poly_log(complement);
#endif
}

// One component of a packed normal, as an integer in [-1023, 1023].
whole normal_component(word packed, int shift)
{
    return as_whole((packed >> shift) & 1023u) * 2 - 1023;
}

// 0.5 + 0.5 N.M of two packed normals (10 bits a component), in exact integers up to the last step.
real half_cosine(word n, word m)
{
    const whole product = normal_component(n, 0) * normal_component(m, 0) +
                          normal_component(n, 10) * normal_component(m, 10) +
                          normal_component(n, 20) * normal_component(m, 20);
    const real cosine = to_real(product) * (1.0f / 1046529.0f);
    return at_most(at_least(0.5f + 0.5f * cosine, (real)(0.0f)), (real)(1.0f));
}

// Level ceil(max(-log2 q, 0) / 2): it exceeds k exactly where q < 4^-k.
whole find_level(real q, int num_levels)
{
    const whole zero = 0, one = 1;
    const whole level = (q < 1.0f ? one : zero) + (q < 0x1p-2f ? one : zero) + (q < 0x1p-4f ? one : zero) +
                        (q < 0x1p-6f ? one : zero) + (q < 0x1p-8f ? one : zero);
    const whole last = num_levels - 1;
    return level < last ? level : last;
}

// The luminance of a colour's 1/2.2 power, the scalar whose variance decides counts.
real find_luminance(real r, real g, real b)
{
    return 0.3f * poly_gamma(r) + 0.59f * poly_gamma(g) + 0.11f * poly_gamma(b);
}

#ifndef PILOT
#define PILOT 0
#endif
// Whether the variance between a pixel's samples is found: the counts follow from it.
#define SPREAD (PILOT || LAST_FRAME)

// setup_texture: half-float texels as two words, red | green << 16 and blue | depth << 16. ratio:
// of level l, its width (2 l) and height (2 l + 1) over level 0's. _r, _g, _b, _s: red, green, blue
// and the sampled channel. A pilot writes (count, depth, variance of the mean, mean) to scattered,
// the last-frame estimator's sampling pass to history.
__kernel __attribute__((reqd_work_group_size(GROUP_ITEMS, 1, 1))) void sampling(
    WARP_ARGS, __global const uint *setup_texture, __global const uint *normal,
    __global const uchar *profile_id, __global const ushort *counts, __global const float *velocity,
    __global half *scattered, const int has_velocity, const int fixed_count, const uint frame,
    const int num_levels, __global const float *ratio, const float texels_per_mm_at_cm, const float d,
    const float rate_r, const float rate_g, const float rate_b, const float rate_s,
    const float density_r, const float density_g, const float density_b, const float density_s,
    const float mip_scale, __global half *history, const float epsilon_u,
    __global const uint *patch_setup, __global const uint *patch_normal, __global const uchar *patch_id,
    __global const uint *rest_setup, __global const uint *rest_normal, __global const uchar *rest_id
    TRACE_ARGS)
{
    FIND_LANES
#if PATCH
    DECLARE_PATCH
    const int patch_left = (int)(tile & 0xffffu) * 8 - 1, patch_top = (int)(tile >> 16) * 8 - 1;
    LOAD_PATCH(0u, patch_setup, patch_normal, patch_id)
    LOAD_PATCH(64u, rest_setup, rest_normal, rest_id)
    AWAIT_PATCH
    if (steps < 0)
        return;
#endif
    const whole own = inside ? find_words(zero, y, x, width, height) : zero;
    const word centre_low = GATHER(uint, setup_texture, own);
    const word centre_high = GATHER(uint, setup_texture, own + 1);
    const real centre_r = decode_half(centre_low);
    const real centre_g = decode_half(centre_low >> 16);
    const real centre_b = decode_half(centre_high);
    const real centre_depth = decode_half(centre_high >> 16);
    whole scatters = inside & (centre_depth > 0.0f);
    TRACE_LANES(TRACE_COLOUR, inside, pack_texels(zero, y, x))

    real result_r = none, result_g = none, result_b = none;
    whole count = zero;
#if SPREAD
    real spread = none, tracked = none;
#endif
    if (steps > 0) {
#if SEPARATION
        // A pixel that hardly scatters beyond itself takes no samples.
#if PILOT
        const real centre_scale = texels_per_mm_at_cm / (scatters ? centre_depth : (real)(1.0f));
        scatters &= burley(1.0f / centre_scale * rate_s, 0.75f, 0.25f) > epsilon_u;
#elif WIDTH == 1
        scatters &= (whole)counts[warp * 32u + lane] > 0;
#else
        scatters &= convert_int8(vload8(0, counts + warp * 32u + lane)) > 0;
#endif
#endif
        const word centre_normal = GATHER(uint, normal, pixel);
#if NORMAL_WEIGHTS
        TRACE_LANES(TRACE_NORMAL, scatters, pack_texels(zero, y, x))
#endif
#if ADAPTIVE && !PILOT
#if WIDTH == 1
        count = counts[warp * 32u + lane];
#else
        count = convert_int8(vload8(0, counts + warp * 32u + lane));
#endif
#if TRACED && TWO_PASS
        TRACE_LANES(1, scatters, pack_texels(zero, y, x))
#elif TRACED
        whole past_x = x, past_y = y;
        if (has_velocity) {
            const whole at = scatters ? 2 * pixel : zero;
            past_x = reproject(x, scatters ? GATHER(float, velocity, at) : none);
            past_y = reproject(y, scatters ? GATHER(float, velocity, at + 1) : none);
        }
        TRACE_LANES(1, scatters, pack_texels(zero, y, x))
        const whole on_screen =
            scatters & (past_x >= 0) & (past_x < width) & (past_y >= 0) & (past_y < height);
        TRACE_LANES(1, on_screen, pack_texels(zero, past_y, past_x))
        TRACE_LANES(RULE_SLIDING, on_screen, pack_texels(zero, past_y, past_x))
#endif
#else
        count = fixed_count;
#endif
        count = scatters ? count : zero;

        // Project: texels per mm at this depth, and the mip rule's factor that does not change with
        // the sample.
        const real texels_per_mm = texels_per_mm_at_cm / (scatters ? centre_depth : (real)(1.0f));
        const real mip_factor = mip_scale * to_real(count) / (texels_per_mm * texels_per_mm);

        // Centre reweighting: the share of each profile beyond one texel; samples start beyond the
        // sampled channel's.
        const real radius_centre = 1.0f / texels_per_mm;
        const real beyond_r = burley(radius_centre * rate_r, 0.75f, 0.25f);
        const real beyond_g = burley(radius_centre * rate_g, 0.75f, 0.25f);
        const real beyond_b = burley(radius_centre * rate_b, 0.75f, 0.25f);
        const real beyond_s = burley(radius_centre * rate_s, 0.75f, 0.25f);
#if CENTRE_REWEIGHTING
        const real unit = 0x1p-24f * beyond_s;
#else
        const real unit = 0x1p-24f;
#endif

        const real middle_x = to_real(x) + 0.5f;
        const real middle_y = to_real(y) + 0.5f;
        const real right = (float)width - 0.5f;
        const real bottom = (float)height - 0.5f;
        const word start = pcg3d16(as_word(x), as_word(y), (word)(frame));
        real sum_r = none, sum_g = none, sum_b = none;
        real total_r = none, total_g = none, total_b = none;
#if SPREAD
        real sum_y = none, total_y = none, square_y = none, cross_y = none, square_w = none;
#endif

        for (int i = 0; i < steps; ++i) {
            const whole active = i < count;

            // Sample a radius and a direction.
            const word index = start + (uint)i;
            const real complement = to_real(as_whole(0x1000000u - ((index * R2_X) >> 8))) * unit;
            real cosine, sine;
            poly_cos_sin(index * R2_Y, &cosine, &sine);
            const real r = at_least(d * invert_cdf(complement), (real)(RADIUS_MIN));
            const real p = at_least(burley(r * rate_s, 1.0f, 1.0f) * density_s, (real)(PDF_MIN));

            // Find the texel; coordinates are clamped to the viewport's texel centres.
            const real reach_texels = r * texels_per_mm;
            const real at_x = at_most(at_least(middle_x + reach_texels * cosine, (real)(0.5f)), right);
            const real at_y = at_most(at_least(middle_y + reach_texels * sine, (real)(0.5f)), bottom);
            const whole texel_x = to_whole(at_x);
            const whole texel_y = to_whole(at_y);
#if MIP_RULE == 0
            const whole level = zero, level_x = texel_x, level_y = texel_y;
#else
#if MIP_RULE == 1
            const whole level = find_level(p * mip_factor, num_levels);  // Eq 5.12
#else
            // [KC08]: samples per texel of level 0.
            const whole level = find_level(p * mip_factor / r, num_levels);
#endif
            const whole level_x = to_whole(at_x * GATHER(float, ratio, 2 * level));
            const whole level_y = to_whole(at_y * GATHER(float, ratio, 2 * level + 1));
#endif

            // Fetch, unless the patch holds the texel.
            const whole at = find_words(level, level_y, level_x, width, height);
            const whole fetched = texel_y * width + texel_x;
#if PATCH
            const whole patch_x = texel_x - patch_left, patch_y = texel_y - patch_top;
            const whole is_held = (level == 0) & (patch_x >= 0) & (patch_x < PATCH_SIDE) & (patch_y >= 0) &
                                  (patch_y < PATCH_SIDE);
            const whole fetches = active & (is_held == 0);
#else
            const whole fetches = active;
#endif
#if PATCH_IS_LOCAL
            const int held = is_held ? patch_y * PATCH_SIDE + patch_x : 0;
            word low = patch_low[held], high = patch_high[held], sampled_normal = patch_normals[held];
            whole id = patch_ids[held];
            if (!is_held) {
                low = setup_texture[at];
                high = setup_texture[at + 1];
                id = profile_id[fetched];
#if NORMAL_WEIGHTS
                sampled_normal = normal[fetched];
#endif
            }
#else
            const word low = GATHER(uint, setup_texture, at);
            const word high = GATHER(uint, setup_texture, at + 1);
            const whole id = to_whole(GATHER(uchar, profile_id, fetched));
#endif
            TRACE_LANES(TRACE_COLOUR, fetches, pack_texels(level, level_y, level_x))
            real common = (active & (id > 0)) ? 1.0f / p : none;
#if NORMAL_WEIGHTS
#if !PATCH_IS_LOCAL
            const word sampled_normal = GATHER(uint, normal, fetched);
#endif
            common *= sqrt(half_cosine(sampled_normal, centre_normal));
            TRACE_LANES(TRACE_NORMAL, fetches, pack_texels(zero, texel_y, texel_x))
#endif
            TRACE_LANES(TRACE_PROFILE_ID, fetches, pack_texels(zero, texel_y, texel_x))

            // Weigh: each channel's profile at the distance in space, over the density that drew
            // the sample.
#if BILATERAL
            const real dz = (decode_half(high >> 16) - centre_depth) * MM_PER_CM;
            const real reach = sqrt(r * r + dz * dz);
#else
            const real reach = r;
#endif
            const real weight_r = burley(reach * rate_r, 1.0f, 1.0f) * density_r * common;
            const real weight_g = burley(reach * rate_g, 1.0f, 1.0f) * density_g * common;
            const real weight_b = burley(reach * rate_b, 1.0f, 1.0f) * density_b * common;
            sum_r += weight_r * decode_half(low);
            sum_g += weight_g * decode_half(low >> 16);
            sum_b += weight_b * decode_half(high);
            total_r += weight_r;
            total_g += weight_g;
            total_b += weight_b;
#if SPREAD
            // The sample's part of the luminance, and its weight in it.
            const real part = 0.3f * (weight_r * decode_half(low)) +
                              0.59f * (weight_g * decode_half(low >> 16)) +
                              0.11f * (weight_b * decode_half(high));
#if SELF_NORMALISED
            const real share = 0.3f * weight_r + 0.59f * weight_g + 0.11f * weight_b;
#else
            const real share = active ? (real)(1.0f) : none;
#endif
            sum_y += part;
            total_y += share;
            square_y += part * part;
            cross_y += part * share;
            square_w += share * share;
#endif
        }

#if SELF_NORMALISED
        result_r = total_r > 0.0f ? sum_r / total_r : centre_r;
        result_g = total_g > 0.0f ? sum_g / total_g : centre_g;
        result_b = total_b > 0.0f ? sum_b / total_b : centre_b;
#if CENTRE_REWEIGHTING
        result_r += (centre_r - result_r) * (1.0f - beyond_r);
        result_g += (centre_g - result_g) * (1.0f - beyond_g);
        result_b += (centre_b - result_b) * (1.0f - beyond_b);
#endif
#else
        const real num_samples = to_real(count);
        result_r = sum_r / num_samples;
        result_g = sum_g / num_samples;
        result_b = sum_b / num_samples;
#if CENTRE_REWEIGHTING
        // The samples were drawn from the part of the profile beyond the centre texel.
        result_r = result_r * beyond_s + centre_r * (1.0f - beyond_r);
        result_g = result_g * beyond_s + centre_g * (1.0f - beyond_g);
        result_b = result_b * beyond_s + centre_b * (1.0f - beyond_b);
#endif
#endif
#if SPREAD
        // Of what the update pass would track: its value, and the variance of a ratio of two sums,
        // carried through the 1/2.2 power by its slope.
#if SEPARATION
        const real distant_r = at_least(result_r - centre_r * (1.0f - beyond_r), none);
        const real distant_g = at_least(result_g - centre_g * (1.0f - beyond_g), none);
        const real distant_b = at_least(result_b - centre_b * (1.0f - beyond_b), none);
#else
        const real distant_r = result_r, distant_g = result_g, distant_b = result_b;
#endif
#if !CENTRE_REWEIGHTING
        const real scattered_share = 1.0f;
#elif SELF_NORMALISED
        const real scattered_share = 0.3f * beyond_r + 0.59f * beyond_g + 0.11f * beyond_b;
#else
        const real scattered_share = beyond_s;
#endif
        const real linear = 0.3f * distant_r + 0.59f * distant_g + 0.11f * distant_b;
        tracked = find_luminance(distant_r, distant_g, distant_b);
        const real total = total_y > 0.0f ? total_y : (real)(1.0f);
        const real mean_y = sum_y / total;
        const real squares = square_y - 2.0f * mean_y * cross_y + mean_y * mean_y * square_w;
        const real drawn = to_real(count);
        const real of_mean = at_least(squares, none) / (total * total) * (drawn / (drawn - 1.0f));
        const real slope =
            tracked * scattered_share / (2.2f * (linear > 0.0f ? linear : (real)(1.0f)));
        spread = slope * slope * of_mean;
#endif
    }
#if SEPARATION && !PILOT
    result_r = count > 0 ? result_r : centre_r;
    result_g = count > 0 ? result_g : centre_g;
    result_b = count > 0 ? result_b : centre_b;
#endif

    // Store colour and count, texel by texel.
    TRACE_LANES(1, inside, pack_texels(zero, y, x))
    TRACE_LANES(LAST_FRAME && !PILOT, inside, pack_texels(zero, y, x))
    const whole target = inside ? pixel : (whole)(-1);
    const real kept = to_real(count);
    // With separation, what takes no samples keeps its light; elsewhere that is 0 already.
#if SEPARATION
#define RESULT(is_sampled, colour) (colour)
#else
#define RESULT(is_sampled, colour) ((is_sampled) ? (colour) : (float4)(0.0f))
#endif
#if WIDTH == 1
    if (target >= 0) {
        const float4 result = (float4)(result_r, result_g, result_b, kept);
#if SPREAD
        const float4 found = (float4)(kept, centre_depth, spread, tracked);
        store_half(PILOT ? scattered : history, target, count > 0 ? found : (float4)(0.0f));
#endif
#if !PILOT
        store_half(scattered, target, RESULT(count > 0, result));
#endif
    }
#else
    float red[8], green[8], blue[8], samples[8];
    int targets[8];
    vstore8(result_r, 0, red);
    vstore8(result_g, 0, green);
    vstore8(result_b, 0, blue);
    vstore8(kept, 0, samples);
    vstore8(target, 0, targets);
#if SPREAD
    float depths[8], spreads[8], means[8];
    vstore8(centre_depth, 0, depths);
    vstore8(spread, 0, spreads);
    vstore8(tracked, 0, means);
#endif
    for (int k = 0; k < 8; ++k) {
        if (targets[k] >= 0) {
            const float4 result = (float4)(red[k], green[k], blue[k], samples[k]);
#if SPREAD
            const float4 found = (float4)(samples[k], depths[k], spreads[k], means[k]);
            store_half(
                PILOT ? scattered : history, targets[k], samples[k] > 0.0f ? found : (float4)(0.0f));
#endif
#if !PILOT
            store_half(scattered, targets[k], RESULT(samples[k] > 0.0f, result));
#endif
        }
    }
#endif
}
