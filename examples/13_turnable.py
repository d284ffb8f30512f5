"""Writes a page with an animated scene that the mouse rotates, without a server.

Needs the extra `viewer`. Here joints sway about their home; replace them by recorded coordinates,
such as `qpos.npy` of an episode.
"""

import pathlib

import numpy as np

from starjax.addons.viewer import frame, playback
from starjax.sim import scene

HZ, SECONDS = 30.0, 3.0


def main() -> None:
    names = scene.name("reach", arms=["panda"])
    loaded = scene.load(names)
    (arm,) = loaded.arms
    phase = np.linspace(0.0, 2.0 * np.pi, round(HZ * SECONDS))
    qpos = np.tile(loaded.mj_model.qpos0, (len(phase), 1))
    qpos[:, arm.q] = arm.home + 0.1 * np.sin(phase)[:, None]
    frames = frame.from_arrays(
        qpos,
        p_world_trocar=loaded.p_world_ref,
        p_world_tip=np.zeros((len(phase), 1, 3)),
        rcm_error=None,
        rgb=loaded.geom_rgb,
    )
    page = playback.html(loaded.mj_model, [frames], HZ, longest_s=SECONDS)
    path = pathlib.Path("turnable.html")
    path.write_text(page)
    print(f"open {path} in a browser: {len(page) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
