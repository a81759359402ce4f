// Update: blend this frame into the history (mean count, depth, variance of the mean, mean) and
// pass the colour on. The tracked scalar is the luminance of the colour's 1/2.2 power [Xie20], less
// a times the lighting's where there is a control variate [Xie21].

float find_luminance(float3 colour)
{
    return 0.3f * poly_gamma(colour.x) + 0.59f * poly_gamma(colour.y) + 0.11f * poly_gamma(colour.z);
}

#define LIGHT(texel_y, texel_x) load_setup(lighting, setup_index(0, texel_y, texel_x, width, height))

// Arguments of Method.control and its neighbours: sampled, lighting and centre are scattered and the
// setup texture once more, for the reads that the plain update does not make. jitter: of the camera,
// texels. rate: -1 / (3 d) of red, green and blue.
PASS_KERNEL update(
    WARP_ARGS, __global const half *scattered, __global const float2 *velocity, __global const float *depth,
    __global const half *old_history, __global half *resolved, __global half *history, const int has_velocity,
    const float alpha, const float sigma0_sq, __global const half *sampled, __global const ushort *lighting,
    __global const ushort *centre, __global const half *old_covariance, __global half *covariance,
    __global const uint4 *old_past_counts, __global uint4 *past_counts, const uint mask_0, const uint mask_1,
    const uint mask_2, const uint mask_3, const float num_past_frames, const float jitter_x,
    const float jitter_y, const float eta_cov, const float epsilon_a, const float texels_per_mm_at_cm,
    const float rate_r, const float rate_g, const float rate_b TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const uint pixel = inside ? (uint)(y * width + x) : 0u;
    const float4 colour = inside ? vload_half4(pixel, scattered) : (float4)(0.0f);
    TRACE(1, inside, 0, y, x)
    const bool scatters = colour.w > 0.0f;
    float4 blended = (float4)(0.0f);
    float4 moments = (float4)(0.0f);
    uint4 counts = (uint4)(0u);
    if (steps > 0) {
        const float2 moved = scatters && has_velocity ? velocity[pixel] : (float2)(0.0f);
        const int2 past = (int2)(reproject(x, moved.x), reproject(y, moved.y));
        const bool on_screen = scatters && past.x >= 0 && past.x < width && past.y >= 0 && past.y < height;
        TRACE(1, scatters, 0, y, x)
        TRACE(1, scatters, 0, y, x)
        TRACE(1, on_screen, 0, past.y, past.x)
#if CONTROL == 2
        TRACE(1, on_screen, 0, past.y, past.x)
#endif
#if RULE_SLIDING
        TRACE(1, on_screen, 0, past.y, past.x)
#endif
#if CONTROL
        // The lighting where the pixel's centre is without the jitter, between four texels.
        const float at_x = at_most(at_least((float)x - jitter_x, 0.0f), (float)(width - 1));
        const float at_y = at_most(at_least((float)y - jitter_y, 0.0f), (float)(height - 1));
        const int left = (int)at_x;
        const int top = (int)at_y;
        TRACE(1, scatters, 0, y, x)
        TRACE(1, scatters, 0, top, left)
#endif
#if SEPARATION
        TRACE(1, scatters, 0, y, x)
#endif
        if (scatters) {
            const float z = depth[pixel];
            const float4 old = on_screen ? vload_half4(past.y * width + past.x, old_history) : (float4)(0.0f);
#if CONTROL
            float3 tracked = vload_half4(pixel, sampled).xyz;
#else
            float3 tracked = colour.xyz;
#endif
#if SEPARATION
            // What comes from beyond the pixel.
            const float4 own = load_setup(centre, setup_index(0, y, x, width, height));
            const float radius_centre = 1.0f / (texels_per_mm_at_cm / own.w);
            const float3 share = (float3)(
                burley(radius_centre * rate_r, 0.75f, 0.25f), burley(radius_centre * rate_g, 0.75f, 0.25f),
                burley(radius_centre * rate_b, 0.75f, 0.25f));
            tracked = tracked - own.xyz * (1.0f - share);
            tracked = select(tracked, (float3)(0.0f), tracked < 0.0f);
#endif
            const float luminance = find_luminance(tracked);
            const bool known = is_known(old, z, on_screen);

#if CONTROL
            const int right = min(left + 1, width - 1);
            const int bottom = min(top + 1, height - 1);
            const float weight_x = at_x - (float)left;
            const float weight_y = at_y - (float)top;
            const float4 above = LIGHT(top, left) * (1.0f - weight_x) + LIGHT(top, right) * weight_x;
            const float4 below = LIGHT(bottom, left) * (1.0f - weight_x) + LIGHT(bottom, right) * weight_x;
            float3 light = (above * (1.0f - weight_y) + below * weight_y).xyz;
#if SEPARATION
            light = light * share;
#endif
            const float control = find_luminance(light);
#endif
#if CONTROL == 2
            const float4 old_moments =
                on_screen ? vload_half4(past.y * width + past.x, old_covariance) : (float4)(0.0f);
            const float coefficient = known ? find_coefficient(old_moments, epsilon_a) : 1.0f;
            const float scalar = luminance - coefficient * control;
            moments = known ? update_moments(old_moments, luminance, control, eta_cov)
                            : (float4)(luminance, control, 0.0f, 0.0f);
#elif CONTROL == 1
            const float scalar = luminance - control;
#else
            const float scalar = luminance;
#endif

            // No history: the target variance, and this frame alone.
            blended = (float4)(colour.w, z, DISOCCLUSION == 0 ? sigma0_sq : 0.0f, scalar);
            if (known) {
                const float difference = scalar - old.w;
                blended.x = (1.0f - alpha) * old.x + alpha * colour.w;
                blended.z = (1.0f - alpha) * old.z + alpha * (1.0f - alpha) * (difference * difference);
                blended.w = (1.0f - alpha) * old.w + alpha * scalar;
            }
#if RULE_SLIDING
            // The simple mean of the last frames' counts instead of the moving one.
            const uint count = (uint)colour.w;
            counts = (uint4)(count * 0x01010101u);
            if (known)
                counts = push_count(
                    on_screen ? old_past_counts[past.y * width + past.x] : (uint4)(0u), count);
            blended.x = sum_counts(counts, (uint4)(mask_0, mask_1, mask_2, mask_3)) / num_past_frames;
#endif
        }
    }
    if (inside) {
        store_half(resolved, pixel, (float4)(colour.xyz, scatters ? 1.0f : 0.0f));
        store_half(history, pixel, blended);
#if CONTROL == 2
        store_half(covariance, pixel, moments);
#endif
#if RULE_SLIDING
        past_counts[pixel] = counts;
#endif
    }
    TRACE(1, inside, 0, y, x)
    TRACE(1, inside, 0, y, x)
#if CONTROL == 2
    TRACE(1, inside, 0, y, x)
#endif
#if RULE_SLIDING
    TRACE(1, inside, 0, y, x)
#endif
}
