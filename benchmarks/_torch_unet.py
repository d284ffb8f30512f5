"""The U-Net in PyTorch, as fast as we could write it there; see `starjax.policies.models.unet1d`.

Over `[B, L, C]`, convolutions as matrix products, without taps that only meet padding, the
condition's part of FiLM apart: the same function and the same parameters as ours.
"""

import math

import torch
import torch.nn.functional as F
from torch import nn

HORIZON = 16
TIME = 128  # width of the embedding of the diffusion step
ACTION = 4  # position and gripper


class Conv1d(nn.Module):
    """1-D convolution over `[B, L, C]` as one matrix product of the shifted inputs."""

    def __init__(self, length, channels, features, kernel, stride=1, padding=None):
        super().__init__()
        padding = kernel // 2 if padding is None else padding
        out = (length + 2 * padding - kernel) // stride + 1
        live = [
            tap
            for tap in range(kernel)
            if any(0 <= i * stride + tap - padding < length for i in range(out))
        ]
        self.left = padding - live[0]
        self.right = max(0, (out - 1) * stride + live[-1] - padding - (length - 1))
        self.taps, self.stride, self.span = len(live), stride, (out - 1) * stride + 1
        bound = (kernel * channels) ** -0.5
        weight = torch.empty(features, len(live) * channels).uniform_(-bound, bound)
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(torch.empty(features).uniform_(-bound, bound))

    def forward(self, x):
        x = F.pad(x, (0, 0, self.left, self.right))
        shifted = [x[:, j : j + self.span : self.stride] for j in range(self.taps)]
        return F.linear(torch.cat(shifted, -1), self.weight, self.bias)


class Upsample(nn.Module):
    """Transposed convolution, kernel 4, stride 2: one product each for even and odd outputs."""

    def __init__(self, channels):
        super().__init__()
        self.even = nn.Linear(2 * channels, channels)
        self.odd = nn.Linear(2 * channels, channels, bias=False)

    def forward(self, x):
        batch, length, channels = x.shape
        padded = F.pad(x, (0, 0, 1, 1))
        even = self.even(torch.cat([padded[:, :-2], x], -1))
        odd = F.linear(torch.cat([x, padded[:, 2:]], -1), self.odd.weight, self.even.bias)
        return torch.stack([even, odd], 2).reshape(batch, 2 * length, channels)


class ConvBlock(nn.Module):
    """Conv1d, GroupNorm (float32 statistics), Mish."""

    def __init__(self, length, channels, features, kernel=5, groups=8):
        super().__init__()
        self.conv = Conv1d(length, channels, features, kernel)
        self.scale, self.bias = (
            nn.Parameter(torch.ones(features)),
            nn.Parameter(torch.zeros(features)),
        )
        self.groups = groups

    def forward(self, x):
        y = self.conv(x)
        wide = y.float().unflatten(-1, (self.groups, -1))
        mean = wide.mean((1, 3), keepdim=True)
        variance = (wide * wide).mean((1, 3), keepdim=True) - mean * mean
        normal = (wide - mean) * torch.rsqrt(variance.clamp_min(0) + 1e-5)
        return F.mish(normal.flatten(-2) * self.scale.float() + self.bias.float()).to(y.dtype)


class ResidualBlock(nn.Module):
    """Two blocks with FiLM between them, and a skip."""

    def __init__(self, length, channels, features):
        super().__init__()
        self.first = ConvBlock(length, channels, features)
        self.second = ConvBlock(length, features, features)
        same = channels == features
        self.skip = nn.Identity() if same else nn.Linear(channels, features)

    def forward(self, x, film):
        scale, bias = film[:, None].chunk(2, -1)
        return self.second(scale * self.first(x) + bias) + self.skip(x)


class UNet(nn.Module):
    """Diffusion Policy's conditional U-Net."""

    def __init__(self, condition, channels):
        super().__init__()
        down, up, halving, doubling = [], [], [], []
        length, inputs = HORIZON, ACTION
        for level, width in enumerate(channels):
            down += [ResidualBlock(length, inputs, width), ResidualBlock(length, width, width)]
            inputs = width
            if level < len(channels) - 1:
                halving.append(Conv1d(length, width, width, 3, stride=2))
                length //= 2
        middle = [ResidualBlock(length, inputs, inputs) for _ in range(2)]
        for width, joined in zip(channels[-2::-1], channels[:0:-1]):
            up += [ResidualBlock(length, 2 * joined, width), ResidualBlock(length, width, width)]
            doubling.append(Upsample(width))
            length *= 2
        lists = (down, middle, up, halving, doubling)
        self.down, self.middle, self.up, self.halving, self.doubling = map(nn.ModuleList, lists)
        blocks = [*down, *middle, *up]
        self.widths = [2 * block.second.scale.numel() for block in blocks]
        self.film_cond = nn.Linear(condition, sum(self.widths))
        self.film_time = nn.Linear(TIME, sum(self.widths), bias=False)
        self.time = nn.Sequential(nn.Linear(TIME, 4 * TIME), nn.Mish(), nn.Linear(4 * TIME, TIME))
        self.last = ConvBlock(length, channels[0], channels[0])
        self.out = nn.Linear(channels[0], ACTION)

    def condition(self, cond):
        """The condition's part of every FiLM."""
        return self.film_cond(F.mish(cond))

    def embed_step(self, k):
        """The diffusion step's part of every FiLM."""
        half = torch.arange(TIME // 2, device=k.device)
        angle = k.float()[:, None] * torch.exp(half * (-math.log(1e4) / (TIME // 2 - 1)))
        wave = torch.cat([angle.sin(), angle.cos()], -1).to(self.film_time.weight.dtype)
        return self.film_time(F.mish(self.time(wave)))

    def denoise(self, x, film):
        """Noise in `x` `[B, H, A]`."""
        films = iter(film.split(self.widths, -1))
        x, skips = x.to(film.dtype), []
        for level, (first, second) in enumerate(zip(self.down[::2], self.down[1::2])):
            x = second(first(x, next(films)), next(films))
            skips.append(x)
            if level < len(self.halving):
                x = self.halving[level](x)
        for block in self.middle:
            x = block(x, next(films))
        for first, second, doubling in zip(self.up[::2], self.up[1::2], self.doubling):
            x = torch.cat([x, skips.pop()], -1)
            x = doubling(second(first(x, next(films)), next(films)))
        return self.out(self.last(x)).float()

    def forward(self, x, k, cond):
        return self.denoise(x, self.condition(cond) + self.embed_step(k))
