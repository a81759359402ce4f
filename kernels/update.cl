// Update: blend this frame into the history (mean count, depth, variance of the mean, mean) and
// pass the colour on. The tracked scalar is the luminance of the colour's 1/2.2 power. [Xie20]
PASS_KERNEL update(
    WARP_ARGS, __global const half *scattered, __global const float2 *velocity, __global const float *depth,
    __global const half *old_history, __global half *resolved, __global half *history, const int has_velocity,
    const float alpha, const float sigma0_sq TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const uint pixel = inside ? (uint)(y * width + x) : 0u;
    const float4 colour = inside ? vload_half4(pixel, scattered) : (float4)(0.0f);
    TRACE(1, inside, 0, y, x)
    const bool scatters = colour.w > 0.0f;
    float4 blended = (float4)(0.0f);
    if (steps > 0) {
        const float2 moved = scatters && has_velocity ? velocity[pixel] : (float2)(0.0f);
        const int2 past = (int2)(reproject(x, moved.x), reproject(y, moved.y));
        const bool on_screen = scatters && past.x >= 0 && past.x < width && past.y >= 0 && past.y < height;
        TRACE(1, scatters, 0, y, x)
        TRACE(1, scatters, 0, y, x)
        TRACE(1, on_screen, 0, past.y, past.x)
        if (scatters) {
            const float z = depth[pixel];
            const float4 old = on_screen ? vload_half4(past.y * width + past.x, old_history) : (float4)(0.0f);
            const float scalar =
                0.3f * poly_gamma(colour.x) + 0.59f * poly_gamma(colour.y) + 0.11f * poly_gamma(colour.z);

            // No history: the target variance, and this frame alone.
            blended = (float4)(colour.w, z, sigma0_sq, scalar);
            if (has_history(old, z)) {
                const float difference = scalar - old.w;
                blended.x = (1.0f - alpha) * old.x + alpha * colour.w;
                blended.z = (1.0f - alpha) * old.z + alpha * (1.0f - alpha) * (difference * difference);
                blended.w = (1.0f - alpha) * old.w + alpha * scalar;
            }
        }
    }
    if (inside) {
        store_half(resolved, pixel, (float4)(colour.xyz, scatters ? 1.0f : 0.0f));
        store_half(history, pixel, blended);
    }
    TRACE(1, inside, 0, y, x)
    TRACE(1, inside, 0, y, x)
}
