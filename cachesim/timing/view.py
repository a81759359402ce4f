"""Views: named sets of arrays that compiled functions take as one address.

A tuple of arrays goes into a compiled function as seven words per array, and there are a hundred
arrays here: a call cost more than its work, and compiling took minutes. A view is the address of a
table with a pointer and three dimensions per array; `view.field` reads the array from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array, populate_array

_WORDS = 4
#: Name of a view -> its fields: (dtype, dimensions), or the name of another view.
_FIELDS: dict[str, dict[str, tuple[np.dtype[Any], int] | str]] = {}


class ViewType(types.Type):
    """The type of a view, known by its name."""

    def __init__(self, view: str) -> None:
        self.view = view
        super().__init__(name=f"View({view})")


@register_model(ViewType)
class _ViewModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, ir.IntType(64))  # type: ignore[no-untyped-call]


def _field_type(view: str, field: str) -> Any:
    found = _FIELDS[view].get(field)
    if found is None:
        return None
    if isinstance(found, str):
        return ViewType(found)
    dtype, dimensions = found
    return types.Array(from_dtype(dtype), dimensions, "C")


@infer_getattr
class _ViewAttributes(AttributeTemplate):
    key = ViewType

    def generic_resolve(self, value: Any, attr: str) -> Any:  # type: ignore[override]
        return _field_type(value.view, attr)


@lower_getattr_generic(ViewType)  # type: ignore[no-untyped-call, untyped-decorator]
def _read_field(context: Any, builder: Any, typ: Any, value: Any, attr: str) -> Any:
    """The array that the table describes."""
    result = _field_type(typ.view, attr)
    index = list(_FIELDS[typ.view]).index(attr) * _WORDS
    table = builder.inttoptr(value, ir.IntType(64).as_pointer())

    def word(k: int) -> Any:
        return builder.load(builder.gep(table, [ir.Constant(ir.IntType(64), index + k)]))

    if isinstance(result, ViewType):
        return word(0)
    array = make_array(result)(context, builder)  # type: ignore[no-untyped-call]
    data = builder.inttoptr(word(0), array.data.type)
    item = context.get_abi_sizeof(context.get_data_type(result.dtype))
    shape = [word(1 + k) for k in range(result.ndim)]
    strides, step = [], context.get_constant(types.intp, item)
    for length in reversed(shape):
        strides.append(step)
        step = builder.mul(step, length)
    populate_array(  # type: ignore[no-untyped-call]
        array,
        data=data,
        shape=cgutils.pack_array(builder, shape),  # type: ignore[no-untyped-call]
        strides=cgutils.pack_array(builder, strides[::-1]),  # type: ignore[no-untyped-call]
        itemsize=context.get_constant(types.intp, item),
        meminfo=None,
    )
    return array._getvalue()


def define(name: str, fields: Mapping[str, tuple[Any, int] | str]) -> None:
    """Declare a view: field -> (dtype, dimensions) or the name of a view, in the order of the
    NamedTuple that holds the arrays.
    """
    _FIELDS[name] = {
        field: what if isinstance(what, str) else (np.dtype(what[0]), what[1])
        for field, what in fields.items()
    }


def opener(name: str) -> Any:
    """A compiled function's way from an address to the view `name`."""

    @intrinsic
    def open_view(typingctx: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return arguments[0]

        return ViewType(name)(types.int64), codegen

    return open_view


class Table(NamedTuple):
    """The address of a view, and what must live as long as it is used."""

    address: int
    held: list[Any]


def table_of(name: str, arrays: tuple[Any, ...]) -> Table:
    """The table of a NamedTuple of arrays that matches the view `name`.

    Raises:
        TypeError: an array's dtype, dimensions or order in memory is not the view's.
    """
    fields = _FIELDS[name]
    table = np.zeros(len(fields) * _WORDS, np.int64)
    held: list[Any] = [table, arrays]
    for k, ((field, what), value) in enumerate(zip(fields.items(), arrays, strict=True)):
        if isinstance(what, str):
            inner = table_of(what, value)
            table[k * _WORDS] = inner.address
            held.append(inner)
            continue
        dtype, dimensions = what
        if value.dtype != dtype or value.ndim != dimensions or not value.flags.c_contiguous:
            raise TypeError(
                f"{name}.{field}: {value.dtype} with {value.ndim} dimensions: "
                f"the view has {dtype} with {dimensions}"
            )
        table[k * _WORDS] = value.ctypes.data
        table[k * _WORDS + 1 : k * _WORDS + 1 + dimensions] = value.shape
    return Table(table.ctypes.data, held)
