"""Reads YAML files of users: safely, and refusing what would be read otherwise than it looks."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

MOST_YAML_BYTES = 2**17
"""Limit for sensor files, which have some kilobytes."""


class _StrictLoader(yaml.SafeLoader):
    """Safe YAML that refuses duplicate keys, and aliases, with which a few lines can expand to gigabytes."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.events.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "an alias (*): write the value itself", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            name = repr(self.construct_object(key, deep=True))
            if name in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {name}: given twice", node.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """The content of a YAML file, read safely, or ValueError."""
    if path.stat().st_size > MOST_YAML_BYTES:
        raise ValueError(
            f"{path}: expected a file of at most {MOST_YAML_BYTES} bytes, got {path.stat().st_size}: not a sensor file"
        )
    try:
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_StrictLoader)  # a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: not a YAML file: {error}") from error
