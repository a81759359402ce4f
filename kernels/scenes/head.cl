// Sphere tracing and lighting of the head. `head_start` marches one ray per tile, as a cone wide enough for all the
// tile's rays; `head_render` goes on from there for every pixel.

#define TILE 8
#define MAX_STEPS 192
#define MAX_SHADOW_STEPS 56
#define FAR_CM 1.0e6f
// Pixels larger than this (cm) do not make the surface any coarser.
#define COARSEST 0.15f

// The bust lies inside this sphere: rays that miss it see the background.
#define BOUND_CENTRE ((float3)(0.0f, -12.0f, -2.0f))
#define BOUND_RADIUS 27.0f

// Entry and exit of a ray through the bounding sphere; exit < entry where it misses. direction need not be a unit.
HEAD_INLINE float2 head_bounds(float3 origin, float3 direction, float widen)
{
    float3 o = origin - BOUND_CENTRE;
    float a = head_dot(direction, direction);
    float b = head_dot(o, direction);
    float radius = BOUND_RADIUS + widen;
    float c = head_dot(o, o) - radius * radius;
    float discriminant = b * b - a * c;
    if (discriminant <= 0.0f)
        return (float2)(0.0f, -1.0f);
    float root = head_root(discriminant);
    return (float2)(fmax(head_over(-b - root, a), 0.0f), head_over(-b + root, a));
}

HEAD_INLINE float3 head_direction(float4 right, float4 up, float4 forward, float x, float y)
{
    // .w of right and up: size of a pixel at unit distance; .w of forward is not used. x, y: pixels from the centre
    return forward.xyz + right.xyz * (x * right.w) + up.xyz * (y * up.w);
}

__kernel void head_start(float4 origin, float4 right, float4 up, float4 forward, int width, int height, int first_row,
                         int rows, int tiles_x, __global const float* restrict grid,
                         __global float* restrict start)
{
    int tile_x = get_global_id(0), tile_y = get_global_id(1);
    if (tile_x >= tiles_x || tile_y * TILE >= rows)
        return;
    float x = (float)(tile_x * TILE) + 0.5f * TILE - 0.5f * (float)width;
    float y = 0.5f * (float)height - ((float)(first_row + tile_y * TILE) + 0.5f * TILE);
    float3 direction = head_direction(right, up, forward, x, y);
    float inverse = head_over(1.0f, head_length(direction));
    // Radius of the cone around the tile at unit depth: half its diagonal, a little more for safety
    float spread = 0.75f * TILE * right.w;
    float2 range = head_bounds(origin.xyz, direction, 1.0f);
    float t = range.x;
    float result = range.y < range.x ? FAR_CM : t;
    if (range.y >= range.x) {
        for (int step = 0; step < MAX_STEPS; ++step) {
            float free = head_far(grid, origin.xyz + direction * t) - spread * t;
            if (free < 0.02f)
                break;
            t += free * 0.85f * inverse;
            if (t > range.y)
                break;
        }
        result = t > range.y ? FAR_CM : fmax(t - 0.05f, 0.0f);
    }
    start[tile_y * tiles_x + tile_x] = result;
}

HEAD_INLINE float3 head_normal(float3 p, float h)
{
    const float3 a = (float3)(1.0f, -1.0f, -1.0f), b = (float3)(-1.0f, -1.0f, 1.0f);
    const float3 c = (float3)(-1.0f, 1.0f, -1.0f), d = (float3)(1.0f, 1.0f, 1.0f);
    return head_unit(a * head_distance(p + a * h) + b * head_distance(p + b * h) + c * head_distance(p + c * h)
                     + d * head_distance(p + d * h));
}

// Share of a disc light of angular radius atan(radius) that is seen from p: the closest that the ray to its centre
// comes to the surface, in units of the disc's cone there, from -1 (all hidden) to 1 (all seen).
HEAD_INLINE float head_shadow(__global const float* restrict grid, float3 p, float3 to_light, float radius)
{
    float closest = 1.0f;
    float t = 0.06f;
    for (int step = 0; step < MAX_SHADOW_STEPS; ++step) {
        float d = head_far(grid, p + to_light * t);
        closest = fmin(closest, head_over(d, t * radius));
        if (closest < -1.0f || t > 26.0f)
            break;
        t += fmin(fmax(fabs(d), 0.03f + 0.03f * t), 6.0f);
    }
    closest = fmax(closest, -1.0f);
    return 0.25f * (1.0f + closest) * (1.0f + closest) * (2.0f - closest);
}

// Ambient occlusion from the field's value at a few heights above the surface.
HEAD_INLINE float head_occlusion(__global const float* restrict grid, float3 p, float3 n)
{
    float hidden = 0.0f;
    float weight = 1.0f;
    float height = 0.12f;
    for (int tap = 0; tap < 5; ++tap) {
        hidden += fmax(height - head_far(grid, p + n * height), 0.0f) * head_over(weight, height);
        weight *= 0.85f;
        height *= 2.0f;
    }
    return fmax(1.0f - 0.36f * hidden, 0.12f);
}

__kernel void head_render(float4 origin, float4 right, float4 up, float4 forward, int width, int height, int first_row,
                          int rows, int tiles_x, __global const float* restrict grid,
                          __global const float* restrict start, int num_lights,
                          __global const float* restrict lights, float4 ambient, float4 background,
                          __global float* restrict irradiance, __global float* restrict albedo,
                          __global float* restrict non_subsurface, __global float* restrict depth,
                          __global float* restrict normal, __global uchar* restrict profile)
{
    int column = get_global_id(0), row = get_global_id(1);
    if (column >= width || row >= rows)
        return;
    size_t pixel = (size_t)row * width + column;
    float3 direction = head_direction(right, up, forward, (float)column + 0.5f - 0.5f * (float)width,
                                      0.5f * (float)height - ((float)(first_row + row) + 0.5f));
    float inverse = head_over(1.0f, head_length(direction));
    float3 unit = direction * inverse;
    float2 range = head_bounds(origin.xyz, direction, 1.0f);
    float t = start[(row / TILE) * tiles_x + column / TILE];

    // Find the surface to half a pixel, which rays along a silhouette reach in few steps, then to much less
    bool hit = false;
    if (t < FAR_CM && range.y >= range.x) {
        for (int step = 0; step < MAX_STEPS; ++step) {
            float d = head_far(grid, origin.xyz + direction * t);
            t += d * 0.95f * inverse;
            if (d < 0.5f * fmin(right.w * t, COARSEST)) {
                hit = true;
                break;
            }
            if (t > range.y)
                break;
        }
    }
    if (!hit) {
        vstore3((float3)(0.0f, 0.0f, 0.0f), pixel, irradiance);
        vstore3((float3)(0.0f, 0.0f, 0.0f), pixel, albedo);
        vstore3(background.xyz, pixel, non_subsurface);
        vstore3((float3)(0.0f, 0.0f, 0.0f), pixel, normal);
        depth[pixel] = 0.0f;
        profile[pixel] = 0;
        return;
    }

    // What is there: eyes and shirt end where the skin begins
    t += head_distance(origin.xyz + direction * t) * inverse;
    float3 p = origin.xyz + direction * t;
    float footprint = right.w * t;
    float3 smooth = head_normal(p, fmax(0.5f * fmin(footprint, COARSEST), 0.004f));
    float skin = head_skin(p);
    HeadSurface s;
    if (p.z > 5.0f && head_eyeball(p) < skin)
        s = head_eye_surface(p);
    else if (p.y < -10.0f && head_shirt(p, skin) < skin)
        s = head_shirt_surface(p, footprint);
    else
        s = head_skin_surface(p, smooth, footprint);
    float3 n = head_unit(smooth - (s.relief - smooth * head_dot(s.relief, smooth)));

    // Light it: diffuse irradiance apart from the mirrored part
    float occlusion = head_occlusion(grid, p, smooth);
    float3 diffuse = ambient.xyz * (occlusion * (0.75f + 0.25f * n.y));
    float grazing = 1.0f - head_saturate(-head_dot(n, unit));
    float fresnel = grazing * grazing * grazing * grazing * grazing;
    float3 mirrored = ambient.xyz * (occlusion * occlusion * (s.reflectance + (0.25f - 0.3f * s.roughness) * fresnel));
    float3 lifted = p + smooth * (0.02f + fmin(footprint, COARSEST));
    for (int index = 0; index < num_lights; ++index) {
        __global const float* light = lights + index * 8;
        float3 to_light = (float3)(light[0], light[1], light[2]);
        float3 power = (float3)(light[4], light[5], light[6]);
        float facing = head_dot(n, to_light);
        float wrap = head_dot(smooth, to_light);
        if (facing <= 0.0f || wrap <= -0.1f)
            continue;
        float seen = light[7] > 0.0f ? head_shadow(grid, lifted, to_light, light[3]) : occlusion;
        diffuse += power * (facing * seen);
        // GGX lobe with Kelemen's visibility term, widened by the size of the light
        float3 half_way = head_unit(to_light - unit);
        float nh = head_saturate(head_dot(n, half_way));
        float lh = fmax(head_dot(to_light, half_way), 0.05f);
        float alpha = s.roughness + 0.35f * light[3];
        float a2 = alpha * alpha;
        float spread = nh * nh * (a2 - 1.0f) + 1.0f;
        float away = 1.0f - lh;
        float schlick = s.reflectance + (1.0f - s.reflectance) * away * away * away * away * away;
        mirrored += power * (facing * seen * schlick * head_over(a2, 4.0f * lh * lh * spread * spread));
    }

    float skin_pixel = s.profile != 0 ? 1.0f : 0.0f;
    vstore3(diffuse * skin_pixel, pixel, irradiance);
    vstore3(s.albedo * skin_pixel, pixel, albedo);
    vstore3(mirrored + diffuse * s.albedo * (1.0f - skin_pixel), pixel, non_subsurface);
    vstore3(n, pixel, normal);
    depth[pixel] = t;
    profile[pixel] = s.profile;
}
