// What update and estimate share of the history textures.

// Whether a history texel is taken for this pixel's: see Method.disocclusion.
bool is_known(float4 history, float depth, bool on_screen)
{
#if DISOCCLUSION == 0
    return has_history(history, depth);
#elif DISOCCLUSION == 1
    return on_screen;
#else
    return true;
#endif
}

// Past counts: a byte per frame, the newest lowest in the first word. With this frame's before them.
uint4 push_count(uint4 past, uint count)
{
    uchar16 bytes = as_uchar16(past).sf0123456789abcde;
    bytes.s0 = (uchar)count;
    return as_uint4(bytes);
}

// The count of so many frames ago.
float find_count(uint4 past, int num_frames)
{
    const int place = num_frames - 1;
    const uint2 words = place < 8 ? past.xy : past.zw;
    const uint bits = (place & 4) ? words.y : words.x;
    return (float)(bits >> (8 * (place & 3)) & 255u);
}

// The sum of the bytes that the mask keeps, in halves of words.
float sum_counts(uint4 past, uint4 mask)
{
    past &= mask;
    const uint4 pairs = (past & 0x00ff00ffu) + (past >> 8 & 0x00ff00ffu);
    const uint sum = pairs.x + pairs.y + pairs.z + pairs.w;
    return (float)((sum & 0xffffu) + (sum >> 16));
}
