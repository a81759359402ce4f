"""The way a warp takes through a kernel's machine code, and what its loads and stores touch.

Blocks end at branches and begin at labels. A block that calls a subroutine is the slow path of a
division or square root, for denormal and huge operands, which do not occur here: no warp goes
through it. Of what remains,

- a warp in which something scatters takes the longest way from the entry to the end, so that it
  executes both what is under a condition and what is not, and of two alternatives the longer;
- a warp in which nothing scatters takes the shortest way that visits the accesses of such warps and
  avoids those of the others. (The compiler may leave such a warp no use for an access that it has
  in the trace: its way then misses that.)

A strongly connected set of blocks is the sample loop; its body is the longest way from its head to
a branch back to it. Which buffer a load or store touches follows from the kernel's arguments: they
are followed through the registers along the way to the address.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

from kernels.instruction_counts.machine import CountError, MachineCode, MachineInstruction

_ARGUMENTS = "the address of the arguments"
#: Weight of a block that a way should avoid.
_AVOID = 1 << 20


@dataclass(frozen=True)
class Way:
    """The instructions of one way, by index in the code: those before the loop, one turn of it,
    those after it. Without a loop all are in `before`.
    """

    before: tuple[int, ...]
    loop: tuple[int, ...]
    after: tuple[int, ...]


class Flow:
    """The blocks of a kernel: [start, end) of its instructions, in layout order."""

    def __init__(self, code: MachineCode) -> None:
        self.code = code
        cuts = {0, len(code.instructions), *code.labels.values()}
        cuts |= {i + 1 for i, x in enumerate(code.instructions) if x.ends_block}
        edges = sorted(cuts)
        self.blocks = list(pairwise(edges))
        block_at = {start: number for number, (start, _) in enumerate(self.blocks)}
        self.followers: list[list[int]] = []
        for number, (start, end) in enumerate(self.blocks):
            last = code.instructions[end - 1]
            slow = any(x.is_call for x in code.instructions[start:end])
            found = [number + 1] if last.falls_through and number + 1 < len(self.blocks) else []
            if last.target:
                found.append(block_at[code.labels[last.target]])
            self.followers.append([] if slow else found)
        self._slow = {
            n
            for n, (start, end) in enumerate(self.blocks)
            if any(x.is_call for x in code.instructions[start:end])
        }
        reached = _reach(0, self._next)
        self.loop = self._find_loop(reached)
        self.reached = reached

    def _next(self, block: int) -> list[int]:
        return [b for b in self.followers[block] if b not in self._slow]

    def _find_loop(self, reached: set[int]) -> frozenset[int]:
        """The blocks that can reach themselves."""
        after = {b: _reach_from(self._next(b), self._next) for b in reached}
        cyclic = {b for b in reached if b in after[b]}
        heads = {b for b in cyclic for p in reached - cyclic if b in self._next(p)}
        if len(heads) > 1 or any(after[a] & cyclic != cyclic for a in cyclic):
            raise CountError(f"{self.code.name}: more than one loop")
        self._head = heads.pop() if heads else -1
        return frozenset(cyclic)

    def length(self, block: int) -> int:
        start, end = self.blocks[block]
        return end - start

    def longest_way(self) -> Way:
        """Of a warp in which something scatters."""
        return self._way(lambda b: -self.length(b), self._ends(), through_loop=bool(self.loop))

    def shortest_way(self, visit: Iterable[int], avoid: Iterable[int]) -> Way:
        """Of a warp in which nothing scatters. visit, avoid: instructions; visited are those that
        can be without one that is to be avoided.
        """
        avoided = {self.block_of(i) for i in avoid}
        stops = sorted({self.block_of(i) for i in visit})

        def cost(block: int) -> int:
            return self.length(block) + _AVOID * (block in avoided or block in self.loop)

        # Leave out stops from the first on, as far as that avoids more.
        tries = [self._through(stops[k:], cost) for k in range(len(stops) + 1)]
        best = min(tries, key=lambda blocks: sum(map(cost, blocks)) // _AVOID)
        return Way(self._instructions(best), (), ())

    def _through(self, stops: list[int], cost: Callable[[int], int]) -> list[int]:
        """The blocks of a way of least cost that visits some blocks on its way to an end."""
        blocks = [0]
        for stop in stops:
            blocks += self._path(blocks[-1], {stop}, cost)[1:]
        return blocks + self._path(blocks[-1], self._ends(), cost)[1:]

    def block_of(self, instruction: int) -> int:
        return next(n for n, (a, b) in enumerate(self.blocks) if a <= instruction < b)

    def _ends(self) -> set[int]:
        """Blocks in which a warp ends without a condition."""
        last = {b: self.code.instructions[self.blocks[b][1] - 1] for b in self.reached}
        return {b for b, x in last.items() if x.is_exit and not x.falls_through}

    def _way(self, cost: Callable[[int], int], ends: set[int], through_loop: bool) -> Way:
        if not through_loop:
            return Way(self._instructions(self._path(0, ends, cost)), (), ())
        before = self._path(0, {self._head}, cost)[:-1]
        tails = {b for b in self.loop if self._head in self._next(b)}
        body = self._path(self._head, tails, cost, inside=self.loop)
        exits = {b for a in body for b in self._next(a) if b not in self.loop}
        if len(exits) != 1:
            raise CountError(f"{self.code.name}: its loop has {len(exits)} exits")
        after = self._path(exits.pop(), ends, cost)
        return Way(self._instructions(before), self._instructions(body), self._instructions(after))

    def _instructions(self, blocks: Iterable[int]) -> tuple[int, ...]:
        return tuple(i for b in blocks for i in range(*self.blocks[b]))

    def _path(
        self,
        start: int,
        ends: set[int],
        cost: Callable[[int], int],
        inside: frozenset[int] | None = None,
    ) -> list[int]:
        """The way of least cost from a block to one of `ends`, without a branch back."""
        best: dict[int, tuple[int, list[int]]] = {}

        def search(block: int) -> tuple[int, list[int]] | None:
            if block in best:
                return best[block]
            found = None
            if block in ends:
                found = (cost(block), [block])
            for follower in self._next(block):
                is_back = follower == self._head and (block in self.loop)
                leaves = inside is not None and follower not in inside
                if is_back or leaves or (block in ends and inside is None):
                    continue
                rest = search(follower)
                if rest and (found is None or rest[0] + cost(block) < found[0]):
                    found = (rest[0] + cost(block), [block, *rest[1]])
            if found:
                best[block] = found
            return found

        found = search(start)
        if found is None:
            raise CountError(f"{self.code.name}: no way from block {start} to {sorted(ends)}")
        return found[1]

    def buffers(self, way: Way, arguments: dict[int, str]) -> dict[int, str]:
        """The buffer that each load and store of global memory on a way touches, by instruction; no
        entry where its address comes from no buffer's. arguments: names of the pointers, by byte
        offset.

        Raises:
            CountError: an address that comes from two buffers'.
        """
        state = {r: frozenset({_ARGUMENTS}) for r in self.code.argument_registers}
        found: dict[int, str] = {}
        for i in (*way.before, *way.loop, *way.loop, *way.after):
            instruction = self.code.instructions[i]
            if instruction.access:
                names = _union(state, instruction.address) - {_ARGUMENTS}
                names |= {found[i]} if i in found else set()
                if len(names) > 1:
                    raise CountError(f"{instruction.text!r} may touch any of {sorted(names)}")
                if names:
                    found[i] = next(iter(names))
            _follow(state, instruction, arguments, bool(self.code.argument_registers))
        return found


def _follow(
    state: dict[str, frozenset[str]],
    instruction: MachineInstruction,
    arguments: dict[int, str],
    from_memory: bool,
) -> None:
    """What one instruction does to the buffers that registers point to. from_memory: arguments are
    loaded from an address in registers, so that other loads look the same.
    """
    read = _union(state, instruction.reads)
    takes_arguments = not from_memory or _ARGUMENTS in read
    for register in instruction.writes:
        is_loaded = instruction.access or (from_memory and instruction.arguments)
        # A predicated write counts as made: what uses an address stands under the same predicate.
        state[register] = (frozenset() if is_loaded else read) | {
            arguments[offset]
            for place, offset in instruction.arguments
            if takes_arguments and place in ("", register) and offset in arguments
        }


def _union(state: dict[str, frozenset[str]], registers: Iterable[str]) -> frozenset[str]:
    return frozenset().union(*(state.get(r, frozenset()) for r in registers))


def _reach(start: int, following: Callable[[int], list[int]]) -> set[int]:
    return {start} | _reach_from(following(start), following)


def _reach_from(starts: Iterable[int], following: Callable[[int], list[int]]) -> set[int]:
    found, work = set(starts), list(starts)
    while work:
        for block in following(work.pop()):
            if block not in found:
                found.add(block)
                work.append(block)
    return found
