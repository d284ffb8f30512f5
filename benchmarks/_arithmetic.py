"""The matrix products and convolutions inside a program, counted from its trace."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np


def operations(function: Callable, *arguments: Any) -> float:
    """Floating-point operations of all products and convolutions; loops count once."""
    return sum(2.0 * m * k * n for m, k, n in products(function, *arguments))


def products(function: Callable, *arguments: Any) -> list[tuple[int, int, int]]:
    """(rows, contracted, columns) of every product; a convolution as the product it amounts to."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return [shape for equation in _equations(jaxpr) if (shape := _product(equation))]


def _equations(jaxpr: Any) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        nested = [
            getattr(value, "jaxpr", value)
            for parameter in equation.params.values()
            for value in (parameter if isinstance(parameter, tuple) else (parameter,))
            if hasattr(value, "eqns") or hasattr(value, "jaxpr")
        ]
        if not nested:
            yield equation
        for inner in nested:
            yield from _equations(inner)


def _product(equation: Any) -> tuple[int, int, int] | None:
    name, out = equation.primitive.name, equation.outvars[0].aval
    if name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        left = equation.invars[0].aval.shape
        inner = int(np.prod([left[i] for i in contracted]))
    elif name == "conv_general_dilated":
        kernel = equation.invars[1].aval
        inner = kernel.size // kernel.shape[equation.params["dimension_numbers"].rhs_spec[0]]
    else:
        return None
    columns = out.shape[-1] if out.ndim else 1
    return out.size // columns, inner, columns
