"""The ring and its wire: as in the model; tests of touch, end and success."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core.types import Pose
from starjax.sim import scene
from starjax.sim.task import Contacts, SimReadings
from starjax.tasks import outlines
from starjax.tasks.ring_on_wire import task


@pytest.fixture(scope="module")
def model():
    return scene.compose(scene.name("ring_on_wire"))


@pytest.fixture(scope="module")
def bound(model):
    return task.bind(model)


def hanging(bound, y, start=0, raised=0.0, rubbed=0, touch=False, speed=0.0):
    """Layout and facts of a ring at rest at `y`."""
    layout = task.sample(bound, jax.random.key(0))
    layout = layout.replace(start=jnp.int32(start), way=jnp.array(1.0 - 2.0 * start))
    p = jnp.array([0.0, y, float(task.height(jnp.array(y))) - task.HANG + raised])
    measurements = task.RingMeasurements(
        Pose(jnp.eye(3), p),
        jnp.full(6, speed),
        p,
        jnp.array(touch),
        jnp.zeros((), bool),
        jnp.int32(rubbed),
    )
    return layout, measurements


def test_the_wire_is_that_of_the_model(model, bound):
    ys = np.unique(np.round(bound.pieces[:, :, 1].ravel(), 5))
    np.testing.assert_allclose(ys, task.BENDS, atol=2e-5)
    for k, (y, z) in enumerate(zip(task.BENDS, task.HEIGHTS)):
        assert abs(float(task.height(jnp.array(y))) - z) < 1e-6, k
    slopes = np.abs(np.diff(task.HEIGHTS) / np.diff(task.BENDS))
    np.testing.assert_allclose(np.degrees(np.arctan(slopes)), [0, 30, 30, 30, 30, 0], atol=0.1)
    top = model.geom("ring0")
    tube, wire = top.size[0], bound.radius
    # A regular twelve-sided polygon hangs by a corner, whose two sides lean by 15 degrees.
    corner = max(np.linalg.norm(end) for end in outlines.capsule_ends(top))
    assert abs(corner - (tube + wire) / np.cos(np.pi / 12) - task.HANG) < 1e-5
    assert abs(corner * np.cos(np.pi / 12) - tube - 0.005) < 1e-5  # inner radius 5 mm
    assert 0.8e-3 < model.body("ring").mass[0] < 1.0e-3  # kg


@pytest.mark.parametrize("start", [0, 1])
def test_it_is_done_at_the_other_end_alone(bound, start):
    way = 1.0 - 2.0 * start
    layout, measurements = hanging(bound, way * task.START, start)
    found = task.status(bound, layout, measurements)
    assert found.success_now and found.loose and not found.lost and float(found.reward) == 1.0
    for wrong in (
        {"y": -way * task.START},
        {"y": 0.0},
        {"touch": True},
        {"speed": 0.02},
        {"raised": 0.004},
        {"rubbed": task.MAY_TOUCH + 1},
    ):
        layout, measurements = hanging(bound, **{"y": way * task.START, "start": start, **wrong})
        found = task.status(bound, layout, measurements)
        assert not found.success_now and float(found.reward) < 1.0, wrong
        assert bool(found.lost) == ("rubbed" in wrong)
        assert bool(found.loose) == ("y" not in wrong)


@pytest.mark.parametrize(
    ("y", "pair", "dist", "counts"),
    [
        (0.01, ("ring3", "wire2"), -1e-5, True),
        (0.01, ("wire2", "ring3"), -1e-5, True),
        (0.01, ("ring3", "wire2"), 1e-4, False),
        (0.01, ("tab0", "arm0/tool/pad_left"), -1e-5, False),
        (0.035, ("ring3", "wire5"), -1e-5, False),
    ],
)
def test_touching_counts_over_the_bent_part(model, bound, y, pair, dist, counts):
    layout, before = hanging(bound, y)
    qpos = task.place_objects(bound, jnp.zeros(model.nq), layout.replace(ring=before.ring))
    contacts = Contacts(jnp.array([[model.geom(g).id for g in pair]]), jnp.array([dist]))
    none = jnp.zeros((1, 3))
    readings = SimReadings(
        qpos, jnp.zeros(model.nv), Pose(jnp.eye(3)[None], none), none, none, none, contacts
    )
    assert int(task.measure(bound, layout, readings, before).rubbed) == counts
