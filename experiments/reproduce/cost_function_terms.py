"""The cost function's terms on one GPU: M(d) by distance, parts of T(n), the hybrid's w and S."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from cachesim.config import Gpu
    from cachesim.cost.fit import Observation
    from cachesim.cost.model import CostModel, Prepared
    from experiments.reproduce.cost_function_cells import Cell


def make_terms(
    cells: tuple[Cell, ...], observed: list[dict[str, Observation]], gpu: Gpu, model: CostModel
) -> dict[str, Any]:
    """Tables of the terms on one GPU: M(d), the parts of T(n), and the hybrid's w and S."""
    from cachesim.cost.machine import Machine
    from cachesim.cost.model import Prepared, predict_prepared
    from cachesim.cost.terms import frame_terms, sample_costs

    chosen = next(k for k, c in enumerate(cells) if c.scene == "close" and c.kind == "adaptive")
    prepared = Prepared(observed[chosen][gpu.name].workload, Machine.of(gpu))
    predicted = predict_prepared(prepared, model)
    found: dict[str, Any] = {
        "M-of-d": sample_costs(prepared, model),
        "T-of-n": frame_terms(prepared, model, predicted),
    }
    hybrid = next(
        (k for k, c in enumerate(cells) if c.kind == "hybrid" and c.scene == "front"), None
    )
    if hybrid is not None:
        found["hybrid"] = _hybrid_table(
            Prepared(observed[hybrid][gpu.name].workload, Machine.of(gpu)), model
        )
    return found


def _hybrid_table(prepared: Prepared, model: CostModel) -> pd.DataFrame:
    """w_ia, summed, and S of each technique: tiles, share, samples and L2 bytes of a pixel."""
    import pandas as pd

    sector = prepared.machine.levels[0].sector_bytes
    rows = []
    for cost in prepared.costs:
        pixels = int(cost.scatter.pixels.sum())
        missed = cost.missed * sector
        rows.append(
            {
                "pass": cost.scatter.pass_name,
                "tiles": int((cost.scatter.pixels > 0).sum()),
                "pixels": pixels,
                "reads_per_pixel": cost.scatter.num_samples / max(pixels, 1),
                "l2_bytes_per_pixel": missed / max(pixels, 1),
            }
        )
    frame = pd.DataFrame(rows)
    techniques = frame["pass"].where(~frame["pass"].str.startswith("separable"), "separable")
    tiles = frame.groupby(techniques)["tiles"].max()
    frame["w"] = techniques.map(tiles / tiles.sum())
    return frame
