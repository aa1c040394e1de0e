"""Start-up code of the notebooks of the site: cells of commands, without colours or progress."""

import os
import subprocess

from IPython.core.magic import register_cell_magic

for name in ("CLICOLOR", "CLICOLOR_FORCE", "FORCE_COLOR"):
    os.environ.pop(name, None)


@register_cell_magic
def sh(line: str, cell: str) -> None:
    """Run a cell's commands, and print at once what they write; stop at the first that fails."""
    done = subprocess.run(["sh", "-e", "-c", cell], capture_output=True, text=True, check=False)
    print(done.stdout, end="")
    if done.returncode != 0:
        raise RuntimeError(f"exit code {done.returncode}\n{done.stderr}")
