"""Policies of instruments with a wrist, outside of the simulator."""

import fakes
import jax
import numpy as np
import pytest

from starjax import deploy, rcm
from starjax.core import config
from starjax.core.errors import UsageError
from starjax.core.methods import METHODS
from starjax.core.types import Command, Pose
from starjax.data import normalizer
from starjax.deploy import inputs, plan_executor, plan_motion
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.sim import registries, wrists

WRIST = rcm.LARGE_NEEDLE_DRIVER
WHERE = np.float32([0.01, -0.02, 0.15])
HORIZON = 16
SCENE = fakes.SCENE._replace(task="fake", tools=("needle_driver",))


def bent(rng, count, most=1.2):
    """Feasible tips `[count]` about the board."""
    angles = rng.uniform(-most, most, (count, 2))
    p = rng.uniform([-0.03, -0.03, 0.0], [0.03, 0.03, 0.04], (count, 3))
    actions = np.concatenate([rng.uniform(-1.0, 1.0, (count, 1)), angles, p], -1)
    trocar = rcm.trocar_from_position(WHERE, np.zeros(3, np.float32))
    pose, _ = rcm.rcm6(WRIST).decode(np.float32(actions), trocar, np.zeros(3, np.float32))
    return Pose(*(np.asarray(x) for x in pose))


def test_commands_keep_the_shaft_in_the_trocar_and_do_not_jump():
    rng, limits = np.random.default_rng(0), deploy.Limits()
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, 8, None, limits, WRIST)
    start = bent(rng, 1)
    executor.begin(Pose(start.R[0], start.p[0]), 0.3)
    commands = [executor.last]
    for _ in range(100):
        if executor.needs_plan:
            executor.on_request()
            executor.on_plan(Command(bent(rng, HORIZON), np.zeros(HORIZON)))
        commands.append(executor.step())
    assert executor.report.limited > 0 and executor.report.refused == 0
    pose = Pose(*(np.stack([c.pose[n] for c in commands]) for n in (0, 1)))
    angles = np.stack([c.wrist for c in commands])
    shaft = rcm.shaft_of(WRIST, pose, angles)
    assert np.asarray(rcm.rcm_error(shaft, WHERE)).max() < 1e-6
    assert (np.abs(angles) <= np.float32([WRIST.pitch, WRIST.yaw]) + 1e-4).all()
    move = np.linalg.norm(np.diff(pose.p, axis=0), axis=-1).max()
    assert move <= limits.per_step[0] * (1 + 1e-4)


def test_a_plan_beyond_the_wrists_limits_is_not_followed():
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, 8, None, deploy.Limits(), WRIST)
    good = bent(np.random.default_rng(0), HORIZON)
    executor.begin(Pose(good.R[0], good.p[0]), 1.0)
    R = np.array(good.R)
    R[5] = R[5] @ np.diag([1.0, -1.0, -1.0])  # the jaws point back along the shaft
    executor.on_request()
    executor.on_plan(Command(Pose(R, good.p), np.zeros(HORIZON)))
    assert executor.report.refused == 1
    executor.on_request()
    executor.on_plan(Command(good, np.zeros(HORIZON)))
    assert executor.report.refused == 1


def test_straight_tools_have_no_angles():
    pose = rcm.pose_on_manifold(np.float32([0.0, 0.0, -1.0]), np.float32(0.0), 0.1, WHERE)
    assert plan_motion.of(None).angles(pose, WHERE) is None


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files of two methods with random weights, of a fake task with a needle driver."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registries, "tasks", registries.Registry("task", {"fake": "fakes:TASK"}))
        paths, task = {}, wrists.holding(fakes.TASK, SCENE)
        for name in ("stardiff_pose", "dp_ee_wrist"):
            row = METHODS[name]
            policy = policies.make(row, fakes.TINY, task, config.TrainConfig())
            stats = normalizer.fit(row, task, fakes.dataset(seed=0), np.arange(80))
            trained = fakes.trained(
                method=name, params=fakes.params(policy), normalizer=stats, scene=SCENE
            )
            paths[name] = tmp_path_factory.mktemp("wrist") / f"{name}.safetensors"
            policy_file.save(paths[name], trained)
        yield paths


def test_a_deployed_policy_moves_the_wrist_through_any_trocar(files):
    policy = deploy.load(files["stardiff_pose"], max_first_move=np.inf, max_first_turn=np.inf)
    moments = policy.settings.obs_horizon
    trocar = rcm.trocar_from_position(WHERE, policy.p_world_ref)
    pose = bent(np.random.default_rng(1), 1)
    repeated = Pose(*(np.repeat(x, moments, 0) for x in pose))
    seen = deploy.Observation(
        pose=repeated, gripper=np.ones(moments), state=np.zeros((moments, 12), np.float32)
    )
    command = policy(jax.random.key(0), seen, trocar)
    assert command.wrist.shape == (policy.settings.horizon, 2)
    shaft = rcm.shaft_of(WRIST, command.pose, command.wrist)
    assert np.asarray(rcm.rcm_error(shaft, WHERE)).max() < 1e-6
    # jaws that point back at the trocar are a mistake of the frames
    back = Pose(repeated.R @ np.diag([1.0, -1.0, -1.0]).astype(np.float32), repeated.p)
    with pytest.raises(UsageError) as caught:
        inputs.validate(policy.input_spec, seen.replace(pose=back), trocar)
    assert caught.value.argument == "observation.pose"


def test_a_policy_of_a_free_shaft_is_not_deployed_as_it_is(files):
    with pytest.raises(UsageError) as caught:
        deploy.load(files["dp_ee_wrist"])
    assert caught.value.argument == "method"
    assert deploy.load(files["dp_ee_wrist"], "dp_ee_proj_wrist").input_spec.wrist == tuple(WRIST)
