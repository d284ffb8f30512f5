"""MuJoCo's C renderer as a separate process: a GL context must not live in the tests' process.

python gl_renderer.py model.mjb qpos.npz pictures.npz camera height width [slices]
"""

import sys


def main(model: str, states: str, out: str, camera: str, *numbers: int) -> None:
    """Draws every row of `qpos`; writes rgb, depth (m), segmentation and seconds a picture.

    `slices` a turn make round shapes rounder: the model's own 28 cut 0.6% off the radius.
    """
    import time

    import mujoco
    import numpy as np

    mj_model = mujoco.MjModel.from_binary_path(model)
    height, width, *slices = numbers
    if slices:
        mj_model.vis.quality.numslices, mj_model.vis.quality.numstacks = slices[0], slices[0] // 2
    data = mujoco.MjData(mj_model)
    renderer = mujoco.Renderer(mj_model, height, width)
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    rgb, depth, segmentation, seconds = [], [], [], []
    for qpos in np.load(states)["qpos"]:
        data.qpos[:] = qpos
        mujoco.mj_forward(mj_model, data)
        start = time.perf_counter()
        renderer.update_scene(data, camera, option)
        rgb.append(renderer.render().copy())
        seconds.append(time.perf_counter() - start)
        renderer.enable_depth_rendering()
        depth.append(renderer.render().copy())
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        ids, kinds = np.moveaxis(renderer.render(), -1, 0)
        segmentation.append(np.where(kinds == int(mujoco.mjtObj.mjOBJ_GEOM), ids, -1))
        renderer.disable_segmentation_rendering()
    np.savez(out, rgb=rgb, depth=depth, segmentation=segmentation, seconds=seconds)
    renderer.close()


if __name__ == "__main__":
    main(*sys.argv[1:5], *map(int, sys.argv[5:]))
