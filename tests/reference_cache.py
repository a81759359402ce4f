"""An obvious cache: one ordered dictionary per set, sector by sector, no arrays and no tricks.

Written from the facts sheet (sections 3.2 and 4) and the docstrings of `cachesim.config`,
`cachesim.policies` and `cachesim.report`, to hold `cachesim.cache` to.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, defaultdict
from dataclasses import dataclass, field

from cachesim.config import CacheLevel
from cachesim.stream import ATOMIC, LOAD, STORE

MASK64 = (1 << 64) - 1


def mix64(x: int) -> int:
    """splitmix64's finaliser."""
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 & MASK64
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB & MASK64
    return x ^ (x >> 31)


@dataclass
class Line:
    """way: its place. readable: sectors. held: sector -> bytes of one not readable. dirty: sector
    -> group. rrpv: SRRIP's value."""

    way: int
    readable: set[int] = field(default_factory=set)
    held: dict[int, int] = field(default_factory=dict)
    dirty: dict[int, int] = field(default_factory=dict)
    rrpv: int = 2


@dataclass
class Answer:
    """down: sectors passed down as the request itself. fill: sectors fetched for it. written_back:
    sector -> (group, bytes) of line `evicted`."""

    down: set[int]
    fill: set[int] = field(default_factory=set)
    evicted: int | None = None
    written_back: dict[int, tuple[int, int]] = field(default_factory=dict)


class Set:
    """One set; lines from the oldest to the newest use (LRU) or arrival (the others)."""

    def __init__(self, number: int, ways: int, policy: str) -> None:
        self.number, self.ways, self.policy = number, ways, policy
        self.lines: OrderedDict[int, Line] = OrderedDict()
        self.num_fills = 0
        self.points_right: defaultdict[tuple[int, int], bool] = defaultdict(bool)
        self.tree_ways = 1 << (ways - 1).bit_length()

    def used(self, tag: int) -> None:
        if self.policy == "lru":
            self.lines.move_to_end(tag)
        elif self.policy == "srrip":
            self.lines[tag].rrpv = 0
        elif self.policy == "tree-plru":
            self._point_away(self.lines[tag].way, 0, self.tree_ways)

    def insert(self, tag: int) -> tuple[int, Line] | None:
        """A new line for the tag; the tag and line that it replaces, if any."""
        gone = None
        way = len(self.lines)
        if way == self.ways:
            victim = self._victim()
            gone = victim, self.lines.pop(victim)
            way = gone[1].way
        self.lines[tag] = Line(way)
        self.num_fills += 1
        if self.policy == "tree-plru":
            self._point_away(way, 0, self.tree_ways)
        return gone

    def _victim(self) -> int:
        by_way = {line.way: tag for tag, line in self.lines.items()}
        if self.policy == "random":
            high = mix64((self.number << 32) ^ self.num_fills) >> 32
            return by_way[high * self.ways >> 32]
        if self.policy == "tree-plru":
            return by_way[self._pointed(0, self.tree_ways)]
        if self.policy == "srrip":
            while all(line.rrpv < 3 for line in self.lines.values()):
                for line in self.lines.values():
                    line.rrpv += 1
            return by_way[min(line.way for line in self.lines.values() if line.rrpv == 3)]
        return next(iter(self.lines))

    def _point_away(self, way: int, low: int, high: int) -> None:
        if high - low > 1:
            middle = (low + high) // 2
            self.points_right[low, high] = way < middle
            self._point_away(way, *((low, middle) if way < middle else (middle, high)))

    def _pointed(self, low: int, high: int) -> int:
        if high - low == 1:
            return low
        middle = (low + high) // 2
        right = self.points_right[low, high] and middle < self.ways
        return self._pointed(*((middle, high) if right else (low, middle)))


class ReferenceCache:
    """All instances of one level. counters: (group, name) -> count, names as in `LevelCounters`."""

    def __init__(self, level: CacheLevel, *, bypass_loads: bool, bypass_stores: bool) -> None:
        self.level, self.bypass_loads, self.bypass_stores = level, bypass_loads, bypass_stores
        self.every_byte = (1 << min(32, level.sector_bytes)) - 1
        self.counters: Counter[tuple[int, str]] = Counter()
        self.sets: dict[int, Set] = {}

    def dirty_sectors(self) -> Counter[int]:
        """group -> dirty sectors held."""
        held = (line for s in self.sets.values() for line in s.lines.values())
        return Counter(group for line in held for group in line.dirty.values())

    def access(
        self,
        instance: int,
        set_in_instance: int,
        tag: int,
        sectors: set[int],
        operation: int,
        group: int,
        bytes_written: dict[int, int],
    ) -> Answer:
        """One request. bytes_written: sector -> bytes that a store covers."""
        count = lambda name, n: self.counters.update({(group, name): n})  # noqa: E731
        writes = operation != LOAD
        around = self.bypass_stores if writes else self.bypass_loads
        if around or (operation == ATOMIC and self.level.write_policy != "write-back"):
            count("bypasses", len(sectors))
            count("bypassed_writes", len(sectors) * writes)
            return Answer(set(sectors))
        number = instance * self.level.num_sets + set_in_instance
        cache_set = self.sets.setdefault(
            number, Set(number, self.level.ways, self.level.replacement)
        )
        count("requests", 1)
        count("accesses", len(sectors))
        count("writes", len(sectors) * writes)
        line = cache_set.lines.get(tag)
        hits: set[int] = set()
        if line is not None:
            found = line.readable | (set(line.held) if operation == STORE else set())
            hits = sectors & found
            cache_set.used(tag)
        count("hits", len(hits))
        count("sector_misses" if line is not None else "line_misses", len(sectors - hits))
        count("write_misses", len(sectors - hits) * writes)
        answer = Answer(set())
        if line is None:
            if writes and self.level.write_allocate == "none":
                count("stores_down", len(sectors))
                return Answer(set(sectors))
            gone = cache_set.insert(tag)
            line = cache_set.lines[tag]
            if gone is not None:
                self._write_back(*gone, answer)
        if not writes:
            line.readable |= sectors
            for s in sectors:
                line.held.pop(s, None)
            answer.down = sectors - hits
            return answer
        for s in sectors:
            atomic = operation == ATOMIC
            self._write(
                line, s, atomic, self.every_byte if atomic else bytes_written[s], group, answer
            )
        count("stores_down", len(answer.down))
        count("write_fills", len(answer.fill))
        return answer

    def _write_back(self, tag: int, line: Line, answer: Answer) -> None:
        answer.evicted = tag
        for s, group in line.dirty.items():
            held = self.every_byte if s in line.readable else line.held[s]
            answer.written_back[s] = group, held
            self.counters[group, "writebacks"] += 1

    def _write(
        self, line: Line, s: int, atomic: bool, new: int, group: int, answer: Answer
    ) -> None:
        """Store into one sector of a line that is there."""
        policy, allocate = self.level.write_policy, self.level.write_allocate
        if policy in ("write-evict", "local-write-back"):
            line.readable.discard(s)
            line.held.pop(s, None)
            answer.down.add(s)
            return
        absent = s not in line.readable and s not in line.held
        if absent and allocate == "none":
            answer.down.add(s)
            return
        if absent and allocate == "write-allocate":
            # The write goes down, and the sector is read back: present and clean.
            line.readable.add(s)
            answer.down.add(s)
            answer.fill.add(s)
            return
        if s not in line.readable:
            covered = new | line.held.pop(s, 0)
            if atomic or (allocate != "lazy-fetch-on-read" and covered != self.every_byte):
                answer.fill.add(s)
                line.readable.add(s)
            elif covered == self.every_byte:
                line.readable.add(s)
            else:
                line.held[s] = covered
        if policy == "write-back":
            line.dirty[s] = group
        else:
            answer.down.add(s)
