"""`starjax export`, `import`, `inspect` and `--demos.from`: their output and mistakes."""

import dataclasses
import json
import shutil
import types

import fakes
import kill
import mistakes
import numpy as np
import pytest
import recorded

from starjax.addons.formats.commands import export_command, import_command
from starjax.cli import demonstrations, inspect_command, options, presets, run_settings
from starjax.core import config
from starjax.data import store

MAP = """
task = "peg_transfer"
state = "environment_state"
[[arms]]
position = "state[0:3]"
rotation = "state[3:7]"
gripper = "state[7]"
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("ours") / "d"
    recorded.write(root)
    return root


@pytest.fixture(scope="module")
def exported(root, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "zarr"
    assert export_command.main([str(root), str(out), "--format", "zarr"]) == 0
    return out


def test_out_and_back(root, exported, tmp_path, capsys):
    assert import_command.main([str(exported), str(tmp_path / "back")]) == 0
    assert kill.tree(tmp_path / "back") == kill.tree(root)
    assert "4 demonstrations" in capsys.readouterr().out


def test_a_dataset_goes_out_and_comes_back_by_its_name_on_the_hub(root, tmp_path, monkeypatch):
    monkeypatch.setattr("starjax.runtime.hub.dataset", lambda argument, name: tmp_path / name[5:])
    shutil.copytree(root, tmp_path / "ours")
    assert export_command.main(["hf://ours", str(tmp_path / "shared")]) == 0
    assert import_command.main(["hf://shared", str(tmp_path / "back")]) == 0
    assert store.read_seal(tmp_path / "back") == store.read_seal(root)


def test_a_mapping_makes_a_dataset_of_a_strangers(exported, tmp_path, capsys):
    (tmp_path / "map.toml").write_text(MAP)
    argv = [str(exported), str(tmp_path / "d"), "--map", str(tmp_path / "map.toml")]
    assert import_command.main(argv) == 0
    said = capsys.readouterr().out
    assert "4 demonstrations" in said and "--demos.from" in said
    assert store.is_sealed(tmp_path / "d")
    with mistakes.of("OUT", "d"):
        import_command.main(argv)
    assert inspect_command.main([str(tmp_path / "d")]) == 0


def test_mistakes_are_a_line_each(root, exported, tmp_path):
    with mistakes.of("OUT", exported):
        export_command.main([str(root), str(exported)])
    with mistakes.of("format", "tape"):
        export_command.main([str(root), str(tmp_path / "x"), "--format", "tape"])
    with mistakes.of("DATASET", "nowhere"):
        export_command.main(["nowhere", str(tmp_path / "x")])
    with mistakes.of("PATH", "nowhere"):
        import_command.main(["nowhere", str(tmp_path / "x")])
    plain = shutil.copytree(exported, tmp_path / "plain")
    about = json.loads((plain / ".zattrs").read_text())
    (plain / ".zattrs").write_text(json.dumps(about | {"starjax": None}))
    with mistakes.of("--map", "smoke"):
        import_command.main([str(plain), str(tmp_path / "x"), "--map", "smoke"])
    assert import_command.main([str(plain), str(tmp_path / "by_columns")]) == 0
    for path in (tmp_path, tmp_path / "nowhere", "nothing.safetensors"):
        with mistakes.of("PATH"):
            inspect_command.main([str(path)])
    assert not (tmp_path / "x").exists()


def test_inspect_shows_columns_of_others_and_what_is_not_finite(exported, tmp_path):
    found = inspect_command.inspect(str(exported))
    rows = {name.strip(): text for name, text in found.rows}
    assert rows["rate"] == "30 Hz" and "float32 [8]" in rows["state"] and not found.odd


def test_inspect_reads_policies_and_results(request):
    found = inspect_command.inspect("compact")
    assert "stardiff" in found.rows[0][1] and not found.odd
    file = request.config.rootpath / "tests/golden/result/result.json"
    rows = dict(inspect_command.inspect(str(file)).rows)
    assert rows["trials"] == "72" and rows["seen"].startswith("46/48")


def _edit(root, name, change):
    """An episode written again, with correct hashes."""
    key = store.keys(root)[0]
    record = store.verify(root, key)
    arrays = {n[:-4]: np.load(root / "episodes" / key / n) for n in record["files"]}
    change(arrays)
    store.remove(root, key)
    outcome = {n: v for n, v in record.items() if n not in ("files", "digest")}
    new = store.commit(root, key, outcome, {n: [a] for n, a in arrays.items()})
    records = {k: store.verify(root, k) for k in store.keys(root)}
    store.seal(root, records | {key: new})


def _nan(arrays):
    arrays["command_p"][3] = np.nan


def _jump(arrays):
    arrays["p"][9:] += 0.2


def _elsewhere(arrays):
    arrays["p"] += np.float32([0.01, 0.0, 0.0])


ODD = {
    "not finite": _nan,
    "faster": _jump,
    "another trocar": _elsewhere,
}


@pytest.mark.parametrize("kind", ODD)
def test_inspect_says_what_is_odd_about_a_dataset(root, tmp_path, kind):
    copy = shutil.copytree(root, tmp_path / "d")
    assert not inspect_command.inspect(str(copy)).odd
    _edit(copy, "p", ODD[kind])
    odd = inspect_command.inspect(str(copy)).odd
    assert any(kind in line and store.keys(copy)[0] in line for line in odd)


def test_inspect_finds_damage(root, tmp_path):
    copy = shutil.copytree(root, tmp_path / "d")
    file = copy / "episodes" / store.keys(copy)[0] / "p.npy"
    file.write_bytes(file.read_bytes()[:-1])
    assert any("p.npy" in line for line in inspect_command.inspect(str(copy)).odd)
    assert inspect_command.main([str(copy)]) == 1


def env():
    """As much of the environment as the check of a dataset looks at."""
    return types.SimpleNamespace(
        task=fakes.TASK, names=fakes.SCENE, p_world_ref=np.float32([[0.0, 0.0, 0.15]])
    )


def asked(root, **policy):
    given = dataclasses.replace(presets.PRESETS["smoke"].demos, from_=str(root))
    settings = dataclasses.replace(fakes.TINY, **policy)
    return dataclasses.replace(presets.PRESETS["smoke"], demos=given, policy=settings)


def test_a_run_learns_from_a_dataset_that_is_given(root, tmp_path):
    found, collect, _ = demonstrations.plan(asked(root), env(), None)
    before = kill.tree(root)
    collect()
    assert found == root and kill.tree(root) == before
    with mistakes.of("demos.from_", "none in"):
        demonstrations.plan(asked(root, observation="image"), env(), None)
    with mistakes.of("demos.from_", "dataset.json"):
        demonstrations.plan(asked(tmp_path), env(), None)
    other = types.SimpleNamespace(**{**vars(env()), "task": fakes.task(name="reach")})
    with mistakes.of("demos.from_", "peg_transfer"):
        demonstrations.plan(asked(root), other, None)
    moved = types.SimpleNamespace(**{**vars(env()), "p_world_ref": np.float32([[0, 0, 0.2]])})
    with mistakes.of("demos.from_", "0.15"):
        demonstrations.plan(asked(root), moved, None)
    copy = shutil.copytree(root, tmp_path / "d")
    (copy / "SEALED.json").unlink()
    with mistakes.of("demos.from_", "not complete"):
        demonstrations.plan(asked(copy), env(), None)


def test_a_given_dataset_that_is_damaged_is_not_touched(root, tmp_path):
    from starjax.sim.rollouts import sharing

    copy = shutil.copytree(root, tmp_path / "d")
    file = copy / "episodes" / store.keys(copy)[0] / "p.npy"
    file.write_bytes(file.read_bytes()[:-1])
    before, given = kill.tree(copy), asked(copy)
    with mistakes.of("demos.from_", "p.npy"):
        demonstrations.load(given, None, copy, lambda: None, None, sharing.ALONE)
    assert kill.tree(copy) == before


def test_the_flag_is_spelled_as_people_would():
    typed = ["--preset", "smoke", "--demos.from", "there/d"]
    found = run_settings.parse("run", typed, "")
    assert found.demos.from_ == "there/d" and found.out.endswith("from-d")
    assert options.flag("demos.from_") == "--demos.from"
    assert "--demos.from" in options.flags(config.RunConfig())
