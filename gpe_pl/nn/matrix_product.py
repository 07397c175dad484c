"""The product of matrices in compiled functions, by the BLAS library that PyTorch uses.

``np.dot`` cannot add to its result, and copies matrices whose rows are not adjacent in memory. ``gemm`` adds and takes strides of rows.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
import torch
from numba import types
from numba.core import cgutils
from numba.core.cgutils import ir  # that of llvmlite, which numba depends on
from numba.extending import get_cython_function_address, intrinsic


@cache
def gemm_address(dtype: Any) -> int:
    """Return the address of the BLAS function ``sgemm`` or ``dgemm`` for a precision.

    It is the one in PyTorch's library, which uses PyTorch's number of threads, or SciPy's if that library exports none.
    """
    name = "dgemm" if dtype == np.float64 else "sgemm"
    for library in sorted((Path(torch.__file__).parent / "lib").glob("libtorch_cpu.*")):
        try:
            return int(ctypes.cast(getattr(ctypes.CDLL(str(library)), f"{name}_"), ctypes.c_void_p).value or 0)
        except (OSError, AttributeError):
            continue
    return int(get_cython_function_address("scipy.linalg.cython_blas", name))


@intrinsic
@no_type_check
def gemm(typing_context, like, address, turns_a, turns_b, m, n, k, a, a_stride, b, b_stride, adds, c, c_stride):
    """Compute C = A B, or C += A B, for A [m, k], B [k, n] and C [m, n] at addresses in memory.

    Args:
        like: array of the precision of the matrices.
        address: ``gemm_address`` of this precision.
        turns_a, turns_b: 1 if A or B is stored transposed, else 0.
        m, n, k: sizes.
        a, b, c: addresses of the matrices.
        a_stride, b_stride, c_stride: distances between stored rows [elements].
        adds: 1 to add to C, 0 to replace it.
    """
    is_double = like.dtype == types.float64
    signature = types.void(like, *[types.int64] * 13)

    def generate(context, builder, _, arguments):
        _, address, turns_a, turns_b, m, n, k, a, a_stride, b, b_stride, adds, c, c_stride = arguments
        number, real, letter = ir.IntType(32), ir.DoubleType() if is_double else ir.FloatType(), ir.IntType(8)

        def at(x):
            return cgutils.alloca_once_value(builder, x)

        def size(x):
            return at(builder.trunc(x, number))

        def matrix(x):
            return builder.inttoptr(x, real.as_pointer())

        def kind(turns):
            is_turned = builder.icmp_signed("!=", turns, ir.Constant(turns.type, 0))
            return at(builder.select(is_turned, ir.Constant(letter, ord("T")), ir.Constant(letter, ord("N"))))

        # Fortran sees every matrix transposed, and computes Cᵀ = Bᵀ Aᵀ
        values = [kind(turns_b), kind(turns_a), size(n), size(m), size(k), at(ir.Constant(real, 1.0)), matrix(b), size(b_stride), matrix(a)]
        values += [size(a_stride), at(builder.sitofp(adds, real)), matrix(c), size(c_stride)]
        function = builder.inttoptr(address, ir.FunctionType(ir.VoidType(), [v.type for v in values]).as_pointer())
        builder.call(function, values)
        return context.get_dummy_value()

    return signature, generate
