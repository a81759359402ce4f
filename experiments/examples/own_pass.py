"""Trace a pass of your own: a 9-tap horizontal blur, written down as warp-wide accesses.

Run: python experiments/examples/own_pass.py [FOLDER]
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cachesim import Report, simulate
from traces.parquet import write_parquet
from traces.texture import Texture, pack_texel
from traces.trace import Chunk, Instruction, Launch, Trace

TAPS = range(-4, 5)


def main(folder: Path, width: int = 960, height: int = 544) -> Report:
    """One launch of 32x1-pixel warps, eight to a CTA: nine loads and a store each."""
    source, target = (Texture(name, "RGBA16F", width, height) for name in ("source", "target"))
    # The static accesses, as a program counter names them: nine loads, then a store.
    program = [Instruction("blur", 0, "load", arithmetic=(("int", 2), ("fp32", 4))) for _ in TAPS]
    program.append(Instruction("blur", 1, "store"))
    columns, bands = width // 32, height // 8  # the size in CTAs of 32x8 pixels
    launch = Launch(frame=0, pass_name="blur", num_ctas=columns * bands, warps_per_cta=8)

    def chunks() -> Iterator[Chunk]:
        """One chunk per band of CTAs; a row is (warp, step), its lanes are 32 packed texels."""
        for band in range(bands):
            cta, warp, lane = np.ogrid[:columns, :8, :32]
            x, y = cta * 32 + lane, band * 8 + warp
            steps = [pack_texel(0, y, np.clip(x + tap, 0, width - 1)) for tap in TAPS]
            lanes = np.stack([*steps, pack_texel(0, y, x)], axis=2).reshape(-1, 32)
            instruction = np.tile(np.arange(10, dtype=np.uint16), columns * 8)
            offsets = np.arange(0, len(lanes) + 1, 10)
            yield Chunk(0, band * columns, offsets, instruction, lanes)

    trace = Trace({"name": "blur"}, [source, target], program, [launch], chunks)
    write_parquet(trace, folder / "blur.parquet")  # checked on its way; then: cachesim run
    return simulate(trace, "titan-x-pascal")


if __name__ == "__main__":
    print(main(Path(sys.argv[1] if len(sys.argv) > 1 else ".")).frame().to_string(index=False))
