"""A scripted browser steers an episode of `reach` through the page of `starjax teleop`.

It reads where the tip is off the page, presses the page's hotkeys until the tip is at the mark,
waits for the strict success and saves. The episode must then load as a dataset, be exported, and
train. Needs `playwright` and a Chromium (named by CHROMIUM, else `chromium`); no extra brings them.
Run as a script, or by pytest, which skips it where something is missing.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
ARGS = [
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
KEYS = (("ArrowUp", "ArrowDown"), ("ArrowRight", "ArrowLeft"), ("PageUp", "PageDown"))
SIGNS = (-1, 1, 1)  # signs of world x, y, z: away from the person who looks at the picture is -x
STEP = 1.5  # mm a stroke
PATIENCE_S = 90
VIEW = {"width": 480, "height": 360}  # small: it is drawn without a GPU
SEED, TROCAR = 3, 1


def goal_mm():
    """Where the mark of the first episode is: the dataset's own rule."""

    from starjax.data import schema
    from starjax.sim import registries, scene
    from starjax.sim.rollouts import trial_key

    task = registries.tasks.get("reach")
    key = trial_key.of_reset(SEED, TROCAR, 0, schema.STREAM)
    bound = task.bind(scene.compose(scene.name("reach")))
    return [1e3 * float(x) for x in task.sample(bound, key).p]


def tip_mm(page):
    found = re.search(r"tip (-?[\d.]+) (-?[\d.]+) (-?[\d.]+) mm", page.inner_text("body"))
    return [float(x) for x in found.groups()] if found else None


def waited(page, text):
    page.wait_for_function(
        "text => document.body.innerText.includes(text)", arg=text, timeout=1e3 * PATIENCE_S
    )


def strike(page, key, count):
    """Presses a key some times. As one call: a page that is drawn without a GPU answers late."""
    page.evaluate(
        """([key, count]) => {
            for (let i = 0; i < count; i++)
                for (const kind of ["keydown", "keyup"])
                    document.body.dispatchEvent(
                        new KeyboardEvent(kind, {key, code: key, bubbles: true}));
        }""",
        [key, count],
    )


def settled_tip(page):
    """Where the tip is once it rests."""
    before, now = None, tip_mm(page)
    while now is None or now != before:
        time.sleep(1.0)
        before, now = now, tip_mm(page)
    return now


def steer(page, goal):
    """Presses keys until the tip is within a stroke of the goal on every axis; how many."""
    strokes = 0
    for _ in range(5):
        tip = settled_tip(page)
        print(f"tip {tip} mm, mark {[round(x, 1) for x in goal]} mm", flush=True)
        left = [sign * (g - t) for sign, g, t in zip(SIGNS, goal, tip)]
        if max(map(abs, left)) < 0.6 * STEP:
            break
        for (plus, minus), way in zip(KEYS, left):
            strike(page, plus if way > 0 else minus, round(abs(way) / STEP))
            strokes += round(abs(way) / STEP)
    return strokes


def demonstrate(out):
    """Runs command and browser; returns strokes, and the last line of the command."""
    from playwright.sync_api import sync_playwright

    flags = f"--task reach --observation state --trocar {TROCAR} --seed {SEED} --port 0 --out {out}"
    command = [sys.executable, "-u", "-m", "starjax", "teleop", *flags.split()]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        address = re.search(r"http://[\d.]+:\d+", process.stdout.readline())[0]
        with sync_playwright() as p, tempfile.TemporaryDirectory() as profile:
            browser = p.chromium.launch_persistent_context(
                profile, executable_path=CHROMIUM, headless=True, args=ARGS, viewport=VIEW
            )
            page = browser.pages[0]
            page.goto(address)
            waited(page, "waits for your hand")
            page.mouse.click(40, 40)  # the page, not a field of it, has the keys
            strokes = steer(page, goal_mm())
            waited(page, "success, ")
            page.keyboard.press("Enter")
            waited(page, "1 episodes saved, 1 of them successful")
            browser.close()
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[0].strip().splitlines()[-1]
        assert process.returncode == 0
        return strokes, said
    finally:
        process.kill()


def main(out):
    strokes, said = demonstrate(out)
    from starjax.data import load

    demos = load.load(out, report=print)
    frames = int(demos.dataset.length[0])
    assert list(demos.dataset.length) == [frames] and demos.description["expert"] == "operator"
    print(f"{strokes} strokes, {frames} control steps ({frames / 30:.1f} s), strict success")
    print(said)
    exported, run = out.parent / "lerobot", out.parent / "run"
    train = "train --preset smoke --task reach --policy.observation state"
    for words in (
        ["export", str(out), str(exported), "--format", "lerobot"],
        [*train.split(), "--demos.from", str(out), "--out", str(run)],
    ):
        done = subprocess.run([sys.executable, "-m", "starjax", *words], check=True)
        print(f"starjax {words[0]}: exit code {done.returncode}")
    assert (exported / "meta" / "info.json").is_file()
    assert (run / "stardiff" / "policy.safetensors").is_file()


def test_a_browser_demonstrates_reach(tmp_path):
    pytest.importorskip("playwright")
    if not CHROMIUM:
        pytest.skip("no Chromium")
    main(tmp_path / "demos")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp()) / "demos")
