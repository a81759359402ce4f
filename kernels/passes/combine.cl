// Combine: scattered light times albedo, plus everything that does not scatter.
PASS_KERNEL combine(
    WARP_ARGS, __global const half *scene_colour, __global const uchar *profile_id,
    __global const half *scattered, __global const half *albedo, __global half *output TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const uint pixel = inside ? (uint)(y * width + x) : 0u;
    const bool scatters = inside && profile_id[pixel] > 0;
    TRACE(1, inside, 0, y, x)
    TRACE(1, inside, 0, y, x)
    if (steps > 0) {
        TRACE(1, scatters, 0, y, x)
        TRACE(1, scatters, 0, y, x)
    }
    if (inside) {
        float4 colour = vload_half4(pixel, scene_colour);
        if (scatters)
            colour += vload_half4(pixel, scattered) * vload_half4(pixel, albedo);
        store_half(output, pixel, (float4)(colour.xyz, 1.0f));
    }
    TRACE(1, inside, 0, y, x)
}
