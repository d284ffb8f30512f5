"""Exports opened by those that they are for, in an environment of their own.

STARJAX_PEERS names its Python; a peer that is not installed there is skipped:
`python -m venv peers && peers/bin/pip install lerobot robomimic 'zarr<3'`.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import recorded

from starjax.data.formats import base, exchange

PYTHON = os.environ.get("STARJAX_PEERS", "")
PACKAGE = {"lerobot": "lerobot", "robomimic": "robomimic", "zarr": "zarr"}


def there(package):
    found = [PYTHON, "-c", f"import {package}"]
    return bool(PYTHON) and subprocess.run(found, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("name", "video"), [("lerobot", True), ("lerobot", False), ("robomimic", True), ("zarr", True)]
)
def test_the_peer_reads_what_we_wrote(tmp_path, name, video):
    if not there(PACKAGE[name]):
        pytest.skip(f"STARJAX_PEERS has no {PACKAGE[name]}")
    recorded.write(tmp_path / "d", size=32)
    form = base.FORMATS.get(name)
    out = tmp_path / ("out.hdf5" if name == "robomimic" else "out")
    source = exchange.source(tmp_path / "d", form)
    exchange.export(source, out, form, video)
    script = Path(__file__).with_name(f"read_{name}.py")
    done = subprocess.run([PYTHON, script, out], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    print(done.stdout)
    said = json.loads(done.stdout.splitlines()[-1])
    first, last = (source.read(i, source.columns) for i in (0, 3))
    assert (said["episodes"], said["frames"]) == (4, 120)
    action, state, image = map(form.named, ("action", "state", "image_camera"))
    np.testing.assert_array_equal(np.float32(said["action"]), first[action][0])
    np.testing.assert_array_equal(np.float32(said["state"]), last[state][-1])
    mean = said["mean"][image] * 255 if name == "lerobot" else said["mean"]
    assert abs(mean - last[image][-1].mean()) < (2.0 if video else 1e-3)
