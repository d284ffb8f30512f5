"""Checks of an image encoder's trunk: its maps, their cells, numbers, gradients."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.learners import ENCODERS
from starjax.core.types import ArrayTree
from starjax.policies.models.encoders import ImageEncoder, Trunk
from starjax.runtime import user_code
from starjax.testing.base import FAILED, NOTE, Check, attempt, failed, verdict

CELLS = 4  # along a side of the images
BATCH = 2
FEATURES = 16
WIDTH_UNIT = 16  # widths are multiples of it
TOLERANCE = 1e-4  # between an image in one batch and alone
SEEN = 1e-5  # least change of a feature


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of an encoder; `n` is not used."""
    fault, trunk = attempt("record", lambda: ENCODERS.get(name))
    if fault:
        yield fault
        return
    yield verdict("record", _record(trunk), f"width {trunk.width}, cells of {trunk.cell} pixels")
    images = jax.random.normal(jax.random.key(0), (BATCH, *2 * (CELLS * trunk.cell,), 3))
    if trunk.encoder is not None:  # whose trunk need not return maps
        whole = trunk.encoder(trunk=name, features=FEATURES, width=WIDTH_UNIT)
        yield from _values(whole, images, trunk.reads_depth)
        return
    make = user_code.guarded(f"encoder {name}", "make", trunk.make)
    fault, module = attempt("maps", lambda: make(WIDTH_UNIT, jnp.float32, name="trunk"))
    if not fault:
        apply = user_code.guarded(f"encoder {name}", "maps", module.init_with_output)
        fault, traced = attempt("maps", lambda: jax.eval_shape(apply, jax.random.key(0), images))
    if fault:
        yield fault
        return
    maps, params = traced
    size = sum(leaf.size for leaf in jax.tree.leaves(params))
    shape = f"{list(maps.shape)} of images {list(images.shape)}, {size:,} parameters"
    result = verdict("maps", _maps(maps), shape)
    yield result
    if result.status == FAILED:
        return
    yield from _values(ImageEncoder(trunk=name, features=FEATURES, width=WIDTH_UNIT), images)
    half, _ = jax.eval_shape(
        make(WIDTH_UNIT, jnp.bfloat16, name="trunk").init_with_output, jax.random.key(0), images
    )
    if half.dtype != jnp.bfloat16:
        yield Check("dtype", f"{half.dtype} instead of bfloat16", NOTE)


def _record(trunk: Trunk) -> Iterator[str]:
    for field in ("width", "cell"):
        value = getattr(trunk, field)
        if not isinstance(value, int) or value < 1:
            yield f"{field}: expected a number of 1 or more, got {value!r}"


def _maps(maps: Any) -> Iterator[str]:
    if maps.ndim != 4 or maps.shape[0] != BATCH:
        yield f"expected {[BATCH, CELLS, CELLS]} and channels, got {list(maps.shape)}"
    elif maps.shape[1:3] != (CELLS, CELLS):
        yield f"expected {CELLS} x {CELLS} cells, got {maps.shape[1]} x {maps.shape[2]}"


def _unseen(apply: Callable[..., Any], params: ArrayTree, images: jax.Array) -> Iterator[str]:
    """Yields the channels, quarters and orders of an image that change no feature."""
    before, half = np.asarray(apply(params, images[:1])), images.shape[1] // 2
    slices = {"upper": slice(0, half), "lower": slice(half, None)}
    parts: dict[str, Any] = {
        f"channel {i}": (slice(None), slice(None), slice(None), i) for i in range(3)
    }
    for y, rows in slices.items():
        for x, columns in zip(("left", "right"), slices.values()):
            parts[f"{y} {x} quarter"] = (slice(None), rows, columns)
    changes = {name: images[:1].at[part].set(images[1:][part]) for name, part in parts.items()}
    changes |= {"order of colours": images[:1, ..., ::-1], "side to side": images[:1, :, ::-1]}
    for name, changed in changes.items():
        if (moved := float(np.abs(np.asarray(apply(params, changed)) - before).max())) < SEEN:
            yield f"{name} changes the features by {moved:.2g}, expected {SEEN:g} or more"


def _values(encoder: Any, images: jax.Array, reads_depth: bool = False) -> Iterator[Check]:
    """Yields checks of numbers: features of an image and of each part, gradients."""
    fault, params = attempt("features", lambda: jax.jit(encoder.init)(jax.random.key(1), images))
    if fault:
        yield fault
        return
    apply = jax.jit(encoder.apply)
    both, alone = apply(params, images), apply(params, images[:1])
    if not (np.isfinite(both).all() and np.isfinite(apply(params, 0.0 * images)).all()):
        yield failed("features", "not finite, of random or of even images")
        return
    apart = float(np.abs(both[:1] - alone).max())
    mixed = [f"an image's features depend on its batch, by {apart:.2g}"] * (apart > TOLERANCE)
    yield verdict("features", mixed, f"{FEATURES} finite numbers per image, from it alone")

    if not mixed and not reads_depth:  # the channels of depth are digits of one number
        unseen = _unseen(apply, params, images)
        yield verdict("input", unseen, "every channel and quarter is seen")

    def loss(p: ArrayTree) -> jax.Array:
        features: Any = encoder.apply(p, images)
        return jnp.mean(features**2)

    gradient = jax.jit(jax.grad(loss))(params)
    leaves = jax.tree_util.tree_leaves_with_path(gradient)
    faults = [
        f"not finite at {jax.tree_util.keystr(path)}"
        for path, leaf in leaves
        if not np.isfinite(leaf).all()
    ]
    flat = not any(np.any(leaf) for _, leaf in leaves)
    yield verdict("gradient", faults + ["0 everywhere"] * flat, "finite")
