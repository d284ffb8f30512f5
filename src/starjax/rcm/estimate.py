"""Estimation of a trocar from a moving tool: the common point of its shaft's lines."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.core import types
from starjax.rcm import arrays
from starjax.rcm import wrist as wrists

# rad; a smaller spread (RMS) of the axes about one direction does not fix the point along it
MIN_SPREAD = float(np.deg2rad(2.0))
MIN_LINES = 3.0  # inliers
MAX_RESIDUAL = 5e-3  # m; straight shafts miss their trocar by less, even in a yielding wall
_FARTHEST = 1e3  # m; tips beyond are ignored, as non-finite ones
_FINEST = 1e-5  # m; a line nearer to the point is no outlier
_DAMPING = 1e-5  # well below the least eigenvalue at `MIN_SPREAD`
_COARSE, _FINE = 40, 10  # steps of the two minimisations
_FEW = 10.0  # lines; fewer may leave no scale to tell outliers by
_CUT = 4.685  # deviations beyond which the weight is zero (Tukey's, for 95% efficiency)
_RAYLEIGH = 1.1774  # median distance from a point, of lines with unit deviation each way


class TrocarEstimate(NamedTuple):
    """An estimated trocar.

    Attributes:
      p_world_trocar: `[..., 3]` m; NaN if undetermined, which every later check refuses.
      residual: `[...]` m, weighted root mean square of the lines' distances from the point (Eq. 3).
        It says how straight the shaft is, not how well few or parallel lines fix the point: that is
        `covariance`. A wrist that bends by 2 degrees leaves 3 to 4 mm, by which the point is off.
      covariance: `[..., 3, 3]` m^2 of the point, for independent errors of the lines; very large if
        undetermined. Those of a bending wrist are not independent.
      weight: `[..., T]` in [0, 1] of the lines: 0 for an outlier.
      is_determined: `[...]`, True if the axes spread by `MIN_SPREAD`, `MIN_LINES` are inliers and
        `is_straight`; see `why_undetermined`.
      is_straight: `[...]`, True if the residual is at most `MAX_RESIDUAL`. Tips of instruments with
        a moving wrist have no common point on their axes and exceed it.
    """

    p_world_trocar: jax.Array
    residual: jax.Array
    covariance: jax.Array
    weight: jax.Array
    is_determined: jax.Array
    is_straight: jax.Array


@arrays.compiled("wrist")
def trocar_from_poses(
    pose: types.Pose,
    wrist: wrists.Wrist | None = None,
    angles: ArrayLike | None = None,
) -> TrocarEstimate:
    """Estimates the trocar from a moving tool: the point nearest to the lines of its shaft.

    The minimum of the sum of distances, a convex function that tolerates a third of wrong poses, is
    the start; weighted squares (Tukey's, by the median distance) refine it. Among fewer than ten
    lines the weights may keep too few; plain least squares then replace them. Turning about the
    shaft and sliding along it leave the point along it undetermined: see `is_determined`. Ten poses
    whose axes span 20 degrees determine it well.

    Args:
      pose: pose_world_tip `[..., T]` of a straight tool, or pose_world_shaft; with `wrist`
        pose_world_tip of an instrument with that wrist. Non-finite poses are ignored.
      wrist: sizes.
      angles: `[..., T, 2]` rad, measured pitch and yaw of the wrist.

    Raises:
      ValueError: shapes differ, or only one of `wrist` and `angles` is given.
    """
    if (wrist is None) != (angles is None):
        raise ValueError("wrist, angles: expected both or neither")
    R, p = arrays.checked(**{"pose.R": (pose.R, (3, 3)), "pose.p": (pose.p, (3,))})
    if R.ndim < 3 or R.shape[:-2] != p.shape[:-1]:
        raise ValueError(
            f"pose: expected R [..., T, 3, 3] and p [..., T, 3], got {list(R.shape)}, "
            f"{list(p.shape)}"
        )
    if wrist is not None and angles is not None:
        R, p = wrists.shaft_of(wrist, types.Pose(R, p), angles)
    axis = R[..., :, 2]
    is_known = jnp.isfinite(axis).all(-1) & (jnp.abs(p) <= _FARTHEST).all(-1)
    axis, length = arrays.direction(arrays.bounded(axis), np.array([0.0, 0.0, -1.0], np.float32))
    # A rotation's column has length 1
    known = (is_known & (length > 0.5) & (length < 2.0)).astype(p.dtype)
    centre = _median(p, known)
    # Positions relative to the centre keep more digits in float32.
    p = jnp.where(known[..., None] > 0.0, p - centre[..., None, :], 0.0)

    # Weiszfeld: weights 1 / distance make the squares a sum of distances.
    def nearer(_: int, point: jax.Array) -> jax.Array:
        return _step(point, axis, p, known / jnp.maximum(_distance(point, axis, p), _FINEST))

    # Iteratively reweighted least squares with Tukey's biweight.
    def better(_: int, point: jax.Array) -> jax.Array:
        return _step(point, axis, p, _weight(_distance(point, axis, p), known))

    # Robust start: sum of distances
    point = jax.lax.fori_loop(0, _COARSE, nearer, jnp.zeros_like(centre))
    point = jax.lax.fori_loop(0, _FINE, better, point)
    weight = _weight(_distance(point, axis, p), known)
    is_plain = ~_is_spread(axis, weight) & (jnp.sum(known, -1) < _FEW)
    plain = jax.lax.fori_loop(0, 3, lambda _, x: _step(x, axis, p, known), jnp.zeros_like(centre))
    point = jnp.where(is_plain[..., None], plain, point)
    weight = jnp.where(is_plain[..., None], known, weight)
    distance, count = _distance(point, axis, p), jnp.sum(weight, -1)
    total = jnp.sum(weight * distance**2, -1)
    residual = jnp.sqrt(jnp.maximum(total / jnp.maximum(count, 1.0), 1e-30))  # m, root mean square
    is_straight = residual <= MAX_RESIDUAL
    is_determined = _is_spread(axis, weight) & is_straight
    variance = total / jnp.maximum(2.0 * count - 3.0, 1.0)  # a line fixes two coordinates
    eye = jnp.eye(3, dtype=p.dtype)
    safe = jnp.where(is_determined[..., None, None], _normal(axis, weight), eye)
    # A constant NaN would trip `jax_debug_nans` for every estimate.
    unknown = jax.lax.stop_gradient(jnp.zeros_like(count) / is_determined.astype(count.dtype))
    # s^2 (sum w N)^-1
    covariance = (variance / jnp.maximum(count, 1.0))[..., None, None] * _inverse(safe)
    return TrocarEstimate(
        p_world_trocar=jnp.where(is_determined[..., None], centre + point, unknown[..., None]),
        residual=residual,
        covariance=jnp.where(is_determined[..., None, None], covariance, _FARTHEST**2 * eye),
        weight=weight,
        is_determined=is_determined,
        is_straight=is_straight,
    )


def why_undetermined(estimate: TrocarEstimate) -> str:
    """Returns the reason of a first undetermined estimate on the host, or an empty string."""
    is_determined, is_straight, residual = (
        np.ravel(x) for x in (estimate.is_determined, estimate.is_straight, estimate.residual)
    )
    if is_determined.all():
        return ""
    i = int(np.argmin(is_determined))
    if is_straight[i]:
        return "the shaft does not lean in enough directions"
    return (
        f"the axes miss any one point by {1e3 * residual[i]:.0f} mm: another frame or axis, or an "
        "instrument with a wrist, which needs its angles or the poses of its shaft"
    )


def _is_spread(axis: jax.Array, weight: jax.Array) -> jax.Array:
    """Returns True `[...]` if enough lines of different directions have weight."""
    # The least eigenvalue is the mean square of sin(angle to the axes' common direction).
    normal = jax.lax.stop_gradient(_normal(axis, weight))
    spread = jnp.linalg.eigvalsh(normal)[..., 0]
    return (spread >= np.sin(MIN_SPREAD) ** 2) & (jnp.sum(weight, -1) >= MIN_LINES)


def _step(point: jax.Array, axis: jax.Array, p: jax.Array, weight: jax.Array) -> jax.Array:
    """Minimises the weighted squares by one Newton step.

    Normal equations of sum w |(I - a a')(p - x)|^2: the weighted mean of I - a a' times the step
    is the weighted mean offset.
    """
    off = _off(point, axis, p)
    scale = jnp.maximum(jnp.sum(weight, -1), 1e-30)[..., None]
    towards = jnp.sum(weight[..., None] * off, -2) / scale  # minus the gradient / 2
    # The damping keeps the point along parallel lines, the arbitrary direction.
    damped = _normal(axis, weight) + _DAMPING * jnp.eye(3, dtype=p.dtype)
    return jnp.clip(point + arrays.matvec(_inverse(damped), towards), -1e4, 1e4)


def _inverse(symmetric: jax.Array) -> jax.Array:
    """Inverts a positive `[..., 3, 3]`; jax's own inverse fails under its error checks."""
    x, y, z = (symmetric[..., i] for i in range(3))
    adjugate = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)], axis=-2)
    return adjugate / arrays.dot(x, adjugate[..., 0, :])[..., None]  # adj A / det A


def _normal(axis: jax.Array, weight: jax.Array) -> jax.Array:
    """Returns the weighted mean `[..., 3, 3]` of `I - a a'`."""
    scale = jnp.maximum(jnp.sum(weight, -1), 1e-30)[..., None, None]
    outer = axis[..., :, None] * axis[..., None, :]
    spanned = jnp.sum(weight[..., None, None] * outer, -3) / scale
    return jnp.eye(3, dtype=axis.dtype) - spanned  # projects across the lines


def _off(point: jax.Array, axis: jax.Array, p: jax.Array) -> jax.Array:
    """Returns the vectors `[..., T, 3]` m from the point to the nearest position on each line."""
    away = p - point[..., None, :]
    return away - arrays.dot(away, axis) * axis  # the part across the line


def _distance(point: jax.Array, axis: jax.Array, p: jax.Array) -> jax.Array:
    return arrays.norm(_off(point, axis, p))


def _weight(distance: jax.Array, known: jax.Array) -> jax.Array:
    """Returns Tukey's weights, scaled by the median distance of known lines."""
    middle = _median(distance[..., None], known)
    deviation = jax.lax.stop_gradient(jnp.maximum(middle / _RAYLEIGH, _FINEST))
    # Zero weight for outliers
    inside = jnp.maximum(1.0 - (distance / (_CUT * deviation)) ** 2, 0.0)
    return known * inside**2


def _median(x: jax.Array, known: jax.Array) -> jax.Array:
    """Returns the lower median of the known rows over the last axis but one; zero without any."""
    large = jnp.finfo(x.dtype).max
    ordered = jnp.sort(jnp.where(known[..., None] > 0.0, x, large), axis=-2)
    middle = jnp.maximum((jnp.sum(known, -1) - 1.0) // 2.0, 0.0).astype(jnp.int32)
    median = jnp.take_along_axis(ordered, middle[..., None, None], axis=-2)[..., 0, :]
    return jnp.where(jnp.sum(known, -1)[..., None] > 0.0, median, 0.0)
