// What every pass shares: the lane's pixel, the texel stores of the half-float textures, and the
// trace rows.
//
// One work group of 32 work-items is one warp; two warps are the 8x8 tile of one CTA. warp_steps
// holds, per warp, -1 where all lanes lie outside the frame, 0 where none scatters, else the steps
// of its hungriest lane (1 where a pass has no loop).

#define PASS_KERNEL __kernel __attribute__((reqd_work_group_size(32, 1, 1))) void

#define WARP_ARGS \
    const uint first_warp, __global const int *warp_steps, __global const uint *tiles, \
    __global const uchar *lane_xy, const int width, const int height

// Declares warp, steps, lane, x, y and inside; leaves where the whole warp is outside.
#define FIND_PIXEL \
    const uint warp = first_warp + (uint)get_group_id(0); \
    const int steps = warp_steps[warp]; \
    if (steps < 0) \
        return; \
    const uint lane = (uint)get_local_id(0); \
    const uint tile = tiles[warp >> 1]; \
    const uint slot = lane_xy[((warp & 1u) << 5) | lane]; \
    const int x = (int)((tile & 0xffffu) * 8u + (slot & 7u)); \
    const int y = (int)((tile >> 16) * 8u + (slot >> 3)); \
    const bool inside = x < width && y < height;

// A row's slot follows from (warp, step): rows of a warp are counted up in program order, by all of
// its lanes alike.
#if TRACED
#define TRACE_ARGS , __global uint *lanes, __global const uint *row_of_warp, const uint first_row
#define FIND_ROW size_t slot_of_row = (size_t)(row_of_warp[warp] - first_row) * 32 + lane;
#define TRACE(is_traced, active, mip, texel_y, texel_x) \
    if (is_traced) { \
        lanes[slot_of_row] = (active) ? pack_texel(mip, texel_y, texel_x) : 0xffffffffu; \
        slot_of_row += 32; \
    }
#else
#define TRACE_ARGS
#define FIND_ROW
#define TRACE(is_traced, active, mip, texel_y, texel_x)
#endif

#define HALF_MAX 65504.0f
#define HALF_NORMAL_MIN 0x1p-14f

uint pack_texel(uint mip, int texel_y, int texel_x)
{
    return (mip << 28) | ((uint)texel_y << 14) | (uint)texel_x;
}

// Level 0 fills the left of the buffer, the further levels stand below each other to its right.
uint setup_index(uint level, int texel_y, int texel_x, int width, int height)
{
    const uint pitch = (uint)(width + (width >> 1));
    const uint below = level > 0u ? (uint)(height - (height >> (level - 1u))) : 0u;
    const uint right = level > 0u ? (uint)width : 0u;
    return ((uint)texel_y + below) * pitch + (uint)texel_x + right;
}

// Setup texels are non-negative and hold no half-float denormals, so that they decode with a shift
// and a product.
float4 load_setup(__global const ushort *setup, uint index)
{
    return as_float4(convert_uint4(vload4(index, setup)) << 13) * 0x1p112f;
}

void store_setup(__global half *setup, uint index, float4 value)
{
    value = min(value, (float4)(HALF_MAX));
    value = select(value, (float4)(0.0f), value < (float4)(HALF_NORMAL_MIN));
    vstore_half4_rte(value, index, setup);
}

void store_half(__global half *texture, uint index, float4 value)
{
    value = select(value, (float4)(HALF_MAX), value > (float4)(HALF_MAX));
    value = select(value, (float4)(-HALF_MAX), value < (float4)(-HALF_MAX));
    vstore_half4_rte(value, index, texture);
}

// One coordinate of the pixel that showed this surface in the previous frame; nearest, it may lie
// outside the frame.
whole reproject(whole at, real velocity)
{
    const real past = at_most(at_least(to_real(at) + 0.5f + velocity, (real)(-1.0f)), (real)(32768.0f));
    return to_whole(floor(past));
}

// Whether a history texel (mean count, depth, variance, mean) belongs to a surface at this depth:
// within a tenth of it.
bool has_history(float4 history, float depth)
{
    const float difference = history.y - depth;
    return history.y > 0.0f && (difference < 0.0f ? -difference : difference) <= 0.1f * depth;
}
