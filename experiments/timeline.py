"""A run's timeline in Chrome's trace-event format, which Perfetto and chrome://tracing open.

    timeline.event(...), timeline.counter(...) ──► a line of JSON each ──► FILE, once it is whole

Times are written in microseconds at the preset's clock, to the nanosecond, the resolution at which
both viewers keep them; each event's own cycles stand in its arguments.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from traces.files import replacing, writing

#: The one process of the timeline: the machine.
_PROCESS = 1
#: Bytes of text that are held back before they are written.
_BUFFER_BYTES = 1 << 16


class Timeline:
    """Writes events as they come; memory does not grow with their number.

    A viewer can show events of one track only nested or one after the other. An event that begins
    before another of its track has ended therefore goes to a further lane of the track, called
    "TRACK (2)" and so on.
    """

    def __init__(self, file: TextIO, path: Path, clock_hz: int, title: str) -> None:
        self._file = file
        self._path = path
        self._clock_hz = clock_hz
        self._pending: list[str] = []
        self._pending_bytes = 0
        self._is_first = True
        #: Track -> for each of its lanes, the viewer's thread and the cycle at which it is free.
        self._lanes: dict[str, list[list[int]]] = {}
        self._num_threads = 0
        self.num_events = 0
        head = {"clock_hz": clock_hz, "cycles": "of the SMs; in the arguments of each event"}
        self._put('{"displayTimeUnit": "ns", "otherData": ' + json.dumps(head))
        self._put(', "traceEvents": [')
        self._metadata("process_name", 0, {"name": title})

    def event(
        self, name: str, category: str, start_cycle: int, duration_cycles: int, track: str
    ) -> None:
        """Something that took a while.

        Args:
            name: what it was. category: by which viewers filter. start_cycle: core cycle since the
                run began. duration_cycles: core cycles, 0 and up. track: where it happened.

        Raises:
            ValueError: a negative start or duration.
            WorkError: the file could not be written.
        """
        start, end = int(start_cycle), int(start_cycle) + int(duration_cycles)
        if start < 0 or end < start:
            raise ValueError(
                f"event {name!r}: start {start}, duration {end - start}: allowed are 0 and up"
            )
        start_ns, end_ns = self._nanoseconds(start), self._nanoseconds(end)
        self.num_events += 1
        self._record(
            {
                "name": name,
                "cat": category,
                "ph": "X",
                "ts": start_ns / 1000,
                "dur": (end_ns - start_ns) / 1000,
                "pid": _PROCESS,
                "tid": self._lane(track, start, end),
                "args": {"cycle": start, "cycles": end - start},
            }
        )

    def counter(self, name: str, cycle: int, value: float) -> None:
        """The value of something from `cycle` on, drawn as a graph of that name.

        Raises:
            ValueError: a negative cycle, or a value that is not finite.
            WorkError: the file could not be written.
        """
        if cycle < 0:
            raise ValueError(f"counter {name!r}: cycle {cycle}: allowed are 0 and up")
        self.num_events += 1
        plain = value.item() if hasattr(value, "item") else value
        self._record(
            {
                "name": name,
                "ph": "C",
                "ts": self._nanoseconds(int(cycle)) / 1000,
                "pid": _PROCESS,
                "args": {"value": plain},
            }
        )

    def close(self) -> None:
        """Write what is held back, and the end."""
        self._put("\n]}\n")
        self._flush()

    def _nanoseconds(self, cycle: int) -> int:
        """Whole nanoseconds, rounded half up in integers: events that meet in cycles meet here."""
        return (2 * cycle * 1_000_000_000 + self._clock_hz) // (2 * self._clock_hz)

    def _lane(self, track: str, start: int, end: int) -> int:
        """The viewer's thread of the first lane of `track` that is free at `start`."""
        lanes = self._lanes.setdefault(track, [])
        for lane in lanes:
            if lane[1] <= start:
                lane[1] = end
                return lane[0]
        self._num_threads += 1
        thread = self._num_threads
        lanes.append([thread, end])
        shown = track if len(lanes) == 1 else f"{track} ({len(lanes)})"
        self._metadata("thread_name", thread, {"name": shown})
        # All lanes of a track stand together, tracks in order of first use.
        order = list(self._lanes).index(track) * 4096 + len(lanes)
        self._metadata("thread_sort_index", thread, {"sort_index": order})
        return thread

    def _metadata(self, name: str, thread: int, arguments: dict[str, Any]) -> None:
        self._record({"name": name, "ph": "M", "pid": _PROCESS, "tid": thread, "args": arguments})

    def _record(self, event: dict[str, Any]) -> None:
        text = json.dumps(event, allow_nan=False, separators=(",", ":"))
        self._put(("\n" if self._is_first else ",\n") + text)
        self._is_first = False

    def _put(self, text: str) -> None:
        self._pending.append(text)
        self._pending_bytes += len(text)
        if self._pending_bytes >= _BUFFER_BYTES:
            self._flush()

    def _flush(self) -> None:
        with writing(self._path):
            self._file.write("".join(self._pending))
            self._file.flush()
        self._pending.clear()
        self._pending_bytes = 0


@contextmanager
def timeline_file(path: Path, clock_hz: int, title: str) -> Iterator[Timeline]:
    """A `Timeline` that stands at `path`, whole, once the block has ended well.

    clock_hz: of the cycles that events are given in. title: what ran where.

    Raises:
        InputError: the folder cannot be written to.
        WorkError: the file could not be written.
    """
    with replacing(path) as part:
        with writing(path):
            file = part.open("w", encoding="utf-8")
        with file:
            timeline = Timeline(file, path, clock_hz, title)
            yield timeline
            timeline.close()
