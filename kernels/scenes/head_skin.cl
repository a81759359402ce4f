// What the surface of the head is made of: colour, gloss and relief, from integer-hashed noise.

typedef struct {
    float3 albedo;
    float3 relief;    // gradient of the height of the fine relief, cm per cm
    float roughness;  // alpha of the GGX lobe
    float reflectance;
    uchar profile;    // 1 = skin, 0 = does not scatter
} HeadSurface;

HEAD_INLINE uint head_hash(int x, int y, int z)
{
    uint h = (uint)x * 0x8da6b343u ^ (uint)y * 0xd8163841u ^ (uint)z * 0xcb1ab31fu;
    h = (h ^ (h >> 16)) * 0x7feb352du;
    h = (h ^ (h >> 15)) * 0x846ca68bu;
    return h ^ (h >> 16);
}
HEAD_INLINE float head_random(int x, int y, int z) { return (float)(head_hash(x, y, z) >> 8) * 5.9604645e-8f; }

// Value noise in [0, 1] and its gradient.
HEAD_INLINE float head_noise(float3 p, float3* gradient)
{
    float3 cell = (float3)(floor(p.x), floor(p.y), floor(p.z));
    float3 f = p - cell;
    int x = (int)cell.x, y = (int)cell.y, z = (int)cell.z;
    float3 u = f * f * (3.0f - 2.0f * f);
    float3 du = 6.0f * f * (1.0f - f);
    float a = head_random(x, y, z), b = head_random(x + 1, y, z);
    float c = head_random(x, y + 1, z), d = head_random(x + 1, y + 1, z);
    float e = head_random(x, y, z + 1), g = head_random(x + 1, y, z + 1);
    float h = head_random(x, y + 1, z + 1), i = head_random(x + 1, y + 1, z + 1);
    float ab = head_lerp(a, b, u.x), cd = head_lerp(c, d, u.x);
    float eg = head_lerp(e, g, u.x), hi = head_lerp(h, i, u.x);
    float near = head_lerp(ab, cd, u.y), far = head_lerp(eg, hi, u.y);
    float slope_x = head_lerp(head_lerp(b - a, d - c, u.y), head_lerp(g - e, i - h, u.y), u.z);
    float slope_y = head_lerp(cd - ab, hi - eg, u.z);
    *gradient = du * (float3)(slope_x, slope_y, far - near);
    return head_lerp(near, far, u.z);
}
HEAD_INLINE float head_tone(float3 p)
{
    float3 unused;
    return head_noise(p, &unused);
}

// Pores: a dimple at a jittered point of every cell. Returns the depth in [0, 1] and adds its gradient.
HEAD_INLINE float head_pores(float3 p, float3* gradient)
{
    float3 base = (float3)(floor(p.x - 0.5f), floor(p.y - 0.5f), floor(p.z - 0.5f));
    float nearest = 1.0f;
    float3 towards = (float3)(0.0f, 0.0f, 0.0f);
    for (int corner = 0; corner < 8; ++corner) {
        int x = (int)base.x + (corner & 1), y = (int)base.y + ((corner >> 1) & 1), z = (int)base.z + (corner >> 2);
        uint h = head_hash(x, y, z);
        float3 point = (float3)((float)x, (float)y, (float)z)
                     + (float3)((float)(h & 255u), (float)((h >> 8) & 255u), (float)((h >> 16) & 255u)) * (0.5f / 255.0f)
                     + 0.25f;
        float3 offset = p - point;
        float squared = head_dot(offset, offset) * (2.2f + 6.0f * (float)(h >> 24) * (1.0f / 255.0f));
        towards = squared < nearest ? offset : towards;
        nearest = fmin(nearest, squared);
    }
    float depth = 1.0f - nearest;
    *gradient = towards * depth * 4.0f;
    return depth * depth;
}

// How much of a detail of the given size (cm) survives where a pixel covers `footprint` cm: none below two pixels.
HEAD_INLINE float head_visible(float size, float footprint) { return head_saturate(head_over(size, 3.0f * footprint) - 0.6f); }

HEAD_INLINE float head_brow_mask(float3 q, float3 p)
{
    float x = q.x;
    float arch = 1.72f + 0.30f * head_step(0.9f, 3.9f, x) - 0.75f * head_step(3.6f, 5.6f, x);
    float half_height = 0.42f - 0.30f * head_step(2.0f, 5.2f, x);
    float inside = 1.0f - head_step(0.45f, 1.15f, head_over(fabs(q.y - arch), half_height));
    inside = inside * head_step(0.75f, 1.3f, x) * (1.0f - head_step(4.6f, 5.3f, x)) * head_step(4.0f, 5.0f, q.z);
    // Hairs lean outwards and up
    float hair = head_tone((float3)((x - q.y) * 9.0f, (q.y + 0.35f * x) * 3.0f, p.x > 0.0f ? 3.5f : 9.5f));
    return head_saturate(inside * (0.45f + 0.9f * hair));
}

HEAD_INLINE float head_lip_mask(float3 q)
{
    float3 m = head_mouth_space(q);
    float bow = 0.10f * head_step(0.0f, 0.55f, m.x) - 0.12f * head_step(0.5f, 2.4f, m.x);
    float reach = head_saturate(1.0f - m.x * m.x * (1.0f / 7.3f));
    float top = (0.74f + bow) * reach;
    float bottom = -0.92f * reach;
    float inside = fmin(top - m.y, m.y - bottom);
    return head_step(-0.10f, 0.14f, inside) * head_step(8.2f, 8.8f, m.z);
}

// Share of the scalp's cropped hair: above the hairline, behind the temples, around the ears.
HEAD_INLINE float head_hair_mask(float3 q, float3 p)
{
    float ragged = 0.7f * (head_tone(p * 1.1f) - 0.5f) + 0.25f * (head_tone(p * 7.0f) - 0.5f);
    float front = q.y - 7.2f + 0.10f * q.x * q.x * head_saturate(1.0f - 0.13f * q.x);
    float back = -1.6f - q.z + 0.55f * (q.y + 2.2f);
    float side = fmin(q.x - 5.4f, fmin(q.y - 1.0f - 0.9f * (q.z - 1.5f), 1.2f * (5.2f - q.z)));
    float nape = q.y + 6.2f + ragged;
    float edge = fmax(fmax(front, side), fmin(back, nape)) + ragged;
    float3 e = head_ear_space(q);
    float ear = head_length2(e.x * 0.52f, e.y * 0.33f) + 2.0f * head_step(-0.25f, -0.9f, e.z);
    return head_step(-0.5f, 0.7f, edge) * head_step(0.95f, 1.25f, ear);
}

HEAD_INLINE HeadSurface head_skin_surface(float3 p, float3 n, float footprint)
{
    float3 q = head_mirrored(p);
    HeadSurface s;
    s.profile = 1;
    s.reflectance = 0.028f;

    // Flush: cheeks, nose, ears, chin
    float flush = 0.0f;
    float3 c = q - (float3)(4.3f, -3.4f, 7.0f);
    flush += 0.75f * head_saturate(1.0f - head_dot(c, c) * 0.12f);
    c = q - (float3)(0.3f, -3.9f, 10.9f);
    flush += 0.85f * head_saturate(1.0f - head_dot(c, c) * 0.28f);
    c = q - (float3)(8.6f, -1.8f, -1.4f);
    flush += 0.9f * head_saturate(1.0f - head_dot(c, c) * 0.07f);
    c = q - (float3)(0.0f, -10.2f, 8.6f);
    flush += 0.45f * head_saturate(1.0f - head_dot(c, c) * 0.3f);
    // Blotches at three scales
    float blotch = head_tone(p * 0.55f) * 0.5f + head_tone(p * 1.7f + 11.3f) * 0.3f + head_tone(p * 5.3f + 4.1f) * 0.2f;
    flush = head_saturate(flush * (0.55f + 0.9f * blotch) + 0.35f * (blotch - 0.4f));
    float3 albedo = head_lerp3((float3)(0.640f, 0.395f, 0.285f), (float3)(0.560f, 0.265f, 0.190f), flush);
    // Darker around the eyes
    c = (q - EYE_CENTRE) * (float3)(0.75f, 1.0f, 0.6f) - (float3)(-0.1f, -0.25f, 0.6f);
    albedo = albedo * (1.0f - (float3)(0.11f, 0.17f, 0.15f) * head_saturate(1.25f - 0.42f * head_dot(c, c)));
    // Freckles, few on the neck
    float3 unused;
    float freckle = head_pores(p * 2.6f + 7.7f, &unused) * head_step(0.40f, 0.75f, head_tone(p * 0.7f + 2.2f));
    freckle = head_step(0.25f, 0.6f, freckle);
    albedo = albedo * (1.0f - (float3)(0.16f, 0.28f, 0.36f) * freckle * head_visible(0.25f, footprint) * 0.8f);
    float mole = head_step(0.55f, 0.75f, head_pores(p * 0.55f + 3.1f, &unused) * head_step(0.30f, 0.31f, head_tone(p * 0.5f + 8.2f)) * head_step(0.975f, 0.98f, head_tone(floor(p * 0.55f + 2.6f) * 7.3f)));
    albedo = albedo * (1.0f - (float3)(0.35f, 0.5f, 0.55f) * mole);

    // Beard shadow, cropped hair and brows darken the skin
    float beard = head_step(-4.4f, -6.2f, q.y - 0.10f * q.x * q.x) * head_step(-13.0f, -11.5f, q.y)
                * head_step(1.5f, 4.0f, q.z + 0.55f * (-q.y - 6.0f));
    float lips = head_lip_mask(q);
    beard = beard * (1.0f - lips) * 0.30f * (0.7f + 0.6f * head_tone(p * 9.0f));
    albedo = head_lerp3(albedo, (float3)(0.215f, 0.165f, 0.150f), beard);
    float hair = head_hair_mask(q, p);
    float strand = head_tone((float3)(p.x * 16.0f, p.y * 6.0f + p.z * 4.0f, p.z * 16.0f));
    strand = head_lerp(0.5f, strand, head_visible(0.07f, footprint));
    albedo = head_lerp3(albedo, (float3)(0.105f, 0.078f, 0.062f), hair * head_saturate(0.40f + 0.75f * strand));
    float brow = head_brow_mask(q, p);
    albedo = head_lerp3(albedo, (float3)(0.060f, 0.038f, 0.026f), brow * 0.92f);
    // Lips
    float3 lip_colour = (float3)(0.500f, 0.205f, 0.175f) * (0.86f + 0.28f * head_tone((float3)(p.x * 9.0f, p.y * 2.0f, p.z * 2.0f)));
    albedo = head_lerp3(albedo, lip_colour, lips * 0.9f);
    // Lashes and the wet pink rim of the lids
    float opening = head_eye_opening(q);
    float front = head_step(0.2f, 0.6f, q.z - EYE_CENTRE.z);
    float near_eye = head_saturate(2.6f - head_length(q - EYE_CENTRE)) * front;
    float lash = (1.0f - head_step(0.02f, q.y > EYE_CENTRE.y ? 0.17f : 0.10f, fabs(opening))) * head_saturate(near_eye * 3.0f);
    albedo = head_lerp3(albedo, (float3)(0.035f, 0.024f, 0.020f), lash * (q.y > EYE_CENTRE.y ? 0.85f : 0.5f));
    s.albedo = albedo;

    // Relief: undulation, skin lines, pores; the lips have grooves instead, the scalp stubble
    float3 g;
    float3 relief = (float3)(0.0f, 0.0f, 0.0f);
    head_noise(p * 1.6f, &g);
    relief += g * 0.035f;
    head_noise(p * 6.5f + 3.3f, &g);
    relief += g * (0.055f * head_visible(0.15f, footprint));
    head_noise(p * 15.0f + 9.1f, &g);
    relief += g * (0.085f * head_visible(0.066f, footprint) * (1.0f - 0.5f * lips));
    float fine = head_visible(0.030f, footprint);
    if (fine > 0.0f) {
        head_noise((float3)(p.x + 0.6f * p.y, p.y - 0.5f * p.x, p.z) * (float3)(46.0f, 24.0f, 30.0f), &g);
        relief += (float3)(g.x - 0.5f * g.y, g.y + 0.6f * g.x, g.z) * (0.10f * fine * (1.0f - lips));
    }
    float pore_size = head_visible(0.045f, footprint);
    if (pore_size > 0.0f) {
        float depth = head_pores(p * 13.0f, &g);
        float amount = (1.0f - lips) * (0.55f + 0.8f * head_tone(p * 0.9f + 5.5f)) * pore_size;
        relief += g * (0.20f * amount);
        s.albedo = s.albedo * (1.0f - 0.16f * depth * amount);
    }
    if (lips > 0.0f) {
        head_noise((float3)(p.x * 8.0f, p.y * 1.4f, 0.5f), &g);
        relief += (float3)(g.x, 0.17f * g.y, 0.0f) * (0.22f * lips * head_visible(0.12f, footprint));
    }
    if (brow > 0.02f || hair > 0.02f) {
        head_noise((float3)(p.x * 14.0f, p.y * 7.0f, p.z * 14.0f), &g);
        relief += g * (0.35f * fmax(brow, 0.7f * hair) * head_visible(0.07f, footprint));
    }
    // Forehead lines
    float brow_lines = head_step(2.8f, 3.6f, q.y) * (1.0f - head_step(6.0f, 7.4f, q.y)) * head_step(4.5f, 7.0f, q.z);
    head_noise((float3)(p.x * 0.25f, p.y * 1.3f + 0.25f * head_tone(p * 0.6f), 1.5f), &g);
    relief += (float3)(0.0f, g.y, 0.0f) * (0.11f * brow_lines);
    s.relief = relief;

    float oily = head_saturate(1.0f - 0.16f * q.x) * head_step(6.0f, 9.0f, q.z);
    s.roughness = 0.26f - 0.07f * oily - 0.08f * lips + 0.10f * hair + 0.05f * (blotch - 0.5f);
    s.reflectance = head_lerp(s.reflectance, 0.02f, fmax(brow, hair));
    return s;
}

HEAD_INLINE HeadSurface head_eye_surface(float3 p)
{
    float3 e = head_mirrored(p) - EYE_CENTRE;
    float r = head_length2(e.x, e.y);
    HeadSurface s;
    s.profile = 0;
    s.relief = (float3)(0.0f, 0.0f, 0.0f);
    s.roughness = 0.03f;
    s.reflectance = 0.04f;
    // Sclera with a few vessels, redder to the corners
    float vessel = head_step(0.62f, 0.75f, head_tone((float3)(p.x * 5.0f, p.y * 13.0f, p.z * 3.0f)));
    float3 white = head_lerp3((float3)(0.46f, 0.42f, 0.40f), (float3)(0.42f, 0.24f, 0.20f), 0.25f * vessel + 0.45f * head_step(0.8f, 1.3f, r));
    // Iris: fibres run from the pupil to the limbus
    float inverse = head_over(1.0f, r + 1e-4f);
    float fibre = head_tone((float3)(e.x * inverse * 9.0f, e.y * inverse * 9.0f, r * 3.0f + (p.x > 0.0f ? 0.0f : 5.0f)));
    float3 iris = head_lerp3((float3)(0.055f, 0.085f, 0.095f), (float3)(0.20f, 0.25f, 0.24f), fibre);
    iris = head_lerp3((float3)(0.20f, 0.13f, 0.06f), iris, head_step(0.22f, 0.40f, r));
    iris = iris * (1.0f - 0.75f * head_step(0.46f, 0.60f, r));
    iris = iris * head_step(0.18f, 0.23f, r);
    s.albedo = head_lerp3(iris, white, head_step(0.56f, 0.64f, r));
    // The lids and lashes shade the rim of the opening, the upper one more
    float inside = -head_eye_opening(head_mirrored(p));
    s.albedo *= 0.35f + 0.65f * head_step(-0.02f, e.y > 0.0f ? 0.34f : 0.16f, inside);
    return s;
}

HEAD_INLINE HeadSurface head_shirt_surface(float3 p, float footprint)
{
    HeadSurface s;
    s.profile = 0;
    s.roughness = 0.7f;
    s.reflectance = 0.02f;
    s.albedo = (float3)(0.050f, 0.056f, 0.068f) * (0.85f + 0.3f * head_tone(p * 0.7f));
    float3 g;
    head_noise(p * 0.45f, &g);
    s.relief = g * 0.25f;
    head_noise(p * (float3)(18.0f, 11.0f, 18.0f), &g);
    s.relief += g * (0.5f * head_visible(0.08f, footprint));
    return s;
}
