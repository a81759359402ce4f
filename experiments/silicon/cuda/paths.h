// The two ways in which the passes reach their texels.
#pragma once
#include "passes.h"

// Texture objects on arrays, of which the setup texture's is mip-mapped; stores through surfaces.
struct TexturePath {
    static DEVICE_METHOD Colour to_colour(float4 v) { return make_colour(v.x, v.y, v.z, v.w); }
    static DEVICE_METHOD Colour fetch_colour(Image image, int x, int y)
    {
        return to_colour(tex2D<float4>(image.fetch, (float)x + 0.5f, (float)y + 0.5f));
    }
    static DEVICE_METHOD float fetch_float(Image image, int x, int y)
    {
        return tex2D<float>(image.fetch, (float)x + 0.5f, (float)y + 0.5f);
    }
    static DEVICE_METHOD float2 fetch_pair(Image image, int x, int y)
    {
        return tex2D<float2>(image.fetch, (float)x + 0.5f, (float)y + 0.5f);
    }
    static DEVICE_METHOD u32 fetch_word(Image image, int x, int y)
    {
        return tex2D<u32>(image.fetch, (float)x + 0.5f, (float)y + 0.5f);
    }
    static DEVICE_METHOD u32 fetch_byte(Image image, int x, int y)
    {
        return tex2D<unsigned char>(image.fetch, (float)x + 0.5f, (float)y + 0.5f);
    }
    // Coordinates of a mip-mapped texture must be shares of its sides.
    static DEVICE_METHOD Colour fetch_level(const Constants &c, int level, int x, int y)
    {
        const float u = ((float)x + 0.5f) * c.texel[2 * level];
        const float v = ((float)y + 0.5f) * c.texel[2 * level + 1];
        return to_colour(tex2DLod<float4>(setup_levels.fetch, u, v, (float)level));
    }
    static DEVICE_METHOD Colour filter_level(int level, float u, float v)
    {
        return to_colour(tex2DLod<float4>(setup_levels.filtered, u, v, (float)level));
    }
    static DEVICE_METHOD void store_colour(Image image, int x, int y, ushort4 bits)
    {
        surf2Dwrite(bits, image.store, x * 8, y);
    }
    static DEVICE_METHOD void store_byte(Image image, int x, int y, u32 value)
    {
        surf2Dwrite((unsigned char)value, image.store, x, y);
    }
    static DEVICE_METHOD void store_level(int level, int x, int y, ushort4 bits)
    {
        surf2Dwrite(bits, setup_levels.level[level], x * 8, y);
    }
};

// Plain loads and stores of row-major memory. Image: (first byte, bytes of a row).
struct LoadPath {
    static DEVICE_METHOD u64 find(Image image, int x, int y, int bytes)
    {
        return image.fetch + (u64)(u32)y * image.store + (u64)(u32)(x * bytes);
    }
    static DEVICE_METHOD u64 find_in_level(int level, int x, int y)
    {
        return setup_levels.level[level] + (u64)(u32)y * setup_levels.pitch[level] + (u64)(u32)(x * 8);
    }
    static DEVICE_METHOD Colour decode(ushort4 bits)
    {
        return make_colour(half_to_float(bits.x), half_to_float(bits.y), half_to_float(bits.z), half_to_float(bits.w));
    }
    static DEVICE_METHOD Colour fetch_colour(Image image, int x, int y)
    {
        return decode(load_halves(find(image, x, y, 8)));
    }
    static DEVICE_METHOD float fetch_float(Image image, int x, int y)
    {
        return __int_as_float((int)load_word(find(image, x, y, 4)));
    }
    static DEVICE_METHOD float2 fetch_pair(Image image, int x, int y)
    {
        const u32 bits = load_word(find(image, x, y, 4));
        float2 pair;
        pair.x = half_to_float((u16)bits);
        pair.y = half_to_float((u16)(bits >> 16));
        return pair;
    }
    static DEVICE_METHOD u32 fetch_word(Image image, int x, int y) { return load_word(find(image, x, y, 4)); }
    static DEVICE_METHOD u32 fetch_byte(Image image, int x, int y) { return load_byte(find(image, x, y, 1)); }
    static DEVICE_METHOD Colour fetch_level(const Constants &, int level, int x, int y)
    {
        return decode(load_halves(find_in_level(level, x, y)));
    }
    static DEVICE_METHOD void store_colour(Image image, int x, int y, ushort4 bits)
    {
        store_halves(find(image, x, y, 8), bits);
    }
    static DEVICE_METHOD void store_byte(Image image, int x, int y, u32 value)
    {
        store_byte_at(find(image, x, y, 1), value);
    }
    static DEVICE_METHOD void store_level(int level, int x, int y, ushort4 bits)
    {
        store_halves(find_in_level(level, x, y), bits);
    }
};
