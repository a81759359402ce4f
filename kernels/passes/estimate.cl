// Estimate: this frame's sample count of each pixel from its history or its pilots, before the
// sampling pass of the adaptive method. Counts are stored in lane order, so that a warp's largest is
// one run.
PASS_KERNEL estimate(
    WARP_ARGS, __global const ushort *setup_texture, __global const float2 *velocity,
    __global const half *history, __global ushort *counts, const int has_velocity, const float sigma0_sq,
    const float kappa, const float k_minus_1, const float b_min, const float b_max,
    __global const uint4 *past_counts, const int num_past_frames, const float texels_per_mm_at_cm,
    const float rate_s, const float epsilon_u)
{
    FIND_PIXEL
    const float depth = inside ? load_setup(setup_texture, setup_index(0, y, x, width, height)).w : 0.0f;
    float count = 0.0f;
#if SEPARATION
    // A pixel that hardly scatters beyond itself stays diffuse.
    const float radius_centre = 1.0f / (texels_per_mm_at_cm / (depth > 0.0f ? depth : 1.0f));
    if (depth > 0.0f && burley(radius_centre * rate_s, 0.75f, 0.25f) > epsilon_u) {
#else
    if (depth > 0.0f) {
#endif
#if TWO_PASS
        // The pilots' count and the variance of their mean.
        const float4 texel = vload_half4(y * width + x, history);
        const float mean_count = texel.x;
        const float variance = texel.z;
#else
        const float2 moved = has_velocity ? velocity[y * width + x] : (float2)(0.0f);
        const int2 past = (int2)(reproject(x, moved.x), reproject(y, moved.y));

#if DISOCCLUSION == 0
        // A pixel without history stands at the target variance with the largest count.
        float mean_count = b_max;
        float variance = sigma0_sq;
#else
        float mean_count = 0.0f;
        float variance = 0.0f;
#endif
        float oldest_count = mean_count;
        if (past.x >= 0 && past.x < width && past.y >= 0 && past.y < height) {
            const float4 texel = vload_half4(past.y * width + past.x, history);
#if RULE_SLIDING
            const uint4 counts_before = past_counts[past.y * width + past.x];
#endif
            if (is_known(texel, depth, true)) {
                mean_count = texel.x;
                variance = texel.z;
#if RULE_SLIDING
                oldest_count = find_count(counts_before, num_past_frames);
#endif
            }
        }
#endif
#if TWO_PASS || LAST_FRAME
        // n = s2 n / s0.
        count = variance * mean_count / sigma0_sq;
#elif RULE_SLIDING
        // n = (s2 - s0) / s0 n_bar k + n of k frames ago. [Xie's slides]
        count = (variance - sigma0_sq) / sigma0_sq * mean_count * (float)num_past_frames + oldest_count;
#elif RULE_PAPER
        // n = kappa Delta + E, Delta = (s2 - s0) / s0 n_bar (k - 1), E = s2 / s0 n_bar. [Xie20]
        const float delta = (variance - sigma0_sq) / sigma0_sq * mean_count * k_minus_1;
        count = kappa * delta + variance / sigma0_sq * mean_count;
#else
        count = variance / sigma0_sq;
#endif
        count = count < b_min ? b_min : count;
        count = count > b_max ? b_max : count;
    }
    counts[warp * 32u + lane] = (ushort)(count + 0.5f);
}
