// Patch: colour, normal and profile id of a tile and of a border of one texel, which its two warps
// load once and keep in local memory for the samples that land there.
//
// Values are the same with and without: where work-items hold several lanes (CPUs), which have no
// local memory of their own, samples are read as ever and the trace alone says what would be
// fetched.
#ifndef PATCH
#define PATCH 0
#endif
#define PATCH_IS_LOCAL (PATCH && WIDTH == 1)

#if PATCH
#define PATCH_SIDE 10
#define PATCH_TEXELS 100
#if WIDTH == 1
#define LANE_NUMBERS 0
#else
#define LANE_NUMBERS (int8)(0, 1, 2, 3, 4, 5, 6, 7)
#endif

#if PATCH_IS_LOCAL
#define DECLARE_PATCH \
    __local uint patch_low[PATCH_TEXELS], patch_high[PATCH_TEXELS], patch_normals[PATCH_TEXELS]; \
    __local uchar patch_ids[PATCH_TEXELS];
#if NORMAL_WEIGHTS
#define KEEP_NORMAL(of_normal) patch_normals[number] = of_normal[at];
#else
#define KEEP_NORMAL(of_normal)
#endif
#define KEEP(of_setup, of_normal, of_id) \
    if (exists) { \
        const int at = row * width + column; \
        const int words = find_words(0, row, column, width, height); \
        patch_low[number] = of_setup[words]; \
        patch_high[number] = of_setup[words + 1]; \
        KEEP_NORMAL(of_normal) \
        patch_ids[number] = of_id[at]; \
    }
#define AWAIT_PATCH barrier(CLK_LOCAL_MEM_FENCE);
#else
#define DECLARE_PATCH
#define KEEP(of_setup, of_normal, of_id)
#define AWAIT_PATCH
#endif

// Texels are numbered row by row; each thread of the tile loads its own number and the one 64 on.
#define LOAD_PATCH(first_number, of_setup, of_normal, of_id) \
    if (tile_steps > 0) { \
        const whole number = (int)(((warp & 1u) << 5 | lane) + (first_number)) + LANE_NUMBERS; \
        const whole row = patch_top + number / PATCH_SIDE; \
        const whole column = patch_left + number % PATCH_SIDE; \
        const whole exists = (number < PATCH_TEXELS) & (row >= 0) & (row < height) & (column >= 0) & \
                             (column < width); \
        KEEP(of_setup, of_normal, of_id) \
        TRACE_LANES(TRACE_COLOUR, exists, pack_texels(zero, row, column)) \
        TRACE_LANES(TRACE_NORMAL && NORMAL_WEIGHTS, exists, pack_texels(zero, row, column)) \
        TRACE_LANES(TRACE_PROFILE_ID, exists, pack_texels(zero, row, column)) \
    }
#endif
