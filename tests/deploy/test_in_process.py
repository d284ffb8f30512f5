"""A robot driven by a policy of the same process, and its stops."""

import jax
import numpy as np
import pytest
import served

from starjax import deploy, rcm
from starjax.core.errors import UsageError
from starjax.sim import registries


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registries, "tasks", registries.Registry("task", {"fake": "fakes:TASK"}))
        yield served.policy(tmp_path_factory.mktemp("drive"))


class Robot:
    """It reaches each command at once, unless `stuck`."""

    def __init__(self, stuck=False):
        self.seen, self.commands, self.stuck = served.moment(), [], stuck

    def measure(self):
        return self.seen

    def send(self, command):
        self.commands.append(command)
        if not self.stuck:
            self.seen = self.seen.replace(pose=command.pose, gripper=command.gripper)


def test_it_drives_on_the_manifold(policy):
    robot = Robot()
    report = deploy.drive(robot, policy, served.PORT, 1.0, key=jax.random.key(0))
    assert report.steps == len(robot.commands) == 30 and report.plans >= 2 and not report.fault
    where = np.asarray(rcm.trocar_position(served.PORT, policy.p_world_ref))
    assert max(float(rcm.rcm_error(one.pose, where)) for one in robot.commands) < 1e-6
    assert np.linalg.norm(robot.commands[-1].pose.p - robot.commands[0].pose.p) > 1e-3


def test_an_arm_that_does_not_follow_gets_no_more(policy):
    robot = Robot(stuck=True)
    report = deploy.drive(robot, policy, served.PORT, 2.0, key=jax.random.key(0))
    assert report.silent > 20 and report.fault.startswith("following")
    away = np.linalg.norm(robot.commands[-1].pose.p - served.moment().pose.p)
    assert away < deploy.Tolerances().max_following + 4 * deploy.Limits().per_step[0]


def test_an_arm_that_stays_where_plans_begin_gets_no_more(policy):
    robot, wide = Robot(stuck=True), deploy.Tolerances(max_following=0.02)
    slow = deploy.Limits(speed=0.02)
    report = deploy.drive(
        robot, policy, served.PORT, 2.0, key=jax.random.key(0), tolerances=wide, limits=slow
    )
    assert report.silent > 20 and report.fault.startswith("stall"), report


def test_a_trocar_beside_the_shaft_is_refused_before_anything_moves(policy):
    robot, where = Robot(), rcm.trocar_position(served.PORT, policy.p_world_ref)
    beside = np.asarray(where) + np.float32([0.005, 0.0, 0.0])
    with pytest.raises(UsageError) as caught:
        deploy.drive(robot, policy, beside, 0.2)
    assert "trocar" in caught.value.got and not robot.commands
    wide = deploy.Tolerances(max_off_trocar=0.02, max_following=1.0)
    assert (
        deploy.drive(robot, policy, beside, 0.2, tolerances=wide).steps == len(robot.commands) > 0
    )


def test_a_refused_plan_holds(policy, monkeypatch):
    """An error of the policy is a reply, and the thread lives on."""

    def broken(*_):
        raise RuntimeError("out of memory")

    robot = Robot()
    planned = type(policy).plan
    calls = iter(range(100))

    def plan(self, *inputs):
        return planned(self, *inputs) if next(calls) == 0 else broken()

    monkeypatch.setattr(type(policy), "plan", plan)  # the first call compiles
    report = deploy.drive(robot, policy, served.PORT, 0.3)
    assert report.refused >= 1 and report.fault == "out of memory"
    assert report.held == report.steps == 9
