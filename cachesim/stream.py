"""Request streams: what passes between the stages of the counting model, as flat arrays in issue
order.

A request is one warp instruction's access to one line of the level that the stream is for. Batches
are bounded; no stage holds more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

LOAD, STORE, ATOMIC, NO_OPERATION = range(4)
OPERATION_CODES = {"load": LOAD, "store": STORE, "atomic": ATOMIC}

#: Bits of `Requests.meta` below the operation code: the group.
GROUP_BITS = 24
GROUP_MASK = (1 << GROUP_BITS) - 1


class Requests(NamedTuple):
    """A batch of requests to one level.

    line: (n,) uint64, byte address / line_bytes. mask: (n,) uint8, the sectors asked for, bit s =
        sector s of the line.
    meta: (n,) uint32, operation code << 24 | group; a group is one pass x texture x mip.
    written: (n,) int32, row of `bytes_written` of a store; undefined otherwise.
    bytes_written: (num_stores, 8) uint32, per sector the bytes that a store covers, one bit per
        sector_bytes / 32 (at least 1) bytes.
    segments: (num_segments + 1,) int64, offsets of the runs that go to one cache instance;
        instance: (num_segments,) uint32.
    order: (num_segments,) int64, the segments in issue order.
    """

    line: npt.NDArray[np.uint64]
    mask: npt.NDArray[np.uint8]
    meta: npt.NDArray[np.uint32]
    written: npt.NDArray[np.int32]
    bytes_written: npt.NDArray[np.uint32]
    segments: npt.NDArray[np.int64]
    instance: npt.NDArray[np.uint32]
    order: npt.NDArray[np.int64]

    @property
    def num_requests(self) -> int:
        return int(self.segments[-1])


class Outcome(NamedTuple):
    """What one level did with a batch, request by request, in the batch's own order.

    down: (n,) uint8, sectors of the request's line that go to the next level as the request's own
        operation, or as a load where `fill` is set. fill: (n,) uint8, sectors to fetch so that a
        store can be merged.
    evicted_line: (n,) uint64, and per sector evicted_owner: (n, 8) int32, 1 + the group that
        dirtied it, 0 = not written back;
    evicted_bytes: (n, 8) uint32, the bytes it holds. Empty arrays where the level cannot hold dirty
        lines.
    """

    down: npt.NDArray[np.uint8]
    fill: npt.NDArray[np.uint8]
    evicted_line: npt.NDArray[np.uint64]
    evicted_owner: npt.NDArray[np.int32]
    evicted_bytes: npt.NDArray[np.uint32]
