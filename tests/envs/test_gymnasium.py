"""Tasks as Gymnasium environments: its checkers, and its own vector environments as the oracle."""

import importlib
import pathlib
import warnings

import gymnasium
import mistakes
import numpy as np
import pytest
from gymnasium.utils import env_checker

import starjax.envs
from starjax import rcm
from starjax.core import errors
from starjax.envs import registration, settings, trocar_draws, vector
from starjax.sim import registries

STEPS = 3  # time limit at which some episodes end
REACH = {"max_episode_steps": STEPS, "trocar": "all"}
MODES = list(gymnasium.vector.AutoresetMode)


@pytest.fixture(scope="module")
def lanes():
    """Two lanes by us, and two environments side by side by Gymnasium, in a mode."""

    def make(mode):
        ours = gymnasium.make_vec("starjax/Reach-v0", 2, autoreset_mode=mode, **REACH)
        one = [lambda: gymnasium.make("starjax/Reach-v0", **REACH)] * 2
        return ours, gymnasium.vector.SyncVectorEnv(one, autoreset_mode=mode)

    return make


def same(ours, theirs):
    """Numbers, arrays and dicts of them, with object arrays of observations."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for name in theirs:
            same(ours[name], theirs[name])
    elif theirs.dtype == object:
        assert [x is None for x in ours] == [x is None for x in theirs]
        for one, other in zip(ours, theirs, strict=True):
            if other is not None:
                same(one, other)
    else:
        assert ours.shape == theirs.shape and ours.dtype.kind == theirs.dtype.kind
        np.testing.assert_allclose(ours, theirs, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
def test_lanes_are_what_gymnasium_makes_of_single_environments(lanes, mode):
    ours, theirs = lanes(mode)
    assert ours.metadata["autoreset_mode"] == mode
    ours.action_space.seed(0)
    for one, other in zip(ours.reset(seed=5), theirs.reset(seed=5), strict=True):
        same(one, other)
    ended = 0
    for i in range(2 * STEPS + 2):
        if i == 1:  # from here on they end at different times
            mask = {"reset_mask": np.array([True, False])}
            for one, other in zip(*(env.reset(options=dict(mask)) for env in (ours, theirs))):
                same(one, other)
        actions = ours.action_space.sample()
        found, wanted = ours.step(actions), theirs.step(actions)
        for one, other in zip(found, wanted, strict=True):
            same(one, other)
        assert found[0] in ours.observation_space
        over = found[2] | found[3]
        ended += over.sum()
        if mode == gymnasium.vector.AutoresetMode.DISABLED and over.any():
            for env in (ours, theirs):
                env.reset(options={"reset_mask": over})
    assert ended >= 4


@pytest.mark.slow
def test_only_masked_lanes_begin_anew_and_others_stay(lanes):
    ours, _ = lanes("Disabled")
    first, _ = ours.reset(seed=[7, 8])
    mask = np.array([True, False])
    second, _ = ours.reset(options={"reset_mask": mask})
    assert not np.array_equal(second[0], first[0])
    np.testing.assert_array_equal(second[1], first[1])
    again, _ = ours.reset(seed=[7, 9], options={"reset_mask": mask})
    np.testing.assert_array_equal(again, first)
    for _ in range(STEPS):
        *_, truncated, _ = ours.step(np.zeros((2, 5), np.float32))
    assert truncated.all()
    still, reward, _, truncated, _ = ours.step(np.ones((2, 5), np.float32))
    rested, *_ = ours.step(-np.ones((2, 5), np.float32))
    np.testing.assert_array_equal(still, rested)
    assert truncated.all() and not reward.any()


@pytest.mark.slow
def test_gymnasium_finds_nothing_to_say():
    env = gymnasium.make("starjax.envs:starjax/Reach-v0", **REACH).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_env(env, skip_render_check=True)


def test_every_task_has_an_environment_also_one_of_another_package(monkeypatch):
    site = pathlib.Path(__file__).parents[1] / "extension" / "site"
    monkeypatch.syspath_prepend(site)
    importlib.invalidate_caches()
    known = dict(gymnasium.registry)
    try:
        registration.register()
        for task in registries.tasks.names():
            spec = gymnasium.spec(registration.name(task))
            assert spec.kwargs == {"task": task}
        assert "starjax/Touch-v0" in gymnasium.registry
    finally:
        gymnasium.registry.clear()
        gymnasium.registry.update(known)
    assert registration.name("peg_transfer") == "starjax/PegTransfer-v0"


@pytest.mark.parametrize(
    ("wrong", "argument"),
    [
        ({"trocar": "sen"}, "trocar"),
        ({"trocar": 12}, "trocar"),
        ({"trocar": (0.03, np.pi / 2, 0.4)}, "trocar"),  # parameters where a position is meant
        ({"trocar": (0.0, 0.15)}, "trocar"),
        ({"trocar": rcm.Trocar(0.2, 1.5, 0.0)}, "trocar"),
        ({"trocar": rcm.Trocar([0.0] * 3, [1.0] * 3, [0.0] * 3)}, "trocar"),
        ({"action_space": "rcm5"}, "action_space"),
        ({"reward": "big"}, "reward"),
        ({"control": "both"}, "control"),
        ({"max_episode_steps": 0}, "max_episode_steps"),
        ({"num_envs": 0}, "num_envs"),
        ({"render_mode": "human"}, "render_mode"),
        ({"imagesize": 8}, "environment's argument"),
    ],
)
def test_a_mistake_names_its_argument(wrong, argument):
    with pytest.raises(errors.UsageError) as raised:
        gymnasium.make_vec("starjax/Reach-v0", **wrong)
    assert raised.value.argument == argument


def test_a_trocar_is_a_position_or_parameters():
    task = registries.tasks.get("reach")
    one = rcm.Trocar(0.03, 1.4, 0.4)
    place = rcm.trocar_position(one, np.float32(task.slots[0].p_world_ref))
    draws = [
        trocar_draws.make(task, settings.make(trocar=chosen).trocar)(None)
        for chosen in (one, tuple(np.asarray(place).tolist()))
    ]
    for first, second in zip(*draws, strict=True):
        assert first.shape == (1,)
        np.testing.assert_allclose(first, second, atol=1e-5)


@pytest.mark.slow
def test_wrong_calls_are_one_line(lanes):
    ours, _ = lanes("NextStep")
    with pytest.raises(gymnasium.error.ResetNeeded):
        ours.step(np.zeros((2, 5)))
    with pytest.raises(errors.UsageError):
        ours.reset(options={"reset_mask": np.array([True, False])})
    ours.reset(seed=0)
    for actions in (np.zeros(5), np.full((2, 5), np.nan)):
        with pytest.raises(errors.UsageError):
            ours.step(actions)
    for mask in (np.zeros(2, bool), np.ones(3, bool), np.ones(2)):
        with pytest.raises(errors.UsageError):
            ours.reset(options={"reset_mask": mask})
    with pytest.raises(errors.UsageError):
        ours.reset(seed=[1, 2, 3])


@pytest.mark.parametrize("seed", [2**32, 2**32 + 3, 2**64, -1, 3.0, "3", True])
def test_a_seed_that_would_alias_another_is_refused(seed):
    assert vector.checked_seed(np.uint32(2**32 - 1)) == vector.checked_seed(2**32 - 2, 1)
    with mistakes.of("seed"):
        vector.checked_seed(seed)


@pytest.mark.slow
def test_seeds_and_options_of_a_reset_are_checked(lanes):
    ours, theirs = lanes("NextStep")
    for seed in (2**32 - 1, [0, 2**32], [1.0, 2], [None, -1]):
        with mistakes.of("seed"):
            ours.reset(seed=seed)
    ours.reset(seed=[None, 2**32 - 1])
    ours.reset(seed=np.uint32(2**32 - 2), options={})
    for env, options in ((ours, {"trocar": 3}), (theirs, {"low": 0.1})):
        with mistakes.of("options", next(iter(options))):
            env.reset(options=options)


def test_without_gymnasium_the_extra_is_named(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(errors.UsageError) as raised:
        registration.register()
    assert "[gym]" in raised.value.hint
    importlib.reload(starjax.envs)  # the Playground wrapper works without it
