"""Where a frame's textures lie in memory, and how many sectors the pixels of a sweep ask for.

Nothing here is a model: layouts are those of the simulator, and sectors are counted.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cachesim.cost.machine import Machine
from cachesim.cost.workload import Ints, Sweep, Workload
from traces.placement import AddressMap, place

#: Blocks of a sweep that are looked at, along each side of the frame.
_LOOKED_AT = 9


@dataclass(frozen=True, eq=False)
class Memory:
    """The textures of a workload under a machine's layout."""

    placed: AddressMap
    sector_bytes: int
    index: dict[str, int]
    _sectors: dict[tuple[object, ...], float] = field(default_factory=dict)

    @staticmethod
    def of(workload: Workload, machine: Machine) -> Memory:
        """Place the textures as the simulator does."""
        placed = place(workload.textures, machine.gpu.texture_layout)
        names = {texture.name: k for k, texture in enumerate(workload.textures)}
        return Memory(placed, machine.levels[0].sector_bytes, names)

    def level_bytes(self, texture: str, mip: int) -> float:
        """Bytes of a level that texels lie in. GPGPU-Sim's blocks overlap, so that it is fewer than
        the texels' own.
        """
        k = self.index[texture]
        described = self.placed.textures[k]
        width, height = described.mip_size(mip)
        texels = width * height * described.texel_bytes
        return float(min(texels, int(self.placed.size_bytes[k, mip])))

    def sectors(self, texture: int, mip: int, y: Ints, x: Ints) -> npt.NDArray[np.uint64]:
        """Sector numbers of texels, which are clamped to the level."""
        m = self.placed
        x = np.clip(x, 0, m.width[texture, mip] - 1)
        y = np.clip(y, 0, m.height[texture, mip] - 1)
        x_term = m.x_tables[m.x_start[texture, mip] + x].astype(np.uint64)
        y_term = m.y_tables[m.y_start[texture, mip] + y].astype(np.uint64)
        low = np.uint64(m.low_mask[texture])
        offset = (x_term & ~low) + (y_term & ~low) + ((x_term ^ y_term) & low)
        found: npt.NDArray[np.uint64] = (m.base[texture, mip] + offset) // np.uint64(
            self.sector_bytes
        )
        return found

    def row_sectors(self, sweep: Sweep, block: tuple[int, int]) -> float:
        """Different sectors that a block of pixels asks for in a sweep, all of them active: the
        mean over blocks of the frame.
        """
        key = (sweep.texture, sweep.mip, sweep.pass_name, sweep.bilinear, block)
        if key not in self._sectors:
            self._sectors[key] = self._count(sweep, block)
        return self._sectors[key]

    def _count(self, sweep: Sweep, block: tuple[int, int]) -> float:
        halves = sweep.bilinear and sweep.pass_name == "prefilter"
        texture = self.index[sweep.texture]
        width = sweep.width // 2 if halves else sweep.width
        height = sweep.height // 2 if halves else sweep.height
        at_x, at_y = (_spread(n, side) for n, side in ((width, block[0]), (height, block[1])))
        x, y = np.meshgrid(np.arange(block[0]), np.arange(block[1]))
        found = []
        for corner_y in at_y:
            for corner_x in at_x:
                columns, rows = corner_x + x.ravel(), corner_y + y.ravel()
                inside = (columns < max(width, 1)) & (rows < max(height, 1))
                columns, rows = columns[inside], rows[inside]
                if halves:
                    columns, rows = 2 * columns, 2 * rows
                if sweep.bilinear:
                    columns = np.concatenate([columns, columns + 1, columns, columns + 1])
                    rows = np.concatenate([rows, rows, rows + 1, rows + 1])
                found.append(len(np.unique(self.sectors(texture, sweep.mip, rows, columns))))
        return float(np.mean(found))


def _spread(texels: int, side: int) -> Ints:
    """Corners of some blocks along a side of the frame, whole ones where there are any."""
    blocks = max(1, texels // side)
    chosen = np.unique(np.linspace(0, blocks - 1, min(blocks, _LOOKED_AT)).astype(np.int64))
    found: Ints = chosen * side
    return found
