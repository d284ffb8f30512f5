"""The table of presets, from their values."""

from starjax.cli.presets import PRESETS
from starjax.report import formats

FOR = {
    "smoke": "every stage in minutes; learns nothing",
    "cpu": "a policy that works, on two cores",
    "gpu": "a policy that works, on one GPU",
    "resnet": "the same with the paper's encoder, from scratch",
    "compact": "tables: the paper's learner, small networks",
    "paper": "the paper's figures",
}


def table() -> str:
    """Returns observations, networks, learner and training of each preset as markdown."""
    rows = [["preset", "observes", "demonstrations", "networks", "learner", "training", "for"]]
    for name, run in PRESETS.items():
        policy, train = run.policy, run.train
        observes = "state" if policy.observation == "state" else f"images, {policy.image_size} px"
        encoder = {"small": "small encoder", "resnet18": "ResNet-18"}[policy.encoder]
        if policy.freeze_encoder:
            encoder = f"encoder of `{policy.encoder_weights}`, frozen"
        widths = "-".join(map(str, policy.options.unet_channels))
        network = f"U-Net {widths}" + (", bfloat16" if policy.dtype == "bfloat16" else "")
        if policy.observation == "image":
            network = f"{encoder}; {network}"
        count = run.demos.seen_trocars * run.demos.per_trocar
        steps = f"{train.steps:,} steps of {train.batch_size}"
        rows.append(
            [f"`{name}`", observes, f"{count:,}", network, policy.learner, steps, FOR[name]]
        )
    return formats.render(rows, names=len(rows[0]))
