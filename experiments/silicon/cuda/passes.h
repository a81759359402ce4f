// The passes of adaptive filtered importance sampling, written over a path: what fetches and stores
// texels. One CTA of 64 threads shades a tile of 8x8 pixels, row by row, so that a warp is 8x4 pixels;
// tiles go in raster order. The fetches of a warp, and their order, are those of the OpenCL kernels.
#pragma once
#include "maths.h"

#define PDF_MIN 1e-5f
#define RADIUS_MIN 1e-5f
#define MM_PER_CM 10.0f
#define MAX_LEVELS 6

// A texture of one level as (what fetches, what stores); of which kind is the path's matter.
struct Image {
    u64 fetch;
    u64 store;
};

// The setup texture's levels. fetch: of all levels, by point; filtered: bilinear (texture path alone).
// level, pitch: of each level, what stores it, or its first byte and the bytes of a row.
struct Levels {
    u64 fetch;
    u64 filtered;
    u64 level[MAX_LEVELS];
    u64 pitch[MAX_LEVELS];
};

// In constant memory and no argument: compilers would copy an argument that is indexed at run time to
// local memory, whose loads and stores the L1 would count.
CONSTANT Levels setup_levels;

// What one picture fixes. rate, density: -1 / (3 d) and 1 / (4 d) of red, green, blue and the sampled
// channel. ratio: width and height of each level over level 0's. texel: 1 / width and 1 / height of it.
struct Constants {
    int width, height, num_levels, fixed_count;
    u32 frame;
    float texels_per_mm_at_cm, d, mip_scale, alpha, sigma0_sq;
    float rate[4], density[4];
    float ratio[2 * MAX_LEVELS], texel[2 * MAX_LEVELS];
};

struct Colour {
    float r, g, b, a;
};

DEVICE Colour make_colour(float r, float g, float b, float a)
{
    Colour made;
    made.r = r;
    made.g = g;
    made.b = b;
    made.a = a;
    return made;
}

// As half floats: kept within their range.
DEVICE ushort4 encode(Colour value)
{
    ushort4 bits;
    bits.x = float_to_half(at_most(at_least(value.r, -HALF_MAX), HALF_MAX));
    bits.y = float_to_half(at_most(at_least(value.g, -HALF_MAX), HALF_MAX));
    bits.z = float_to_half(at_most(at_least(value.b, -HALF_MAX), HALF_MAX));
    bits.w = float_to_half(at_most(at_least(value.a, -HALF_MAX), HALF_MAX));
    return bits;
}

DEVICE float clean(float value)
{
    const float finite = at_most(value, HALF_MAX);
    return finite < HALF_NORMAL_MIN ? 0.0f : finite;
}

// As texels of the setup texture: no denormals, nothing negative.
DEVICE ushort4 encode_setup(Colour value)
{
    return encode(make_colour(clean(value.r), clean(value.g), clean(value.b), clean(value.a)));
}

// The pixel of this thread, and whether it lies in a frame of this size.
DEVICE bool find_pixel(int width, int height, int *x, int *y)
{
    const int across = (width + 7) / 8;
    const int tile = (int)blockIdx.x, thread = (int)threadIdx.x;
    *x = tile % across * 8 + (thread & 7);
    *y = tile / across * 8 + (thread >> 3);
    return *x < width && *y < height;
}

template <class Path>
DEVICE void run_setup(const Constants &c, Image scene_light, Image depth, Image gbuffer_id,
                      Image profile_id)
{
    int x, y;
    if (!find_pixel(c.width, c.height, &x, &y))
        return;
    const u32 id = Path::fetch_byte(gbuffer_id, x, y);
    const float z = Path::fetch_float(depth, x, y);
    Colour texel = make_colour(0.0f, 0.0f, 0.0f, 0.0f);
    const bool scatters = id > 0u && z > 0.0f;
    if (scatters) {
        texel = Path::fetch_colour(scene_light, x, y);
        texel.a = z < HALF_NORMAL_MIN ? HALF_NORMAL_MIN : z;
    }
    Path::store_level(0, x, y, encode_setup(texel));
    Path::store_byte(profile_id, x, y, scatters ? id : 0u);
}

// Four fetches and the filter in float32: what the OpenCL kernel computes.
template <class Path> DEVICE void run_prefilter(const Constants &c, int source)
{
    const int source_width = c.width >> source, source_height = c.height >> source;
    const int width = c.width >> (source + 1), height = c.height >> (source + 1);
    int x, y;
    if (!find_pixel(width, height, &x, &y))
        return;
    int right, below;
    float weight_x, weight_y;
    const int left = find_tap(x, source_width, width, &right, &weight_x);
    const int above = find_tap(y, source_height, height, &below, &weight_y);
    const Colour p = Path::fetch_level(c, source, left, above);
    const Colour q = Path::fetch_level(c, source, right, above);
    const Colour r = Path::fetch_level(c, source, left, below);
    const Colour s = Path::fetch_level(c, source, right, below);
#define FILTER(channel) \
    ((p.channel * (1.0f - weight_x) + q.channel * weight_x) * (1.0f - weight_y) + \
     (r.channel * (1.0f - weight_x) + s.channel * weight_x) * weight_y)
    const Colour filtered = make_colour(FILTER(r), FILTER(g), FILTER(b), FILTER(a));
#undef FILTER
    Path::store_level(source + 1, x, y, encode_setup(filtered));
}

// What one scattering pixel gathers from around it. centre: its own texel of the setup texture.
template <class Path>
DEVICE Colour gather(const Constants &c, Image normal, Image profile_id, int x, int y, Colour centre, u32 centre_normal,
                     int count)
{
    const float texels_per_mm = c.texels_per_mm_at_cm / centre.a;
    const float mip_factor = c.mip_scale * (float)count / (texels_per_mm * texels_per_mm);
    const float radius_centre = 1.0f / texels_per_mm;
    const float beyond_r = burley(radius_centre * c.rate[0], 0.75f, 0.25f);
    const float beyond_g = burley(radius_centre * c.rate[1], 0.75f, 0.25f);
    const float beyond_b = burley(radius_centre * c.rate[2], 0.75f, 0.25f);
    const float beyond_s = burley(radius_centre * c.rate[3], 0.75f, 0.25f);
    const float unit = 0x1p-24f * beyond_s;
    const float middle_x = (float)x + 0.5f, middle_y = (float)y + 0.5f;
    const float right = (float)c.width - 0.5f, bottom = (float)c.height - 0.5f;
    const u32 start = pcg3d16((u32)x, (u32)y, c.frame);
    float sum_r = 0.0f, sum_g = 0.0f, sum_b = 0.0f;
    float total_r = 0.0f, total_g = 0.0f, total_b = 0.0f;

    for (int i = 0; i < count; ++i) {
        // Sample a radius and a direction.
        const u32 index = start + (u32)i;
        const float complement = (float)(int)(0x1000000u - ((index * R2_X) >> 8)) * unit;
        float cosine, sine;
        poly_cos_sin(index * R2_Y, &cosine, &sine);
        const float r = at_least(c.d * invert_cdf(complement), RADIUS_MIN);
        const float p = at_least(burley(r * c.rate[3], 1.0f, 1.0f) * c.density[3], PDF_MIN);

        // Find the texel.
        const float reach_texels = r * texels_per_mm;
        const float at_x = at_most(at_least(middle_x + reach_texels * cosine, 0.5f), right);
        const float at_y = at_most(at_least(middle_y + reach_texels * sine, 0.5f), bottom);
        const int texel_x = (int)at_x, texel_y = (int)at_y;
        const int level = find_level(p * mip_factor, c.num_levels);
        const int level_x = (int)(at_x * c.ratio[2 * level]);
        const int level_y = (int)(at_y * c.ratio[2 * level + 1]);

        // Fetch.
        const Colour texel = Path::fetch_level(c, level, level_x, level_y);
        const u32 sample_normal = Path::fetch_word(normal, texel_x, texel_y);
        const u32 id = Path::fetch_byte(profile_id, texel_x, texel_y);

        // Weigh.
        float common = id > 0u ? 1.0f / p : 0.0f;
        common *= sqrtf(half_cosine(sample_normal, centre_normal));
        const float dz = (texel.a - centre.a) * MM_PER_CM;
        const float reach = sqrtf(r * r + dz * dz);
        const float weight_r = burley(reach * c.rate[0], 1.0f, 1.0f) * c.density[0] * common;
        const float weight_g = burley(reach * c.rate[1], 1.0f, 1.0f) * c.density[1] * common;
        const float weight_b = burley(reach * c.rate[2], 1.0f, 1.0f) * c.density[2] * common;
        sum_r += weight_r * texel.r;
        sum_g += weight_g * texel.g;
        sum_b += weight_b * texel.b;
        total_r += weight_r;
        total_g += weight_g;
        total_b += weight_b;
    }

    float result_r = total_r > 0.0f ? sum_r / total_r : centre.r;
    float result_g = total_g > 0.0f ? sum_g / total_g : centre.g;
    float result_b = total_b > 0.0f ? sum_b / total_b : centre.b;
    result_r += (centre.r - result_r) * (1.0f - beyond_r);
    result_g += (centre.g - result_g) * (1.0f - beyond_g);
    result_b += (centre.b - result_b) * (1.0f - beyond_b);
    return make_colour(result_r, result_g, result_b, (float)count);
}

// counts: the count map, with a pixel's count as the first half float of its texel. The adaptive pass
// reads it in place of its history, at the pixel that the velocity points to.
template <class Path, bool Adaptive>
DEVICE void run_sampling(const Constants &c, Image normal, Image profile_id, Image velocity, Image counts,
                         Image scattered)
{
    int x, y;
    if (!find_pixel(c.width, c.height, &x, &y))
        return;
    const Colour centre = Path::fetch_level(c, 0, x, y);
    Colour result = make_colour(0.0f, 0.0f, 0.0f, 0.0f);
    if (centre.a > 0.0f) {
        const u32 centre_normal = Path::fetch_word(normal, x, y);
        int count = c.fixed_count;
        if (Adaptive) {
            const float2 moved = Path::fetch_pair(velocity, x, y);
            const int past_x = reproject(x, moved.x), past_y = reproject(y, moved.y);
            count = 0;
            if (past_x >= 0 && past_x < c.width && past_y >= 0 && past_y < c.height)
                count = (int)Path::fetch_colour(counts, past_x, past_y).r;
        }
        if (count > 0)
            result = gather<Path>(c, normal, profile_id, x, y, centre, centre_normal, count);
    }
    Path::store_colour(scattered, x, y, encode(result));
}

template <class Path>
DEVICE void run_update(const Constants &c, Image scattered, Image velocity, Image depth, Image old_history,
                       Image resolved, Image history)
{
    int x, y;
    if (!find_pixel(c.width, c.height, &x, &y))
        return;
    const Colour colour = Path::fetch_colour(scattered, x, y);
    const bool scatters = colour.a > 0.0f;
    Colour blended = make_colour(0.0f, 0.0f, 0.0f, 0.0f);
    if (scatters) {
        const float2 moved = Path::fetch_pair(velocity, x, y);
        const int past_x = reproject(x, moved.x), past_y = reproject(y, moved.y);
        const float z = Path::fetch_float(depth, x, y);
        Colour old = make_colour(0.0f, 0.0f, 0.0f, 0.0f);
        if (past_x >= 0 && past_x < c.width && past_y >= 0 && past_y < c.height)
            old = Path::fetch_colour(old_history, past_x, past_y);
        const float scalar =
            0.3f * poly_gamma(colour.r) + 0.59f * poly_gamma(colour.g) + 0.11f * poly_gamma(colour.b);
        blended = make_colour(colour.a, z, c.sigma0_sq, scalar);
        const float distance = old.g - z;
        if (old.g > 0.0f && (distance < 0.0f ? -distance : distance) <= 0.1f * z) {
            const float difference = scalar - old.a;
            blended.r = (1.0f - c.alpha) * old.r + c.alpha * colour.a;
            blended.b = (1.0f - c.alpha) * old.b + c.alpha * (1.0f - c.alpha) * (difference * difference);
            blended.a = (1.0f - c.alpha) * old.a + c.alpha * scalar;
        }
    }
    Path::store_colour(resolved, x, y, encode(make_colour(colour.r, colour.g, colour.b, scatters ? 1.0f : 0.0f)));
    Path::store_colour(history, x, y, encode(blended));
}

template <class Path>
DEVICE void run_combine(const Constants &c, Image scene_colour, Image profile_id, Image scattered, Image albedo,
                        Image output)
{
    int x, y;
    if (!find_pixel(c.width, c.height, &x, &y))
        return;
    const bool scatters = Path::fetch_byte(profile_id, x, y) > 0u;
    Colour colour = Path::fetch_colour(scene_colour, x, y);
    if (scatters) {
        const Colour light = Path::fetch_colour(scattered, x, y);
        const Colour base = Path::fetch_colour(albedo, x, y);
        colour.r += light.r * base.r;
        colour.g += light.g * base.g;
        colour.b += light.b * base.b;
    }
    colour.a = 1.0f;
    Path::store_colour(output, x, y, encode(colour));
}
