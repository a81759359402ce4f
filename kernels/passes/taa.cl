// Temporal anti-aliasing of the finished picture: the history at the place of the nearest surface
// around, clamped to the colours of the 3x3 neighbourhood, and blended with this frame. [Karis14]
// A warp takes one step per neighbour.

#define FARTHEST 1e30f

// Luma Y in x, and the chroma Co and Cg.
float4 to_ycocg(float4 c)
{
    return (float4)(0.25f * c.x + 0.5f * c.y + 0.25f * c.z, 0.5f * c.x - 0.5f * c.z,
                    0.5f * c.y - 0.25f * c.x - 0.25f * c.z, 0.0f);
}

PASS_KERNEL taa(
    WARP_ARGS, __global const float *depth, __global const half *output, __global const float2 *velocity,
    __global const half *old_taa, __global half *new_taa, const int has_velocity, const float least_weight,
    const float largest_weight, const float full_speed TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    // The box of the neighbours' colours and the nearest of them; among equals, the pixel itself.
    // Depth 0 is nothing, farther than all.
    float4 centre = (float4)(0.0f), low = (float4)(FARTHEST), high = (float4)(-FARTHEST);
    float nearest = FARTHEST;
    uint nearest_pixel = 0;
    int nearest_x = x, nearest_y = y;
    for (int place = 0; place < steps; ++place) {
        const int near_x = min(max(x + place % 3 - 1, 0), width - 1);
        const int near_y = min(max(y + place / 3 - 1, 0), height - 1);
        const uint pixel = (uint)(near_y * width + near_x);
        const float found = depth[pixel];
        const float z = found > 0.0f ? found : FARTHEST;
        TRACE(1, inside, 0, near_y, near_x)
        const float4 colour = to_ycocg(vload_half4(pixel, output));
        TRACE(1, inside, 0, near_y, near_x)
        const bool is_centre = place == 4;
        if (z < nearest || (is_centre && z == nearest)) {
            nearest = z;
            nearest_pixel = pixel;
            nearest_x = near_x;
            nearest_y = near_y;
        }
        centre = is_centre ? colour : centre;
        low = select(low, colour, colour < low);
        high = select(high, colour, colour > high);
    }

    // Where the surface stood; bilinear, clamped to the picture's edge.
    const float2 moved = has_velocity ? velocity[nearest_pixel] : (float2)(0.0f);
    TRACE(1, inside, 0, nearest_y, nearest_x)
    const float past_x = (float)x + 0.5f + moved.x;
    const float past_y = (float)y + 0.5f + moved.y;
    const bool on_screen =
        inside && past_x >= 0.0f && past_x < (float)width && past_y >= 0.0f && past_y < (float)height;
    const float at_x = at_most(at_least(past_x - 0.5f, 0.0f), (float)(width - 1));
    const float at_y = at_most(at_least(past_y - 0.5f, 0.0f), (float)(height - 1));
    const int left = (int)at_x, above = (int)at_y;
    TRACE(1, on_screen, 0, above, left)
    float4 old = (float4)(0.0f);
    if (on_screen) {
        const int right = min(left + 1, width - 1), below = min(above + 1, height - 1);
        const float of_right = at_x - (float)left, of_below = at_y - (float)above;
        const float4 a = vload_half4(above * width + left, old_taa);
        const float4 b = vload_half4(above * width + right, old_taa);
        const float4 c = vload_half4(below * width + left, old_taa);
        const float4 d = vload_half4(below * width + right, old_taa);
        const float4 top = a * (1.0f - of_right) + b * of_right;
        const float4 bottom = c * (1.0f - of_right) + d * of_right;
        old = top * (1.0f - of_below) + bottom * of_below;
    }

    // The faster, the less history; all of this frame where there is none. Alpha marks history.
    const float speed = sqrt(moved.x * moved.x + moved.y * moved.y);
    const float share = at_most(speed / full_speed, 1.0f);
    float weight = least_weight + (largest_weight - least_weight) * share;
    weight = old.w > 0.0f ? weight : 1.0f;

    // Blend, both sides weighed down by their luma so that no firefly outweighs the rest.
    float4 history = to_ycocg(old);
    history = select(history, low, history < low);
    history = select(history, high, history > high);
    const float of_new = weight / (1.0f + at_least(centre.x, 0.0f));
    const float of_old = (1.0f - weight) / (1.0f + at_least(history.x, 0.0f));
    const float4 mixed = (centre * of_new + history * of_old) / (of_new + of_old);
    if (inside) {
        const float rest = mixed.x - mixed.z;
        const float4 colour = (float4)(rest + mixed.y, mixed.x + mixed.z, rest - mixed.y, 1.0f);
        store_half(new_taa, (uint)(y * width + x), select(colour, (float4)(0.0f), colour < (float4)(0.0f)));
    }
    TRACE(1, inside, 0, y, x)
}
