"""An expert that takes over in the middle of a demonstration continues it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.finetune.rescuers import midway
from starjax.addons.finetune.rescuers import peg_transfer as rescue
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting
from starjax.tasks.peg_transfer import expert

STEPS = 230  # control steps, up to the last phase of the slowest
KEYS = jax.random.split(jax.random.key(4), 12)


@pytest.fixture(scope="module")
def found(reset, takeover):
    """Demonstrations without physics: tips follow their commands, closed jaws move the block."""

    def step(carry, _):
        memory, state = carry
        _, memory, label = expert.AGENT.act(memory, state)
        after, jaws = label.pose, label.gripper
        moved = jnp.where(state.touch[0], after.p[0] - state.pose.p[0], 0.0)
        block, goal = state.measurements.block, state.layout.target_peg
        is_there = jnp.linalg.norm(block.p[:2] - goal) < 2e-3
        block = block._replace(p=block.p + moved)
        velocity = (
            jnp.zeros_like(state.velocity).at[:, :3].set(CONTROL_HZ * (after.p - state.pose.p))
        )
        following = state.replace(
            pose=after,
            velocity=velocity,
            gripper=jaws,
            gripper_target=jaws,
            touch=jaws < 0.0,
            measurements=state.measurements.replace(block=block),
            stage=memory.phase,
            done=(memory.phase > expert.OPEN) & is_there,
        )
        return (memory, following), (state, label.pose.p, jaws)

    @jax.jit
    @jax.vmap
    def episode(key, state):
        return jax.lax.scan(step, (expert.AGENT.init(key, state), state), None, STEPS)[1]

    swapped = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), episode(KEYS, reset(6)))
    return takeover.Episodes(*swapped)


@pytest.fixture(scope="module")
def takeover(pytestconfig):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(pytestconfig.rootpath / "experiments" / "fine_tuning")
        import takeover

        return takeover


@pytest.mark.slow
def test_the_expert_of_peg_transfer_continues_a_demonstration(found, takeover):
    gaps = takeover.compared(rescue.RESCUER, found)
    is_beyond = gaps.velocity > takeover.TOLERANCE
    phases = {phase: (gaps.stage == phase) for phase in range(expert.WAIT)}
    assert all(phases[p].sum() > 5 for p in (1, 2, expert.LIFT, expert.CARRY, expert.LOWER))
    assert np.median(gaps.velocity) < takeover.TOLERANCE / 4
    assert is_beyond.mean() < 0.06 and not is_beyond[phases[expert.DESCEND]].any()


@pytest.mark.parametrize("speed", [0.0, 0.01, 0.04])
def test_a_motion_goes_on_at_its_speed(speed):
    left, duration = 0.012, 1.1
    at = float(midway.share(jnp.float32(left), jnp.float32(speed), jnp.float32(duration)))
    way = left / (1.0 - scripting.sloped(at))
    slope = jax.grad(scripting.sloped)(at)
    np.testing.assert_allclose(way * slope / duration, speed, rtol=0.01, atol=1e-6)
