"""The head model that a capture was tracked with: named by the user, by the capture, or by the environment."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from mgavatar.errors import DataError
from mgavatar.files import path_inside, read_json
from mgavatar.head.load import read_head_model
from mgavatar.head.model import HeadModel
from mgavatar.head.procedural.build import build_head

BUILTIN = "builtin"
"""Names the built-in head wherever a head model's file may be named."""

HEAD_MODEL_KEY = "head_model"
"""Key of a capture's transforms files that names its head model."""

HEAD_MODEL_FILE = "head_model.npz"
"""Name of a head model that lies beside a capture's transforms files."""

ENVIRONMENT_VARIABLE = "MGAVATAR_HEAD_MODEL"

FLAME_PICKLES = ("generic_model.pkl", "male_model.pkl", "female_model.pkl", "flame*.pkl")
"""Names of FLAME's head models in its own downloads, in lower case."""

OTHER_PICKLES = ("mask", "embedding", "landmark", "texture")
"""Parts of names of the pickles that come with FLAME and are not head models."""

log = logging.getLogger("mgavatar")


def load_head_model(name: Path | str) -> HeadModel:
    """Return a head model by the path of its file, or the built-in one.

    Args:
        name: ``.npz`` with FLAME's keys, FLAME ``.pkl``, or ``"builtin"``.

    Raises:
        DataError: If the file is missing, damaged or inconsistent.
    """
    return build_head() if str(name) == BUILTIN else read_head_model(Path(name).expanduser())


def resolve_head_model(text: str | None, root: Path) -> HeadModel:
    """Return the head model that the user names, or else the one that belongs to the capture.

    Log a warning if the user names another head model than the capture does.

    Args:
        text: Path of a head model, ``"builtin"`` for the built-in head, or None to look for it.
        root: Folder of the capture.

    Returns:
        The head model, loaded and checked.

    Raises:
        DataError: If the head model is missing, ambiguous or damaged; the message is one line with the remedy.
    """
    if text is None:
        return find_head_model(root)
    head = load_head_model(text)
    _warn_of_another_head(head, root)
    return head


def find_head_model(root: Path) -> HeadModel:
    """Return the head model that a capture was tracked with.

    These places are tried in turn:

    1. the key ``head_model`` of ``transforms_train.json``: ``"builtin"``, or a file in the capture's folder;
    2. a ``head_model.npz`` or a FLAME pickle beside the transforms;
    3. the environment variable ``MGAVATAR_HEAD_MODEL``: ``builtin``, or a path.

    The built-in head is never assumed: parameters of another head would pose it without an error, but wrongly.

    Args:
        root: Folder of the capture.

    Returns:
        The head model, loaded and checked.

    Raises:
        DataError: If no place has a head model, if several files lie beside the transforms, or if the file is missing,
            outside the folder or damaged.
    """
    if (head := _named_head(root)) is not None:
        return head
    beside = _heads_beside(root)
    if len(beside) > 1:
        names = " and ".join(path.name for path in beside)
        raise DataError(f"{root}: {names} are head models; give --head-model with the one that it was tracked with")
    if beside:
        return read_head_model(beside[0])
    if text := os.environ.get(ENVIRONMENT_VARIABLE):
        try:
            return load_head_model(text)
        except DataError as error:
            raise DataError(f"{ENVIRONMENT_VARIABLE}: {error}") from error
    raise DataError(
        f"{root}: does not name its head model; give --head-model FILE (the FLAME .pkl or head .npz that it was "
        f"tracked with), set {ENVIRONMENT_VARIABLE}, or --head-model {BUILTIN} for the built-in head"
    )


def _named_head(root: Path) -> HeadModel | None:
    """Return the head model that the transforms name, or None if they name none."""
    path = root / "transforms_train.json"
    if not path.exists():
        return None
    meta: Any = read_json(path)
    name = meta.get(HEAD_MODEL_KEY) if isinstance(meta, dict) else None
    if name is None:
        return None
    if name == BUILTIN:
        return build_head()
    folder = root.resolve()
    return read_head_model(path_inside(name, base=folder, allowed=folder, where=f"{path}: {HEAD_MODEL_KEY}"))


def _heads_beside(root: Path) -> list[Path]:
    """List the files beside the transforms that are head models by their names."""
    files = [path for path in sorted(root.glob("*")) if path.is_file()]
    return [path for path in files if path.name == HEAD_MODEL_FILE or _is_flame_pickle(path)]


def _is_flame_pickle(path: Path) -> bool:
    plain = Path(path.name.lower())
    is_flame = any(plain.match(pattern) for pattern in FLAME_PICKLES)
    return is_flame and not any(word in plain.name for word in OTHER_PICKLES)


def _warn_of_another_head(head: HeadModel, root: Path) -> None:
    """Log a warning if the capture names a head model whose rest mesh differs from that of ``head``."""
    try:
        named = _named_head(root)
    except DataError:  # the user gave another one, perhaps because of this
        return
    if named is not None and not _have_same_mesh(named, head):
        own = "the built-in head" if named is build_head() else named.name
        log.warning("%s: was tracked with %s; its parameters may pose %s wrongly", root, own, head.name)


def _have_same_mesh(one: HeadModel, other: HeadModel) -> bool:
    return np.array_equal(one.faces, other.faces) and np.allclose(one.v_template, other.v_template, atol=1e-6)
