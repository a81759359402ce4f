// For passes whose work-items hold WIDTH lanes of a warp: the lanes' pixels, half-float texels as
// words, and the trace rows.

// A launch over a list reads its tile from there: entry number CTA.
#define CTA ((int)(warp >> 1))
#define TILES_ACROSS ((width + 7) / 8)

// Declares warp, steps, lane, x, y, inside and pixel (0 outside), and the constants zero and none;
// leaves where the whole warp is outside.
#if WIDTH == 1
#define LOAD_SLOTS lane_xy[((warp & 1u) << 5) | lane]
#else
#define LOAD_SLOTS convert_int8(vload8(0, lane_xy + (((warp & 1u) << 5) | lane)))
#endif
// With a patch a work-group is a tile, in which a warp that is outside helps the other: it leaves
// later, and tile_steps is the larger of both warps'.
#if PATCH_IS_LOCAL
#define GROUP_ITEMS 64
#define FIND_WARP \
    const uint warp = first_warp + 2u * (uint)get_group_id(0) + ((uint)get_local_id(0) >> 5); \
    const uint lane = (uint)get_local_id(0) & 31u;
#else
#define GROUP_ITEMS (32 / WIDTH)
#define FIND_WARP \
    const uint warp = first_warp + (uint)get_group_id(0); \
    const uint lane = (uint)get_local_id(0) * WIDTH;
#endif
#if PATCH
#define LEAVE_OUTSIDE const int tile_steps = max(steps, warp_steps[warp ^ 1u]);
#else
#define LEAVE_OUTSIDE \
    if (steps < 0) \
        return;
#endif
#define FIND_LANES \
    FIND_WARP \
    const int steps = warp_steps[warp]; \
    LEAVE_OUTSIDE \
    FIND_ROW \
    const uint tile = tiles[warp >> 1]; \
    const whole zero = 0; \
    const real none = 0.0f; \
    const whole slot = LOAD_SLOTS; \
    const whole x = (int)(tile & 0xffffu) * 8 + (slot & 7); \
    const whole y = (int)(tile >> 16) * 8 + (slot >> 3); \
    const whole inside = (x < width) & (y < height); \
    const whole pixel = inside ? y * width + x : zero; \
    TRACE_LANES(LISTED && steps >= 0, zero == zero, pack_texels(zero, zero + CTA / TILES_ACROSS, zero + CTA % TILES_ACROSS))

// A non-negative half float from the low 16 bits; no denormals.
real decode_half(word bits)
{
    return as_real((bits & 0xffffu) << 13) * 0x1p112f;
}

// Where a texel of the setup texture stands, in words; setup_index of common.cl for WIDTH lanes.
whole find_words(whole level, whole texel_y, whole texel_x, int width, int height)
{
    const whole zero = 0;
    const whole below = level > 0 ? height - (((whole)height) >> (level - 1)) : zero;
    const whole right = level > 0 ? (whole)width : zero;
    return 2 * ((texel_y + below) * (width + (width >> 1)) + texel_x + right);
}

word pack_texels(whole mip, whole texel_y, whole texel_x)
{
    return as_word((mip << 28) | (texel_y << 14) | texel_x);
}

#if TRACED
#if WIDTH == 1
#define STORE_ROW(texels) lanes[slot_of_row] = (texels);
#else
#define STORE_ROW(texels) vstore8((texels), 0, lanes + slot_of_row);
#endif
#define TRACE_LANES(is_traced, active, texels) \
    if (is_traced) { \
        STORE_ROW((active) ? (texels) : (word)(0xffffffffu)) \
        slot_of_row += 32; \
    }
#else
#define TRACE_LANES(is_traced, active, texels)
#endif
