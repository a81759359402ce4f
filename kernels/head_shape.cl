// The shape of the head: a signed-distance field in cm. y up, the face looks along +z, +x is the head's own left.
// Sizes are those of an average man: 23 cm from crown to chin, 15.4 cm wide, 6.3 cm between the pupils.
// Only + - * / sqrt and exact functions: every device gets the same bits.
#pragma OPENCL FP_CONTRACT OFF

#define EYE_CENTRE ((float3)(3.15f, 0.0f, 7.45f))
#define EYE_RADIUS 1.20f

static float head_dot(float3 a, float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static float head_length(float3 a) { return sqrt(head_dot(a, a)); }
static float head_length2(float x, float y) { return sqrt(x * x + y * y); }
static float3 head_unit(float3 a) { return a * (1.0f / head_length(a)); }
static float head_saturate(float x) { return fmin(fmax(x, 0.0f), 1.0f); }
static float head_lerp(float a, float b, float t) { return a + (b - a) * t; }
static float3 head_lerp3(float3 a, float3 b, float t) { return a + (b - a) * t; }
static float head_step(float low, float high, float x)
{
    float t = head_saturate((x - low) / (high - low));
    return t * t * (3.0f - 2.0f * t);
}

// Union, intersection and carving with a fillet of width k (quadratic polynomial blend).
static float head_join(float a, float b, float k)
{
    float h = fmax(k - fabs(a - b), 0.0f);
    return fmin(a, b) - h * h * (0.25f / k);
}
static float head_carve(float a, float b, float k)
{
    float h = fmax(k - fabs(a + b), 0.0f);
    return fmax(a, -b) + h * h * (0.25f / k);
}

// Distance to an ellipsoid, first order in the distance.
static float head_ellipsoid(float3 p, float3 radii)
{
    float3 q = p / radii;
    float3 g = q / radii;
    float k0 = head_length(q);
    return k0 * (k0 - 1.0f) / (head_length(g) + 1e-6f);
}

// A rod from a to b whose radius goes from ra to rb.
static float head_rod(float3 p, float3 a, float3 b, float ra, float rb)
{
    float3 pa = p - a;
    float3 ba = b - a;
    float t = head_saturate(head_dot(pa, ba) / head_dot(ba, ba));
    return head_length(pa - ba * t) - (ra + (rb - ra) * t);
}

// The opening between the lids, in the plane of the face, relative to the eye: two circular arcs.
static float head_eye_opening(float3 q)
{
    float x = q.x - EYE_CENTRE.x;
    float y = q.y - EYE_CENTRE.y - 0.07f * x;
    float upper = head_length2(x + 0.06f, y + 1.74f) - 2.17f;
    float lower = head_length2(x, y - 2.10f) - 2.46f;
    return fmax(upper, lower);
}

static float head_skull(float3 q)
{
    float d = head_ellipsoid(q - (float3)(0.0f, 3.1f, -1.2f), (float3)(7.5f, 8.4f, 9.0f));
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, 3.4f, 3.0f), (float3)(6.6f, 5.6f, 5.9f)), 2.5f);
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -3.4f, 3.2f), (float3)(5.9f, 6.2f, 5.5f)), 2.0f);
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

static float head_eyes_and_brow(float d, float3 q)
{
    // Brow ridge and the outer rim of the orbit
    d = head_join(d, head_rod(q, (float3)(1.0f, 1.75f, 8.30f), (float3)(4.3f, 2.0f, 6.9f), 0.75f, 0.65f), 1.3f);
    d = head_join(d, head_rod(q, (float3)(4.4f, 1.9f, 6.7f), (float3)(5.4f, -0.6f, 5.4f), 0.60f, 0.5f), 1.2f);
    // Socket, deepest beside the root of the nose
    d = head_carve(d, head_ellipsoid(q - (float3)(3.0f, 0.1f, 9.3f), (float3)(2.1f, 1.05f, 1.60f)), 1.0f);
    d = head_carve(d, head_ellipsoid(q - (float3)(1.75f, 0.5f, 9.0f), (float3)(0.6f, 0.6f, 0.9f)), 0.8f);
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

static float head_nose(float d, float3 q)
{
    // Bridge and side walls
    d = head_join(d, head_rod(q, (float3)(0.0f, 0.6f, 8.30f), (float3)(0.0f, -3.3f, 10.40f), 0.60f, 0.62f), 0.9f);
    d = head_join(d, head_rod(q, (float3)(0.45f, -0.6f, 8.1f), (float3)(0.8f, -3.5f, 9.3f), 0.7f, 0.72f), 1.0f);
    // Tip, wing, columella, nostril
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -3.70f, 10.45f), (float3)(0.82f, 0.72f, 0.80f)), 0.6f);
    d = head_join(d, head_ellipsoid(q - (float3)(1.12f, -4.05f, 9.6f), (float3)(0.60f, 0.58f, 0.92f)), 0.40f);
    d = head_join(d, head_rod(q, (float3)(0.0f, -4.28f, 10.40f), (float3)(0.0f, -4.85f, 9.5f), 0.30f, 0.36f), 0.35f);
    d = head_carve(d, head_ellipsoid(q - (float3)(0.60f, -4.78f, 9.9f), (float3)(0.26f, 0.40f, 0.50f)), 0.22f);
    return d;
}

// Mouth in bent coordinates: the lips follow the arch of the teeth.
static float3 head_mouth_space(float3 q)
{
    float x2 = q.x * q.x;
    return (float3)(q.x, q.y + 7.0f + 0.015f * x2, q.z + 0.15f * x2);
}

static float head_mouth(float d, float3 q)
{
    d = head_join(d, head_ellipsoid(q - (float3)(0.0f, -6.7f, 7.3f), (float3)(3.0f, 2.6f, 2.2f)), 1.8f);
    // Philtrum and the folds around the mouth
    d = head_carve(d, head_rod(q, (float3)(0.0f, -5.1f, 10.0f), (float3)(0.0f, -6.0f, 9.95f), 0.14f, 0.20f), 0.4f);
    d = head_carve(d, head_ellipsoid(q - (float3)(0.0f, -8.6f, 10.05f), (float3)(1.7f, 0.45f, 0.9f)), 1.0f);
    d = head_carve(d, head_rod(q, (float3)(1.9f, -4.2f, 9.5f), (float3)(3.3f, -7.2f, 8.5f), 0.06f, 0.04f), 0.9f);
    // Lips, the line between them, the corners
    float3 m = head_mouth_space(q);
    d = head_join(d, head_rod(m, (float3)(0.0f, 0.40f, 9.42f), (float3)(2.35f, 0.04f, 9.42f), 0.45f, 0.12f), 0.40f);
    d = head_join(d, head_rod(m, (float3)(0.0f, -0.52f, 9.34f), (float3)(2.2f, -0.10f, 9.38f), 0.54f, 0.15f), 0.40f);
    d = head_carve(d, head_rod(m, (float3)(0.0f, -0.04f, 9.84f), (float3)(2.25f, 0.0f, 9.60f), 0.05f, 0.01f), 0.24f);
    d = head_carve(d, head_length(q - (float3)(2.75f, -7.15f, 9.1f)) - 0.10f, 0.8f);
    return d;
}

// The ear's own frame: x to the front, y up along the ear, z away from the head.
static float3 head_ear_space(float3 q)
{
    float3 p = q - (float3)(7.15f, -1.5f, -1.1f);
    // Columns of a rotation: leaning back by 12 degrees, opening to the front by 24
    const float3 up = (float3)(0.0f, 0.9781f, -0.2079f);
    const float3 out = (float3)(0.9135f, 0.0846f, 0.3979f);
    const float3 front = (float3)(-0.4067f, 0.1899f, 0.8936f);
    return (float3)(head_dot(p, front), head_dot(p, up), head_dot(p, out));
}

static float head_ear(float d, float3 q)
{
    float3 e = head_ear_space(q);
    // The sheet of cartilage, dished; narrower towards the lobe
    float wide = 1.0f + 0.10f * head_saturate(-0.4f * e.y);
    float3 f = (float3)(e.x * wide - 0.12f * head_saturate(-0.5f * e.y), e.y - 0.2f, e.z - 0.09f * (e.x * e.x + 0.35f * e.y * e.y) + 0.15f);
    float ear = head_ellipsoid(f, (float3)(1.60f, 2.65f, 0.26f));
    // What carries it
    ear = head_join(ear, head_ellipsoid(e - (float3)(0.45f, -0.45f, -0.55f), (float3)(1.15f, 1.35f, 0.75f)), 0.3f);
    // Helix: an elliptical ring, thick at the crown and thin towards the lobe, open at the front below its root
    float ring = (head_length2(f.x / 1.58f, f.y / 2.66f) - 1.0f) * 1.75f;
    float thick = 0.15f + 0.15f * head_step(-2.2f, 1.2f, f.y);
    float helix = head_length2(ring, f.z - 0.34f) - thick;
    float open = head_length2(f.x - 2.2f, f.y + 1.0f) - 1.75f;
    helix = head_carve(helix, open, 0.3f);
    ear = head_join(ear, helix, 0.20f);
    // Antihelix
    float inner = (head_length2((f.x - 0.20f) / 1.02f, (f.y + 0.10f) / 1.70f) - 1.0f) * 1.2f;
    float antihelix = head_length2(inner, f.z - 0.24f) - 0.20f - 0.06f * head_step(0.0f, 1.5f, f.y);
    antihelix = head_carve(antihelix, head_length2(f.x - 1.5f, f.y + 0.5f) - 1.5f, 0.4f);
    ear = head_join(ear, antihelix, 0.24f);
    // Concha: the bowl that leads into the ear
    ear = head_carve(ear, head_ellipsoid(e - (float3)(0.32f, -0.45f, 0.30f), (float3)(0.72f, 1.0f, 0.75f)), 0.28f);
    ear = head_carve(ear, head_ellipsoid(e - (float3)(0.62f, -0.55f, -0.20f), (float3)(0.35f, 0.40f, 0.7f)), 0.25f);
    // Lobe, tragus, antitragus, root of the helix
    ear = head_join(ear, head_ellipsoid(e - (float3)(0.45f, -2.35f, 0.12f), (float3)(0.78f, 0.80f, 0.26f)), 0.45f);
    ear = head_join(ear, head_ellipsoid(e - (float3)(1.08f, -0.70f, 0.30f), (float3)(0.28f, 0.50f, 0.30f)), 0.35f);
    ear = head_join(ear, head_ellipsoid(e - (float3)(0.22f, -1.48f, 0.26f), (float3)(0.40f, 0.24f, 0.24f)), 0.28f);
    ear = head_join(ear, head_rod(e, (float3)(1.45f, 0.60f, 0.20f), (float3)(0.25f, -0.05f, 0.0f), 0.22f, 0.14f), 0.28f);
    return head_join(d, ear, 0.70f);
}

static float head_neck(float d, float3 q)
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
static float3 head_mirrored(float3 p) { return (float3)(sqrt(p.x * p.x + 0.0049f), p.y, p.z); }

// Distance to the skin. A group of features is skipped where it is farther than its widest blend: the value is the same.
static float head_skin(float3 p)
{
    float3 q = head_mirrored(p);
    float d = head_skull(q);
    if (p.y < 2.0f)
        d = head_neck(d, q);
    float margin = fmax(d, 0.0f);
    if (head_length(q - (float3)(2.9f, 0.2f, 7.3f)) - 4.9f < margin + 1.2f)
        d = head_eyes_and_brow(d, q);
    if (head_length(q - (float3)(0.0f, -2.6f, 9.6f)) - 3.6f < margin + 1.0f)
        d = head_nose(d, q);
    if (head_length(q - (float3)(0.0f, -6.8f, 8.6f)) - 3.9f < margin + 1.8f)
        d = head_mouth(d, q);
    if (head_length(q - (float3)(7.15f, -1.6f, -1.0f)) - 4.1f < margin + 0.7f)
        d = head_ear(d, q);
    return d;
}

static float head_eyeball(float3 p)
{
    float3 e = head_mirrored(p) - EYE_CENTRE;
    // The cornea bulges from the ball
    float cornea = head_length(e - (float3)(0.0f, 0.0f, 0.52f)) - 0.76f;
    return head_join(head_length(e) - EYE_RADIUS, cornea, 0.1f);
}

// A shirt over the shoulders, with a round collar.
static float head_shirt(float3 p, float skin)
{
    float cut = p.y + 17.2f + 0.16f * p.z;
    float shell = fabs(skin - 0.25f) - 0.12f;
    float shirt = fmax(shell, cut * 0.98f);
    return shirt;
}

// Distance to whatever is nearest.
static float head_distance(float3 p)
{
    float d = head_skin(p);
    if (p.y < -10.0f)
        d = fmin(d, head_shirt(p, d));
    if (p.z > 5.0f && fabs(p.y) < 3.5f)
        d = fmin(d, head_eyeball(p));
    return d;
}
