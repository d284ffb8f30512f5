"""Contacts of a scene as C MuJoCo finds them, which has no limits on their number."""

import collections

import mujoco
import numpy as np

from starjax.sim import mjcf_parts

TOUCHING = -2e-5  # m: contacts deeper than this are alike in float32 and float64


def asked(scene, qpos, p_world_trocar):
    """The most that the compiled model had to hold at once: pairs of a kind, contacts.

    Args:
      qpos: `[L, N, Q]` of N episodes.
      p_world_trocar: `[N, A, 3]` m.
    """
    m, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    pairs = contacts = 0
    for moment in qpos:
        for lane, at in enumerate(np.asarray(moment)):
            data.qpos[:], data.mocap_pos[scene.trocar_mocap] = at, p_world_trocar[lane]
            mujoco.mj_fwdPosition(m, data)
            touching = [tuple(c.geom) for c in data.contact if c.dist < TOUCHING]
            kinds = [tuple(sorted(m.geom_type[list(pair)])) for pair in set(touching)]
            pairs = max([pairs, *collections.Counter(kinds).values()])
            contacts = max(contacts, len(touching))
    return pairs, contacts


def held(scene):
    """How many the compiled model can hold: pairs of a kind, contacts."""
    return tuple(int(scene.mj_model.numeric(name).data[0]) for name in mjcf_parts.CONTACT_LIMITS)
