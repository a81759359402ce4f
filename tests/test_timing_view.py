"""Views: one address stands for a tree of arrays, read field by field in compiled code."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import njit

from cachesim.timing.view import define, opener, table_of

RECORD = np.dtype([("count", "i4"), ("sum", "f8")], align=True)
define("Leaf", {"records": (RECORD, 1), "bytes": (np.uint8, 2)})
define("Tree", {"grid": (np.float64, 3), "leaf": "Leaf", "last": (np.int32, 1)})
open_tree = opener("Tree")


class Leaf(NamedTuple):
    records: Any
    bytes: Any


class Tree(NamedTuple):
    grid: Any
    leaf: Any
    last: Any


def tree() -> Tree:
    records = np.zeros(3, RECORD)
    records["count"] = [1, 2, 3]
    grid = np.arange(24, dtype=np.float64).reshape(2, 3, 4)
    leaf = Leaf(records, np.arange(6, dtype=np.uint8).reshape(3, 2))
    return Tree(grid, leaf, np.array([7, 8], np.int32))


@njit
def _look(address, a, b, c):  # type: ignore[no-untyped-def]
    view = open_tree(address)
    leaf = view.leaf
    return (
        view.grid[a, b, c],
        leaf.bytes[b, a],
        leaf.records[a].count,
        view.last[len(view.last) - 1],
        view.grid.shape[0] * 100 + view.grid.shape[1] * 10 + view.grid.shape[2],
        len(leaf.records) * 100 + leaf.bytes.shape[0] * 10 + leaf.bytes.shape[1],
    )


@njit
def _change(address):  # type: ignore[no-untyped-def]
    view = open_tree(address)
    view.leaf.records[2].sum = 2.5
    view.leaf.records[2].count += 1
    view.grid[1, 2, 3] = -1.0
    view.last[:] = 5


@pytest.mark.parametrize("at", [(0, 0, 0), (1, 2, 3), (1, 0, 2), (0, 1, 1)])
def test_compiled_code_reads_every_array_of_a_view(at: tuple[int, int, int]) -> None:
    held = tree()
    table = table_of("Tree", held)
    a, b, c = at
    assert _look(table.address, *at) == (
        held.grid[at], held.leaf.bytes[b, a], held.leaf.records["count"][a], 8, 234, 332,
    )  # fmt: skip
    assert a < 2 and c < 4


def test_what_compiled_code_writes_is_in_the_arrays() -> None:
    held = tree()
    table = table_of("Tree", held)
    _change(table.address)
    assert held.leaf.records["sum"].tolist() == [0, 0, 2.5]
    assert held.leaf.records["count"].tolist() == [1, 2, 4]
    assert held.grid[1, 2, 3] == -1 and held.grid.sum() == 276 - 23 - 1
    assert held.last.tolist() == [5, 5]


def test_a_table_keeps_its_arrays_alive() -> None:
    table = table_of("Tree", tree())
    # The arrays have no other owner now.
    assert _look(table.address, 1, 2, 3)[0] == 23


def test_an_empty_array_has_length_zero() -> None:
    held = tree()._replace(leaf=Leaf(np.zeros(0, RECORD), np.zeros((0, 2), np.uint8)))

    @njit
    def length(address):  # type: ignore[no-untyped-def]
        view = open_tree(address)
        return len(view.leaf.records) + view.leaf.bytes.shape[0]

    table = table_of("Tree", held)
    assert length(table.address) == 0


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("last", np.zeros(2, np.int64), r"Tree\.last: int64 with 1 dimensions: .* int32 with 1"),
        ("last", np.zeros((2, 1), np.int32), r"Tree\.last: int32 with 2 dimensions"),
        ("grid", np.zeros((2, 3), np.float64), r"Tree\.grid: float64 with 2 .* has float64 with 3"),
        ("grid", np.zeros((4, 3, 2)).T, r"Tree\.grid: float64 with 3 dimensions"),
        ("leaf", Leaf(np.zeros(1, "i4"), np.zeros((1, 1), np.uint8)), r"Leaf\.records: int32"),
    ],
)
def test_a_table_refuses_arrays_that_are_not_the_views(field: str, value: Any, told: str) -> None:
    with pytest.raises(TypeError, match=told):
        table_of("Tree", tree()._replace(**{field: value}))


def test_a_table_refuses_a_missing_array() -> None:
    with pytest.raises(ValueError):
        table_of("Tree", tuple(tree())[:2])
