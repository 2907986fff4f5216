"""A TOML table that remembers where it was last read, so that an error about a value names its key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from athlete_twin.errors import ConfigError


class Entries(Mapping[str, Any]):
    """A table and those within it, all of which note the key last asked for."""

    def __init__(self, content: Mapping[str, Any], *, name: str = "", trail: list[str] | None = None) -> None:
        self._content, self._name = content, name
        self._trail = [name] if trail is None else trail

    @property
    def last(self) -> str:
        """The key last asked for here or in any table within, such as "wheel.radius.value"."""
        return self._trail[0]

    def __getitem__(self, key: str) -> Any:
        name = f"{self._name}.{key}" if self._name else key
        self._trail[0] = name
        if key not in self._content:
            raise ConfigError(f"key {name} is missing")
        return self._within(self._content[key], name)

    def __contains__(self, key: object) -> bool:
        return key in self._content

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return f"{self._name} = {dict(self._content)}"

    def get(self, key: str, default: Any = None) -> Any:
        """The value of a key that may be absent."""
        return self[key] if key in self._content else default

    def _within(self, value: Any, name: str) -> Any:
        if isinstance(value, dict):
            return Entries(value, name=name, trail=self._trail)
        if isinstance(value, list) and any(isinstance(v, dict) for v in value):
            return [self._within(v, f"{name}[{k}]") for k, v in enumerate(value)]
        return value
