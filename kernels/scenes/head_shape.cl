// The shape of the head: a signed-distance field in cm. y up, the face looks along +z, +x is the head's own left.
// Sizes are those of an average man: 23 cm from crown to chin, 15.4 cm wide, 6.3 cm between the pupils.
// Only + - * / sqrt and exact functions: every device gets the same bits. Where the device does not promise correctly
// rounded division and square root, HEAD_DOUBLE asks for them by way of double, whose rounding to float is the same.
#pragma OPENCL FP_CONTRACT OFF

// All is inlined but head_distance, to whose calls the compilers would otherwise owe seconds. Its arguments are scalars:
// Intel's vectoriser (2026.2) passes float3 wrongly to functions that it does not inline.
#define HEAD_INLINE static inline __attribute__((always_inline))

#ifdef HEAD_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
HEAD_INLINE float head_over(float a, float b) { return (float)((double)a / (double)b); }
HEAD_INLINE float head_root(float a) { return (float)sqrt((double)a); }
#else
HEAD_INLINE float head_over(float a, float b) { return a / b; }
HEAD_INLINE float head_root(float a) { return sqrt(a); }
#endif

#define EYE_CENTRE ((float3)(3.15f, 0.0f, 7.45f))
#define EYE_RADIUS 1.20f

HEAD_INLINE float head_dot(float3 a, float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HEAD_INLINE float head_length(float3 a) { return head_root(head_dot(a, a)); }
HEAD_INLINE float head_length2(float x, float y) { return head_root(x * x + y * y); }
HEAD_INLINE float3 head_unit(float3 a) { return a * head_over(1.0f, head_length(a)); }
HEAD_INLINE float head_saturate(float x) { return fmin(fmax(x, 0.0f), 1.0f); }
HEAD_INLINE float head_lerp(float a, float b, float t) { return a + (b - a) * t; }
HEAD_INLINE float3 head_lerp3(float3 a, float3 b, float t) { return a + (b - a) * t; }
HEAD_INLINE float head_step(float low, float high, float x)
{
    float t = head_saturate((x - low) * (1.0f / (high - low)));
    return t * t * (3.0f - 2.0f * t);
}

// Union, intersection and carving with a fillet of width k (quadratic polynomial blend).
HEAD_INLINE float head_join(float a, float b, float k)
{
    float h = fmax(k - fabs(a - b), 0.0f);
    return fmin(a, b) - h * h * (0.25f / k);
}
HEAD_INLINE float head_carve(float a, float b, float k)
{
    float h = fmax(k - fabs(a + b), 0.0f);
    return fmax(a, -b) + h * h * (0.25f / k);
}

// Distance to an ellipsoid, first order in the distance.
HEAD_INLINE float head_ellipsoid(float3 p, float3 radii)
{
    float3 inverse = 1.0f / radii;
    float3 q = p * inverse;
    float3 g = q * inverse;
    return head_over(0.5f * (head_dot(q, q) - 1.0f), head_root(head_dot(g, g) + 1e-6f));
}

// The same, and finite at the centre: for shapes that are carved out, whose inside is seen.
HEAD_INLINE float head_hollow(float3 p, float3 radii)
{
    float3 inverse = 1.0f / radii;
    float3 q = p * inverse;
    float3 g = q * inverse;
    float k = head_length(q);
    return head_over(k * (k - 1.0f), head_length(g) + 1e-3f);
}

// A rod from a to b whose radius goes from ra to rb.
HEAD_INLINE float head_rod(float3 p, float3 a, float3 b, float ra, float rb)
{
    float3 pa = p - a;
    float3 ba = b - a;
    float t = head_saturate(head_dot(pa, ba) * (1.0f / head_dot(ba, ba)));
    return head_length(pa - ba * t) - (ra + (rb - ra) * t);
}

// The opening between the lids, in the plane of the face, relative to the eye: two circular arcs.
HEAD_INLINE float head_eye_opening(float3 q)
{
    float x = q.x - EYE_CENTRE.x;
    float y = q.y - EYE_CENTRE.y - 0.07f * x;
    float upper = head_length2(x + 0.06f, y + 1.74f) - 2.17f;
    float lower = head_length2(x, y - 2.10f) - 2.46f;
    return fmax(upper, lower);
}

HEAD_INLINE float head_skull(float3 q)
{
    float d = head_ellipsoid(q - (float3)(0.0f, 3.1f, -1.2f), (float3)(7.5f, 8.4f, 9.0f));
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, 3.4f, 3.0f), (float3)(6.6f, 5.6f, 5.9f)), 2.5f);
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -3.4f, 3.2f), (float3)(5.9f, 6.2f, 5.5f)), 2.0f);
    if (q.y + 0.1f > fmax(d, 0.0f) + 2.2f)
        return d;
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -7.0f, 3.6f), (float3)(4.7f, 4.3f, 4.9f)), 2.0f);
    // Side of the jaw up to the ear, its edge from the angle to the chin
    d = head_join(d, head_ellipsoid(q - (float3)(3.9f, -4.3f, 1.9f), (float3)(2.5f, 4.2f, 3.4f)), 1.5f);
    d = head_join(d, head_rod(q, (float3)(4.7f, -6.6f, 0.8f), (float3)(1.8f, -10.1f, 6.4f), 0.95f, 1.0f), 2.2f);
    // Cheekbone with its arch to the ear, chin
    d = head_join(d, head_ellipsoid(q - (float3)(4.4f, -2.1f, 5.4f), (float3)(1.8f, 1.25f, 2.1f)), 2.0f);
    d = head_join(d, head_rod(q, (float3)(5.4f, -1.6f, 4.2f), (float3)(6.0f, -1.2f, -0.5f), 0.8f, 0.8f), 1.6f);
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -10.0f, 7.3f), (float3)(1.9f, 1.25f, 1.5f)), 1.4f);
    return d;
}

HEAD_INLINE float head_eyes_and_brow(float d, float3 q)
{
    // Brow ridge and the outer rim of the orbit
    d = head_join(d, head_rod(q, (float3)(1.0f, 1.75f, 8.30f), (float3)(4.3f, 2.0f, 6.9f), 0.75f, 0.65f), 1.3f);
    d = head_join(d, head_rod(q, (float3)(4.4f, 1.9f, 6.7f), (float3)(5.4f, -0.6f, 5.4f), 0.60f, 0.5f), 1.2f);
    // Socket, deepest beside the root of the nose
    d = head_carve(d, head_hollow(q - (float3)(3.0f, 0.1f, 9.3f), (float3)(2.1f, 1.05f, 1.60f)), 1.0f);
    d = head_carve(d, head_hollow(q - (float3)(1.75f, 0.5f, 9.0f), (float3)(0.6f, 0.6f, 0.9f)), 0.8f);
    // Lids: a shell over the eyeball, with the opening cut out
    float3 e = q - EYE_CENTRE;
    float shell = head_length(e - (float3)(0.0f, 0.06f, 0.03f)) - 1.36f;
    d = head_join(d, shell, 0.75f);
    // Crease above the upper lid
    float opening = head_eye_opening(q);
    float crease = head_length2(head_length2(e.x * 0.85f, e.y + 0.95f) - 1.72f, head_length(e) - 1.44f) - 0.05f + 0.09f * e.x * e.x;
    d = e.y > 0.0f && e.z > 0.0f ? head_carve(d, crease, 0.24f) : d;
    float cut = fmax(opening, -e.z);
    d = head_carve(d, cut, 0.10f);
    // Caruncle, in the inner corner
    return head_join(d, head_length(e - (float3)(-1.16f, -0.10f, 0.62f)) - 0.17f, 0.12f);
}

HEAD_INLINE float head_nose(float d, float3 q)
{
    // Bridge and side walls
    d = head_join(d, head_rod(q, (float3)(0.0f, 0.6f, 8.30f), (float3)(0.0f, -3.3f, 10.40f), 0.60f, 0.62f), 0.9f);
    d = head_join(d, head_rod(q, (float3)(0.45f, -0.6f, 8.1f), (float3)(0.8f, -3.5f, 9.3f), 0.7f, 0.72f), 1.0f);
    // Tip, wing, columella, nostril
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -3.70f, 10.45f), (float3)(0.82f, 0.72f, 0.80f)), 0.6f);
    d = head_join(d, head_ellipsoid(q - (float3)(1.12f, -4.05f, 9.6f), (float3)(0.60f, 0.58f, 0.92f)), 0.40f);
    d = head_join(d, head_rod(q, (float3)(0.0f, -4.28f, 10.40f), (float3)(0.0f, -4.85f, 9.5f), 0.30f, 0.36f), 0.35f);
    d = head_carve(d, head_hollow(q - (float3)(0.60f, -4.80f, 9.85f), (float3)(0.28f, 0.55f, 0.50f)), 0.20f);
    return d;
}

// Mouth in bent coordinates: the lips follow the arch of the teeth.
HEAD_INLINE float3 head_mouth_space(float3 q)
{
    float x2 = q.x * q.x;
    return (float3)(q.x, q.y + 7.0f + 0.015f * x2, q.z + 0.15f * x2);
}

HEAD_INLINE float head_mouth(float d, float3 q)
{
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -6.7f, 7.3f), (float3)(3.0f, 2.6f, 2.2f)), 1.8f);
    // Philtrum and the folds around the mouth
    d = head_carve(d, head_rod(q, (float3)(0.0f, -5.1f, 10.0f), (float3)(0.0f, -6.0f, 9.95f), 0.14f, 0.20f), 0.4f);
    d = head_carve(d, head_hollow(q - (float3)(0.0f, -8.6f, 10.05f), (float3)(1.7f, 0.45f, 0.9f)), 1.0f);
    d = head_carve(d, head_rod(q, (float3)(1.9f, -4.2f, 9.5f), (float3)(3.3f, -7.2f, 8.5f), 0.06f, 0.04f), 0.9f);
    // Lips, the line between them, the corners
    float3 m = head_mouth_space(q);
    d = head_join(d, head_rod(m, (float3)(0.0f, 0.40f, 9.42f), (float3)(2.35f, 0.04f, 9.42f), 0.45f, 0.12f), 0.40f);
    d = head_join(d, head_rod(m, (float3)(0.0f, -0.52f, 9.34f), (float3)(2.2f, -0.10f, 9.38f), 0.54f, 0.15f), 0.40f);
    d = head_carve(d, head_rod(m, (float3)(0.0f, -0.04f, 9.82f), (float3)(2.45f, 0.02f, 9.78f), 0.06f, 0.02f), 0.20f);
    return d;
}

// The ear's own frame: x to the front, y up along the ear, z away from the head.
HEAD_INLINE float3 head_ear_space(float3 q)
{
    float3 p = q - (float3)(7.15f, -1.5f, -1.1f);
    // Columns of a rotation: leaning back by 12 degrees, opening to the front by 24
    const float3 up = (float3)(0.0f, 0.9781f, -0.2079f);
    const float3 out = (float3)(0.9135f, 0.0846f, 0.3979f);
    const float3 front = (float3)(-0.4067f, 0.1899f, 0.8936f);
    return (float3)(head_dot(p, front), head_dot(p, up), head_dot(p, out));
}

HEAD_INLINE float head_ear(float d, float3 q)
{
    float3 e = head_ear_space(q);
    // The sheet of cartilage, narrower towards the lobe: dished behind, diving into the cheek in front
    float front = fmin(e.x, 2.0f);
    float dish = front * front * (front < 0.0f ? 0.09f : -0.20f) + 0.03f * fmin(e.y * e.y, 20.0f);
    float wide = 1.0f + 0.10f * head_saturate(-0.4f * e.y);
    float3 f = (float3)(e.x * wide - 0.12f * head_saturate(-0.5f * e.y), e.y - 0.2f, e.z - dish + 0.15f);
    float ear = head_hollow(f, (float3)(1.60f, 2.65f, 0.26f));
    // What carries it
    ear = head_join(ear, head_ellipsoid(e - (float3)(0.45f, -0.45f, -0.55f), (float3)(1.15f, 1.35f, 0.75f)), 0.3f);
    // Helix: an elliptical ring, thick at the crown and thin towards the lobe, open at the front below its root
    float ring = (head_length2(f.x * (1.0f / 1.58f), f.y * (1.0f / 2.66f)) - 1.0f) * 1.75f;
    float thick = 0.15f + 0.15f * head_step(-2.2f, 1.2f, f.y);
    float helix = head_length2(ring, f.z - 0.34f) - thick;
    float open = head_length2(f.x - 2.2f, f.y + 1.0f) - 1.75f;
    helix = head_carve(helix, open, 0.3f);
    ear = head_join(ear, helix, 0.20f);
    // Antihelix
    float inner = (head_length2((f.x - 0.20f) * (1.0f / 1.02f), (f.y + 0.10f) * (1.0f / 1.70f)) - 1.0f) * 1.2f;
    float antihelix = head_length2(inner, f.z - 0.24f) - 0.20f - 0.06f * head_step(0.0f, 1.5f, f.y);
    antihelix = head_carve(antihelix, head_length2(f.x - 1.5f, f.y + 0.5f) - 1.5f, 0.4f);
    ear = head_join(ear, antihelix, 0.24f);
    // Concha: the bowl that leads into the ear
    ear = head_carve(ear, head_hollow(e - (float3)(0.32f, -0.45f, 0.30f), (float3)(0.72f, 1.0f, 0.75f)), 0.28f);
    ear = head_carve(ear, head_hollow(e - (float3)(0.62f, -0.55f, -0.20f), (float3)(0.35f, 0.40f, 0.7f)), 0.25f);
    // Lobe, tragus, antitragus, root of the helix
    ear = head_join(ear, head_ellipsoid(e - (float3)(0.45f, -2.35f, 0.12f), (float3)(0.78f, 0.80f, 0.26f)), 0.45f);
    ear = head_join(ear, head_ellipsoid(e - (float3)(1.08f, -0.70f, 0.30f), (float3)(0.28f, 0.50f, 0.30f)), 0.35f);
    ear = head_join(ear, head_ellipsoid(e - (float3)(0.22f, -1.48f, 0.26f), (float3)(0.40f, 0.24f, 0.24f)), 0.28f);
    ear = head_join(ear, head_rod(e, (float3)(1.45f, 0.60f, 0.20f), (float3)(0.25f, -0.05f, 0.0f), 0.22f, 0.14f), 0.28f);
    return head_join(d, ear, 0.70f);
}

HEAD_INLINE float head_neck(float d, float3 q)
{
    float neck = head_rod(q, (float3)(0.0f, -5.0f, -2.8f), (float3)(0.0f, -19.0f, -4.2f), 5.4f, 5.9f);
    d = head_join(d, neck, 1.8f);
    // Muscle from behind the ear to the collar bone, Adam's apple
    d = head_join(d, head_rod(q, (float3)(5.0f, -4.0f, -2.6f), (float3)(1.3f, -18.8f, 1.6f), 1.0f, 0.8f), 1.6f);
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -14.0f, 1.7f), (float3)(0.9f, 1.3f, 0.9f)), 1.4f);
    // Shoulders
    d = head_join(d, head_rod(q, (float3)(3.5f, -13.5f, -6.2f), (float3)(15.0f, -21.6f, -5.0f), 2.4f, 3.4f), 3.0f);
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -29.0f, -3.6f), (float3)(21.5f, 10.5f, 9.5f)), 2.5f);
    return d;
}

// The right half of the head, mirrored; rounded where the halves meet.
HEAD_INLINE float3 head_mirrored(float3 p) { return (float3)(head_root(p.x * p.x + 0.0049f), p.y, p.z); }

// Distance to the skin. A group of features is skipped where it is farther than its widest blend: the value is the same.
HEAD_INLINE float head_skin(float3 p)
{
    float3 q = head_mirrored(p);
    float d = head_skull(q);
    float margin = fmax(d, 0.0f);
    if (p.y < 0.5f + margin + 3.0f && (p.y < -9.5f || p.z < 2.8f + margin + 1.8f))
        d = head_neck(d, q);
    margin = fmax(d, 0.0f);
    if (head_length(q - (float3)(2.9f, 0.2f, 7.3f)) - 4.9f < margin + 1.2f)
        d = head_eyes_and_brow(d, q);
    if (head_length(q - (float3)(0.0f, -2.6f, 9.6f)) - 3.6f < margin + 1.0f)
        d = head_nose(d, q);
    if (head_length(q - (float3)(0.0f, -6.8f, 8.6f)) - 3.9f < margin + 1.8f)
        d = head_mouth(d, q);
    if (head_length(q - (float3)(7.15f, -1.6f, -1.0f)) - 4.3f < margin + 0.7f)
        d = head_ear(d, q);
    return d;
}

HEAD_INLINE float head_eyeball(float3 p)
{
    float3 e = head_mirrored(p) - EYE_CENTRE;
    // The cornea bulges from the ball
    float cornea = head_length(e - (float3)(0.0f, 0.0f, 0.52f)) - 0.76f;
    return head_join(head_length(e) - EYE_RADIUS, cornea, 0.1f);
}

// A shirt over the shoulders, with a round collar.
HEAD_INLINE float head_shirt(float3 p, float skin)
{
    float cut = p.y + 17.2f + 0.16f * p.z;
    float shell = fabs(skin - 0.25f) - 0.12f;
    float shirt = fmax(shell, cut * 0.98f);
    return shirt;
}

// Distance to whatever is nearest.
__attribute__((noinline)) float head_distance_to(float x, float y, float z)
{
    float3 p = (float3)(x, y, z);
    float d = head_skin(p);
    if (p.y < -10.0f)
        d = fmin(d, head_shirt(p, d));
    if (p.z > 5.0f && fabs(p.y) < 3.5f)
        d = fmin(d, head_eyeball(p));
    return d;
}

HEAD_INLINE float head_distance(float3 p) { return head_distance_to(p.x, p.y, p.z); }

// The distances at the nodes of a grid over one half of head and neck, for points well off the surface.
#define GRID_STEP 0.2f
#define GRID_X 54
#define GRID_Y 168
#define GRID_Z 132
#define GRID_ORIGIN ((float3)(0.0f, -20.0f, -13.0f))
// Within this distance of the surface the field itself is asked.
#define GRID_NEAR 0.06f

__kernel void head_grid(__global float* restrict grid)
{
    int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    float3 p = GRID_ORIGIN + (float3)((float)x, (float)y, (float)z) * GRID_STEP;
    grid[(z * GRID_Y + y) * GRID_X + x] = head_distance(p);
}

// The distance, interpolated between the nodes of the grid where it is large, exact where it is small.
HEAD_INLINE float head_far(__global const float* restrict grid, float3 p)
{
    float3 g = ((float3)(fabs(p.x), p.y, p.z) - GRID_ORIGIN) * (1.0f / GRID_STEP);
    if (g.x < GRID_X - 1.01f && g.y > 0.0f && g.y < GRID_Y - 1.01f && g.z > 0.0f && g.z < GRID_Z - 1.01f) {
        int x = (int)g.x, y = (int)g.y, z = (int)g.z;
        float3 f = g - (float3)((float)x, (float)y, (float)z);
        __global const float* near = grid + (z * GRID_Y + y) * GRID_X + x;
        __global const float* far = near + GRID_Y * GRID_X;
        float a = head_lerp(head_lerp(near[0], near[1], f.x), head_lerp(near[GRID_X], near[GRID_X + 1], f.x), f.y);
        float b = head_lerp(head_lerp(far[0], far[1], f.x), head_lerp(far[GRID_X], far[GRID_X + 1], f.x), f.y);
        float d = head_lerp(a, b, f.z);
        if (fabs(d) > GRID_NEAR)
            return d;
    }
    return head_distance(p);
}
