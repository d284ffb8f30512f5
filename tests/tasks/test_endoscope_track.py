"""The endoscope: pose of its camera, test of its target, end of a trial."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mistakes
import mujoco
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import ik, registries, scene
from starjax.sim.chain import chain_of
from starjax.sim.task import Contacts, SimReadings
from starjax.tasks.endoscope_track import expert, task

NO_CONTACTS = Contacts(jnp.zeros((0, 2), jnp.int32), jnp.zeros(0))
TARGET = jnp.array([0.02, -0.015, 0.03])


def model(tool):
    return scene.compose(scene.name("endoscope_track", tools=(tool,)))


def measured(m, pose, before=None):
    """Measurements of a tip at `pose`, the target at TARGET."""
    bound = task.bind(m)
    qpos = jnp.zeros(m.nq).at[bound.target].set(TARGET)
    one = jax.tree.map(lambda leaf: leaf[None], pose)
    nothing = jnp.zeros(1)
    readings = SimReadings(qpos, jnp.zeros(m.nv), one, nothing, nothing, nothing, NO_CONTACTS)
    return task.measure(bound, None, readings, before)


def looking(m, trocar, turn=0.0, distance=task.DISTANCE):
    """The expert's pose at a trocar, turned about the shaft by `turn` rad."""
    frame = rcm.trocar_frame(trocar, np.array(task.TASK.slots[0].p_world_ref))
    pose = task.looking_at(
        TARGET, frame.p_world_trocar, jnp.array(distance), task.bind(m).R_tip_camera
    )
    assert rcm.rcm_error(pose, frame.p_world_trocar) < 1e-6
    return Pose(pose.R @ rcm.rotation_z(turn), pose.p)


@pytest.mark.parametrize("tool", ["endoscope", "endoscope30"])
def test_the_camera_is_judged_where_mujoco_has_it(tool):
    m = model(tool)
    data = mujoco.MjData(m)
    data.qpos[:6] = [0.1, -1.2, 1.4, -1.0, -1.5, 0.3]
    mujoco.mj_kinematics(m, data)
    mujoco.mj_camlight(m, data)
    chain = chain_of(m, "arm0/shoulder", "arm0/tool/tcp")
    order = [m.joint(f"arm0/j{i + 1}").qposadr[0] for i in range(6)]
    pose, _, _ = ik.forward(chain, jnp.asarray(data.qpos[order], jnp.float32))
    camera, at = measured(m, pose).camera, m.camera(task.CAMERA).id
    np.testing.assert_allclose(camera.R, data.cam_xmat[at].reshape(3, 3), atol=1e-5)
    np.testing.assert_allclose(camera.p, data.cam_xpos[at], atol=1e-5)


@pytest.mark.parametrize("tool", ["endoscope", "endoscope30"])
@pytest.mark.parametrize("row", [0, 8, 11])
def test_one_pose_of_a_trocar_has_the_target_where_it_belongs(tool, row):
    m, trocar = model(tool), rcm.Trocar(*(field[row] for field in rcm.TROCARS))
    measurements = measured(m, looking(m, trocar))
    assert measurements.off < 1e-4 and measurements.tilt < 1e-4 and measurements.on_target
    assert abs(measurements.distance - task.DISTANCE) < 1e-5
    turned = measured(m, looking(m, trocar, turn=1.5 * task.TILT))
    assert not turned.on_target
    assert not measured(m, looking(m, trocar, distance=1.25 * task.DISTANCE)).on_target
    assert measured(m, looking(m, trocar, distance=1.15 * task.DISTANCE)).on_target


@pytest.mark.parametrize("tool", ["endoscope", "endoscope30"])
def test_an_episode_begins_with_its_target_in_the_picture(tool):
    bound = task.bind(model(tool))
    work = registries.workspaces.get(task.TASK.slots[0].workspace)

    def furthest_aside(key):
        key_trocar, key_layout = jax.random.split(key)
        where = jax.random.uniform(key_trocar, (3, 1))
        low, high = jnp.array([work.radius, work.polar, work.azimuth]).T[..., None]
        trocar = rcm.trocar_frame(
            rcm.Trocar(*(low + (high - low) * where)), np.array(work.p_world_ref)[None]
        )
        layout = task.sample(bound, key_layout)
        tips = task.tips(bound, layout, trocar.p_world_trocar)
        start = jnp.concatenate([jnp.zeros((1, 1)), tips], axis=-1)
        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(start, trocar)
        camera_R = pose.R[0] @ bound.R_tip_camera
        target = camera_R.T @ (task.path(layout, jnp.zeros(())) - pose.p[0])
        return jnp.max(jnp.abs(target[:2])) / (-2.0 * bound.half * target[2])

    keys = jax.random.split(jax.random.key(0), 20_000)
    assert float(jnp.max(jax.jit(jax.vmap(furthest_aside))(keys))) < 0.5


@pytest.mark.slow
def test_the_expert_records_the_right_distance_from_a_disturbed_one():
    m, measured_trocar = (
        model("endoscope"),
        rcm.Trocar(*(jnp.full(1, angle) for angle in (0.03, 1.5, 0.0))),
    )
    measured_trocar = rcm.trocar_frame(
        measured_trocar, np.array(task.TASK.slots[0].p_world_ref)[None]
    )
    measurements = measured(m, looking(m, rcm.Trocar(0.03, 1.5, 0.0)))
    pose = Pose(
        measurements.camera.R[None] @ task.bind(m).R_tip_camera.T, measurements.camera.p[None]
    )
    state = SimpleNamespace(
        measurements=measurements, pose=pose, measured_trocar=measured_trocar, step=jnp.int32(0)
    )

    def distances(key):
        script = expert.init(key, state).replace(elapsed=jnp.array(expert.FIND_TIME[1]))
        executed, _, recorded = expert.act(script, state)
        tips = jnp.stack([executed.pose.p[0], recorded.pose.p[0]])
        return jnp.linalg.norm(tips - TARGET, axis=-1)

    executed, recorded = jax.vmap(distances)(jax.random.split(jax.random.key(0), 64)).T
    np.testing.assert_allclose(recorded, task.DISTANCE, atol=1e-5)
    assert executed.min() < 0.95 * task.DISTANCE and executed.max() > 1.05 * task.DISTANCE


@pytest.mark.parametrize(
    ("missed", "unseen", "good", "loose", "lost"),
    [
        (0, False, True, True, False),
        (task.MAY_MISS, True, True, False, False),
        (task.MAY_MISS + 1, False, False, True, False),
        (task.MAY_MISS + 1, True, False, False, True),
    ],
)
def test_a_trial_is_judged_by_the_time_on_target(missed, unseen, good, loose, lost):
    m = model("endoscope")
    measurements = measured(m, looking(m, rcm.Trocar(0.0, 1.5, 0.0)))
    measurements = measurements.replace(missed=jnp.int32(missed), unseen=jnp.array(unseen))
    for step, is_over in ((task.LAST - 1, False), (task.LAST, True)):
        found = task.status(None, None, measurements.replace(step=jnp.int32(step)))
        assert bool(found.success_now) == (good and is_over) and bool(found.loose) == (
            loose and is_over
        )
        assert bool(found.lost) == lost and (float(found.reward) == 1.0) == bool(found.success_now)


def test_time_off_target_counts_after_the_first_seconds():
    m = model("endoscope")
    pose = looking(m, rcm.Trocar(0.0, 1.5, 0.0), turn=2 * task.TILT)
    before = measured(m, pose)
    early, late = (
        measured(m, pose, before.replace(step=jnp.int32(step)))
        for step in (task.FIRST - 1, task.FIRST)
    )
    assert int(early.missed) == 0 and int(late.missed) == 1 and not late.unseen


def test_a_tool_without_the_camera_is_a_mistake(monkeypatch):
    names, mounted = scene.name("endoscope_track"), registries.mount
    monkeypatch.setattr(
        registries, "mount", lambda arm, tool, workspace: mounted(arm, "endoscope", workspace)
    )
    with mistakes.of("camera", "endoscope"):
        scene.compose(names._replace(tools=("grasper",)))
