"""Bit masks, and powers of two."""

from __future__ import annotations

from collections.abc import Callable
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


def _counting(build: Callable[[Any, Any], Any]) -> Any:
    """A compiled function of a mask whose result one of the host's instructions counts."""

    @intrinsic
    def count(typingctx: Any, mask: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return build(builder, arguments[0])

        return types.int64(types.uint64), codegen

    return count


_NOT_ZERO = ir.Constant(ir.IntType(1), 1)
_trailing_zeros = _counting(lambda builder, mask: builder.cttz(mask, _NOT_ZERO))
_leading_zeros = _counting(lambda builder, mask: builder.ctlz(mask, _NOT_ZERO))
_population = _counting(lambda builder, mask: builder.ctpop(mask))


@small
def num_set(mask):  # type: ignore[no-untyped-def]
    """How many bits are set."""
    return _population(mask)


@small
def lowest(mask):  # type: ignore[no-untyped-def]
    """Place of the lowest bit that is set; `mask` is not 0."""
    return _trailing_zeros(mask)


@small
def highest(mask):  # type: ignore[no-untyped-def]
    """Place of the highest bit that is set; `mask` is not 0."""
    return 63 - _leading_zeros(mask)


@small
def bit_at(place):  # type: ignore[no-untyped-def]
    """The mask with one bit."""
    return U64(1) << U64(place)


@small
def without_lowest(mask):  # type: ignore[no-untyped-def]
    """`mask` without its lowest bit."""
    return mask & (mask - U64(1))
