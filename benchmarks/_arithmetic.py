"""The matrix products and convolutions inside a program, counted from its trace."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax.core.config import PolicyConfig


class Product(NamedTuple):
    """A matrix product `[rows, contracted] @ [contracted, columns]`, done `times` times."""

    rows: int
    contracted: int
    columns: int
    times: int


def operations(function: Callable, *arguments: Any) -> float:
    """Floating-point operations of all products and convolutions; `while` loops count once."""
    return sum(2.0 * m * k * n * times for m, k, n, times in products(function, *arguments))


def products(function: Callable, *arguments: Any) -> list[Product]:
    """Every product; a convolution as the one it amounts to."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return [p for equation, times in _equations(jaxpr, 1) if (p := _product(equation, times))]


def of_padding(policy_config: PolicyConfig, action_dim: int = 4) -> float:
    """Operations of one U-Net evaluation of one sample that multiply padding: no work either."""
    options, length, inputs = policy_config.options, policy_config.horizon, action_dim
    widths = options.unet_channels
    total = 0

    def block(inputs: int, width: int) -> int:
        taps = range(-(options.kernel_size // 2), options.kernel_size // 2 + 1)
        outside = [[not 0 <= i + tap < length for i in range(length)] for tap in taps]
        # A tap that is outside everywhere is not made at all.
        zeros = sum(sum(tap) for tap in outside if not all(tap))
        return zeros * (inputs * width + width * width)

    for level, width in enumerate(widths):
        total += block(inputs, width) + block(width, width)
        inputs = width
        if level < len(widths) - 1:
            total += width * width
            length //= 2
    total += 2 * block(inputs, inputs)
    for width, joined in zip(widths[-2::-1], widths[:0:-1]):
        total += block(2 * joined, width) + block(width, width) + 2 * width * width
        length *= 2
    return 2.0 * (total + block(0, widths[0]))


def _equations(jaxpr: Any, times: int) -> Iterator[tuple[Any, int]]:
    for equation in jaxpr.eqns:
        nested = [
            getattr(value, "jaxpr", value)
            for parameter in equation.params.values()
            for value in (parameter if isinstance(parameter, tuple) else (parameter,))
            if hasattr(value, "eqns") or hasattr(value, "jaxpr")
        ]
        if equation.primitive.name == "cond":  # a choice by platform, the default last
            nested = nested[-1:]
        if not nested:
            yield equation, times
        inside = times * equation.params["length"] if equation.primitive.name == "scan" else times
        for inner in nested:
            yield from _equations(inner, inside)


def _product(equation: Any, times: int) -> Product | None:
    name, out = equation.primitive.name, equation.outvars[0].aval
    if name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        left = equation.invars[0].aval.shape
        inner = int(np.prod([left[i] for i in contracted]))
    elif name == "conv_general_dilated":
        kernel = equation.invars[1].aval
        inner = kernel.size // kernel.shape[equation.params["dimension_numbers"].rhs_spec[0]]
        # The gradient of a strided convolution spreads its input with zeros: no work in them.
        inner = max(1, round(inner / np.prod(equation.params["lhs_dilation"])))
    else:
        return None
    columns = out.shape[-1] if out.ndim else 1
    return Product(out.size // columns, inner, columns, times)
