"""How compiled loops read stored values: from an address, whatever the storage type, as a float.

A pool is handed to compiled loops as the addresses of its blocks and a *tag*. The tag is a number, and its type tells how
values are stored. numba compiles a loop once for each type of tag that it meets, so nothing is decided inside the loop. What
is here becomes part of the loops that use it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

TAGS = {torch.float32: np.float32(0), torch.float16: np.uint16(0), torch.int8: np.int8(0)}
"""Tag of each storage type; numba has no halves on CPUs, so they go by the type of their bits."""

FLOAT = np.float32(0)
"""Tag of values that are stored as they are."""

CACHE_LINE = 64
"""Bytes that the memory hands out at once."""

_STORED = {types.float32: ir.FloatType(), types.uint16: ir.HalfType(), types.int8: ir.IntType(8)}


@intrinsic
def value_at(typing_context: Any, tag: Any, address: Any, index: Any) -> Any:
    """Read the index-th value from an address on, as a float: one instruction where the processor knows halves."""
    stored = _STORED[tag]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # The pointer is made from the address before the index is added, or the compiler would not see consecutive values.
        value = builder.load(builder.gep(builder.inttoptr(arguments[1], stored.as_pointer()), [arguments[2]]))
        if tag == types.int8:
            return builder.sitofp(value, ir.FloatType())
        return builder.fpext(value, ir.FloatType()) if tag == types.uint16 else value

    return types.float32(tag, types.int64, types.int64), generate


@intrinsic
def put_at(typing_context: Any, tag: Any, address: Any, index: Any, value: Any) -> Any:
    """Store a float as the index-th value from an address on: as the nearest half, or without its fraction as an integer."""
    stored = _STORED[tag]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value = arguments[3]
        if tag == types.int8:
            value = builder.fptosi(value, stored)
        elif tag == types.uint16:
            value = builder.fptrunc(value, stored)
        builder.store(value, builder.gep(builder.inttoptr(arguments[1], stored.as_pointer()), [arguments[2]]))
        return context.get_dummy_value()

    return types.void(tag, types.int64, types.int64, types.float32), generate


@intrinsic
def prefetch(typing_context: Any, address: Any) -> Any:
    """Tell the memory that the cache line at an address will be read soon."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", [pointer], ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        )
        # For reading, into every level of the cache, as data.
        builder.call(function, [builder.inttoptr(arguments[0], pointer), number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(types.int64), generate


def stored(pool: RowPool) -> tuple[Any, ...]:
    """Return a pool as compiled loops take it: tag, bytes of a value, address of each block, and log2 of a block's rows."""
    return TAGS[pool.dtype], pool.dtype.itemsize, pool.addresses, pool.block_rows.bit_length() - 1
