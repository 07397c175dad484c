"""Arrays at memory addresses, for compiled functions. The memory must stay allocated while the arrays are in use."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import carray, njit, types
from numba.extending import intrinsic
from torch import Tensor


@intrinsic
@no_type_check
def pointer(_, address):
    """Return an integer address as a pointer, for ``numba.carray``."""

    def convert(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.voidptr(address), convert


@njit(cache=True, nogil=True)
@no_type_check
def matrix_at(address, rows, columns, like):
    """Return the matrix [rows, columns] at an address, with the precision of the array ``like``."""
    return carray(pointer(address), (rows, columns), like.dtype)


@njit(cache=True, nogil=True)
@no_type_check
def row_of(matrix, row, column, count):
    """Return some columns of a row. Loops over them vectorise, unlike loops over ``matrix[row, column + c]``, whose index might be negative."""
    address = matrix.ctypes.data + matrix.itemsize * (row * matrix.shape[1] + column)
    return carray(pointer(address), (count,), matrix.dtype)


def count_words(tensor: Tensor) -> int:
    """Return the number of words of four bytes from the first to the last value of a tensor in memory."""
    extent = 1 + sum((size - 1) * step for size, step in zip(tensor.shape, tensor.stride(), strict=True))
    return extent * tensor.element_size() // 4 if tensor.numel() else 0


@njit(cache=True, nogil=True)
@no_type_check
def checksum(addresses, num_words):
    """Return a checksum of the words of four bytes at some addresses, ``num_words`` at each. A change of one word always changes it, others nearly always."""
    total = np.uint32(0)
    for k in range(len(addresses)):
        words, part = carray(pointer(addresses[k]), num_words[k], np.uint32), np.uint32(0)
        for c in range(num_words[k]):
            part = np.uint32(part + words[c] * np.uint32(2 * c + 1))  # an odd factor has an inverse
        total = np.uint32(total * np.uint32(2_654_435_761) + part)
    return total
