// The names of portable.h on a processor: threads run one after the other, clocks count what loads
// and fetches would cost, textures are row-major arrays.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#include <utility>
#include <vector>

typedef unsigned int u32;
typedef unsigned long long u64;
typedef unsigned short u16;

#define KERNEL extern "C" void
#define CONSTANT
#define DEVICE static inline
#define DEVICE_METHOD inline

struct uint4 { u32 x, y, z, w; };
struct ushort4 { u16 x, y, z, w; };
struct float2 { float x, y; };
struct float4 { float x, y, z, w; };
struct Dim { u32 x; };
static Dim blockIdx, threadIdx, gridDim, blockDim;
static u64 fake_clock = 1000;
enum { FAKE_SMS = 4, L1_CYCLES = 33, L2_CYCLES = 280, TEXTURE_CYCLES = 90 };

// The sectors that each fetch of each thread of a warp touches, as (number of the fetch, sector):
// lanes execute their fetches in step.
static std::vector<std::pair<u32, u64>> touched;
static u32 fetch_number = 0;
static bool counting = false;
DEVICE void begin_fetch() { ++fetch_number; }
DEVICE void touch(u64 sector)
{
    if (counting)
        touched.emplace_back(fetch_number, sector);
}
DEVICE void touch_memory(u64 at)
{
    begin_fetch();
    touch(at >> 5);
}

DEVICE void __syncthreads() {}
DEVICE u32 atomicAdd(u32 *at, u32 value) { const u32 old = *at; *at += value; return old; }
DEVICE int __float_as_int(float value) { int bits; memcpy(&bits, &value, 4); return bits; }
DEVICE float __int_as_float(int bits) { float value; memcpy(&value, &bits, 4); return value; }
DEVICE u64 read_clock() { return fake_clock += 2; }
DEVICE u64 read_clock_after(u64) { return fake_clock += 2; }
DEVICE u64 read_timer() { return (fake_clock += 1000) / 2; }
DEVICE u32 read_sm() { return blockIdx.x % FAKE_SMS; }

DEVICE float half_to_float(u16 bits)
{
    // Bits moved into place and scaled: exact for denormals too. No infinities come here.
    const float size = __int_as_float((bits & 0x7fff) << 13) * 0x1p112f;
    return bits & 0x8000 ? -size : size;
}
// To nearest, ties to even, for numbers within the range of half floats.
DEVICE u16 float_to_half(float value)
{
    const u16 sign = __float_as_int(value) < 0 ? 0x8000 : 0;
    const float size = fabsf(value);
    // Added, it leaves the nearest multiple of a half float's last place in the low bits.
    int exponent = (__float_as_int(size) >> 23) - 127;
    exponent = exponent < -14 ? -14 : exponent;
    const float magic = ldexpf(1.5f, exponent + 13);
    const float rounded = (size + magic) - magic;
    return sign | (u16)(__float_as_int(rounded * 0x1p-112f) >> 13);
}

DEVICE u64 load_past_l1(const u64 *at) { fake_clock += L2_CYCLES; return *at; }
DEVICE uint4 load4_past_l1(const uint4 *at) { fake_clock += L2_CYCLES; return *at; }
DEVICE u64 load_through_l1(const u64 *at) { fake_clock += L1_CYCLES; return *at; }
DEVICE uint4 load4_through_l1(const uint4 *at) { fake_clock += L1_CYCLES; return *at; }
DEVICE u64 load_read_only(const u64 *at) { fake_clock += L1_CYCLES; return *at; }
DEVICE u32 load_byte(u64 at) { touch_memory(at); return *(const unsigned char *)at; }
DEVICE u32 load_word(u64 at) { touch_memory(at); return *(const u32 *)at; }
DEVICE ushort4 load_halves(u64 at) { touch_memory(at); return *(const ushort4 *)at; }
DEVICE void store_byte_at(u64 at, u32 value) { *(unsigned char *)at = (unsigned char)value; }
DEVICE void store_halves(u64 at, ushort4 value) { *(ushort4 *)at = value; }

enum Component { U8 = 1, U16 = 2, U32 = 3, HALF = 16, FLOAT = 32 };
struct HostArray {
    unsigned char *bytes;
    int width, height, component, channels;
    int component_bytes() const { return component == U8 ? 1 : component == U16 || component == HALF ? 2 : 4; }
    int texel_bytes() const { return channels * component_bytes(); }
};
struct HostTexture {
    HostArray levels[16];
    int num_levels;
    bool linear_filter, normalised, as_integer;
};

static void fail(const char *what);

DEVICE int clamp_to(int at, int size) { return at < 0 ? 0 : at >= size ? size - 1 : at; }
DEVICE const unsigned char *find_texel(const HostArray &array, int x, int y)
{
    x = clamp_to(x, array.width);
    y = clamp_to(y, array.height);
    // Block-linear: a sector is 16 bytes of two rows.
    touch(((u64)array.bytes << 24) ^ ((u64)(y >> 1) << 16) ^ (u64)(x * array.texel_bytes() >> 4));
    return array.bytes + ((size_t)y * array.width + x) * array.texel_bytes();
}
DEVICE float component_of(const HostArray &array, const unsigned char *texel, int k)
{
    if (k >= array.channels)
        return 0.0f;
    switch (array.component) {
    case U8: return texel[k] / 255.0f;
    case HALF: return half_to_float(((const u16 *)texel)[k]);
    case FLOAT: return ((const float *)texel)[k];
    default: fail("integers read as floats"); return 0.0f;
    }
}
DEVICE float4 filter_texels(const HostTexture &texture, const HostArray &array, float x, float y)
{
    float out[4];
    if (!texture.linear_filter) {
        const unsigned char *texel = find_texel(array, (int)floorf(x), (int)floorf(y));
        for (int k = 0; k < 4; ++k)
            out[k] = component_of(array, texel, k);
    } else {
        // Weights of 8 bits, as the texture unit has them.
        const float at_x = floorf((x - 0.5f) * 256.0f + 0.5f) / 256.0f, at_y = floorf((y - 0.5f) * 256.0f + 0.5f) / 256.0f;
        const int left = (int)floorf(at_x), above = (int)floorf(at_y);
        const float u = at_x - left, v = at_y - above;
        for (int k = 0; k < 4; ++k) {
            const float p = component_of(array, find_texel(array, left, above), k);
            const float q = component_of(array, find_texel(array, left + 1, above), k);
            const float r = component_of(array, find_texel(array, left, above + 1), k);
            const float s = component_of(array, find_texel(array, left + 1, above + 1), k);
            out[k] = (p * (1 - u) + q * u) * (1 - v) + (r * (1 - u) + s * u) * v;
        }
    }
    return {out[0], out[1], out[2], out[3]};
}

template <class T> T convert_texel(const HostTexture &texture, const HostArray &array, float x, float y);
template <> inline float4 convert_texel(const HostTexture &t, const HostArray &a, float x, float y)
{
    return filter_texels(t, a, x, y);
}
template <> inline float2 convert_texel(const HostTexture &t, const HostArray &a, float x, float y)
{
    const float4 v = filter_texels(t, a, x, y);
    return {v.x, v.y};
}
template <> inline float convert_texel(const HostTexture &t, const HostArray &a, float x, float y)
{
    return filter_texels(t, a, x, y).x;
}
template <> inline u32 convert_texel(const HostTexture &t, const HostArray &a, float x, float y)
{
    if (!t.as_integer || a.component != U32)
        fail("no texture of 32-bit integers");
    return *(const u32 *)find_texel(a, (int)floorf(x), (int)floorf(y));
}
template <> inline unsigned char convert_texel(const HostTexture &t, const HostArray &a, float x, float y)
{
    if (!t.as_integer || a.component != U8)
        fail("no texture of bytes");
    return *find_texel(a, (int)floorf(x), (int)floorf(y));
}

template <class T> T tex2D(u64 handle, float x, float y)
{
    const HostTexture &texture = *(const HostTexture *)handle;
    if (texture.normalised)
        fail("tex2D of a texture with normalised coordinates");
    fake_clock += TEXTURE_CYCLES;
    begin_fetch();
    return convert_texel<T>(texture, texture.levels[0], x, y);
}
template <class T> T tex2DLod(u64 handle, float u, float v, float lod)
{
    const HostTexture &texture = *(const HostTexture *)handle;
    if (!texture.normalised)
        fail("tex2DLod of a texture without normalised coordinates");
    fake_clock += TEXTURE_CYCLES;
    begin_fetch();
    const HostArray &array = texture.levels[clamp_to((int)(lod + 0.5f), texture.num_levels)];
    return convert_texel<T>(texture, array, u * array.width, v * array.height);
}
template <class T> T tex1Dfetch(u64 handle, int at)
{
    const HostTexture &texture = *(const HostTexture *)handle;
    fake_clock += TEXTURE_CYCLES;
    return ((const T *)texture.levels[0].bytes)[at];
}
template <class T> void surf2Dwrite(T value, u64 handle, int x_bytes, int y)
{
    const HostArray &array = *(const HostArray *)handle;
    if ((int)sizeof(T) != array.texel_bytes() || x_bytes < 0 || x_bytes >= array.width * (int)sizeof(T) || y < 0 || y >= array.height)
        fail("a surface store that the GPU would trap");
    memcpy(array.bytes + (size_t)y * array.width * sizeof(T) + x_bytes, &value, sizeof(T));
}
