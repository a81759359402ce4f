"""Texel formats and filters as the GPU's textures have them."""

from __future__ import annotations

from experiments.silicon.driver import Gpu, MipmappedArray

#: Our format: (component, channels). R11G11B10F has no CUDA array format: it cannot be measured.
FORMATS: dict[str, tuple[str, int]] = {
    "R8": ("u8", 1),
    "R16F": ("half", 1),
    "RGBA8": ("u8", 4),
    "R32F": ("float", 1),
    "RGBA16F": ("half", 4),
    "RGBA32F": ("float", 4),
}
#: Filter: (where in its texel a fetch stands, what is added to its level). Halfway between texels a
#: bilinear fetch needs four; halfway between levels a trilinear one needs both.
FILTERS: dict[str, tuple[float, float]] = {
    "point": (0.5, 0.0),
    "bilinear": (1.0, 0.0),
    "trilinear": (1.0, 0.5),
}


class TextureMaker:
    """Textures on square mip-mapped arrays whose content does not matter; arrays are shared."""

    def __init__(self, gpu: Gpu) -> None:
        self._gpu = gpu
        self._chains: dict[tuple[str, int, int], MipmappedArray] = {}

    def make(self, format_name: str, filtered: str, side: int, num_levels: int) -> int:
        """A texture object."""
        key = format_name, side, num_levels
        if key not in self._chains:
            component, channels = FORMATS[format_name]
            self._chains[key] = self._gpu.make_mipmapped(
                side, side, component, channels, num_levels
            )
        return self._gpu.texture(self._chains[key], filtered=filtered, normalised=True)
