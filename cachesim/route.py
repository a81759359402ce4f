"""From one level's outcome to the next level's requests: what is passed down, in issue order, in
the next level's lines and sectors.

A request's own sectors go first (fetches for a load, the store itself otherwise), then the fetch
that a store needs, then the write-back of the line it evicted.
"""

from __future__ import annotations

import numpy as np

from cachesim.compiled import compiled, inlined
from cachesim.stream import GROUP_BITS, GROUP_MASK, LOAD, STORE

U64, U32 = np.uint64, np.uint32


@inlined
def _scaled_bytes(bits, upper_sector_bytes, lower_sector_bytes, part, lower_all):  # type: ignore[no-untyped-def]
    """The byte bits of part `part` of an upper sector, in the granules of a lower sector of the
    same or smaller size.
    """
    upper_granule = max(1, upper_sector_bytes // 32)
    lower_granule = max(1, lower_sector_bytes // 32)
    scaled = U32(0)
    for bit in range(min(32, lower_sector_bytes)):
        byte = part * lower_sector_bytes + bit * lower_granule
        if (bits >> U32(byte // upper_granule)) & U32(1):
            scaled |= U32(1) << U32(bit)
    return scaled & U32(lower_all)


@compiled
def pass_down(  # type: ignore[no-untyped-def]
    requests,
    outcome,
    upper_line_bytes,
    upper_sector_bytes,
    lower_line_bytes,
    lower_sector_bytes,
    line,
    mask,
    meta,
    written,
    bytes_written,
    position,
):
    """Write the next level's requests into line, mask, meta, written, bytes_written; returns
    (requests, stores) written.

    position: (n,) uint32, the segment of the batch that each came from. The output arrays hold at
        least `bound_passed_down` entries. Lower sectors divide upper ones.
    """
    sectors = upper_line_bytes // upper_sector_bytes
    parts = upper_sector_bytes // lower_sector_bytes
    lower_all = U32((U64(1) << U64(min(32, lower_sector_bytes))) - U64(1))
    same = upper_line_bytes == lower_line_bytes and parts == 1
    lines, metas, all_down = requests.line, requests.meta, outcome.down
    num, stores = U64(0), 0
    for k in range(len(requests.order)):
        segment = requests.order[k]
        begin, end = U64(requests.segments[segment]), U64(requests.segments[segment + 1])
        for i in range(begin, end):
            down = all_down[i]
            code = metas[i]
            operation = code >> U32(GROUP_BITS)
            group = code & U32(GROUP_MASK)
            if same and operation == LOAD:
                # Written in any case and kept where something goes down: a branch would be guessed
                # wrong often.
                line[num], mask[num], meta[num] = lines[i], down, code
                position[num] = segment
                num += U64(down != 0)
            else:
                fill = np.uint8(0)
                if operation != LOAD and len(outcome.fill):
                    fill = outcome.fill[i]
                for kind in range(2):
                    todo = down if kind == 0 else fill
                    passed = operation if kind == 0 else U32(LOAD)
                    for s in range(sectors):
                        if not (todo >> np.uint8(s)) & np.uint8(1):
                            continue
                        bits = (
                            requests.bytes_written[requests.written[i], s]
                            if passed == STORE
                            else U32(0)
                        )
                        num, stores = _append(
                            requests.line[i],
                            s,
                            bits,
                            passed,
                            group,
                            segment,
                            upper_line_bytes,
                            upper_sector_bytes,
                            lower_line_bytes,
                            lower_sector_bytes,
                            parts,
                            lower_all,
                            s == 0 or not (todo & ((np.uint8(1) << np.uint8(s)) - np.uint8(1))),
                            line,
                            mask,
                            meta,
                            written,
                            bytes_written,
                            position,
                            num,
                            stores,
                        )
            if len(outcome.evicted_owner):
                first = True
                for s in range(sectors):
                    owner = outcome.evicted_owner[i, s] - 1
                    if owner < 0:
                        continue
                    outcome.evicted_owner[i, s] = 0
                    if s > 0 and not first:
                        first = meta[num - U64(1)] & U32(GROUP_MASK) != U32(owner)
                    num, stores = _append(
                        outcome.evicted_line[i],
                        s,
                        outcome.evicted_bytes[i, s],
                        U32(STORE),
                        U32(owner),
                        segment,
                        upper_line_bytes,
                        upper_sector_bytes,
                        lower_line_bytes,
                        lower_sector_bytes,
                        parts,
                        lower_all,
                        first,
                        line,
                        mask,
                        meta,
                        written,
                        bytes_written,
                        position,
                        num,
                        stores,
                    )
                    first = False
    return num, stores


@inlined
def _append(  # type: ignore[no-untyped-def]
    upper_line,
    sector,
    bits,
    operation,
    group,
    segment,
    upper_line_bytes,
    upper_sector_bytes,
    lower_line_bytes,
    lower_sector_bytes,
    parts,
    lower_all,
    is_first,
    line,
    mask,
    meta,
    written,
    bytes_written,
    position,
    num,
    stores,
):
    """Append one upper sector to the lower requests: to the last one where it is the same access
    and line, else as a new one.
    """
    for part in range(parts):
        offset = U64(sector * upper_sector_bytes + part * lower_sector_bytes)
        # Only the number of the line is kept: a line number times its size may not fit in 64 bits
        # when it is off by one.
        if lower_line_bytes <= upper_line_bytes:
            lower = upper_line * U64(upper_line_bytes // lower_line_bytes) + offset // U64(
                lower_line_bytes
            )
            within = offset % U64(lower_line_bytes)
        else:
            ratio = U64(lower_line_bytes // upper_line_bytes)
            lower = upper_line // ratio
            within = (upper_line % ratio) * U64(upper_line_bytes) + offset
        lower_sector = within // U64(lower_sector_bytes)
        if (is_first and part == 0) or line[num - U64(1)] != lower:
            line[num], mask[num], position[num] = lower, 0, segment
            meta[num] = (U32(operation) << U32(GROUP_BITS)) | U32(group)
            if operation == STORE:
                written[num] = stores
                for s in range(8):
                    bytes_written[stores, s] = 0
                stores += 1
            num += U64(1)
        mask[num - U64(1)] |= np.uint8(1) << np.uint8(lower_sector)
        if operation == STORE:
            scaled = (
                bits
                if parts == 1
                else _scaled_bytes(bits, upper_sector_bytes, lower_sector_bytes, part, lower_all)
            )
            bytes_written[stores - 1, lower_sector] = scaled
    return num, stores
