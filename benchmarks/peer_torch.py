"""The PyTorch peer: the same train step and the same policy call in PyTorch's best settings.

    python benchmarks/peer_torch.py {train,policy} --crop 96 [--batch 256] [--device cpu --tiny]

Prints one JSON object. The other benchmarks run it by `--peer`, in a process of its own, whose
memory is free again; nothing else here needs PyTorch. Settings: bf16 by autocast (bf16 weights for
the policy call), channels-last, torch.compile, fused AdamW, averages by `_foreach_lerp_`, and each
row with and without one CUDA graph.
"""

import argparse
import json
import statistics
import time

import _torch_model as model
import torch
import torch.nn.functional as F

IMAGE = {96: 108, 224: 256}  # side of the stored picture for each crop
FRAMES = 4096
TINY = {"vision": 32, "state": 32, "channels": (32, 64), "width": 16}
STEPS = range(90, -1, -10)  # DDIM-10, 'leading'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", choices=["train", "policy"])
    parser.add_argument("--crop", type=int, default=96)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--tiny", action="store_true", help="small networks, for a test")
    parser.add_argument("--compile", action="store_true", help="on a CPU too")
    parser.add_argument("--repeats", type=int, default=0, help="0: as suits the work")
    asked = parser.parse_args()
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high")
    torch.manual_seed(0)
    policy = model.Policy(**(TINY if asked.tiny else {})).to(asked.device)
    policy.vision.to(memory_format=torch.channels_last)
    make = make_step if asked.work == "train" else make_call
    compiled = asked.compile or asked.device == "cuda"
    call = make(policy, asked, compiled)
    call()
    _wait(asked.device)
    first_call_at = time.time()
    calls = {"compiled" if compiled else "eager": call}
    for _ in range(2):
        call()
    rows = {}
    if asked.device == "cuda":
        calls["compiled, CUDA graph"] = graphed(call)
    repeats = asked.repeats or (100 if asked.work == "policy" and asked.batch == 1 else 10)
    for mode, timed_call in calls.items():
        rows[mode] = timed(timed_call, asked, repeats)
    found = {
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name() if asked.device == "cuda" else "cpu",
        "parameters": sum(p.numel() for p in policy.parameters()),
        "first_call_at": first_call_at,
        "rows": rows,
        "best": min(rows, key=lambda mode: rows[mode]["ms"]),
    }
    print(json.dumps(found))


def timed(call, asked, repeats: int) -> dict[str, float]:
    """Median ms: of train steps back to back, of policy calls each waited for."""
    times, inner = [], 50 if asked.work == "train" and asked.device == "cuda" else 1
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(inner):
            call()
        _wait(asked.device)
        times.append(1e3 * (time.perf_counter() - start) / inner)
    return {"ms": statistics.median(times), "fastest_ms": min(times)}


def graphed(call):
    """`call` as one CUDA graph."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        call()
    torch.cuda.current_stream().wait_stream(stream)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    return graph.replay


def make_step(policy: model.Policy, asked, compiled: bool):
    """One training step on frames that are on the device."""
    device, batch, crop = asked.device, asked.batch, asked.crop
    side, frames = IMAGE.get(crop, crop + crop // 8), 64 if asked.tiny else FRAMES
    images = torch.randint(0, 256, (frames, side, side, 3), dtype=torch.uint8, device=device)
    actions = torch.rand(frames, model.ACTION, device=device) * 2 - 1
    rolls = torch.rand(frames, device=device) * 2 - 1
    trocars = torch.rand(frames, 7, device=device)
    averages = [p.detach().clone() for p in policy.parameters()]
    optimizer = torch.optim.AdamW(
        policy.parameters(),
        lr=1e-4,
        betas=(0.95, 0.999),
        weight_decay=1e-6,
        fused=True,
        capturable=device == "cuda",
    )
    signal = alpha_bar(device)
    ahead = torch.arange(model.HORIZON, device=device)

    def losses(image, history, noisy, k, noise, trocar, roll, p):
        with torch.autocast(device, dtype=torch.bfloat16):
            seen = policy.vision(image).view(batch, -1)
            cond = torch.cat([seen, policy.history(history).to(seen.dtype)], -1)
            guess = policy.unet(noisy, k, cond)
            turned = policy.roll(p, trocar, roll[:, : model.OBSERVED])
        return F.mse_loss(guess, noise) + 0.1 * F.mse_loss(turned.float(), roll)

    prepare, loss_of = augment, losses
    if compiled:
        prepare, loss_of = (torch.compile(f, dynamic=False) for f in (augment, losses))

    def step() -> None:
        frame = torch.randint(0, frames - model.HORIZON - 1, (batch,), device=device)
        observed = frame[:, None] + ahead[: model.OBSERVED]
        with torch.no_grad():
            image = prepare(images, observed.flatten(), crop)
            target = actions[frame[:, None] + ahead]
            history = actions[observed] + 0.02 * torch.randn(batch, 2, 4, device=device)
            k = torch.randint(0, 100, (batch,), device=device)
            noise = torch.randn_like(target)
            kept = signal[k][:, None, None]
            noisy = kept.sqrt() * target + (1 - kept).sqrt() * noise
            p = target[..., :3] + 0.02 * torch.randn_like(target[..., :3])
        roll = rolls[frame[:, None] + ahead]
        loss_of(image, history, noisy, k, noise, trocars[frame], roll, p).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            torch._foreach_lerp_(averages, list(policy.parameters()), 1e-3)

    return step


def augment(images, frame, crop: int):
    """Random crop, jitter, noise and normalisation: `[N, crop, crop, 3]` as channels-last NCHW."""
    count, spare, device = len(frame), images.shape[1] - crop + 1, images.device
    corner = torch.randint(0, spare, (2, count), device=device)
    rows, columns = corner[:, :, None] + torch.arange(crop, device=device)
    x = images[frame[:, None, None], rows[:, :, None], columns[:, None, :]].float() / 255
    factors = 0.9 + 0.2 * torch.rand(3, count, 1, 1, 1, device=device)
    x = (x * factors[0] - 0.5) * factors[1] + 0.5
    grey = (x * x.new_tensor([0.299, 0.587, 0.114])).sum(-1, keepdim=True)
    x = grey + (x - grey) * factors[2]
    return normalize((x + 0.02 * torch.randn_like(x)).clamp(0, 1))


def normalize(x):
    """Of ImageNet's statistics, bf16, to channels-last NCHW."""
    x = (x - x.new_tensor([0.485, 0.456, 0.406])) / x.new_tensor([0.229, 0.224, 0.225])
    return x.to(torch.bfloat16).permute(0, 3, 1, 2)


def make_call(policy: model.Policy, asked, compiled: bool):
    """One decision: encoder, DDIM-10, roll network, with bf16 weights."""
    device, batch, crop = asked.device, asked.batch, asked.crop
    policy.bfloat16().requires_grad_(False)
    half = {"dtype": torch.bfloat16, "device": device}
    side = IMAGE.get(crop, crop + crop // 8)
    shape = (batch * model.OBSERVED, side, side, 3)
    images = torch.randint(0, 256, shape, dtype=torch.uint8, device=device)
    history = torch.randn(batch, model.OBSERVED, model.ACTION, **half)
    trocar, roll = torch.randn(batch, 7, **half), torch.randn(batch, model.OBSERVED, **half)
    start = torch.randn(batch, model.HORIZON, model.ACTION, device=device)
    k = torch.tensor(list(STEPS), device=device)
    kept = alpha_bar("cpu")
    table = [(float(kept[i]), float(kept[i - 10]) if i else 1.0) for i in STEPS]

    def encode(images, history):
        edge = (side - crop) // 2
        image = normalize(images[:, edge : edge + crop, edge : edge + crop].float() / 255)
        seen = policy.vision(image).view(batch, -1)
        return policy.unet.condition(torch.cat([seen, policy.history(history)], -1))

    def denoise(x, film, film_k):
        return policy.unet.denoise(x, film + film_k)

    functions = (encode, denoise, policy.unet.embed_step, policy.roll)
    if compiled:
        functions = tuple(torch.compile(f, dynamic=False) for f in functions)
    encode, denoise, embed, turn = functions

    @torch.no_grad()
    def call():
        x, film, films = start, encode(images, history), embed(k)
        for i, (now, after) in enumerate(table):
            noise = denoise(x, film, films[i : i + 1])
            clean = ((x - (1 - now) ** 0.5 * noise) / now**0.5).clamp(-1, 1)
            x = after**0.5 * clean + (1 - after) ** 0.5 * noise
        return x, turn(x[..., :3].to(torch.bfloat16), trocar, roll)

    return call


def alpha_bar(device) -> torch.Tensor:
    """Cosine schedule over 100 steps, `[100]`."""
    at = torch.cos((torch.arange(101, dtype=torch.float64) / 100 + 0.008) / 1.008 * torch.pi / 2)
    beta = (1 - (at[1:] / at[:-1]) ** 2).clamp(max=0.999)
    return torch.cumprod(1 - beta, 0).float().to(device)


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


if __name__ == "__main__":
    main()
