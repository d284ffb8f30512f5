"""The region of a task's trocars: its own trocars lie in it, others are refused in one line."""

import jax
import mistakes
import numpy as np
import pytest

from starjax import rcm
from starjax.sim import registries, sampling, trocar_region

TASKS = ("peg_transfer", "peg_transfer_bimanual", "endoscope_track", "ring_on_wire")


def places(task, trocars):
    reference = np.array([slot.p_world_ref for slot in task.slots], np.float32)
    return reference, np.asarray(rcm.trocar_position(trocars, reference))


@pytest.mark.parametrize("name", TASKS)
def test_a_tasks_own_trocars_stay_as_they_are(name):
    task = registries.tasks.get(name)
    regions = trocar_region.of_task(task)
    drawn = sampling.sample_trocars(jax.random.key(0), task, (200,))
    for trocars in (rcm.Trocar(*(np.asarray(field) for field in task.trocars)), drawn):
        reference, p = places(task, trocars)
        for arm, region in enumerate(regions):
            offset = p[..., arm, :] - reference[arm]
            np.testing.assert_allclose(trocar_region.clipped(region, offset), offset, atol=1e-6)
        trocar_region.check(regions, reference, p)


def test_a_clipped_trocar_has_the_regions_ranges():
    region = registries.tasks.get("peg_transfer_bimanual")
    region = trocar_region.of_task(region)[1]
    offset = np.random.default_rng(0).normal(size=(500, 3)) * 0.1
    fields = rcm.trocar_from_position(trocar_region.clipped(region, offset), np.zeros(3))
    fields = [np.asarray(field) for field in fields]
    fields[2] = np.where(fields[2] > np.pi, fields[2] - 2 * np.pi, fields[2])
    for field, (low, high) in zip(fields, region, strict=True):
        assert low - 1e-4 <= field.min() and field.max() <= high + 1e-4


@pytest.mark.parametrize(
    "place", [(0.0, 0.0, 0.164), (0.07, 0.0, 0.15), (0.02, 1.57, 0.8), (np.nan, 0.0, 0.15)]
)
def test_a_trocar_elsewhere_is_one_line(place):
    task = registries.tasks.get("peg_transfer")
    with mistakes.of("trocar", "mm outside"):
        trocar_region.check(trocar_region.of_task(task), task.slots[0].p_world_ref, [place])
