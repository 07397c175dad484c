"""Addresses of arrays in compiled functions."""

from __future__ import annotations

from typing import no_type_check

from numba import types
from numba.extending import intrinsic


@intrinsic
@no_type_check
def pointer(_, address):
    """Return an integer address as a pointer, for ``numba.carray``. The memory has to live as long as the array is used."""

    def convert(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.voidptr(address), convert
