"""Texts of a run's settings: its plan, and warnings for readers of its result."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax

import starjax
from starjax.cli import messages, presets
from starjax.core import config as config_lib
from starjax.core import methods
from starjax.policies import packaged, policy_file
from starjax.policies import policy as policies
from starjax.policies.in_env import Server
from starjax.runtime import stored, xla
from starjax.sim import registries
from starjax.sim.task import CONTROL_HZ
from starjax.training import devices


def plan(config: config_lib.RunConfig, stages: Sequence[str]) -> str:
    """Returns the plan of a run."""
    lines = [*_setting(config), _learning_from(config.demos)]
    lines += [_training(config), *_idle(config.train.batch_size)] if "train" in stages else []
    lines += [f"{_evaluation(config)}, seed {config.trial_seed}"] if "evaluate" in stages else []
    return "\n".join([*lines, *_time(config, stages)])


def about(config: config_lib.RunConfig, name: str, seed: int) -> str:
    """Returns the plan of an evaluation: the policy `name`, its training, its trials and seed."""
    lines = [
        f"starjax {starjax.__version__}: {methods.SCORED[config.method].label} of {name}",
        *_setting(config),
        _learning_from(config.demos),
        _training(config),
        f"{_evaluation(config)}, seed {seed}",
    ]
    return "\n".join(lines)


def about_served(config: config_lib.RunConfig, name: str, seed: int) -> str:
    """Returns the plan of the evaluation of a served policy."""
    policy = config.policy
    plans = f"{policy.horizon} commands, {policy.execute} of them executed"
    lines = [
        f"starjax {starjax.__version__}: policy served at {name}",
        *_setting(config)[:3],
        f"  observation     {policy.observation}; plans of {plans}",
        f"{_evaluation(config)}, seed {seed}",
    ]
    return "\n".join(lines)


def _setting(config: config_lib.RunConfig) -> list[str]:
    """Returns lines with devices, scene, observation and ablations."""
    there, scene = jax.devices(), config.scene
    programs = "found in" if stored.are_cached() else "compiled now, for minutes, and kept in"
    robots = ", ".join(f"{arm} with {tool}" for arm, tool in zip(scene.arm, scene.tool))
    parts = [_task(config).text.title, robots, ", ".join(scene.camera)]
    return [
        f"  device          {len(there)} x {there[0].device_kind}, {xla.cores()} CPU cores",
        f"  programs        {programs} {xla.compilation_cache()}",
        f"  scene           {'; '.join(filter(None, parts))}",
        *_seeing(config),
        *(f"  ablation        {what}" for what in _ablations(config.method, config.policy)),
    ]


def _task(config: config_lib.RunConfig) -> Any:
    return registries.tasks.get(config.scene.task)


def _learning_from(demos: config_lib.DemosConfig) -> str:
    if demos.from_:
        return f"  demonstrations  those in {demos.from_}"
    count = demos.per_trocar * demos.seen_trocars
    return f"  demonstrations  {count} ({demos.per_trocar} x {demos.seen_trocars} seen trocars)"


def _training(config: config_lib.RunConfig) -> str:
    policy, train = config.policy, config.train
    channels = "-".join(map(str, getattr(policy.options, "unet_channels", ())))
    network = f"{policy.learner}, U-Net {channels}" if channels else policy.learner
    dtype = "" if policy.dtype == "float32" else f", {policy.dtype}"
    steps = f"{train.steps} steps of {train.batch_size}"
    return f"  training        {steps}, {network}{dtype}"


def _idle(batch_size: int) -> list[str]:
    """Returns a line if some devices cannot share a batch."""
    used, there = devices.make_mesh(batch_size).size, jax.device_count()
    if used == there:
        return []
    return [f"                  on {used} of {there} devices, as the batch must divide by them"]


def _evaluation(config: config_lib.RunConfig) -> str:
    task, trials = _task(config), config.eval.trials
    trocars, limit = len(task.is_seen), f"at most {config.eval.time_limit_s:g} s each"
    if config.eval.time_limit_s < (longest := task.least_steps / CONTROL_HZ):
        limit += f" (--eval.time-limit-s; demonstrations take up to {longest:g} s)"
    averaged = ", plans averaged" if config.eval.ensemble else ""
    return f"  evaluation      {trocars} trocars x {trials} trials, {limit}{averaged}"


def _time(config: config_lib.RunConfig, stages: Sequence[str]) -> list[str]:
    """Returns a line with the measured time of a preset, if the run does not change it."""
    timing = presets.TIMINGS.get(config.preset)
    if (
        timing is None
        or timing.backend != jax.default_backend()
        or tuple(stages) != messages.STAGES
    ):
        return []
    preset = presets.PRESETS[config.preset]
    parts = [
        (run.method, run.scene.task, run.demos, run.policy, run.train, run.eval)
        for run in (config, preset)
    ]
    minutes = round(timing.seconds / 60)
    return [f"  time            {minutes} min on {timing.machine}"] if parts[0] == parts[1] else []


def _seeing(config: config_lib.RunConfig) -> list[str]:
    """Returns lines with the observation and its encoder."""
    policy = config.policy
    if policy.observation == "state":
        return [
            f"  observation     state instead of pixels: {_fields(config)} "
            "(--policy.observation image turns the camera on)"
        ]
    return [
        f"  observation     image, {policy.image_size} px",
        f"  encoder         {encoder(config)}; {_encoders(policy)}",
    ]


def _encoders(policy: config_lib.PolicyConfig) -> str:
    depth = policy.depth_encoder
    return f"{policy.encoder}, of depth {depth}" if depth else policy.encoder


def _fields(config: config_lib.RunConfig) -> str:
    return ", ".join(field.name for field in _task(config).fields)


def encoder(config: config_lib.RunConfig) -> str:
    """Returns the origin of the image encoder's weights, and if they are frozen."""
    policy, name = config.policy, config.policy.encoder_weights
    if not name:
        return "trained from scratch"
    trained_in, scene, known = _scene_of(name), config.scene, ""
    if trained_in:
        task, cameras = trained_in.task, trained_in.cameras
        other = f" through {', '.join(cameras)}" if {*scene.camera} - {*cameras} else ""
        known = f" (pretrained on {'this task' if task == scene.task else task}{other})"
    return f"{'frozen' if policy.freeze_encoder else 'trained further'}, from {name}{known}"


def _scene_of(encoder_weights: str) -> Any:
    """Returns the scene of an encoder's training, None without a readable policy file."""
    try:
        return policy_file.load(packaged.find_encoder("", encoder_weights)).scene
    except (OSError, ValueError):
        return None


def _ablations(method: str, policy: config_lib.PolicyConfig) -> list[str]:
    """Returns the active ablations: settings that deviate from the method's row."""
    rows = [methods.SCORED[name] for name in methods.selected(method)]
    sees = policy.sees_trocar
    given = "given" if sees == "always" else "not given"
    is_conditioned = sees != "method" and any(row.sees_trocar != (sees == "always") for row in rows)
    spaces = {policies.ablated(row, policy).action_space for row in rows}
    turned = not spaces <= {row.action_space for row in rows}
    rolls = any(row.hierarchical for row in rows)
    active = {
        f"the learner's model is {given} the trocar (--policy.sees-trocar {sees})": is_conditioned,
        "the frame {T} does not turn with the trocar's azimuth (--policy.trocar-yaw fixed)": turned,
        "the roll network does not read the measured rolls (--policy.no-roll-history)": (
            rolls and not policy.roll_history
        ),
        "the roll network does not read the trocar (--policy.no-roll-trocar)": (
            rolls and not policy.roll_trocar
        ),
        "the roll network reads the observation too (--policy.roll-observation)": (
            rolls and policy.roll_observation
        ),
    }
    return [what for what, holds in active.items() if holds]


def warnings(config: config_lib.RunConfig, figures: Mapping[str, Any]) -> list[str]:
    """Returns warnings for readers of a result, one sentence per warning."""
    lines = []
    if config.policy.observation == "state":
        lines.append(
            f"The policy observes the task's state ({_fields(config)}), not pixels as in the "
            "paper; --policy.observation image turns the camera on."
        )
    else:
        policy = config.policy
        networks = f"{_encoders(policy)}, {policy.image_size} px"
        lines.append(f"Image encoder: {encoder(config)}; {networks}.")
    lines += [f"Ablation: {what}." for what in _ablations(figures["method"], config.policy)]
    if config.preset == "smoke":
        lines.append("Preset smoke is too short to learn anything: its rates mean nothing.")
    return lines + _diverged(figures)


def served_warnings(server: Server, figures: Mapping[str, Any]) -> list[str]:
    """Returns warnings for readers of a served policy's result."""
    lines = [f"Policy served at {server.origin['address']}; its settings of training are unknown."]
    if server.refused:
        lines.append(
            f"{server.refused} plan(s) were refused by the server or invalid; the robot held "
            "its pose."
        )
    return lines + _diverged(figures)


def _diverged(figures: Mapping[str, Any]) -> list[str]:
    count = figures["invalid"]
    return [f"{count} trial(s) diverged in simulation; they count as failed."] if count else []
