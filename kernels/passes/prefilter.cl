// Pre-filter: one level of the setup texture's mip chain, a bilinear tap of the finer level at each
// texel's centre. width and height are the destination level's.

// The texel left of the centre of destination texel `at`, and the weight of its right neighbour,
// from integers alone.
int2 find_tap(int at, int source_size, int size, float *weight)
{
    const int twice = (2 * at + 1) * source_size - size;  // (centre in source texels - 1/2) * 2 size
    const int left = twice / (2 * size);
    *weight = (float)(twice - left * 2 * size) / (float)(2 * size);
    return (int2)(left, min(left + 1, source_size - 1));
}

#define LOAD(texel_y, texel_x) \
    load_setup(setup_texture, setup_index(source_level, texel_y, texel_x, full_width, full_height))

PASS_KERNEL prefilter(
    WARP_ARGS, __global ushort *setup_texture, const uint source_level, const int full_width,
    const int full_height TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const int source_width = full_width >> source_level;
    const int source_height = full_height >> source_level;
    float weight_x, weight_y;
    const int2 taps_x = find_tap(inside ? x : 0, source_width, width, &weight_x);
    const int2 taps_y = find_tap(inside ? y : 0, source_height, height, &weight_y);
    TRACE(1, inside, source_level, taps_y.x, taps_x.x)
    if (inside) {
        const float4 a = LOAD(taps_y.x, taps_x.x);
        const float4 b = LOAD(taps_y.x, taps_x.y);
        const float4 c = LOAD(taps_y.y, taps_x.x);
        const float4 d = LOAD(taps_y.y, taps_x.y);
        const float4 top = a * (1.0f - weight_x) + b * weight_x;
        const float4 bottom = c * (1.0f - weight_x) + d * weight_x;
        const uint target = setup_index(source_level + 1u, y, x, full_width, full_height);
        store_setup((__global half *)setup_texture, target, top * (1.0f - weight_y) + bottom * weight_y);
    }
    TRACE(1, inside, source_level + 1u, y, x)
}
