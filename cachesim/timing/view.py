"""Views: named sets of arrays that compiled functions take as one address.

A tuple of arrays goes into a compiled function as seven words per array, and there are a hundred
arrays here: a call cost more than its work, and compiling took minutes. A view is the address of a
table with a pointer and three dimensions per array; `view.field` reads the array from it.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.imputils import lower_builtin, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import load_item, make_array, populate_array, store_item

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


class ViewArray(types.Array):
    """An array of a view. Its indices are never negative, so that none is checked for its sign."""

    def __init__(self, dtype: Any, ndim: int) -> None:
        super().__init__(dtype, ndim, "C", name=f"view of {ndim} x {dtype}")


register_model(ViewArray)(models.ArrayModel)


def _item_pointer(context: Any, builder: Any, array_type: Any, array: Any, at: Any) -> Any:
    """Where an item lies; at: its index along each dimension."""
    view = make_array(array_type)(context, builder, array)  # type: ignore[no-untyped-call]
    shape = cgutils.unpack_tuple(builder, view.shape)  # type: ignore[no-untyped-call]
    offset = at[0]
    for index, length in zip(at[1:], shape[1:], strict=True):
        offset = builder.add(builder.mul(offset, length), index)
    return builder.gep(view.data, [offset])


def _indices(context: Any, builder: Any, index_type: Any, index: Any) -> Any:
    if not isinstance(index_type, types.BaseTuple):
        return [context.cast(builder, index, index_type, types.intp)]
    values = cgutils.unpack_tuple(builder, index)  # type: ignore[no-untyped-call]
    own: Any = index_type
    return [
        context.cast(builder, value, kind, types.intp)
        for value, kind in zip(values, own, strict=True)
    ]


def _get_item(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array_type, index_type = signature.args
    at = _indices(context, builder, index_type, arguments[1])
    if len(at) != array_type.ndim:
        raise NotImplementedError("a view's array is indexed along all its dimensions")
    pointer = _item_pointer(context, builder, array_type, arguments[0], at)
    return load_item(context, builder, array_type, pointer)  # type: ignore[no-untyped-call]


def _set_item(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array_type, index_type, value_type = signature.args
    at = _indices(context, builder, index_type, arguments[1])
    pointer = _item_pointer(context, builder, array_type, arguments[0], at)
    value = context.cast(builder, arguments[2], value_type, array_type.dtype)
    store_item(context, builder, array_type, value, pointer)  # type: ignore[no-untyped-call]
    return context.get_dummy_value()


for _index in (types.Integer, types.BaseTuple):
    lower_builtin(operator.getitem, ViewArray, _index)(_get_item)  # type: ignore[no-untyped-call]
    lower_builtin(operator.setitem, ViewArray, _index, types.Any)(_set_item)  # type: ignore[no-untyped-call]


def _field_type(view: str, field: str) -> Any:
    found = _FIELDS[view].get(field)
    if found is None:
        return None
    if isinstance(found, str):
        return ViewType(found)
    dtype, dimensions = found
    return ViewArray(from_dtype(dtype), dimensions)


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
        loaded = builder.load(builder.gep(table, [ir.Constant(ir.IntType(64), index + k)]))
        # A table never changes while compiled code runs: it need not be read twice.
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
        return loaded

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


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Have the host fetch the line of a view's item, which a later step will need."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at = _indices(context, builder, signature.args[1], arguments[1])
        pointer = _item_pointer(context, builder, signature.args[0], arguments[0], at)
        byte = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte.type, word, word, word])
        function = builder.module.declare_intrinsic("llvm.prefetch", [byte.type], kind)
        # For writing, to be kept in all levels, data.
        builder.call(function, [byte, word(1), word(3), word(1)])
        return context.get_dummy_value()

    return types.none(array, index), codegen


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
