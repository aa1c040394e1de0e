"""The recording of the test site that ships with slipid, made from a folder of driven runs."""

from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from slipid.app.logs import RECORDED
from slipid.cli.demo import PARTS
from slipid.support.files import write_bytes


def pack(folder: Path, archive: Path = RECORDED) -> None:
    """Make the recording from a folder that `drive_anew` wrote; same files, same bytes."""
    wanted = [p for part in PARTS for p in (folder / part / "logs").rglob("*.csv")]
    wanted += [folder / part / "truth" / "truth.json" for part in PARTS]
    content = BytesIO()
    with ZipFile(content, "w") as file:
        for path in sorted(wanted):
            info = ZipInfo(path.relative_to(folder).as_posix())
            file.writestr(info, path.read_bytes(), ZIP_DEFLATED, 9)
    write_bytes(archive, content.getvalue())
