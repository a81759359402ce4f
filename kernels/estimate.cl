// Estimate: this frame's sample count of each pixel from its history, before the sampling pass of
// the adaptive method. Counts are stored in lane order, so that a warp's largest is one run.
PASS_KERNEL estimate(
    WARP_ARGS, __global const ushort *setup_texture, __global const float2 *velocity,
    __global const half *history, __global ushort *counts, const int has_velocity, const float sigma0_sq,
    const float kappa, const float k_minus_1, const float b_min, const float b_max)
{
    FIND_PIXEL
    const float depth = inside ? load_setup(setup_texture, setup_index(0, y, x, width, height)).w : 0.0f;
    float count = 0.0f;
    if (depth > 0.0f) {
        const float2 moved = has_velocity ? velocity[y * width + x] : (float2)(0.0f);
        const int2 past = (int2)(reproject(x, moved.x), reproject(y, moved.y));

        // A pixel without history stands at the target variance with the largest count.
        float mean_count = b_max;
        float variance = sigma0_sq;
        if (past.x >= 0 && past.x < width && past.y >= 0 && past.y < height) {
            const float4 texel = vload_half4(past.y * width + past.x, history);
            if (has_history(texel, depth)) {
                mean_count = texel.x;
                variance = texel.z;
            }
        }
#if RULE_PAPER
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
