"""Bit masks, and powers of two."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from cachesim.compiled import small

U64 = np.uint64


def power_of_two(number: int) -> int:
    """The least power of two that is not below `number`."""
    return 1 << max(0, number - 1).bit_length()


@intrinsic
def _trailing_zeros(typingctx: Any, mask: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), codegen


@intrinsic
def _population(typingctx: Any, mask: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), codegen


@small
def num_set(mask):  # type: ignore[no-untyped-def]
    """How many bits are set."""
    return _population(mask)  # type: ignore[call-arg]


@small
def lowest(mask):  # type: ignore[no-untyped-def]
    """Place of the lowest bit that is set; `mask` is not 0."""
    return _trailing_zeros(mask)  # type: ignore[call-arg]


@intrinsic
def _leading_zeros(typingctx: Any, mask: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctlz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), codegen


@small
def highest(mask):  # type: ignore[no-untyped-def]
    """Place of the highest bit that is set; `mask` is not 0."""
    return 63 - _leading_zeros(mask)  # type: ignore[call-arg]


@small
def bit_at(place):  # type: ignore[no-untyped-def]
    """The mask with one bit."""
    return U64(1) << U64(place)


@small
def without_lowest(mask):  # type: ignore[no-untyped-def]
    """`mask` without its lowest bit."""
    return mask & (mask - U64(1))
