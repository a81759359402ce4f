"""Sizes with units: "48 KiB" to bytes and back.

Binary units only: "KB" means 1000 bytes to some and 1024 to others, so it is refused.
"""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Any

_UNITS = {"B": 1, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*")


def parse_size(value: Any) -> int:
    """Bytes of 49152, "49152", "48 KiB", "5.5MiB".

    Raises:
        ValueError: not a size, an unknown unit (allowed: B, KiB, MiB, GiB), or not a whole number
            of bytes.
    """
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise ValueError(f"{value!r} is not a size; write bytes or for example '48 KiB'")
    if isinstance(value, int):
        return value
    match = _SIZE.fullmatch(value)
    unit = (match[2] or "B") if match else ""
    if not match or unit not in _UNITS:
        raise ValueError(f"{value!r} is not a size; allowed units are {', '.join(_UNITS)}")
    size = Fraction(match[1]) * _UNITS[unit]
    if size.denominator != 1:
        raise ValueError(f"{value!r} is not a whole number of bytes")
    return size.numerator


def format_size(size_bytes: int) -> str:
    """ "48 KiB" for 49152: in the largest unit that gives a whole or a half number, else in bytes.

    Inverse of `parse_size`.
    """
    for unit in ("GiB", "MiB", "KiB"):
        halves, rest = divmod(2 * size_bytes, _UNITS[unit])
        if halves >= 2 and rest == 0:
            return f"{halves // 2}{'.5' * (halves % 2)} {unit}"
    return f"{size_bytes} B"
