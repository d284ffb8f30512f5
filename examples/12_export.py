"""Exports a policy as StableHLO, which other programs run without starjax.

`jax.export` writes one file for C++ through PJRT or IREE, TensorFlow, or jax alone. It needs the
package `flatbuffers`. An exported program lacks the checks of `deploy`, because they need values:
make them before and after the call.
"""

import jax
import numpy as np
from jax import export

from starjax import deploy, rcm

SHAPES = {
    "seed": ((), np.uint32),
    "R": ((2, 3, 3), np.float32),
    "p": ((2, 3), np.float32),
    "gripper": ((2,), np.float32),
    "image": ((2, 128, 128, 3), np.uint8),
    "trocar": ((3,), np.float32),  # x y z in the world, m
}


def main() -> None:
    policy = deploy.load("compact", ddim_steps=5)

    def decide(seed, R, p, gripper, image, trocar):
        """Returns R, p and gripper `[H, ...]` for observations `[O, ...]` and a trocar `[3]`."""
        observation = deploy.Observation(pose=deploy.Pose(R, p), gripper=gripper, image=image)
        parameters = rcm.trocar_from_position(trocar, policy.p_world_ref)
        command = policy(jax.random.key(seed), observation, parameters)
        return command.pose.R, command.pose.p, command.gripper

    arguments = [jax.ShapeDtypeStruct(*shape) for shape in SHAPES.values()]
    # Name every platform that will run it, such as ["cpu", "cuda"]. Weights are constants.
    exported = export.export(jax.jit(decide), platforms=["cpu"])(*arguments)
    blob = exported.serialize()  # write these bytes to a file

    program = export.deserialize(blob)  # in another program, with jax alone
    trocar = np.array([0.014, 0.014, 0.153], np.float32)
    parameters = rcm.trocar_from_position(trocar, policy.p_world_ref)
    action = [0.0, 0.0, 0.0, 0.03]
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, parameters, policy.p_world_ref)
    poses = np.stack([pose.R, pose.R]), np.stack([pose.p, pose.p])
    image = np.zeros((2, 128, 128, 3), np.uint8)
    values = np.uint32(0), *poses, np.ones(2, np.float32), image, trocar
    np.testing.assert_allclose(program.call(*values)[1], decide(*values)[1], atol=1e-6)
    print(f"{len(blob) / 1e6:.1f} MB; the exported plan equals the policy's")


if __name__ == "__main__":
    main()
