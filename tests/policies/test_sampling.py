"""Options of a learner that a trained policy may change."""

import fakes
import mistakes
import pytest

from starjax.policies import sampling


def test_other_samples_are_of_the_same_weights_and_have_no_monitor():
    trained = fakes.trained(monitor="of the old samples")
    assert sampling.applied("options", trained, {}) is trained
    new = sampling.applied("options", trained, {"temperature": 0.25})
    assert new.policy.options.temperature == 0.25 and new.monitor is None
    assert new._replace(policy=trained.policy, monitor=trained.monitor) == trained


def test_a_policy_with_wrists_samples_otherwise_with_the_tools_of_its_scene():
    scene = fakes.SCENE._replace(tools=("needle_driver",))
    trained = fakes.trained(method="stardiff_pose", scene=scene)
    new = sampling.applied("options", trained, {"temperature": 0.25})
    assert new.policy.options.temperature == 0.25


@pytest.mark.parametrize("option", [{"time_dim": 32}, {"kernel_size": 3}])
def test_an_option_of_other_weights_is_refused(option):
    with mistakes.of("options", *option):
        sampling.applied("options", fakes.trained(), option)
