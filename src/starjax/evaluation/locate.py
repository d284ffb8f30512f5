"""Files of results by the path that a user names. Imports no jax."""

from pathlib import Path

from starjax.core import errors

RESULT, SWEEP = "result.json", "sweep.json"


def results(argument: str, path: str | Path) -> list[Path]:
    """Returns the results that a path names: a file, the one in a folder, or those of its folders.

    Raises:
      errors.UsageError: the path has no result.
    """
    folder = Path(path).expanduser()
    files = [folder] if folder.is_file() else [folder / RESULT]
    files = files if files[0].is_file() else sorted(folder.glob(f"*/{RESULT}"))
    if not (str(path) and files):
        expected = f"a directory with {RESULT}, or a parent of such directories"
        raise errors.UsageError(argument, expected, path or "none")
    return files
