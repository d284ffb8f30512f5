"""The policy's networks in PyTorch, of the sizes and functions of `starjax.policies.models`."""

import torch
import torch.nn.functional as F
from _torch_unet import ACTION, HORIZON, Conv1d, UNet
from torch import nn

OBSERVED = 2


class Norm2d(nn.GroupNorm):
    """GroupNorm of 16 channels a group whose output keeps the input's type under autocast."""

    def __init__(self, features):
        super().__init__(features // 16, features)

    def forward(self, x):
        return super().forward(x).to(x.dtype)


class BasicBlock(nn.Module):
    """ResNet's."""

    def __init__(self, channels, features, stride):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, features, 3, stride, 1, bias=False)
        self.conv2 = nn.Conv2d(features, features, 3, 1, 1, bias=False)
        self.norm1, self.norm2 = Norm2d(features), Norm2d(features)
        self.skip = nn.Identity()
        if channels != features:
            conv = nn.Conv2d(channels, features, 1, stride, bias=False)
            self.skip = nn.Sequential(conv, Norm2d(features))

    def forward(self, x):
        y = F.relu(self.norm1(self.conv1(x)))
        return F.relu(self.norm2(self.conv2(y)) + self.skip(x))


class Vision(nn.Module):
    """ResNet-18 (GroupNorm), spatial softmax, a linear layer: `[N, 3, h, w] -> [N, features]`."""

    def __init__(self, features, width):
        super().__init__()
        stem = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        layers = [stem, Norm2d(width), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
        for stage in range(4):
            before, after = width << max(stage - 1, 0), width << stage
            layers += [BasicBlock(before, after, 1 + (stage > 0)), BasicBlock(after, after, 1)]
        self.trunk = nn.Sequential(*layers)
        self.keypoints = nn.Conv2d(8 * width, features // 2, 1, bias=False)
        self.out = nn.Linear(features, features)

    def forward(self, image):
        logits = self.keypoints(self.trunk(image)).float()
        weights = logits.flatten(2).softmax(-1).view(logits.shape)
        points = []
        for axis, cells in ((3, logits.shape[2]), (2, logits.shape[3])):
            centres = (2 * torch.arange(cells, device=image.device) + 1) / cells - 1
            points.append((weights.sum(axis) * centres).sum(-1))
        return self.out(torch.stack(points, -1).flatten(1).to(self.out.weight.dtype))


class History(nn.Sequential):
    """The encoder of positions and gripper: `[B, O, S] -> [B, features]`."""

    def __init__(self, features):
        super().__init__(
            Conv1d(OBSERVED, ACTION, features // 4, 3),
            nn.Mish(),
            Conv1d(OBSERVED, features // 4, features // 2, 3),
            nn.Mish(),
            Conv1d(OBSERVED, features // 2, features, OBSERVED, padding=0),
            nn.Flatten(),
        )


class RollNet(nn.Module):
    """Positions `[B, H, 3]`, trocar `[B, 7]` and roll history `[B, O]` to rolls `[B, H]`."""

    def __init__(self, width=256, blocks=3):
        super().__init__()
        self.embed = nn.Linear(7, 64)
        self.project = nn.Linear(3 * HORIZON + 64 + OBSERVED, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, width)
            )
            for _ in range(blocks)
        )
        self.out = nn.Linear(width, HORIZON)

    def forward(self, p, trocar, history):
        x = self.project(torch.cat([p.flatten(1), F.gelu(self.embed(trocar)), history], -1))
        for block in self.blocks:
            x = x + block(x)
        return self.out(x)


class Policy(nn.Module):
    """All networks of the hierarchical policy."""

    def __init__(self, vision=512, state=256, channels=(256, 512, 1024, 2048), width=64):
        super().__init__()
        self.vision, self.history = Vision(vision, width), History(state)
        self.unet = UNet(OBSERVED * vision + state, channels)
        self.roll = RollNet()
