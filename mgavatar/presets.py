"""Presets: named sets of configuration keys as TOML files, and configurations written as such."""

from __future__ import annotations

import dataclasses
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from mgavatar.config import FitConfig, from_dict
from mgavatar.errors import DataError
from mgavatar.files import one_line


def preset(name: str) -> FitConfig:
    """Return the configuration of a preset, checked.

    Args:
        name: Name of a preset that ships, or the path of a ``.toml`` file; several are combined with commas, and later
            ones override earlier ones: ``"quick,monocular"``.

    Raises:
        DataError: If there is no such preset, the file is not TOML, a key is unknown, or a value cannot work.
    """
    table = preset_table(name)
    try:
        return from_dict(table, FitConfig)
    except ValueError as error:
        raise DataError(f"preset {name}: {error}") from error


def preset_names() -> list[str]:
    """Return the names of the presets that are installed with the program."""
    files = resources.files("mgavatar.configs").iterdir()
    return sorted(Path(file.name).stem for file in files if file.name.endswith(".toml"))


def preset_summary(name: str) -> str:
    """Return the first line of a preset's file, which says in one sentence what the preset is for."""
    text = (resources.files("mgavatar.configs") / f"{name}.toml").read_text(encoding="utf-8")
    return text.splitlines()[0].removeprefix("# ")


def preset_table(preset: str) -> dict[str, Any]:
    """Return the keys that a preset changes, as nested tables; see :func:`preset` for its name.

    Raises:
        DataError: If there is no such preset, or the file is not TOML.
    """
    table: dict[str, Any] = {}
    for name in preset.split(","):
        _merge(table, _read_one(name.strip()))
    return table


def _merge(table: dict[str, Any], more: dict[str, Any]) -> None:
    """Put ``more`` into ``table``; where both have a value, ``more`` wins."""
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(table.get(key), dict):
            _merge(table[key], value)
        else:
            table[key] = value


def _read_one(preset: str) -> dict[str, Any]:
    if preset.endswith(".toml"):
        source: Any = Path(preset)
        if not source.is_file():
            raise DataError(f"{preset}: no such file; give a preset ({', '.join(preset_names())}) or a .toml file")
    elif preset in preset_names():
        source = resources.files("mgavatar.configs") / f"{preset}.toml"
    else:
        raise DataError(f"no preset '{preset}'; there are {', '.join(preset_names())}, or a path ending in .toml")
    try:
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{preset}: cannot be read: {one_line(error.strerror)}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{preset}: not a TOML file ({one_line(error)})") from error


def to_toml(config: Any, prefix: str = "") -> str:
    """Return a configuration as TOML that :func:`preset` reads back, to the last digit."""
    plain, nested = [], []
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if value is None:  # TOML has no word for it; left out, it is the default
            continue
        if dataclasses.is_dataclass(value):
            nested.append(f"\n[{prefix}{entry.name}]\n{to_toml(value, f'{prefix}{entry.name}.')}")
        else:
            plain.append(f"{entry.name} = {_toml_value(value)}\n")
    return "".join(plain + nested)


def _toml_value(value: str | bool | int | float) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    return str(value).lower() if isinstance(value, bool) else repr(value)
