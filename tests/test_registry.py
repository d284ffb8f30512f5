"""Parts of other packages: the right type and name, from one package; a broken one is a line."""

import importlib
import re
import sys

import pytest

from starjax import cli, rcm
from starjax.cli import policy_args, presets, run_settings
from starjax.core import config, errors, extensions, methods, registry
from starjax.data import normalizer
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


def test_broken_mounts_leave_those_of_others(install):
    install("lab_h", "1 / 0", mounts="mounts")
    arm = registries.arms.get("fr5")
    with pytest.warns(UserWarning, match="lab_h"):
        assert registries.mount(arm, "hook", "board") is None
    assert registry.entries("starjax.mounts")


PARTS = """
import dataclasses
from starjax.core import methods
from starjax.cli import presets
from starjax.policies.models.encoders import SMALL
from starjax.policies.external import ExternalPolicy
from starjax.rcm import ACTION_SPACES

BLIND = methods.Method("rcm4_again")
RCM4_AGAIN = ACTION_SPACES["rcm4"]._replace(name="rcm4_again")
BRIEF = dataclasses.replace(presets.PRESETS["smoke"], seed=3)
TINY = SMALL._replace(width=4)
DOWN = ExternalPolicy("goes down", "reach", object, observation="state")
"""
GROUPS = {
    "methods": "blind",
    "action_spaces": "rcm4_again",
    "presets": "brief",
    "encoders": "tiny",
    "policies": "down",
}


def test_methods_spaces_presets_encoders_and_policies_are_parts_too(install, capsys, tmp_path):
    install("lab_i", PARTS, **GROUPS)
    row = methods.METHODS["blind"]
    assert (row.weights_of, row.label) == ("blind", "blind")
    assert normalizer.keeps_to_manifold(row)
    assert list(methods.METHODS)[-1] == "blind" and "blind" not in methods.TABLE_II
    assert list(methods.SCORED).index(methods.SERVED) < list(methods.SCORED).index("blind")
    assert [part.code for part in methods.parts("blind")] == ["lab_i:BLIND", "lab_i:RCM4_AGAIN"]
    assert not any(part.code for part in methods.parts("stardiff"))
    argv = ["--preset", "brief", "--method", "blind", "--policy.encoder", "tiny"]
    config = run_settings.parse("run", [*argv, "--out", str(tmp_path / "out")], "")
    assert (config.preset, config.seed, config.method) == ("brief", 3, "blind")
    args = policy_args.PolicyArgs(policy="down")
    assert policy_args.resolve(args).address == "policy://down"
    assert cli.dispatch(["list"]) == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines() if line}
    assert listed >= {*GROUPS.values()}


def test_a_broken_method_is_a_line_and_leaves_the_others(install):
    install("lab_j", "BLIND = 3\n", methods="blind")
    with pytest.warns(UserWarning, match="lab_j"):
        assert list(methods.METHODS) == list(methods.METHODS.registry.built_in)
    with pytest.raises(errors.UsageError, match="lab_j"):
        methods.METHODS["blind"]


@pytest.mark.parametrize("group", ["methods", "presets", "action_spaces"])
def test_a_row_of_starjax_has_one_owner(install, group):
    name = {"methods": "dp_ee", "presets": "cpu", "action_spaces": "rcm1"}[group]
    rows = {"methods": methods.METHODS, "presets": presets.PRESETS}.get(group, rcm.ACTION_SPACES)
    install("lab_k", f"{name.upper()} = None\n", **{group: name})
    with pytest.raises(errors.UsageError) as caught:
        rows[name]
    assert caught.value.got == "starjax, lab_k"


WIDE = """
import dataclasses
from starjax.core.learners import Learner
@dataclasses.dataclass(frozen=True)
class Wide:
    horizon: int = 3
WIDE = Learner(Wide, print, print)
"""


def test_an_option_of_a_learner_that_the_policy_has_is_named(install):
    install("lab_l", WIDE, learners="wide")
    with pytest.raises(errors.UsageError) as caught:
        config.PolicyConfig(learner="wide")
    assert "wide" in caught.value.argument and caught.value.got == "horizon"


def test_a_traceback_is_shown_only_when_asked_for(capsys):
    def fails(argv):
        raise errors.UsageError("ARG", "a", "b")

    assert (
        cli.guard(fails, [])
        == cli.guard(lambda argv: fails(argv) if not argv else 0, ["--traceback"])
        == 2
    )
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == lines[-1] and lines[1].startswith("Traceback")


COMMAND = """
from starjax.core.extensions import Subcommand
HELLO = Subcommand("lab_i", "greets")
def main(argv):
    print("hello", *argv)
    return 3
"""


def test_a_package_brings_a_command(install, capsys):
    install("lab_i", COMMAND, commands="hello")
    assert cli.dispatch(["hello", "there"]) == 3 and cli.dispatch(["--help"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("hello there\n") and re.search(
        r"of other packages\n  hello +greets", said
    )


def test_an_unknown_command_says_which_add_ons_are_here(monkeypatch):
    table = extensions.AddOn("made up")
    monkeypatch.setattr(extensions, "tables", lambda: {"viewer": table})
    with pytest.raises(errors.UsageError) as caught:
        cli.dispatch(["exprt"])
    assert caught.value.argument == "COMMAND" and "viewer" in caught.value.hint


def test_others_datasets_need_their_add_on(tmp_path, monkeypatch):
    monkeypatch.setattr(extensions, "tables", dict)
    with pytest.raises(errors.UsageError, match="add-on formats"):
        cli.dispatch(["inspect", str(tmp_path)])
