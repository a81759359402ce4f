// Sampling: filtered importance sampling of the diffusion profile around each scattering pixel.
//
// Legend: d profile scale in mm; xi_1 -> radius r in mm, xi_2 -> angle; p density of the radius; reach r' with the depth
// difference. rate = -1 / (3 d) and density = 1 / (4 d) of red, green, blue and the sampled channel.

#define R2_X 0xC13FA9A9u
#define R2_Y 0x91E10DA5u
#define PDF_MIN 1e-5f        // 1/mm
#define RADIUS_MIN 1e-5f     // mm
#define EXPONENT_MIN -28.0f  // keeps the cube of an exponential above the denormals
#define APPROXIMATE_C 2.5715f
#define MM_PER_CM 10.0f

// [JO20] The first component of the hash of three integers, 16 bits.
uint pcg3d16(uint x, uint y, uint z)
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

// e^max(x, -28) and its cube, weighted: w_wide e^x + w_narrow e^3x. With x = -r / (3 d) and weights 1 it is Burley's profile.
float burley(float x, float w_wide, float w_narrow)
{
    const float wide = poly_exp(x < EXPONENT_MIN ? EXPONENT_MIN : x);
    return w_narrow * (wide * wide * wide) + w_wide * wide;
}

// A non-negative half float from the low 16 bits; no denormals.
float decode_half(uint bits)
{
    return as_float((bits & 0xffffu) << 13) * 0x1p112f;
}

// Radius over d for xi_1, given its complement 1 - xi_1 in (0, 1].
float invert_cdf(float complement)
{
#if INVERSE_EXACT
    const float g = poly_cbrt(1.0f + 4.0f * complement * (2.0f * complement + sqrt(1.0f + 4.0f * complement * complement)));
    return 3.0f * poly_log((1.0f + 1.0f / g + g) / (4.0f * complement));
#else
    return ((2.0f - APPROXIMATE_C) * (1.0f - complement) - 2.0f) * poly_log(complement);
#endif
}

// 0.5 + 0.5 N.M of two packed normals (10 bits a component), in exact integers up to the last step.
float half_cosine(uint n, uint m)
{
    const int dot_product =
        ((int)(n & 1023u) * 2 - 1023) * ((int)(m & 1023u) * 2 - 1023) +
        ((int)((n >> 10) & 1023u) * 2 - 1023) * ((int)((m >> 10) & 1023u) * 2 - 1023) +
        ((int)((n >> 20) & 1023u) * 2 - 1023) * ((int)((m >> 20) & 1023u) * 2 - 1023);
    const float cosine = (float)dot_product * (1.0f / 1046529.0f);
    const float result = 0.5f + 0.5f * cosine;
    return result < 0.0f ? 0.0f : (result > 1.0f ? 1.0f : result);
}

// Scalars only, no vector types: compilers for CPUs then put 8 or 16 lanes into one vector by themselves.
// setup_texture: half-float texels as two words, red | green << 16 and blue | depth << 16. ratio: of level l, its width (2 l) and
// height (2 l + 1) over level 0's. _r, _g, _b, _s: red, green, blue and the sampled channel.
PASS_KERNEL sampling(
    WARP_ARGS, __global const uint *setup_texture, __global const uint *normal, __global const uchar *profile_id,
    __global const ushort *counts, __global const float2 *velocity, __global half *scattered, const int has_velocity,
    const int fixed_count, const uint frame, const int num_levels, __global const float *ratio, const float texels_per_mm_at_cm,
    const float d, const float rate_r, const float rate_g, const float rate_b, const float rate_s, const float density_r,
    const float density_g, const float density_b, const float density_s, const float mip_scale TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const uint pixel = inside ? (uint)(y * width + x) : 0u;
    const uint own = inside ? 2u * setup_index(0, y, x, width, height) : 0u;
    const float centre_r = decode_half(setup_texture[own]);
    const float centre_g = decode_half(setup_texture[own] >> 16);
    const float centre_b = decode_half(setup_texture[own + 1u]);
    const float centre_depth = decode_half(setup_texture[own + 1u] >> 16);
    const bool scatters = inside && centre_depth > 0.0f;
    TRACE(TRACE_COLOUR, inside, 0, y, x)

    float4 result = (float4)(0.0f);
    if (steps > 0) {
        const uint centre_normal = normal[pixel];
#if NORMAL_WEIGHTS
        TRACE(TRACE_NORMAL, scatters, 0, y, x)
#endif
#if ADAPTIVE
        const int count = scatters ? (int)counts[warp * 32u + lane] : 0;
        const int2 past = reproject(x, y, scatters && has_velocity ? velocity[pixel] : (float2)(0.0f));
        TRACE(1, scatters, 0, y, x)
        TRACE(1, scatters && past.x >= 0 && past.x < width && past.y >= 0 && past.y < height, 0, past.y, past.x)
#else
        const int count = scatters ? fixed_count : 0;
#endif

        // Project: texels per mm at this depth, and the mip rule's factor that does not change with the sample.
        const float texels_per_mm = texels_per_mm_at_cm / (scatters ? centre_depth : 1.0f);
        const float mip_factor = mip_scale * (float)count / (texels_per_mm * texels_per_mm);

        // Centre reweighting: the share of each profile beyond one texel; samples start beyond the sampled channel's.
        const float radius_centre = 1.0f / texels_per_mm;
        const float beyond_r = burley(radius_centre * rate_r, 0.75f, 0.25f);
        const float beyond_g = burley(radius_centre * rate_g, 0.75f, 0.25f);
        const float beyond_b = burley(radius_centre * rate_b, 0.75f, 0.25f);
        const float beyond_s = burley(radius_centre * rate_s, 0.75f, 0.25f);
#if CENTRE_REWEIGHTING
        const float unit = 0x1p-24f * beyond_s;
#else
        const float unit = 0x1p-24f;
#endif

        const float middle_x = (float)x + 0.5f;
        const float middle_y = (float)y + 0.5f;
        const float right = (float)width - 0.5f;
        const float bottom = (float)height - 0.5f;
        const uint start = pcg3d16((uint)x, (uint)y, frame);
        float sum_r = 0.0f, sum_g = 0.0f, sum_b = 0.0f;
        float total_r = 0.0f, total_g = 0.0f, total_b = 0.0f;

#if TRACED
        const int num_turns = steps;
#else
        const int num_turns = count;
#endif
        for (int i = 0; i < num_turns; ++i) {
            const bool active = i < count;

            // Sample a radius and a direction.
            const uint index = start + (uint)i;
            const float complement = (float)(int)(0x1000000u - ((index * R2_X) >> 8)) * unit;
            const float2 direction = poly_cos_sin(index * R2_Y);
            float r = d * invert_cdf(complement);
            r = r < RADIUS_MIN ? RADIUS_MIN : r;
            float p = burley(r * rate_s, 1.0f, 1.0f) * density_s;
            p = p < PDF_MIN ? PDF_MIN : p;

            // Find the texel; coordinates are clamped to the viewport's texel centres.
            const float reach_texels = r * texels_per_mm;
            float at_x = middle_x + reach_texels * direction.x;
            float at_y = middle_y + reach_texels * direction.y;
            at_x = at_x < 0.5f ? 0.5f : at_x;
            at_y = at_y < 0.5f ? 0.5f : at_y;
            at_x = at_x > right ? right : at_x;
            at_y = at_y > bottom ? bottom : at_y;
            const int texel_x = (int)at_x;
            const int texel_y = (int)at_y;

            // Choose the level: l = ceil(max(-log2 q, 0) / 2) exceeds k exactly where q < 4^-k.
#if MIP_RULE == 0
            const uint level = 0u;
            const int level_x = texel_x, level_y = texel_y;
#else
#if MIP_RULE == 1
            const float q = p * mip_factor;  // Eq 5.12
#else
            const float q = p * mip_factor / r;  // [KC08] samples per texel of level 0
#endif
            const int finer = (q < 1.0f) + (q < 0x1p-2f) + (q < 0x1p-4f) + (q < 0x1p-6f) + (q < 0x1p-8f);
            const uint level = (uint)(finer < num_levels ? finer : num_levels - 1);
            const int level_x = (int)(at_x * ratio[2u * level]);
            const int level_y = (int)(at_y * ratio[2u * level + 1u]);
#endif

            // Fetch.
            const uint at = 2u * setup_index(level, level_y, level_x, width, height);
            const uint red_green = setup_texture[at];
            const uint blue_depth = setup_texture[at + 1u];
            TRACE(TRACE_COLOUR, active, level, level_y, level_x)
            const uint fetched = (uint)(texel_y * width + texel_x);
            float common = (active & (profile_id[fetched] > 0)) ? 1.0f : 0.0f;
#if NORMAL_WEIGHTS
            common *= sqrt(half_cosine(normal[fetched], centre_normal));
            TRACE(TRACE_NORMAL, active, 0, texel_y, texel_x)
#endif
            TRACE(TRACE_PROFILE_ID, active, 0, texel_y, texel_x)
            common /= p;

            // Weigh: each channel's profile at the distance in space, over the density that drew the sample.
#if BILATERAL
            const float dz = (decode_half(blue_depth >> 16) - centre_depth) * MM_PER_CM;
            const float reach = sqrt(r * r + dz * dz);
#else
            const float reach = r;
#endif
            const float weight_r = burley(reach * rate_r, 1.0f, 1.0f) * density_r * common;
            const float weight_g = burley(reach * rate_g, 1.0f, 1.0f) * density_g * common;
            const float weight_b = burley(reach * rate_b, 1.0f, 1.0f) * density_b * common;
            sum_r += weight_r * decode_half(red_green);
            sum_g += weight_g * decode_half(red_green >> 16);
            sum_b += weight_b * decode_half(blue_depth);
            total_r += weight_r;
            total_g += weight_g;
            total_b += weight_b;
        }

        if (scatters) {
#if SELF_NORMALISED
            result.x = total_r > 0.0f ? sum_r / total_r : centre_r;
            result.y = total_g > 0.0f ? sum_g / total_g : centre_g;
            result.z = total_b > 0.0f ? sum_b / total_b : centre_b;
#if CENTRE_REWEIGHTING
            result.x += (centre_r - result.x) * (1.0f - beyond_r);
            result.y += (centre_g - result.y) * (1.0f - beyond_g);
            result.z += (centre_b - result.z) * (1.0f - beyond_b);
#endif
#else
            result.x = sum_r / (float)count;
            result.y = sum_g / (float)count;
            result.z = sum_b / (float)count;
#if CENTRE_REWEIGHTING
            // The samples were drawn from the part of the profile beyond the centre texel.
            result.x = result.x * beyond_s + centre_r * (1.0f - beyond_r);
            result.y = result.y * beyond_s + centre_g * (1.0f - beyond_g);
            result.z = result.z * beyond_s + centre_b * (1.0f - beyond_b);
#endif
#endif
            result.w = (float)count;
        }
    }
    if (inside)
        store_half(scattered, pixel, result);
    TRACE(1, inside, 0, y, x)
}
