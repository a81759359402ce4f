"""The picture that methods are judged against, drawn once and kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from experiments.reproduce.parts import Arrays, Parts
    from kernels.frame import Float
    from kernels.gbuffer import GBuffer
    from kernels.method import Method
    from kernels.opencl.device import Device


def draw_reference(
    gbuffer: GBuffer, method: Method, num_samples: int, parts: Parts, device: Device
) -> Float:
    """(h, w, 3) a G-buffer with `num_samples` samples per pixel, read where it is finished.

    method: whose scale and weights the reference has; see `kernels.quality.reference_image`.
    """
    from experiments.p4000_study import digest
    from kernels.quality import reference_image

    def draw() -> Arrays:
        return {"image": reference_image(gbuffer, method, device, num_samples)}

    inputs = {"gbuffer": digest(gbuffer), "method": method.as_dict(), "samples": num_samples}
    return parts.arrays(f"reference-{gbuffer.name}", inputs, draw)["image"]
