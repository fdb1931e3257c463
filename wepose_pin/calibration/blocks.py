"""CasADi functions evaluated for many samples at once.

CasADi's own virtual machine finishes one sample before it begins the next, and spends most of its time on finding out
what the next operation is. Here each operation is done for a block of samples; the results are bit-identical.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..compilation import kernel

BLOCK = 128  # samples, whose intermediate values stay in the processor's cache
_CONST, _INPUT, _OUTPUT, _ADD, _SUB, _MUL, _DIV, _NEG, _SQ, _TWICE, _INV = range(11)
_SQRT, _SIN, _COS, _EXP, _ATAN2, _FMIN, _LE, _NOT = range(11, 19)
# CasADi's own codes may change with its version, and what is compiled is kept.
_CODES: dict[int, int] = {
    ca.OP_CONST: _CONST,
    ca.OP_INPUT: _INPUT,
    ca.OP_OUTPUT: _OUTPUT,
    ca.OP_ADD: _ADD,
    ca.OP_SUB: _SUB,
    ca.OP_MUL: _MUL,
    ca.OP_DIV: _DIV,
    ca.OP_NEG: _NEG,
    ca.OP_SQ: _SQ,
    ca.OP_TWICE: _TWICE,
    ca.OP_INV: _INV,
    ca.OP_SQRT: _SQRT,
    ca.OP_SIN: _SIN,
    ca.OP_COS: _COS,
    ca.OP_EXP: _EXP,
    ca.OP_ATAN2: _ATAN2,
    ca.OP_FMIN: _FMIN,
    ca.OP_LE: _LE,
    ca.OP_NOT: _NOT,
}


class Program(NamedTuple):
    """The operations of a CasADi function of (x, data) of a sample, in their order.

    Parameters
    ----------
    operations : (k, 4) our code, place of the result, places of one or two arguments; of an input and an output also
        which one it is, and which of its entries
    constants : (k,) of operations that give one
    results : length of each output
    places : of intermediate values
    """

    operations: np.ndarray
    constants: np.ndarray
    results: tuple[int, ...]
    places: int


def make_program(function: Any) -> Program:
    """Read the operations of a CasADi function of scalars (`SX`) with dense inputs x and data.

    Raises
    ------
    NotImplementedError
        It has an operation that no calibration has needed so far.
    """
    count = function.n_instructions()
    operations, constants = np.zeros((count, 4), dtype=np.int64), np.zeros(count)
    for k in range(count):
        code = _CODES.get(function.instruction_id(k))
        if code is None:
            raise NotImplementedError(f"operation {function.instruction_id(k)} of CasADi")
        places = [*function.instruction_output(k), *function.instruction_input(k)]
        operations[k, 0], operations[k, 1 : 1 + len(places)] = code, places
        if code == _CONST:
            constants[k] = function.instruction_constant(k)
    results = tuple(function.numel_out(i) for i in range(function.n_out()))
    return Program(operations, constants, results, function.sz_w())


def evaluate(program: Program, x: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, ...]:
    """Evaluate for samples with the same x (m,) and their own data (rows, n); each output (n, its length)."""
    x, data = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(data, dtype=float)
    results = tuple(np.empty((data.shape[1], length)) for length in program.results)
    work = np.empty((program.places, BLOCK))
    _evaluate(program.operations, program.constants, x, data, work, results)
    return results


@kernel
def _evaluate(
    operations: np.ndarray,
    constants: np.ndarray,
    x: np.ndarray,
    data: np.ndarray,
    work: np.ndarray,
    results: tuple[np.ndarray, ...],
) -> None:
    for first in range(0, data.shape[1], BLOCK):
        n = min(BLOCK, data.shape[1] - first)
        for k in range(len(operations)):
            code, i, j, m = operations[k]
            if code == _OUTPUT:  # i: which output, j: which entry, m: place
                result = results[i]
                for s in range(n):
                    result[first + s, j] = work[m, s]
            elif code == _INPUT:  # i: place, j: which input, m: which entry
                for s in range(n):
                    work[i, s] = x[m] if j == 0 else data[m, first + s]
            elif code == _MUL:
                for s in range(n):
                    work[i, s] = work[j, s] * work[m, s]
            elif code == _ADD:
                for s in range(n):
                    work[i, s] = work[j, s] + work[m, s]
            elif code == _SUB:
                for s in range(n):
                    work[i, s] = work[j, s] - work[m, s]
            elif code == _DIV:
                for s in range(n):
                    work[i, s] = work[j, s] / work[m, s]
            elif code == _NEG:
                for s in range(n):
                    work[i, s] = -work[j, s]
            elif code == _SQ:
                for s in range(n):
                    work[i, s] = work[j, s] * work[j, s]
            elif code == _TWICE:
                for s in range(n):
                    work[i, s] = 2.0 * work[j, s]
            elif code == _INV:
                for s in range(n):
                    work[i, s] = 1.0 / work[j, s]
            elif code == _SQRT:
                for s in range(n):
                    work[i, s] = np.sqrt(work[j, s])
            elif code == _SIN:
                for s in range(n):
                    work[i, s] = np.sin(work[j, s])
            elif code == _COS:
                for s in range(n):
                    work[i, s] = np.cos(work[j, s])
            elif code == _EXP:
                for s in range(n):
                    work[i, s] = np.exp(work[j, s])
            elif code == _ATAN2:
                for s in range(n):
                    work[i, s] = np.arctan2(work[j, s], work[m, s])
            elif code == _FMIN:
                for s in range(n):
                    work[i, s] = min(work[j, s], work[m, s])
            elif code == _LE:
                for s in range(n):
                    work[i, s] = 1.0 if work[j, s] <= work[m, s] else 0.0
            elif code == _NOT:
                for s in range(n):
                    work[i, s] = 0.0 if work[j, s] else 1.0
            elif code == _CONST:
                for s in range(n):
                    work[i, s] = constants[k]
