"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn, PartKind, Subcommand

_HERE = "starjax.addons.formats"
TABLE = AddOn(
    "others' datasets: import, export, inspection",
    commands={
        "export": Subcommand(
            f"{_HERE}.commands.export_command",
            "export demonstrations in the format of another library",
            ("sim", "train", "formats"),
        ),
        "import": Subcommand(
            f"{_HERE}.commands.import_command",
            "import a dataset in the format of another library",
            ("sim", "train", "formats"),
        ),
    },
    kinds={"format": PartKind(f"{_HERE}.base:FORMATS", f"{_HERE}.part_check")},
    hooks={
        "list": f"{_HERE}.inspection:tables",
        "inspect": f"{_HERE}.inspection:summary",
        "inspect_page": f"{_HERE}.inspection:mapped",
    },
)
