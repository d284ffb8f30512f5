"""A GPU is the device of jax; before jax has started, that of the system and its user."""

import os
import subprocess
import sys

import pytest

from starjax.runtime import gpu

VARIABLES = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME", "CUDA_VISIBLE_DEVICES")


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A function that shows these devices and variables, and a plugin by default."""

    def show(*devices, plugin=True, **variables):
        monkeypatch.setattr(gpu, "_DEV", tmp_path)
        monkeypatch.setattr(gpu, "has_plugin", lambda: plugin)
        for device in devices:
            (tmp_path / device).touch()
        for name in VARIABLES:
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    return show


@pytest.mark.parametrize("device", ["nvidiactl", "nvidia0", "nvidia12", "dxg"])
def test_drivers_containers_and_windows_show_a_gpu(machine, device):
    machine(device)
    assert gpu.is_shown() and gpu.is_likely()


def test_without_device_or_plugin_there_is_none(machine):
    machine("nvidia-uvm", "null")
    assert not gpu.is_shown() and not gpu.is_likely() and gpu.why_unused() == ""
    machine("nvidiactl", plugin=False)
    assert gpu.is_shown() and not gpu.is_likely() and "plugin" in gpu.why_unused()


@pytest.mark.parametrize(
    ("name", "value", "forbids"),
    [
        ("JAX_PLATFORMS", "cpu", True),
        ("JAX_PLATFORMS", "cpu,cuda", True),  # jax takes the first
        ("JAX_PLATFORMS", "cuda,cpu", False),
        ("JAX_PLATFORM_NAME", "cpu", True),
        ("JAX_PLATFORM_NAME", "gpu", False),
        ("CUDA_VISIBLE_DEVICES", "", True),
        ("CUDA_VISIBLE_DEVICES", "-1", True),
        ("CUDA_VISIBLE_DEVICES", "1", False),
    ],
)
def test_a_variable_may_forbid_it(machine, name, value, forbids):
    machine("nvidiactl", **{name: value})
    assert gpu.is_likely() != forbids
    assert gpu.forbidden() == (f"{name}={value}" if forbids else "")
    if forbids:
        assert gpu.why_unused() == gpu.forbidden()


def test_a_plugin_that_fails_leaves_the_cpu(tmp_path):
    """As with a driver that is too old: the system shows a GPU, jax starts without it."""
    plugin = tmp_path / "jax_plugins" / "fails"
    plugin.mkdir(parents=True)
    (plugin / "__init__.py").write_text(
        "def initialize(): raise RuntimeError('the driver is too old')"
    )
    code = "from starjax.runtime import gpu; gpu.is_shown = gpu.has_plugin = lambda: True;"
    code += "print(gpu.is_likely(), gpu.is_used(), bool(gpu.why_unused()))"
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={
            **environment,
            "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)]),
        },
        capture_output=True,
        text=True,
    )
    assert done.stdout == "True False True\n", done.stderr
