"""A vector of LANES numbers as a value in numba code: an LLVM vector with arithmetic, loads, selects and sums.

Where numba vectorises a loop over pixels, sums do not stay in registers from one row to the next, and the optimiser
decides which loads become gathers. With the vector as a value both are certain, and the code of an equation still reads
as the equation: + - * with vectors and scalars, ``>=``, ``blend``, ``load``, ``lane_sum``. LANES is 16 where the
processor computes 512 bits at once, else 8: AMD's Zen 4 takes 512 bits in two halves, so that they gain nothing there,
and narrower vectors waste fewer pixels at the rim of a subset.

In all functions ``start`` is a pointer from ``pointer``, and ``index`` counts numbers from there.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.ir as ir
import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name
from numba import extending
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model


def _avx512() -> bool:
    """Whether numba compiles for a processor with AVX-512: this one, or the one that NUMBA_CPU_FEATURES describes."""
    asked = numba.config.CPU_FEATURES  # type: ignore[attr-defined]
    return bool(get_host_cpu_features().get("avx512f")) if asked is None else "+avx512f" in asked.split(",")


_AVX512 = _avx512()
LANES = 16 if _AVX512 and get_host_cpu_name() != "znver4" else 8
FEW_REGISTERS = not _AVX512  # 16 vector registers; with AVX-512 there are 32
WINDOW = 32  # numbers that ``lookup`` reaches
BITS = np.uint16 if LANES == 16 else np.uint8  # one bit a lane
_BITS = types.uint16 if LANES == 16 else types.uint8
INNER: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # kernels that only kernels call compile faster so
intrinsic: Any = extending.intrinsic  # typed Any: its declared type hides the arguments of the functions it defines
_FLAGS = ("contract", "reassoc", "arcp", "nsz")  # sums may be reordered; NaN is respected
_INDEX = ir.VectorType(ir.IntType(32), LANES)


class Lanes(types.Type):
    """Numba type of a vector of LANES floats of one type."""

    def __init__(self, dtype: types.Float) -> None:
        super().__init__(f"Lanes({dtype})")
        self.dtype = dtype


class LaneMask(types.Type):
    """Numba type of a vector of LANES truth values."""

    def __init__(self) -> None:
        super().__init__("Choice")


_CHOICE = LaneMask()


def _vector(dtype: types.Float) -> ir.VectorType:
    """LLVM type of a vector of floats."""
    return ir.VectorType(ir.FloatType() if dtype == types.float32 else ir.DoubleType(), LANES)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, _vector(fe_type.dtype))


@register_model(LaneMask)
class _ChoiceModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: LaneMask) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), LANES))


def _repeat(builder: Any, scalar: Any) -> Any:
    """LLVM vector whose lanes are all equal to a scalar."""
    vector = ir.VectorType(scalar.type, LANES)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), ir.Constant(_INDEX, [0] * LANES))


def _as_lanes(context: Any, builder: Any, value: Any, kind: Any, lanes: Lanes) -> Any:
    """LLVM vector of a value that is a vector already or a scalar to be repeated."""
    return value if isinstance(kind, Lanes) else _repeat(builder, context.cast(builder, value, kind, lanes.dtype))


def _define(symbol: Callable[..., Any], result: Callable[[Lanes], Any], emit: Callable[[Any, Any, Any], Any]) -> None:
    """Define an operator between two vectors, or between a vector and a scalar on either side."""

    @infer_global(symbol)
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            lanes = [a for a in args if isinstance(a, Lanes)]
            if len(args) == 2 and lanes and all(isinstance(a, (Lanes, types.Number)) for a in args):
                return signature(result(lanes[0]), *args) if len(set(lanes)) == 1 else None
            return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = next(a for a in sig.args if isinstance(a, Lanes))
        one, other = (_as_lanes(context, builder, v, k, lanes) for v, k in zip(args, sig.args, strict=True))
        return emit(builder, one, other)

    for kinds in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(symbol, *kinds)(lower)


def _arithmetic(method: str) -> Callable[[Any, Any, Any], Any]:
    """Emitter of an LLVM instruction with the flags of fast arithmetic."""
    return lambda builder, x, y: getattr(builder, method)(x, y, flags=_FLAGS)


for _symbols, _method in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
):
    for _symbol in _symbols:
        _define(_symbol, lambda kind: kind, _arithmetic(_method))
_define(operator.ge, lambda k: _CHOICE, lambda b, x, y: b.fcmp_ordered(">=", x, y))


@intrinsic
def pointer(typingctx, array):  # type: ignore[no-untyped-def]
    """Pointer to the first number of an array.

    It does not keep the array alive: an argument or the caller must hold it.
    """

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return cgutils.create_struct_proxy(sig.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


def _address(builder: Any, start: Any, index: Any, kind: ir.Type) -> Any:
    """LLVM address of a number or vector at an index from a pointer."""
    return builder.bitcast(builder.gep(start, [index]), kind.as_pointer())


@intrinsic
def load(typingctx, start, index):  # type: ignore[no-untyped-def]
    """Load the LANES numbers from start[index] on."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(_address(builder, args[0], args[1], _vector(sig.return_type.dtype)), align=_width(sig) // 8)

    return Lanes(start.dtype)(start, index), codegen


def _width(sig: Any) -> int:
    """Bits of the numbers that the first argument points to."""
    dtype = sig.args[0].dtype
    return int(dtype.bitwidth)


@intrinsic
def store(typingctx, start, index, value):  # type: ignore[no-untyped-def]
    """Store the lanes of a value to start[index] and those after it."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], _address(builder, args[0], args[1], args[2].type), align=_width(sig) // 8)
        return context.get_dummy_value()

    return types.void(start, index, value), codegen


@intrinsic
def load_one(typingctx, start, index):  # type: ignore[no-untyped-def]
    """Load the single number start[index]."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(builder.gep(args[0], [args[1]]))

    return start.dtype(start, index), codegen


@intrinsic
def store_one(typingctx, start, index, value):  # type: ignore[no-untyped-def]
    """Store a single value to start[index]."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(context.cast(builder, args[2], value, start.dtype), builder.gep(args[0], [args[1]]))
        return context.get_dummy_value()

    return types.void(start, index, value), codegen


@intrinsic
def store_integers(typingctx, start, index, value):  # type: ignore[no-untyped-def]
    """Store the lanes of a value, cut to whole numbers, as int32 to start[index] and those after it."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(builder.fptosi(args[2], _INDEX), _address(builder, args[0], args[1], _INDEX), align=4)
        return context.get_dummy_value()

    return types.void(start, index, value), codegen


@intrinsic
def mask_from_bits(typingctx, bits):  # type: ignore[no-untyped-def]
    """Mask whose lane k is bit k of ``bits``, a number of type BITS."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.VectorType(ir.IntType(1), LANES))

    return _CHOICE(_BITS), codegen


@intrinsic
def nonzero_bits(typingctx, start, index):  # type: ignore[no-untyped-def]
    """Number of type BITS whose bit k says whether the byte start[index + k] is not zero."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind = ir.VectorType(ir.IntType(8), LANES)
        bytes_ = builder.load(_address(builder, args[0], args[1], kind), align=1)
        return builder.bitcast(builder.icmp_unsigned("!=", bytes_, ir.Constant(kind, [0] * LANES)), ir.IntType(LANES))

    return _BITS(start, index), codegen


@intrinsic
def bit_count(typingctx, bits):  # type: ignore[no-untyped-def]
    """Number of bits that are set in ``bits``, a number of type BITS."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.zext(_call(builder, f"ctpop.i{LANES}", args[0].type, args[0]), ir.IntType(64))

    return types.int64(_BITS), codegen


@intrinsic
def ramp(typingctx, start):  # type: ignore[no-untyped-def]
    """The vector 0, 1, 2 … of the type that ``start`` points to."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return ir.Constant(_vector(sig.return_type.dtype), [float(k) for k in range(LANES)])

    return Lanes(start.dtype)(start), codegen


@intrinsic
def blend(typingctx, choice, one, other):  # type: ignore[no-untyped-def]
    """Lane by lane ``one`` where the mask ``choice`` is true, else ``other``; either may be a scalar."""
    lanes = one if isinstance(one, Lanes) else other

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        one, other = (_as_lanes(context, builder, v, k, lanes) for v, k in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], one, other)

    return lanes(choice, one, other), codegen


def _call(builder: Any, name: str, kind: Any, *args: Any, fast: bool = False) -> Any:
    """LLVM call of an intrinsic function."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [a.type for a in args]), f"llvm.{name}"
    )
    return builder.call(function, args, fastmath=_FLAGS if fast else ())


def _suffix(lanes: Lanes) -> str:
    """Suffix of the names of LLVM's intrinsic functions for a vector type."""
    return f"v{LANES}f{lanes.dtype.bitwidth}"


@intrinsic
def floor(typingctx, value):  # type: ignore[no-untyped-def]
    """Largest whole number not above each lane of ``value``."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _call(builder, f"floor.{_suffix(value)}", args[0].type, args[0])

    return value(value), codegen


@intrinsic
def absolute(typingctx, value):  # type: ignore[no-untyped-def]
    """Absolute value of each lane of ``value``."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _call(builder, f"fabs.{_suffix(value)}", args[0].type, args[0])

    return value(value), codegen


@intrinsic
def lane_sum(typingctx, value):  # type: ignore[no-untyped-def]
    """Sum of the lanes of ``value``, as a double."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind = args[0].type.element
        summed = _call(
            builder, f"vector.reduce.fadd.{_suffix(value)}", kind, ir.Constant(kind, 0.0), args[0], fast=True
        )
        return context.cast(builder, summed, value.dtype, types.float64)

    return types.float64(value), codegen


@intrinsic
def lookup(typingctx, start, index, which):  # type: ignore[no-untyped-def]
    """Load start[index + which] for each lane, ``which`` holding whole numbers below WINDOW."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        lane = builder.fptosi(args[2], _INDEX)
        if sig.return_type.dtype == types.float32 and _AVX512:
            half, whole = ir.VectorType(ir.FloatType(), WINDOW // 2), ir.Constant(args[1].type, WINDOW // 2)
            near = builder.load(_address(builder, args[0], args[1], half), align=4)
            far = builder.load(_address(builder, args[0], builder.add(args[1], whole), half), align=4)
            all_lanes = [min(k, LANES - 1) for k in range(WINDOW // 2)]
            lane = builder.shuffle_vector(
                lane, lane, ir.Constant(ir.VectorType(ir.IntType(32), WINDOW // 2), all_lanes)
            )
            out = _call(builder, "x86.avx512.vpermi2var.ps.512", half, near, lane, far)
            return builder.shuffle_vector(out, out, ir.Constant(_INDEX, list(range(LANES))))
        out = ir.Constant(_vector(sig.return_type.dtype), ir.Undefined)
        for k in range(LANES):
            at = ir.Constant(ir.IntType(32), k)
            index = builder.add(args[1], builder.zext(builder.extract_element(lane, at), args[1].type))
            out = builder.insert_element(out, builder.load(builder.gep(args[0], [index])), at)
        return out

    return Lanes(start.dtype)(start, index, which), codegen
