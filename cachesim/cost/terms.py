"""The terms of the cost function one by one: M(d) by distance, and what of T(n) each term is."""

from __future__ import annotations

import numpy as np
import pandas as pd

from cachesim.cost.model import CostModel, Prediction, Prepared

#: Passes of O(d): making the mips. What the sampling passes sweep is O(m'); the rest is O(n).
_PER_SAMPLE, _PER_PIXEL = ("prefilter",), ("sampling", "pilot", "separable_h", "separable_v")


def sample_costs(prepared: Prepared, model: CostModel, num_bins: int = 8) -> pd.DataFrame:
    """R(d) measured: what a sample's reads cost by their distance.

    Columns: pass, texture, distance_mm (mean), level (mean mip), reads (share of the texture's),
    l1_bytes and l2_bytes per read: asked of the L1, and of the level behind it. The bins hold about
    as many reads each.
    """
    rows = []
    sector = prepared.machine.levels[0].sector_bytes
    for cost in prepared.costs:
        scatter, distance = cost.scatter, 0.5 * (cost.edges[1:] + cost.edges[:-1])
        for k, read in enumerate(scatter.reads):
            held = []
            for part in cost.classes:
                scale = float(np.mean(scatter.texels_per_mm[part.tiles]))
                shape = part.lanes[k].shape
                columns_of = (
                    np.broadcast_to(distance / scale, shape),
                    np.broadcast_to(np.arange(shape[0])[:, None], shape),
                    part.lanes[k],
                    part.asked[k] * sector,
                    part.missed[k] * sector,
                )
                held.append(np.stack(columns_of, axis=-1).reshape(-1, 5))
            rows += _binned(np.concatenate(held), num_bins, scatter.pass_name, read.texture)
    columns = ["pass", "texture", "distance_mm", "level", "reads", "l1_bytes", "l2_bytes"]
    return pd.DataFrame(rows, columns=columns)


def _binned(
    table: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    num_bins: int,
    pass_name: str,
    texture: str,
) -> list[tuple[str, str, float, float, float, float, float]]:
    """Rows of distance, level, reads, L1 and L2 bytes, sorted into bins of as many reads."""
    table = table[np.argsort(table[:, 0])]
    table = table[table[:, 2] > 0.0]
    reads = table[:, 2]
    middle = (np.cumsum(reads) - 0.5 * reads) / reads.sum()
    bins = np.minimum((middle * num_bins).astype(int), num_bins - 1)
    rows = []
    for k in np.unique(bins):
        part = table[bins == k]
        num = float(part[:, 2].sum())
        distance, level = (float(np.average(part[:, c], weights=part[:, 2])) for c in (0, 1))
        l1, l2 = (float(part[:, c].sum()) / num for c in (3, 4))
        rows.append((pass_name, texture, distance, level, num / float(reads.sum()), l1, l2))
    return rows


def frame_terms(prepared: Prepared, model: CostModel, predicted: Prediction) -> pd.DataFrame:
    """What of a frame's cost each term is.

    Columns: term, l2_bytes, dram_bytes, cycles: of the launches that the term is. The samples' R(d)
    and the pixels' O(m') run in the same launches, so that they share DRAM bytes and cycles.
    """
    by_launch = predicted.by_launch
    reads = prepared.missed_bytes

    def part(chosen: pd.Series) -> tuple[float, float, float]:
        found = by_launch[chosen]
        return tuple(float(found[c].sum()) for c in ("l2_bytes", "dram_bytes", "cycles"))  # type: ignore[return-value]

    sampling = by_launch["pass"].isin(_PER_PIXEL)
    making_mips = by_launch["pass"].isin(_PER_SAMPLE)
    l2, dram, cycles = part(sampling)
    rows = [
        ("R(d), the samples' reads", min(reads, l2), dram, cycles),
        ("O(m'), the rest of those passes", max(l2 - reads, 0.0), float("nan"), float("nan")),
        ("O(d), making the mips", *part(making_mips)),
        ("O(n), the other passes", *part(~sampling & ~making_mips)),
    ]
    return pd.DataFrame(rows, columns=["term", "l2_bytes", "dram_bytes", "cycles"])
