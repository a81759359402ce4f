// Classify: what becomes of each 8x8 tile. A work-group is a tile of two warps, which find its
// number of scattering pixels, the sum of their counts, the nearest depth and the largest importance
// in local memory. Tiles that no later pass works on get their result here; all but those that will
// be filtered get the setup texel as their line of the filter's second pass.
#define EMPTY 0u
#define PASSTHROUGH 1u
#define SEPARABLE 2u
#define SAMPLED 3u
#define FAR_BITS 0x7f800000u

// Non-negative floats are ordered like their bits.
#define REDUCE(stride) \
    if (thread < (stride)) { \
        const uint4 mine = partial[thread], other = partial[thread + (stride)]; \
        partial[thread] = (uint4)(mine.xy + other.xy, min(mine.z, other.z), max(mine.w, other.w)); \
    } \
    barrier(CLK_LOCAL_MEM_FENCE);

// radius_at_cm: mean radius of the scatter in pixels at a depth of 1 cm. by_count, by_radius: whether
// the rule is one of the method's.
__kernel __attribute__((reqd_work_group_size(64, 1, 1))) void classify(
    WARP_ARGS, __global const ushort *setup_texture, __global const ushort *counts,
    __global const float2 *velocity, __global const uchar *importance, __global uchar *tile_class,
    __global half *tex, __global half *scattered, const int has_velocity, const int fixed_count,
    const int by_count, const int by_radius, const float count_threshold, const float radius_threshold,
    const uint importance_threshold, const float passthrough, const float radius_at_cm TRACE_ARGS)
{
    __local uint4 partial[64];
    const uint thread = (uint)get_local_id(0);
    const uint lane = thread & 31u;
    const uint warp = first_warp + 2u * (uint)get_group_id(0) + (thread >> 5);
    const int steps = warp_steps[warp];
    FIND_ROW
    const uint tile = tiles[(first_warp >> 1) + (uint)get_group_id(0)];
    const int tile_x = (int)(tile & 0xffffu), tile_y = (int)(tile >> 16);
    const uint slot = lane_xy[thread];
    const int x = tile_x * 8 + (int)(slot & 7u);
    const int y = tile_y * 8 + (int)(slot >> 3);
    const bool inside = x < width && y < height;
    const uint pixel = inside ? (uint)(y * width + x) : 0u;
    const uint own = inside ? setup_index(0, y, x, width, height) : 0u;

    const float4 texel = inside ? load_setup(setup_texture, own) : (float4)(0.0f);
    const bool scatters = texel.w > 0.0f;
    TRACE(steps >= 0, inside, 0, y, x)
#if ADAPTIVE
    const uint count = scatters ? counts[warp * 32u + lane] : 0u;
#if TRACED
    if (by_count) {
        const float2 moved = scatters && has_velocity ? velocity[pixel] : (float2)(0.0f);
        const int2 past = (int2)(reproject(x, moved.x), reproject(y, moved.y));
        const bool on_screen = scatters && past.x >= 0 && past.x < width && past.y >= 0 && past.y < height;
        TRACE(steps > 0, scatters, 0, y, x)
        TRACE(steps > 0, on_screen, 0, past.y, past.x)
    }
#endif
#else
    const uint count = scatters ? (uint)fixed_count : 0u;
#endif
#if PAINTED
    const uint painted = scatters ? importance[pixel] : 0u;
    TRACE(steps > 0, scatters, 0, y, x)
#else
    const uint painted = 0u;
#endif

    // Reduce over the tile.
    partial[thread] = (uint4)(scatters ? 1u : 0u, count, scatters ? as_uint(texel.w) : FAR_BITS, painted);
    barrier(CLK_LOCAL_MEM_FENCE);
    REDUCE(32u)
    REDUCE(16u)
    REDUCE(8u)
    REDUCE(4u)
    REDUCE(2u)
    REDUCE(1u)
    const uint4 whole_tile = partial[0];

    // Decide.
    const float radius = radius_at_cm / as_float(whole_tile.z);
    const float allowed = count_threshold * (float)whole_tile.x;
    const bool sampled = (by_count && (float)whole_tile.y > allowed) ||
                         (by_radius && radius > radius_threshold) ||
                         (PAINTED && whole_tile.w >= importance_threshold);
    const uint found = whole_tile.x == 0u     ? EMPTY
                       : radius < passthrough ? PASSTHROUGH
                       : sampled              ? SAMPLED
                                              : SEPARABLE;

    // Store.
    const bool first = thread == 0u;
    if (first)
        tile_class[tile_y * ((width + 7) / 8) + tile_x] = (uchar)found;
    TRACE(steps >= 0, first, 0, tile_y, tile_x)
    const bool is_line = inside && found != SEPARABLE;
    if (is_line)
        store_setup(tex, pixel, texel);
    TRACE(steps >= 0, is_line, 0, y, x)
    const bool is_result = inside && (found == EMPTY || found == PASSTHROUGH);
    if (is_result)
        store_half(scattered, pixel, (float4)(texel.xyz, scatters ? 1.0f : 0.0f));
    TRACE(steps >= 0, is_result, 0, y, x)
}
