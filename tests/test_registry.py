"""Parts of other packages: the right type and name, from one package; a broken one is a line."""

import importlib
import sys

import pytest

from starjax import cli, errors, registry
from starjax.data.formats import base
from starjax.sim import registries


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs a package of one module with entry points."""

    def package(name, code, **groups):
        site = tmp_path / name
        info = site / f"{name}-1.0.dist-info"
        info.mkdir(parents=True)
        (site / f"{name}.py").write_text(code)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [
            f"[starjax.{group}]\n{part} = {name}:{part.upper()}\n" for group, part in groups.items()
        ]
        (info / "entry_points.txt").write_text("".join(lines))
        monkeypatch.syspath_prepend(site)
        monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()

    return package


ARM = "from starjax.sim.arms import fr5\nBENT = fr5.ARM._replace(name={name!r})\n"


def refused(name):
    with pytest.raises(errors.UsageError) as caught:
        registries.arms.get(name)
    return caught.value


def test_a_part_of_the_right_type_and_name_is_returned(install):
    install("lab_a", ARM.format(name="bent"), arms="bent")
    assert registries.arms.get("bent").name == "bent"
    assert registries.arms.path("bent") == "lab_a:BENT"


@pytest.mark.parametrize(
    "code",
    [
        "BENT = {}",
        ARM.format(name="other"),
        "raise RuntimeError('no licence')",
        "1 / 0",
        "",
        "def f(:",
    ],
)
def test_a_wrong_part_names_its_package_and_leaves_the_list(install, code, capsys):
    install("lab_b", code, arms="bent")
    assert "lab_b" in refused("bent").got
    assert cli.dispatch(["list"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    (line,) = [row for row in rows if row[:1] == ["bent"]]
    assert line[1:4] == ["cannot", "be", "used:"] and ["fr5"] in [row[:1] for row in rows]


def test_a_name_of_two_packages_is_refused(install):
    install("lab_c", ARM.format(name="bent"), arms="bent")
    install("lab_d", ARM.format(name="bent"), arms="bent")
    assert registries.arms.names().count("bent") == 1
    assert refused("bent").got == "lab_d, lab_c"


def test_a_name_of_starjax_is_refused(install):
    install("lab_e", ARM.replace("BENT", "FR5").format(name="fr5"), arms="fr5")
    assert registries.arms.names().count("fr5") == 1
    assert refused("fr5").got == "starjax, lab_e"


def test_a_broken_format_leaves_the_others(install, tmp_path):
    code = "from starjax.data.formats import zarr\nTABLES = zarr.FORMAT._replace(recognises=len)\n"
    install("lab_f", code, formats="tables")
    install("lab_g", "1 / 0", formats="notes")
    (tmp_path / "d" / "meta").mkdir(parents=True)
    (tmp_path / "d" / "meta" / "info.json").touch()
    assert base.detect(tmp_path / "d") == "lerobot"
    with pytest.warns(UserWarning, match="skipped"), pytest.raises(errors.UsageError):
        base.detect(tmp_path)  # of no format: the broken ones are asked too


def test_broken_mounts_leave_those_of_others(install):
    install("lab_h", "1 / 0", mounts="mounts")
    arm = registries.arms.get("fr5")
    with pytest.warns(UserWarning, match="lab_h"):
        assert registries.mount(arm, "hook", "board") is None
    assert registry.entries("starjax.mounts")
