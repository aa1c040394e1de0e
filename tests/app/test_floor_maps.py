"""Folders of results have copies of the maps that their config names."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.image import imsave

from slipid.app.config import parsed
from slipid.app.floor_maps import copy_maps, map_path
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
    config = config_with(home, "maps/a.toml", "maps/b.toml", "maps/a.toml")
    copy_maps(config, out)
    assert sorted(p.name for p in out.iterdir()) == ["a.toml", "b.toml", "view.png"]
    copied = config_with(out, "maps/a.toml", "maps/b.toml")
    copy_maps(copied, out)  # onto themselves
    one, other = (map_path(copied, s) for s in copied.content.logs[-2:])
    assert (one, other) == (out / "a.toml", out / "b.toml")
    assert read_map(one).surfaces == ("gray",)
    assert read_map(other).cells.shape == (3, 4)
    assert map_path(copied, copied.content.logs[0]) is None


def test_maps_of_one_name_must_not_differ(tmp_path):
    for name, text in (("one", PLAIN), ("two", PLAIN.replace("gray", "green"))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.toml").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=r"two/a\.toml and .*one/a\.toml differ; expected"):
        copy_maps(config_with(tmp_path, "one/a.toml", "two/a.toml"), tmp_path)
    copy_maps(config_with(tmp_path, "one/a.toml"), tmp_path)
    assert (tmp_path / "a.toml").read_text(encoding="utf-8") == PLAIN
