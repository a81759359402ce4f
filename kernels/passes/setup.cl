// Set-up: split the frame into the setup texture (irradiance and depth, 0 where nothing scatters)
// and the profile-id cache.
PASS_KERNEL setup(
    WARP_ARGS, __global const half *scene_light, __global const float *depth,
    __global const uchar *gbuffer_id, __global half *setup_texture, __global uchar *profile_id TRACE_ARGS)
{
    FIND_PIXEL
    FIND_ROW
    const uint pixel = inside ? (uint)(y * width + x) : 0u;

    const uchar id = inside ? gbuffer_id[pixel] : 0;
    TRACE(1, inside, 0, y, x)
    const float z = depth[pixel];
    TRACE(1, inside, 0, y, x)
    const bool scatters = inside && id > 0 && z > 0.0f;
    if (steps > 0) {
        TRACE(1, scatters, 0, y, x)
    }
    if (inside) {
        float4 texel = (float4)(0.0f);
        if (scatters) {
            texel = vload_half4(pixel, scene_light);
            texel.w = z < HALF_NORMAL_MIN ? HALF_NORMAL_MIN : z;
        }
        store_setup(setup_texture, setup_index(0, y, x, width, height), texel);
        profile_id[pixel] = scatters ? id : 0;
    }
    TRACE(1, inside, 0, y, x)
    TRACE(1, inside, 0, y, x)
}
