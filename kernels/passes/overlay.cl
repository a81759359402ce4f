// Overlay: something transparent drawn over the finished picture, which no earlier pass knows of.
// Its texels hold colour and opacity; 0 draws nothing.
PASS_KERNEL overlay(
    WARP_ARGS, __global const half *overlay_texture, __global half *output, const int has_overlay TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const uint pixel = inside ? (uint)(y * width + x) : 0u;
    const float4 over = inside && has_overlay ? vload_half4(pixel, overlay_texture) : (float4)(0.0f);
    const bool covered = over.w > 0.0f;
    TRACE(1, inside, 0, y, x)
    TRACE(1, covered, 0, y, x)
    if (covered) {
        const float4 colour = vload_half4(pixel, output) * (1.0f - over.w) + over * over.w;
        store_half(output, pixel, (float4)(colour.xyz, 1.0f));
    }
    TRACE(1, covered, 0, y, x)
}
