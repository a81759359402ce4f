"""Bit masks of warps."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from cachesim.compiled import compiled

U64 = np.uint64


@intrinsic
def _trailing_zeros(typingctx: Any, mask: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), codegen


@compiled
def lowest(mask):  # type: ignore[no-untyped-def]
    """Place of the lowest bit that is set; `mask` is not 0."""
    return _trailing_zeros(mask)  # type: ignore[call-arg]


@compiled
def bit_at(place):  # type: ignore[no-untyped-def]
    """The mask with one bit."""
    return U64(1) << U64(place)


@compiled
def without_lowest(mask):  # type: ignore[no-untyped-def]
    """`mask` without its lowest bit."""
    return mask & (mask - U64(1))
