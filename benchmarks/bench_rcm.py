"""RCM maps per second: each action space both ways, against numpy (float64) and scipy.

    python benchmarks/bench_rcm.py [--batch 100000] [--tiny]

numpy is the same mathematics vectorised without the guards that make `starjax.rcm` total; scipy
is the usual loop over single poses with `Rotation` objects. Last, calls with one pose as in a
robot's loop, in CPU time: by operations, as the map is, under `jax.jit`, and numpy.
"""

import argparse
import functools
import inspect
import time
from collections.abc import Callable

import _timing
import jax
import numpy as np
from scipy.spatial import transform

from starjax import rcm, runtime

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)
DOWN = np.array([1.0, -1.0, -1.0])
FIXED = "_fixed_yaw"
LOOP = 200  # poses in the scipy loop; its rate does not depend on the number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=100_000, help="poses a call")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    batch = LOOP if asked.tiny else asked.batch
    runtime.prepare_xla()
    trocar = jax.tree.map(np.asarray, rcm.sample_trocar(jax.random.key(0), (batch,)))
    wide_trocar = rcm.Trocar(*(field.astype(np.float64) for field in trocar))
    pose = sample_poses(trocar, batch)
    wide_pose = rcm.Pose(*(value.astype(np.float64) for value in pose))
    rows = {}
    print(f"batch {batch}, maps/s in millions (scipy: thousands)")
    print("space  way     starjax   numpy   scipy  x numpy  x scipy  compile s  max gap")
    straight = {name: s for name, s in rcm.ACTION_SPACES.items() if s.for_wrist is None}
    for name, space in straight.items():
        action = np.asarray(jax.jit(framed(space.encode))(pose, trocar))
        ways = {
            "encode": (framed(space.encode), pose, numpy_encode, wide_pose, scipy_encode),
            "decode": (
                framed(space.decode),
                action,
                numpy_decode,
                action.astype(np.float64),
                scipy_decode,
            ),
        }
        for way, (ours, ours_in, peer, peer_in, loop) in ways.items():
            time_ours = _timing.time_jitted(ours, ours_in, trocar)
            vectorised = functools.partial(peer, name, peer_in, wide_trocar, P_WORLD_REF)
            one_by_one = functools.partial(loop, name, peer_in, wide_trocar, P_WORLD_REF)
            numpy_rate = batch / _timing.time_plain(vectorised, repeats=3).median_s
            scipy_rate = LOOP / _timing.time_plain(one_by_one, repeats=3).median_s
            rate = batch / time_ours.median_s
            gap = largest_gap(ours(ours_in, trocar), vectorised(), one_by_one())
            rows[f"{name}.{way}"] = {
                "maps_per_s": rate,
                "numpy_maps_per_s": numpy_rate,
                "scipy_maps_per_s": scipy_rate,
                "ratio_to_numpy": rate / numpy_rate,
                "ratio_to_scipy": rate / scipy_rate,
                "compile_s": time_ours.compile_s,
                "largest_gap_to_peers": gap,
            }
            print(
                f"{name:6} {way:6} {rate / 1e6:8.2f} {numpy_rate / 1e6:7.2f} "
                f"{scipy_rate / 1e3:7.1f} {rate / numpy_rate:8.1f} {rate / scipy_rate:8.0f} "
                f"{time_ours.compile_s:10.2f} {gap:8.1e}"
            )
    called = one_call(3 if asked.tiny else 200)
    results = {"batch": batch, "dtype": "float32", "results": rows, "one_call_cpu_ms": called}
    _timing.report("rcm", results, asked.tiny)


def one_call(repeats: int) -> dict[str, dict[str, float]]:
    """CPU ms of one call with one pose: five maps, four ways."""
    trocar = jax.tree.map(lambda field: field[:1], rcm.TROCARS)
    pose = sample_poses(trocar, 1)
    where = np.asarray(rcm.trocar_position(trocar, P_WORLD_REF))
    action = np.asarray(rcm.ACTION_SPACES["rcm4"].encode(pose, trocar, P_WORLD_REF))
    wide = jax.tree.map(np.float64, trocar)
    maps = {
        "decode_rcm4": (rcm.ACTION_SPACES["rcm4"].decode, (action, trocar, P_WORLD_REF)),
        "project": (rcm.project, (pose, where)),
        "angles_through": (rcm.angles_through, (rcm.LARGE_NEEDLE_DRIVER, pose, where)),
        "through": (rcm.through, (rcm.LARGE_NEEDLE_DRIVER, pose, where)),
        "trocar_from_poses": (rcm.trocar_from_poses, (sample_poses(trocar, 20),)),
    }
    rows = {}
    for name, (call, inputs) in maps.items():
        fixed = (0,) if inputs[0] is rcm.LARGE_NEEDLE_DRIVER else ()
        jitted = jax.jit(call, static_argnums=fixed)
        ways = {"called": call, "jitted": jitted, "eager": inspect.unwrap(call)}
        rows[name] = {way: cpu_ms(each, inputs, repeats) for way, each in ways.items()}
        print(name, *(f"{way} {ms:.3f} ms" for way, ms in rows[name].items()))
    peer = functools.partial(numpy_decode, "rcm4", np.float64(action), wide, P_WORLD_REF)
    rows["decode_rcm4"]["numpy"] = cpu_ms(peer, (), repeats)
    return rows


def cpu_ms(call: Callable, inputs: tuple, repeats: int) -> float:
    jax.block_until_ready(call(*inputs))
    begun = time.process_time()
    for _ in range(repeats):
        jax.block_until_ready(call(*inputs))
    return 1e3 * (time.process_time() - begun) / repeats


def framed(way: Callable) -> Callable:
    """A map with the trocar's frame made in it, as the peers make theirs."""
    return lambda given, trocar: way(given, rcm.trocar_frame(trocar, P_WORLD_REF))


def sample_poses(trocar: rcm.Trocar, batch: int) -> rcm.Pose:
    """Poses of the manifold, tilted up to about 40 degrees from straight down."""
    rng = np.random.default_rng(0)
    axis = np.concatenate([rng.uniform(-0.6, 0.6, (batch, 2)), -np.ones((batch, 1))], axis=-1)
    roll, depth = rng.uniform(-1.5, 1.5, batch), rng.uniform(0.05, 0.3, batch)
    p_world_trocar = rcm.trocar_position(trocar, P_WORLD_REF)
    numbers = (value.astype(np.float32) for value in (axis, roll, depth))
    return jax.tree.map(np.asarray, rcm.pose_on_manifold(*numbers, p_world_trocar))


def largest_gap(ours, vectorised, one_by_one) -> float:
    """Largest difference to the two peers: the three must compute the same thing."""
    if isinstance(ours, tuple):
        pose, _ = ours
        ours = np.concatenate([pose.R.reshape(-1, 9), pose.p], axis=-1)
    ours = np.asarray(ours)
    return float(max(np.abs(ours - vectorised).max(), np.abs(ours[:LOOP] - one_by_one).max()))


def numpy_frame(
    name: str, trocar: rcm.Trocar, p_world_ref: np.ndarray
) -> tuple[str, np.ndarray, np.ndarray]:
    """Name of the action space without its frame's yaw, R_world_trocar `[..., 3, 3]`, and
    p_world_trocar `[..., 3]`."""
    r, theta, phi = trocar
    c, s, o = np.cos(phi), np.sin(phi), np.zeros_like(phi)
    R = np.stack([c, s, o, s, -c, o, o, o, o - 1.0], axis=-1).reshape(*np.shape(phi), 3, 3)
    direction = np.stack([np.sin(theta) * c, np.sin(theta) * s, np.cos(theta)], axis=-1)
    if name.endswith(FIXED):
        R = np.broadcast_to(np.diag(DOWN), R.shape)
    return name.removesuffix(FIXED), R, p_world_ref + r[..., None] * direction


def numpy_align(b: np.ndarray) -> np.ndarray:
    """Eq. 16 from e_z to unit `b`, written out."""
    x, y, z = np.moveaxis(b, -1, 0)
    f = 1.0 / (1.0 + z)
    R = np.stack([1 - f * x * x, -f * x * y, x, -f * x * y, 1 - f * y * y, y, -x, -y, z], axis=-1)
    return R.reshape(*b.shape, 3)


def numpy_gram_schmidt(rot6d: np.ndarray) -> np.ndarray:
    x = rot6d[..., :3] / np.linalg.norm(rot6d[..., :3], axis=-1, keepdims=True)
    y = rot6d[..., 3:] - np.sum(x * rot6d[..., 3:], axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def numpy_encode(name, pose, trocar, p_world_ref) -> np.ndarray:
    name, R_trocar, p_trocar = numpy_frame(name, trocar, p_world_ref)
    R, p = pose
    if name in ("se3", "rcm1", "rcm3"):
        first = p
        if name != "se3":
            first = np.sum((p - p_trocar) * R[..., 2], axis=-1, keepdims=True)
        R = np.swapaxes(R_trocar, -1, -2) @ R if name == "rcm1" else R
        return np.concatenate([first, R[..., 0], R[..., 1]], axis=-1)
    roll = np.arctan2(-R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] - R[..., 1, 1])
    p = np.einsum("...ji,...j->...i", R_trocar, p - p_trocar) if name == "rcm2" else p
    return np.concatenate([roll[..., None], p], axis=-1)


def numpy_decode(name, action, trocar, p_world_ref) -> np.ndarray:
    name, R_trocar, p_trocar = numpy_frame(name, trocar, p_world_ref)
    if name in ("se3", "rcm1", "rcm3"):
        R = numpy_gram_schmidt(action[..., -6:])
        R = R_trocar @ R if name == "rcm1" else R
        p = action[..., :3] if name == "se3" else p_trocar + action[..., :1] * R[..., 2]
    else:
        p = action[..., 1:]
        p = p_trocar + np.einsum("...ij,...j->...i", R_trocar, p) if name == "rcm2" else p
        axis = (p - p_trocar) / np.linalg.norm(p - p_trocar, axis=-1, keepdims=True)
        base = DOWN[:, None] * numpy_align(DOWN * axis)
        c, s = np.cos(action[..., :1]), np.sin(action[..., :1])
        x, y = c * base[..., 0] + s * base[..., 1], c * base[..., 1] - s * base[..., 0]
        R = np.stack([x, y, base[..., 2]], axis=-1)
    return np.concatenate([R.reshape(*R.shape[:-2], 9), p], axis=-1)


def scipy_encode(name, pose, trocar, p_world_ref) -> np.ndarray:
    rows = []
    for i in range(LOOP):
        kind, R_trocar, p_trocar = scipy_frame(name, trocar, i, p_world_ref)
        R, p = transform.Rotation.from_matrix(pose.R[i]), pose.p[i]
        depth = np.dot(p - p_trocar, R.apply([0, 0, 1]))
        if kind in ("se3", "rcm1", "rcm3"):
            M = (R_trocar.inv() * R if kind == "rcm1" else R).as_matrix()
            rows.append(np.hstack([p if kind == "se3" else depth, M[:, 0], M[:, 1]]))
        else:
            _, _, z, w = (transform.Rotation.from_matrix(np.diag(DOWN)) * R).as_quat()
            roll = 2 * np.arctan2(z, w)
            roll = (roll + np.pi) % (2 * np.pi) - np.pi
            p = R_trocar.inv().apply(p - p_trocar) if kind == "rcm2" else p
            rows.append(np.hstack([roll, p]))
    return np.array(rows)


def scipy_decode(name, action, trocar, p_world_ref) -> np.ndarray:
    rows = []
    for i in range(LOOP):
        kind, R_trocar, p_trocar = scipy_frame(name, trocar, i, p_world_ref)
        if kind in ("se3", "rcm1", "rcm3"):
            R = transform.Rotation.from_matrix(numpy_gram_schmidt(action[i, -6:]))
            R = R_trocar * R if kind == "rcm1" else R
            p = action[i, :3] if kind == "se3" else p_trocar + action[i, 0] * R.apply([0, 0, 1])
        else:
            p = action[i, 1:]
            p = p_trocar + R_trocar.apply(p) if kind == "rcm2" else p
            axis = DOWN * (p - p_trocar) / np.linalg.norm(p - p_trocar)
            k = np.cross([0, 0, 1], axis)
            sin = np.linalg.norm(k)
            base = transform.Rotation.from_rotvec(k / sin * np.arctan2(sin, axis[2]))
            roll = transform.Rotation.from_rotvec([0, 0, action[i, 0]])
            R = transform.Rotation.from_matrix(np.diag(DOWN)) * base * roll
        rows.append(np.hstack([R.as_matrix().ravel(), p]))
    return np.array(rows)


def scipy_frame(name, trocar, i, p_world_ref):
    name, R, p = numpy_frame(name, rcm.Trocar(*(field[i] for field in trocar)), p_world_ref)
    return name, transform.Rotation.from_matrix(R), p


if __name__ == "__main__":
    main()
