"""Which path a trace's fetches take on a GPU, and where its texels lie."""

from __future__ import annotations

from collections.abc import Mapping

from cachesim.config import FetchPath, Gpu
from traces.errors import unknown
from traces.placement import AddressMap, place
from traces.trace import Trace

FETCH_PATHS: tuple[FetchPath, ...] = ("texture", "readonly", "global")


def addressing(
    trace: Trace,
    gpu: Gpu,
    fetch_path: str | None,
    layout: str | None,
    layouts: Mapping[str, str] | None,
) -> tuple[str, str | None, AddressMap | None]:
    """The fetch path, the layout and the addresses of texels; the latter two None for a
    lane-address trace.

    Raises:
        InputError: unknown fetch path or layout.
    """
    default = gpu.lane_address_path if trace.is_lane_address else "texture"
    path = fetch_path or default
    if path not in FETCH_PATHS:
        raise unknown("fetch path", path, FETCH_PATHS)
    if trace.is_lane_address:
        return path, None, None
    name = layout or gpu.texture_layout
    return path, name, place(trace.textures, name, overrides=layouts)
