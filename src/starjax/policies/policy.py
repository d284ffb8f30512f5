"""A policy of Table II: four pure functions, made from a method's row."""

import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from starjax import config, methods, rcm
from starjax.models import pretrained
from starjax.models.kernels import packed_params, sampling_unet
from starjax.policies import features, hierarchical, single
from starjax.policies.base import Params, Policy
from starjax.sim.tasks.base import Task


def vision_of(params: Params) -> Params:
    """The vision encoder's part of a policy's parameters."""
    return params.get("diffuser", params)["vision"]


def with_vision(params: Params, vision: Params) -> Params:
    """Parameters with the given vision encoder in them, in the place of theirs if they have one."""
    if "diffuser" in params:
        return {**params, "diffuser": with_vision(params["diffuser"], vision)}
    return {**params, "vision": vision}


def with_resnet18(params: Params, path: str | pathlib.Path) -> Params:
    """Parameters whose ResNet-18 trunk is filled from a file of ImageNet weights."""
    vision = vision_of(params)["params"]
    filled = {**vision, "trunk": pretrained.load_resnet18(vision["trunk"], path)}
    return with_vision(params, {"params": filled})


def for_sampling(params: Params, dtype: str) -> Params:
    """Parameters as `sample` uses them fastest: for evaluation, not for training.

    `rounded`, and on a GPU those of the U-Net as `sampling_unet` takes them and all of them
    `packed`.
    """
    if sampling_unet.pays():
        params = with_sampling_blocks(params)
    params = rounded(params, dtype)
    return packed(params) if packed_params.pays(jax.default_backend()) else params


def rounded(params: Params, dtype: str) -> Params:
    """Parameters whose large matrices are in the type that the networks calculate in.

    The networks round them so anyway, to the same numbers, wherever they use them; done before,
    the U-Net's are not read in float32 and rounded again at each DDIM step.
    """
    networks, matrices = {"unet", "trunk"}, {"kernel", "film_time", "film_cond"}

    def one(path: tuple[Any, ...], leaf: Any) -> Any:
        names = {getattr(key, "key", None) for key in path}
        return leaf.astype(jnp.dtype(dtype)) if names & networks and names & matrices else leaf

    return jax.tree_util.tree_map_with_path(one, params)


def with_sampling_blocks(params: Params) -> Params:
    """Parameters of `sample` with its U-Net's as `sampling_unet` takes them."""
    if "diffuser" in params:
        return {**params, "diffuser": with_sampling_blocks(params["diffuser"])}
    return {**params, "unet": sampling_unet.prepared(params["unet"])}


def packed(params: Params) -> Params:
    """Parameters with each network's vectors in one array: a decision for one robot begins the
    later, the more arrays it is handed."""
    if "diffuser" in params:
        rest = {
            name: packed_params.packed(net) for name, net in params.items() if name != "diffuser"
        }
        return {**rest, "diffuser": packed(params["diffuser"])}
    return {name: packed_params.packed(net) for name, net in params.items()}


def ablated(method: methods.Method, policy_config: config.PolicyConfig) -> methods.Method:
    """The row of Table II as settings change it: what it sees and how its poses are written."""
    if policy_config.sees_trocar != "method":
        method = method._replace(sees_trocar=policy_config.sees_trocar == "always")
    fixed = f"{method.action_space}_fixed_yaw"
    if policy_config.trocar_yaw == "fixed" and fixed in rcm.ACTION_SPACES:
        method = method._replace(action_space=fixed)
    return method


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    task: Task,
    train_config: config.TrainConfig | None = None,
    cameras: Sequence[str] = (),
) -> Policy:
    """The policy of a method.

    Args:
      method: a row of Table II.
      policy_config: networks and diffusion.
      task: gives the number of arms, and what a state observation is made of.
      train_config: augmentation, which inference does not need.
      cameras: that are observed, in the order in which the networks read them; empty: the task's
        first one.
    """
    method = ablated(method, policy_config)
    build = hierarchical.make if method.hierarchical else single.make
    seen = features.sensors(task, cameras)
    return build(method, policy_config, seen, train_config or config.TrainConfig())
