"""Host memory that kernels write trace rows into, recycled once nobody holds the rows any more."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from kernels.opencl.device import Device
from traces.texture import WARP_SIZE

_PAGE_BYTES = 4096
ROW_BYTES = WARP_SIZE * 4


@dataclass(eq=False)
class LaneBuffer:
    """Memory that host and device share. mapping: the host's current view of it, None while the
    device writes.
    """

    memory: npt.NDArray[np.uint8]
    buffer: cl.Buffer
    mapping: Any = None


class LanePool:
    """Buffers of one size. A buffer comes back by itself when the last array over its rows is
    gone.
    """

    def __init__(self, device: Device, num_rows: int) -> None:
        self._device = device
        self._num_bytes = max(1, num_rows) * ROW_BYTES
        self._free: list[LaneBuffer] = []

    def take(self) -> LaneBuffer:
        """A buffer for the device to write."""
        if not self._free:
            # CPU devices use the memory in place where it begins on a page.
            raw = np.empty(self._num_bytes + _PAGE_BYTES, np.uint8)
            start = -raw.ctypes.data % _PAGE_BYTES
            memory = raw[start : start + self._num_bytes]
            flags = cl.mem_flags.WRITE_ONLY | cl.mem_flags.USE_HOST_PTR
            return LaneBuffer(memory, cl.Buffer(self._device.context, flags, hostbuf=memory))
        lent = self._free.pop()
        if lent.mapping is not None:
            lent.mapping.release(self._device.queue)
            lent.mapping = None
        return lent

    def lend(self, lent: LaneBuffer, num_rows: int) -> npt.NDArray[np.uint32]:
        """(num_rows, 32) uint32: the rows, once all that was enqueued before has run; blocks until
        then.
        """
        queue, size = self._device.queue, (max(1, num_rows) * WARP_SIZE,)
        map_buffer: Any = cl.enqueue_map_buffer  # its stub refuses every dtype
        array, event = map_buffer(
            queue, lent.buffer, cl.map_flags.READ, 0, size, np.uint32, is_blocking=False
        )
        event.wait()
        lent.mapping = array.base
        # An array over a memoryview: slices of it keep it, and only it, alive.
        owner = np.frombuffer(lent.memory.data, np.uint32)
        weakref.finalize(owner, self._free.append, lent)
        return owner[: num_rows * WARP_SIZE].reshape(num_rows, WARP_SIZE)
