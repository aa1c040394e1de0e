"""Optional packages, which the extras of slipid install, and the command that installs them."""

import os
import shlex
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from slipid.support.errors import DataError


class MissingExtra(DataError, ImportError):
    """Error about an optional package that is not installed; it names the command to type."""


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Return an optional module.

    Args:
        module: name of the module.
        extra: extra of slipid that installs it, such as `parquet`.
        purpose: what needs the module, as the subject of a sentence in the singular.

    Raises:
        MissingExtra: the module cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise missing(extra, purpose, error) from error


def missing(extra: str, purpose: str, error: ImportError) -> MissingExtra:
    """Return the error about a missing package, with the command that installs it.

    Args:
        extra, purpose: as in `require`.
        error: error of the import.
    """
    absent = isinstance(error, ModuleNotFoundError) and error.name
    package = f"the package {absent}, which is not installed" if absent else f"a package ({error})"
    return MissingExtra(f"{purpose} needs {package}; install it with: {install_command(extra)}")


def install_command(extra: str) -> str:
    """Return the command that installs an extra where slipid is installed, ready to be typed."""
    root = Path(__file__).resolve().parents[2]
    pip = Path(sys.prefix, "bin", "pip")
    command = _typed(pip) if pip.is_file() else f"{_typed(Path(sys.executable))} -m pip"
    if not (root / "pyproject.toml").is_file():
        return f"{command} install {shlex.quote(f'slipid[{extra}]')}"
    where = "." if Path.cwd() == root else str(root)
    return f"{command} install -e {shlex.quote(f'{where}[{extra}]')}"


def _typed(program: Path) -> str:
    """Return the path of a program for a shell, relative if it is below the current folder."""
    path = os.path.relpath(program) if program.is_relative_to(Path.cwd()) else str(program)
    return shlex.quote(path)
