"""YAML of ROS parameters, read as ROS and generate_parameter_library do."""

from __future__ import annotations

from collections.abc import Mapping

import yaml

Tree = Mapping[str, object]


class Strict(yaml.SafeLoader):
    """Refuses a key that stands twice."""

    def construct_mapping(self, node, deep=False):
        keys = [self.construct_object(key) for key, _ in node.value]
        assert len(set(keys)) == len(keys), keys
        return super().construct_mapping(node, deep=deep)


def read(files: Mapping[str, str], name: str) -> Tree:
    return yaml.load(files[name], Strict)


def flat(tree: Tree, leaf: str | None = None, before: str = "") -> dict[str, object]:
    """Leaves by their dotted names; with `leaf` a mapping that has this key is one."""
    out: dict[str, object] = {}
    for name, value in tree.items():
        if isinstance(value, dict) and (leaf is None or not isinstance(value.get(leaf), str)):
            out |= flat(value, leaf, f"{before}{name}.")
        else:
            out[before + name] = value
    return out


def parameters(files: Mapping[str, str], name: str, node: str) -> dict[str, object]:
    tree = read(files, name)[node]
    assert list(tree) == ["ros__parameters"]
    return flat(tree["ros__parameters"])
