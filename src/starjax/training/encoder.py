"""The vision encoder of another policy, as the start of a new policy's or frozen in it."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax.core import config, errors
from starjax.policies import features, generator, packaged, policy_file
from starjax.policies.base import Params
from starjax.policies.models import pretrained

_WEIGHTS = "policy.encoder_weights"


class Encoder(NamedTuple):
    """A trained vision encoder.

    Attributes:
      params: of `models.encoders.ImageEncoder`.
      fingerprint: start of the hash of the parameters, in hexadecimal.
    """

    params: Params
    fingerprint: str


def read(policy_config: config.PolicyConfig) -> Encoder | None:
    """Returns the encoder that the settings name, if a starjax policy holds it.

    Returns None for a ResNet-18's ImageNet weights, which fill the ResNet's trunk and nothing else.

    Raises:
      errors.UsageError: the file is missing or damaged, or its encoder differs from the settings.
    """
    name = policy_config.encoder_weights
    path = packaged.find_encoder(_WEIGHTS, name)
    if not policy_file.is_policy(path):
        _check_resnet18(policy_config, path)
        return None
    try:
        trained = policy_file.load(path)
    except ValueError as error:
        raise errors.UsageError(_WEIGHTS, "a policy of starjax", error) from error
    if differing := _differing(policy_config, trained):
        raise errors.UsageError(
            _WEIGHTS,
            "an encoder made with these settings",
            f"{name}, made with {', '.join(differing)}",
            "use the same, or other weights",
        )
    params = trained.params["vision"]
    _check_shapes(policy_config, params, name)
    return Encoder(params, policy_file.fingerprint(params)[:16])


def start(params: Params, policy_config: config.PolicyConfig) -> Params:
    """Returns a policy's first parameters, with the encoder that the settings name."""
    encoder = read(policy_config)
    if encoder is not None:
        return {**params, "vision": encoder.params}
    vision = params["vision"]["params"]
    trunk = pretrained.load_resnet18(vision["trunk"], policy_config.encoder_weights)
    return {**params, "vision": {"params": {**vision, "trunk": trunk}}}


def _differing(policy_config: config.PolicyConfig, trained: policy_file.Trained) -> list[str]:
    """Lists settings of the encoder that differ: `policy.vision_dim 64 (here 128)`."""
    names = ["observation", "encoder", "vision_dim"]
    # An encoder that is trained further may adapt to another image size.
    names += ["image_size"] if policy_config.freeze_encoder else []
    ours, theirs = policy_config, trained.policy
    differences = [
        f"policy.{name} {getattr(theirs, name)} (here {getattr(ours, name)})"
        for name in names
        if getattr(ours, name) != getattr(theirs, name)
    ]
    fractions = theirs.crop_fraction, ours.crop_fraction
    cropped = dataclasses.replace(theirs, crop_fraction=ours.crop_fraction)
    if ours.freeze_encoder and features.crop_size(theirs) != features.crop_size(cropped):
        differences.append("policy.crop_fraction {:g} (here {:g})".format(*fractions))
    return differences


def _check_resnet18(policy_config: config.PolicyConfig, path: Path) -> None:
    name = policy_config.encoder_weights
    if policy_config.freeze_encoder:
        raise errors.UsageError(
            "policy.freeze_encoder",
            "policy.encoder_weights of a trained starjax policy",
            f"{name}, which would leave the keypoints untrained",
        )
    if policy_config.encoder != "resnet18":
        raise errors.UsageError(
            "policy.encoder", f"resnet18 with the weights {name}", policy_config.encoder
        )
    try:
        pretrained.load_resnet18(_shapes(policy_config)["params"]["trunk"], path)
    except errors.UsageError as error:
        got = f"{error.got} in {path}"
        raise errors.UsageError(_WEIGHTS, error.expected, got, error.hint) from error


def _check_shapes(policy_config: config.PolicyConfig, params: Params, name: str | Path) -> None:
    """Raises UsageError unless today's network has these parameters."""
    shapes = [
        {jax.tree_util.keystr(path): leaf.shape for path, leaf in leaves}
        for leaves in map(jax.tree_util.tree_leaves_with_path, (_shapes(policy_config), params))
    ]
    for key in sorted({*shapes[0], *shapes[1]}):
        want, got = (shape.get(key, "no such parameter") for shape in shapes)
        if want != got:
            raise errors.UsageError(_WEIGHTS, f"{want} at {key}", f"{got} in {name}")


def _shapes(policy_config: config.PolicyConfig) -> Params:
    """Returns the vision encoder's parameters without their numbers."""
    vision, size = generator.vision_encoder(policy_config), policy_config.image_size
    return jax.eval_shape(vision.init, jax.random.key(0), jnp.zeros((1, size, size, 3)))
