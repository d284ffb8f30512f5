"""`starjax import` of datasets that a mapping of the package fits."""

import mistakes
import openh

from starjax.addons.formats.commands import import_command
from starjax.data import store


def test_a_dataset_is_imported_without_a_mapping_file(tmp_path, capsys):
    path, out = str(openh.write(tmp_path / "theirs", "tud-ur5e")), tmp_path / "d"
    assert import_command.main([path, str(out), "--splits", "train", "test", "--skip", "1"]) == 0
    assert "tud-ur5e" in capsys.readouterr().out
    numbers = [store.verify(out, key)["episode"] for key in store.keys(out)]
    assert numbers == [0, 2]
    with mistakes.of("--cameras", "camera"):
        import_command.main([path, str(tmp_path / "e"), "--cameras", "camera"])
    with mistakes.of("--map: image column", "none.such"):
        import_command.main([path, str(tmp_path / "e"), "--cameras", "camera=none.such"])
