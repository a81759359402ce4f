// Dense evaluation: every texel that the profile reaches around a pixel, weighted with the profile
// over its own area. One work-item is one pixel; WIDTH texels of a row at a time.
//
// Legend: r distance on the screen in mm, dz difference in depth in mm; rate = -1 / (3 d) and
// density = 1 / (4 d) of red, green and blue; mm: a texel's side.

#define MM_PER_CM 10.0f
#define NEAREST 1       // texels to each side of the pixel that are divided finely
#define NEAR 6          // ... and those that are divided coarsely; the others are taken whole
#define FINE 32
#define COARSE 8
// Planes of floats, one behind the other.
#define RED 0
#define DEPTH 3
#define NORMAL 4
#define LOAD(plane) vload8(0, planes + (size_t)(plane) * size + at)
#define NONE ((real)(0.0f))

typedef struct {
    real sum[3], total[3];
} sums;

// Add points of equal area at distances (x, y) in mm; `counts` is not 0 where a lane's point counts.
void add_points(sums *found, real x, real y, float least, real dz, real kind, whole counts,
                const float *rate, const float *density, const real *colour)
{
    const real squared = x * x + y * y;
    const real r = sqrt(squared);
    counts &= r > least;
#if BILATERAL
    const real reach = sqrt(squared + dz * dz);
#else
    const real reach = r;
#endif
    // Densities of the radius become densities of the area.
    const real common = counts ? kind / r : NONE;
    for (int c = 0; c < 3; ++c) {
        const real weight = burley(reach * rate[c], 1.0f, 1.0f) * density[c] * common;
        found->sum[c] += weight * colour[c];
        found->total[c] += weight;
    }
}

float add_lanes(real value)
{
    const float4 half_sum = value.lo + value.hi;
    return (half_sum.x + half_sum.y) + (half_sum.z + half_sum.w);
}

// pixels: x and y of each work-item's pixel. planes: red, green, blue, depth in cm (0 where nothing
// scatters), normal x, y, z; of `rows` rows of `pitch` texels, `margin` of them around the frame.
// result: red, green, blue of each work-item's scattered light.
__kernel void dense(__global const int2 *pixels, __global const float *planes, const int pitch,
                    const int rows, const int margin, const float texels_per_mm_at_cm,
                    const float reach_mm, const float rate_r, const float rate_g, const float rate_b,
                    const float density_r, const float density_g, const float density_b,
                    __global float *result)
{
    const size_t item = get_global_id(0), size = (size_t)pitch * rows;
    const int2 pixel = pixels[item] + margin;
    const size_t centre = (size_t)pixel.y * pitch + pixel.x;
    const float rate[3] = {rate_r, rate_g, rate_b}, density[3] = {density_r, density_g, density_b};
    const real lane = (real)(0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f);

    const float depth = planes[DEPTH * size + centre];
    const float normal_x = planes[NORMAL * size + centre];
    const float normal_y = planes[(NORMAL + 1) * size + centre];
    const float normal_z = planes[(NORMAL + 2) * size + centre];
    const float mm = depth / texels_per_mm_at_cm;
    const int reach = (int)ceil(reach_mm / mm);

    sums found;
    for (int c = 0; c < 3; ++c)
        found.sum[c] = found.total[c] = NONE;
    for (int dy = -reach; dy <= reach; ++dy) {
        sums row;
        for (int c = 0; c < 3; ++c)
            row.sum[c] = row.total[c] = NONE;
        const int half_row = (int)sqrt((float)reach * reach - (float)dy * dy);
        for (int dx = -half_row; dx <= half_row; dx += WIDTH) {
            const size_t at = (size_t)(pixel.y + dy) * pitch + (pixel.x + dx);
            const real colour[3] = {LOAD(RED), LOAD(RED + 1), LOAD(RED + 2)};
            const real depths = LOAD(DEPTH);
            const real texel = (float)dx + lane;
            const real near = fabs(texel);
            whole counts = (depths > 0.0f) & (texel <= (float)half_row);
            if (abs(dy) <= NEAR)
                counts &= near > (float)NEAR;
            real kind = 1.0f;
#if NORMAL_WEIGHTS
            const real cosine =
                LOAD(NORMAL) * normal_x + LOAD(NORMAL + 1) * normal_y + LOAD(NORMAL + 2) * normal_z;
            kind = sqrt(clamp(0.5f + 0.5f * cosine, 0.0f, 1.0f));
#endif
            add_points(&row, texel * mm, (real)(dy * mm), mm, (depths - depth) * MM_PER_CM,
                       kind * (mm * mm), counts, rate, density, colour);
        }
        for (int c = 0; c < 3; ++c) {
            found.sum[c] += row.sum[c];
            found.total[c] += row.total[c];
        }
    }

    // Near the pixel the profile changes within a texel, and the circle around it, within which its
    // own light counts, cuts its neighbours.
    for (int dy = -NEAR; dy <= NEAR; ++dy) {
        for (int dx = -NEAR; dx <= NEAR; ++dx) {
            const size_t at = centre + (long)dy * pitch + dx;
            const float other = planes[DEPTH * size + at];
            if (other <= 0.0f)
                continue;
            const real colour[3] = {(real)(planes[at]), (real)(planes[size + at]),
                                    (real)(planes[2 * size + at])};
            float kind = 1.0f;
#if NORMAL_WEIGHTS
            const float cosine = planes[NORMAL * size + at] * normal_x +
                                 planes[(NORMAL + 1) * size + at] * normal_y +
                                 planes[(NORMAL + 2) * size + at] * normal_z;
            kind = sqrt(clamp(0.5f + 0.5f * cosine, 0.0f, 1.0f));
#endif
            const int parts = max(abs(dx), abs(dy)) <= NEAREST ? FINE : COARSE;
            const float step = mm / parts;
            sums texel;
            for (int c = 0; c < 3; ++c)
                texel.sum[c] = texel.total[c] = NONE;
            for (int j = 0; j < parts; ++j)
                for (int i = 0; i < parts; i += WIDTH)
                    add_points(&texel, (dx - 0.5f) * mm + ((float)i + lane + 0.5f) * step,
                               (real)((dy - 0.5f) * mm + (j + 0.5f) * step), mm,
                               (real)((other - depth) * MM_PER_CM), (real)(kind * (step * step)),
                               (whole)(-1), rate, density, colour);
            for (int c = 0; c < 3; ++c) {
                found.sum[c] += texel.sum[c];
                found.total[c] += texel.total[c];
            }
        }
    }

    for (int c = 0; c < 3; ++c) {
        const float own = planes[c * size + centre];
        const real at_centre = mm * rate[c];
        const float beyond = burley(at_centre, 0.75f, 0.25f).s0;
        const float sum = add_lanes(found.sum[c]);
#if SELF_NORMALISED
        const float total = add_lanes(found.total[c]);
        const float mean = total > 0.0f ? sum / total : own;
        result[3 * item + c] = mean + (own - mean) * (1.0f - beyond);
#else
        // The sum is over the whole circle, the densities are per radius.
        result[3 * item + c] = sum * (0.5f / M_PI_F) + own * (1.0f - beyond);
#endif
    }
}
