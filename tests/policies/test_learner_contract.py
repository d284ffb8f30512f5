"""Mistakes in a learner of another package: one line that names the function and its file."""

import pathlib

import jax
import jax.numpy as jnp
import pytest

from starjax.core import errors
from starjax.policies import learner_contract
from starjax.policies.sequences import SequenceModel, Sizes

SIZES = Sizes(horizon=8, action=5, obs_horizon=2, vision=0, state=6, trocar=0)
HERE = pathlib.Path(__file__).name


def sample(params, keys, condition, reach):
    return jnp.zeros((len(keys), SIZES.horizon, SIZES.action)) + params["bias"]


MODEL = SequenceModel(
    init=lambda key: {"bias": jnp.zeros(())},
    prepare=lambda key, x0: x0,
    loss=lambda params, condition, given: (jnp.mean((given - params["bias"]) ** 2), {}),
    sample=sample,
)
WRONG = {
    "init": [lambda key: jnp.zeros(3)],
    "prepare": [lambda key, x0: x0[0]],
    "loss": [
        lambda params, condition, given: jnp.zeros(()),
        lambda params, condition, given: (given, {}),
        lambda params, condition, given: (jnp.zeros(()), {"mse": 0.0}),
        lambda params, condition, given: 1 / 0,
    ],
    "sample": [
        lambda params, keys, condition, reach: sample(params, keys, condition, reach)[:, :4],
        lambda params, keys, condition, reach: sample(params, keys, condition, reach) > 0,
        lambda params, keys, condition: None,
    ],
}


@pytest.mark.parametrize(
    ("name", "wrong"), [(name, each) for name, some in WRONG.items() for each in some]
)
def test_a_wrong_result_names_the_function_and_its_file(name, wrong):
    with pytest.raises(errors.UsageError) as caught:
        learner_contract.check("learner mine", MODEL._replace(**{name: wrong}), SIZES)
    assert caught.value.argument.startswith(f"learner mine: {name} ({HERE}:")


def test_right_results_are_let_pass():
    learner_contract.check("learner mine", MODEL, SIZES)
    condition = learner_contract.condition(SIZES, 3, jax.random.key(0))
    assert condition.state.shape == (3, 6) and condition.vision is None
