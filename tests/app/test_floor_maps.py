"""Folders of results have copies of the maps that their config names."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.image import imsave

from slipid.app.config import parsed
from slipid.app.floor_maps import copy_maps, map_files, map_path
from slipid.data.floor_map import read_map
from slipid.support.errors import DataError
from tests.app.test_config import GOOD

SECTION = '[[logs]]\nglob = "{0}/*.csv"\nformat = "robotino2022"\nmap = "{1}"\n'
PLAIN = 'schema = "slipid.map/1"\nbase = "gray"\nextent_m = [0, 0, 2, 2]\n'
PICTURED = (
    'schema = "slipid.map/1"\npicture = "top/view.png"\nmetres_per_pixel = 0.1\n'
    '[colours]\ngray = "#808080"\n'
)


def config_with(folder, *maps):
    sections = "".join(SECTION.format(k, path) for k, path in enumerate(maps))
    return parsed(folder / "my.toml", GOOD.replace("[parameters]", f"{sections}[parameters]"))


def test_maps_and_their_pictures_are_read_from_the_copies(tmp_path):
    home, out = tmp_path / "home", tmp_path / "out"
    (home / "maps/top").mkdir(parents=True)
    out.mkdir()
    (home / "maps/a.toml").write_text(PLAIN, encoding="utf-8")
    (home / "maps/b.toml").write_text(PICTURED, encoding="utf-8")
    imsave(home / "maps/top/view.png", np.full((3, 4, 3), 0.5))
    outside = str(home / "maps/b.toml")
    config = config_with(home, "maps/a.toml", outside, "maps/a.toml")
    copy_maps(map_files(config), out)
    assert sorted(p.name for p in (out / "maps").iterdir()) == ["a.toml", "b.toml", "view.png"]
    copied = config_with(out, "elsewhere/a.toml", outside)
    assert map_path(copied, copied.content.logs[-1]) == home / "maps/b.toml"
    (out / "run.json").touch()  # now it is a folder of results
    copy_maps(map_files(copied), out)  # onto themselves
    one, other = (map_path(copied, s) for s in copied.content.logs[-2:])
    assert (one, other) == (out / "maps/a.toml", out / "maps/b.toml")
    assert read_map(one).surfaces == ("gray",)
    assert read_map(other).cells.shape == (3, 4)
    assert map_path(copied, copied.content.logs[0]) is None


def test_maps_of_one_name_must_not_differ(tmp_path):
    for name, text in (("one", PLAIN), ("two", PLAIN.replace("gray", "green"))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.toml").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=r"two/a\.toml and .*one/a\.toml differ; expected"):
        map_files(config_with(tmp_path, "one/a.toml", "two/a.toml"))
    assert map_files(config_with(tmp_path, "one/a.toml")) == {"a.toml": tmp_path / "one/a.toml"}
