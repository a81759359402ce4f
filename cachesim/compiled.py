"""How the hot loops are compiled: cached, without the interpreter's lock, without reference counts.

numba counts references to an array whenever a loop takes it out of a tuple or hands it to another
function, which cost more than the cache look-ups themselves (measured: two thirds of the time).
Nothing here allocates, so `_nrt=False` leaves the counts out.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_options: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False, "error_model": "numpy"}

#: A compiled function.
compiled: Any = njit(**_options)
#: A small one that the machine code of its callers includes.
small: Any = njit(**_options, forceinline=True)
#: A small one that becomes part of the loop that calls it.
inlined: Any = njit(**_options, inline="always")
