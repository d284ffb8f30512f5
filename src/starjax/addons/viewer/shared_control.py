"""Control of an episode by an operator's hand and, if there is one, the policy that it relieves."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import mujoco
import numpy as np

from starjax.addons.viewer import page, teleop_target
from starjax.addons.viewer.devices import Device
from starjax.addons.viewer.frame import Frame
from starjax.addons.viewer.recorder import Recorder, Relieved, Steering
from starjax.addons.viewer.teleop_target import Pilot
from starjax.policies import in_env
from starjax.runtime import files
from starjax.sim import wrists
from starjax.sim.state import Env

if TYPE_CHECKING:  # for annotations alone
    import viser


class SharedControl:
    """The simulated episode, and who acts in it.

    Attributes:
      configuration: index of the task's trocar configuration.
      trial: its number.
      state: LiveState.
      hand_acts: True while the operator has control.
    """

    def __init__(self, steering: Steering, pilot: Pilot, seed: int):
        self._steering, self._pilot, self._seed = steering, pilot, seed

    @property
    def is_shared(self) -> bool:
        """True with a policy that the operator relieves."""
        return self._steering.policy is not None

    @property
    def is_waiting(self) -> bool:
        """True without a policy until the operator's first motion."""
        return not self.is_shared and not self._pilot.has_moved

    def begin(self, configuration: int, trial: int) -> Frame:
        """Sets up a trial; the policy acts first, if there is one."""
        self.configuration, self.trial = configuration, trial
        self.hand_acts = self._keeps = not self.is_shared
        self.state, frame, *now = self._steering.start(self._seed, configuration, trial)
        frames = jax.device_get(self.state.env.measured_trocar)
        arms = range(self._steering.env.task.arms)
        self._trocars = [jax.tree.map(lambda x, i=i: x[0, i], frames) for i in arms]
        self._rest(*now)
        return frame

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Advances the hand by one control period; returns its actions and openings."""
        return self._pilot.read(1.0 / self._steering.env.control_hz)

    def step(self, hand: tuple[np.ndarray, np.ndarray], recorder: Recorder) -> Frame:
        """Runs and records one control step, of the hand's command or the policy's."""
        policy = self._steering.policy
        if policy is not None and not self._keeps and recorder.length % policy.execute == 0:
            self.hand_acts = False  # a new plan begins
        self.state, moment = self._steering.step(self.state, *hand, self.hand_acts)
        if not self.hand_acts:
            self._rest(moment.action, moment.opening)
        recorder.add(moment)
        return moment.frame

    def pass_control(self) -> None:
        """Gives control to the hand at once, or back to the policy at its next plan."""
        if self.is_shared:
            self._keeps = not self._keeps
            self.hand_acts |= self._keeps

    def _rest(self, actions: np.ndarray, openings: np.ndarray) -> None:
        """Lets the hand begin at actions `[A, D]`, see `Steering`, and openings `[A]`."""
        task = self._steering.env.task
        wrist = wrists.common(task)
        limits = [
            teleop_target.bounds(slot, action[1:4], wrist)
            for slot, action in zip(task.slots, actions, strict=True)
        ]
        self._pilot.rest(actions, openings, limits, self._trocars)


def relieved(file: Path, arms: tuple[str, ...] = ()) -> tuple[Any, Relieved]:
    """Returns the environment of a policy file's training, and its policy.

    Args:
      file: the policy file.
      arms: robots instead of those of the training.
    """
    policy = in_env.place_in_own_scene(file, in_env.read(file), arms=arms)
    trained = policy.trained
    return policy.env, Relieved(
        policy.agent(),
        (trained.params, trained.normalizer),
        policy.weights,
        trained.policy.obs_horizon,
        trained.policy.execute,
        trained.monitor,
    )


def add_pilot(server: "viser.ViserServer", env: Env, device: Device | None = None) -> Pilot:
    """Adds the hand to the page: handle, keys and device."""
    return Pilot(server, env.task.arms, camera_axes(env), device, wrists.common(env.task))


def add_keys(gui: "viser.GuiApi", requests: page.UiRequests, is_shared: bool) -> None:
    """Adds the keys that end an episode and, if it is shared, pass control.

    They request `save`, `discard`, `pass`.
    """
    page.add_command(gui, "Save the episode", "enter", lambda: requests.add("save"))
    page.add_command(gui, "Discard the episode", "backspace", lambda: requests.add("discard"))
    if is_shared:
        gui.add_markdown("T: control to your hand, and back to the policy")
        page.add_command(gui, "Pass control", "T", lambda: requests.add("pass"))


def save(server: "viser.ViserServer", recorder: Recorder, control: SharedControl) -> bool:
    """Saves the episode and notifies the user; returns False if the disk refused it."""
    note = "" if recorder.moments[-1].frame.success else ", which training leaves out"
    try:
        folder = recorder.save(control.configuration, control.trial)
    except files.StorageError as error:
        page.notify(server, "Not saved", str(error), is_error=True)
        return False
    page.notify(server, "Saved", f"{folder}{note}")
    return True


def camera_axes(env: Env) -> np.ndarray:
    """Returns the axes of the first camera's image, see `teleop_target.view_axes`."""
    model = env.scene.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    camera = data.cam(env.names.cameras[0])
    return teleop_target.view_axes(camera.xmat.reshape(3, 3))
