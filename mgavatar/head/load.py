"""Head models in files: ``.npz`` with FLAME's keys, and FLAME's own pickles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mgavatar.errors import DataError
from mgavatar.files import GIBIBYTE, atomic_write, float_array, one_line, read_bytes, read_npz
from mgavatar.head.flame_pickle import read_flame_pickle
from mgavatar.head.model import JOINTS, HeadModel

RIG_KEYS = ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table")
UV_KEYS = ("vt", "ft")
UV_FILES = ("FLAME_texture.npz", "flame_uv.npz")
UV_TEMPLATE = "head_template_mesh.obj"
MASK_FILE = "FLAME_masks.pkl"
FLAME_N_SHAPE = 300
"""FLAME's pickles hold 300 identity directions, then 100 expression directions."""
MAX_ARRAYS = 2 * GIBIBYTE


def read_head_model(path: Path) -> HeadModel:
    """Read and check a head model.

    A ``.npz`` holds everything itself. A FLAME pickle (2020, 2023, 2023_no_jaw, 2023_Open) has no texture coordinates:
    they are taken from ``FLAME_texture.npz``, ``flame_uv.npz`` or ``head_template_mesh.obj`` in the same folder, and
    the regions from ``FLAME_masks.pkl`` if that is there.

    Args:
        path: The ``.npz`` or ``.pkl`` file.

    Returns:
        The head, with every array in the type and shape that ``HeadModel`` states.

    Raises:
        DataError: If the file is missing, damaged or inconsistent; the message names the array and the remedy.
    """
    kind = path.suffix.lower()
    if kind == ".npz":
        return _from_npz(path)
    if kind == ".pkl":
        return _from_pickle(path)
    raise DataError(f"{path}: a head model is a .npz with FLAME's keys or a FLAME .pkl")


def head_arrays(model: HeadModel) -> dict[str, np.ndarray]:
    """Return the arrays of a head model's ``.npz`` file by their keys."""
    arrays = {
        "v_template": model.v_template,
        "f": model.faces,
        "shapedirs": model.shapedirs,
        "n_shape": np.asarray(model.n_shape, np.int64),
        "n_expr": np.asarray(model.n_expr, np.int64),
        "posedirs": model.posedirs,
        "J_regressor": model.J_regressor,
        "weights": model.lbs_weights,
        "kintree_table": np.stack([model.parents, np.arange(len(model.parents))]).astype(np.int64),
        "vt": model.vt,
        "ft": model.ft,
        "expr_basis": np.asarray(model.expr_basis),
        **{f"mask_{name}": mask for name, mask in model.masks.items()},
    }
    if model.expr_names:
        arrays["expr_names"] = np.array(model.expr_names)
    return arrays


def save_head_model(path: Path, model: HeadModel) -> None:
    """Write a head model as the ``.npz`` file that :func:`read_head_model` reads.

    Raises:
        DataError: If the file cannot be written.
    """
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **head_arrays(model))


def _basis_of_names(*names: str) -> str:
    """Guess the expression basis from the names of a file and of its folder; the first that tells it counts."""
    for name in (name.lower().replace("-", "_") for name in names):
        if "flame" in name and "2023" in name:
            variants = {"no_jaw": "flame2023_no_jaw", "nojaw": "flame2023_no_jaw", "open": "flame2023_open"}
            return next((basis for tag, basis in variants.items() if tag in name), "flame2023")
        if "flame" in name and "2020" in name:
            return "flame2020"
    return "flame2020" if names[0] == "generic_model" else "unknown"


def _from_npz(path: Path) -> HeadModel:
    known = {*RIG_KEYS, *UV_KEYS, "n_shape", "n_expr", "expr_names", "expr_basis"}
    arrays = read_npz(path, wanted=lambda key: key in known or key.startswith("mask_"), max_bytes=MAX_ARRAYS).arrays
    return head_from_arrays(arrays, path=path)


def head_from_arrays(arrays: dict[str, np.ndarray], *, path: Path) -> HeadModel:
    """Build a head model from the arrays of its ``.npz`` file and check it.

    Args:
        arrays: Arrays by their keys, as :func:`head_arrays` returns them.
        path: File that the messages name.

    Raises:
        DataError: If an array is missing, has another shape, is not finite or is out of range.
    """
    if not any(key in arrays for key in RIG_KEYS):
        raise DataError(f"{path}: not a head model: it has none of {', '.join(RIG_KEYS)}")
    if any(key not in arrays for key in UV_KEYS):
        raise DataError(
            f"{path}: no texture coordinates (vt, ft); add vt (U, 2), v up, and ft (F, 3), which lists them in the "
            "order of the faces f"
        )
    _require(arrays, (*RIG_KEYS, "n_shape", "n_expr"), path=path)
    n_shape, n_expr = (_count(arrays[key], where=f"{path}: {key}") for key in ("n_shape", "n_expr"))
    n_verts = len(_floats(arrays, "v_template", (None, 3), path=path))
    masks = {
        key.removeprefix("mask_"): _vertex_mask(value, n_verts, where=f"{path}: {key}")
        for key, value in arrays.items()
        if key.startswith("mask_")
    }
    basis = _text(arrays["expr_basis"], path=path) if "expr_basis" in arrays else _basis_of_names(path.stem)
    names = _names(arrays.get("expr_names"), n_expr, path=path)
    return _checked(
        arrays, uv_path=path, path=path, n_shape=n_shape, n_expr=n_expr, masks=masks, expr_basis=basis, expr_names=names
    )


def _from_pickle(path: Path) -> HeadModel:
    arrays = read_flame_pickle(path, keys=RIG_KEYS)
    _require(arrays, RIG_KEYS, path=path)
    n_verts = len(_floats(arrays, "v_template", (None, 3), path=path))
    n_dirs = arrays["shapedirs"].shape[-1] if arrays["shapedirs"].ndim else 0
    if n_dirs <= FLAME_N_SHAPE:
        raise DataError(
            f"{path}: shapedirs has {n_dirs} directions, FLAME's pickles have 400 (300 identity, 100 expression); "
            "save other models as .npz with n_shape and n_expr"
        )
    uv_path, uvs = _uvs_beside(path, arrays["f"])
    return _checked(
        {**arrays, **uvs},
        uv_path=uv_path,
        path=path,
        n_shape=FLAME_N_SHAPE,
        n_expr=n_dirs - FLAME_N_SHAPE,
        masks=_masks_beside(path, n_verts),
        expr_basis=_basis_of_names(path.stem, path.absolute().parent.name),
        expr_names=(),
    )


def _checked(
    arrays: dict[str, np.ndarray],
    *,
    path: Path,
    uv_path: Path,
    n_shape: int,
    n_expr: int,
    masks: dict[str, np.ndarray],
    expr_basis: str,
    expr_names: tuple[str, ...],
) -> HeadModel:
    """Check the arrays against each other and convert them to the types of ``HeadModel``."""
    n_joints = len(JOINTS)
    v_template = _floats(arrays, "v_template", (None, 3), path=path)
    _check_metres(v_template, path=path)
    n_verts = len(v_template)
    faces = _indices(arrays["f"], n_verts, where=f"{path}: f", of="vertices")
    if np.any(faces == np.roll(faces, 1, axis=1)):
        raise DataError(f"{path}: f has faces that use a vertex twice; remove them")
    vt, ft = _checked_uvs(arrays, faces, path=uv_path)
    return HeadModel(
        v_template=v_template,
        faces=faces,
        shapedirs=_floats(arrays, "shapedirs", (n_verts, 3, n_shape + n_expr), path=path),
        n_shape=n_shape,
        n_expr=n_expr,
        posedirs=_floats(arrays, "posedirs", (n_verts, 3, 9 * (n_joints - 1)), path=path),
        J_regressor=_joint_regressor(arrays, n_verts, path=path),
        lbs_weights=_skinning_weights(arrays, n_verts, path=path),
        parents=_parents(arrays["kintree_table"], where=f"{path}: kintree_table"),
        vt=vt,
        ft=ft,
        masks=masks,
        expr_basis=expr_basis,
        expr_names=expr_names,
        name=path.name,
    )


def _require(arrays: dict[str, np.ndarray], keys: tuple[str, ...], *, path: Path) -> None:
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise DataError(f"{path}: not a complete head model: {', '.join(missing)} missing")


def _floats(arrays: dict[str, np.ndarray], key: str, shape: tuple[int | None, ...], *, path: Path) -> np.ndarray:
    array = float_array(arrays[key], where=f"{path}: {key}")
    fits = array.ndim == len(shape) and all(need in (None, size) for need, size in zip(shape, array.shape, strict=True))
    if not fits or 0 in array.shape[:1]:
        needed = ", ".join("n" if size is None else str(size) for size in shape)
        raise DataError(f"{path}: {key} has shape {array.shape}, ({needed}) is needed")
    return array


def _check_metres(v_template: np.ndarray, *, path: Path) -> None:
    size = float(np.linalg.norm(np.ptp(v_template.astype(np.float64), axis=0)))
    if not 0.02 < size < 10.0:
        raise DataError(f"{path}: v_template spans {size:.3g} units; vertices must be in metres (a head spans 0.4)")


def _indices(value: np.ndarray, count: int, *, where: str, of: str) -> np.ndarray:
    """Return triangles as int32, shape [F, 3], whose indices are below ``count``."""
    if value.ndim != 2 or value.shape[1] != 3 or value.dtype.kind not in "iu":
        raise DataError(f"{where} has shape {value.shape} and type {value.dtype}, (F, 3) integers are needed")
    if not len(value):
        raise DataError(f"{where} has no faces")
    low, high = int(value.min()), int(value.max())
    if low < 0 or high >= count:
        raise DataError(f"{where} has index {low if low < 0 else high}, but there are {count} {of}")
    return np.ascontiguousarray(value, np.int32)


def _checked_uvs(arrays: dict[str, np.ndarray], faces: np.ndarray, *, path: Path) -> tuple[np.ndarray, np.ndarray]:
    vt = _floats(arrays, "vt", (None, 2), path=path)
    ft = _indices(arrays["ft"], len(vt), where=f"{path}: ft", of="texture coordinates")
    if len(ft) != len(faces):
        raise DataError(f"{path}: ft has {len(ft)} faces, but the head has {len(faces)}; both must list the same faces")
    if vt.min() < -0.01 or vt.max() > 1.01:
        raise DataError(f"{path}: vt runs from {vt.min():.3g} to {vt.max():.3g}; one atlas within 0..1 is needed")
    return vt.clip(0.0, 1.0), ft


def _joint_regressor(arrays: dict[str, np.ndarray], n_verts: int, *, path: Path) -> np.ndarray:
    regressor = _floats(arrays, "J_regressor", (len(JOINTS), n_verts), path=path)
    sums = regressor.sum(axis=1, dtype=np.float64)
    if np.abs(sums - 1.0).max() > 0.05:
        raise DataError(f"{path}: J_regressor's rows sum to {sums.min():.3g}..{sums.max():.3g}, each must sum to 1")
    return regressor


def _skinning_weights(arrays: dict[str, np.ndarray], n_verts: int, *, path: Path) -> np.ndarray:
    weights = _floats(arrays, "weights", (n_verts, len(JOINTS)), path=path)
    sums = weights.sum(axis=1, keepdims=True, dtype=np.float64)
    if weights.min() < -1e-3 or np.abs(sums - 1.0).max() > 1e-2:
        raise DataError(
            f"{path}: weights are as low as {weights.min():.3g} and rows sum to {sums.min():.3g}..{sums.max():.3g}; "
            "skinning weights are not negative and each row sums to 1"
        )
    weights = weights.clip(0.0)
    return (weights / weights.sum(axis=1, keepdims=True, dtype=np.float64)).astype(np.float32)


def _parents(table: np.ndarray, *, where: str) -> np.ndarray:
    """Return the parent of each joint from FLAME's table, in which that of the root is 2**32 - 1 or -1."""
    n_joints = len(JOINTS)
    if table.shape != (2, n_joints) or table.dtype.kind not in "iu":
        raise DataError(f"{where} has shape {table.shape} and type {table.dtype}, (2, {n_joints}) integers are needed")
    joints = table.astype(np.int64)
    parents = np.where(joints[0] == 2**32 - 1, -1, joints[0])
    ordered = parents[0] == -1 and all(0 <= parents[joint] < joint for joint in range(1, n_joints))
    if not ordered or not np.array_equal(joints[1], np.arange(n_joints)):
        raise DataError(f"{where} is {table.tolist()}; joints must come after their parents: {', '.join(JOINTS)}")
    return parents.astype(np.int32)


def _count(value: np.ndarray, *, where: str) -> int:
    if value.size != 1 or value.dtype.kind not in "iu" or not 0 <= int(value.reshape(())) <= 100_000:
        raise DataError(f"{where} must be one number of directions")
    return int(value.reshape(()))


def _text(value: np.ndarray, *, path: Path) -> str:
    if value.size != 1 or value.dtype.kind != "U":
        raise DataError(f"{path}: expr_basis must be one word, for example flame2023")
    return one_line(value.item(), limit=60)


def _names(value: np.ndarray | None, n_expr: int, *, path: Path) -> tuple[str, ...]:
    if value is None:
        return ()
    if value.shape != (n_expr,) or value.dtype.kind != "U":
        raise DataError(
            f"{path}: expr_names has shape {value.shape} and type {value.dtype}, ({n_expr},) text is needed"
        )
    return tuple(one_line(name, limit=60) for name in value)


def _vertex_mask(value: np.ndarray, n_verts: int, *, where: str) -> np.ndarray:
    if value.shape != (n_verts,) or value.dtype.kind not in "biu" or value.max(initial=0) > 1:
        raise DataError(f"{where} has shape {value.shape} and type {value.dtype}, ({n_verts},) true or false is needed")
    return value.astype(bool)


def _uvs_beside(path: Path, faces: np.ndarray) -> tuple[Path, dict[str, np.ndarray]]:
    """Read the texture coordinates for a FLAME pickle from the first file in its folder that has them."""
    for name in UV_FILES:
        beside = path.with_name(name)
        if beside.exists():
            arrays = read_npz(beside, wanted=lambda key: key in UV_KEYS).arrays
            if any(key not in arrays for key in UV_KEYS):
                raise DataError(f"{beside}: no texture coordinates (vt, ft); FLAME's texture download has them")
            return beside, arrays
    template = path.with_name(UV_TEMPLATE)
    if template.exists():
        return template, _obj_uvs(template, faces)
    raise DataError(
        f"{path}: no texture coordinates (vt, ft); put FLAME_texture.npz (of FLAME's texture download), flame_uv.npz "
        f"or {UV_TEMPLATE} into the same folder"
    )


def _obj_uvs(path: Path, faces: np.ndarray) -> dict[str, np.ndarray]:
    """Read the texture coordinates of an OBJ whose triangles are those of ``faces``, in the same order.

    Its positions are not compared with the head's: FLAME's template mesh is displaced.
    """
    coordinates, corners = [], []
    try:
        for line in read_bytes(path, max_bytes=GIBIBYTE // 8).decode("latin1").splitlines():
            words = line.split()
            if words[:1] == ["vt"]:
                coordinates.append((float(words[1]), float(words[2])))
            elif words[:1] == ["f"]:
                # "vertex/texture" or "vertex/texture/normal"; a polygon with another number of corners fails here
                (a, at, *_), (b, bt, *_), (c, ct, *_) = (word.split("/") for word in words[1:])
                corners.append(((int(a), int(b), int(c)), (int(at), int(bt), int(ct))))
        both = np.array(corners, np.int64).reshape(-1, 2, 3) - 1  # an OBJ counts from 1
    except (ValueError, IndexError, OverflowError) as error:
        raise DataError(f"{path}: not an OBJ of triangles with texture coordinates ({one_line(error)})") from error
    if not np.array_equal(both[:, 0], np.asarray(faces)):
        raise DataError(f"{path}: its faces are not those of the head, in the same order; use FLAME's own template")
    return {"vt": np.array(coordinates, np.float64).reshape(-1, 2), "ft": both[:, 1]}


def _masks_beside(path: Path, n_verts: int) -> dict[str, np.ndarray]:
    """Read the regions of a FLAME head from ``FLAME_masks.pkl``; add ``eyeballs``, the union of both."""
    beside = path.with_name(MASK_FILE)
    if not beside.exists():
        return {}
    masks = {}
    for name, ids in read_flame_pickle(beside).items():
        if ids.ndim != 1 or ids.dtype.kind not in "iu" or ids.min(initial=0) < 0 or ids.max(initial=0) >= n_verts:
            raise DataError(f"{beside}: {one_line(name, limit=40)} is no list of vertices of a head with {n_verts}")
        masks[name] = np.zeros(n_verts, bool)
        masks[name][ids] = True
    if "left_eyeball" in masks and "right_eyeball" in masks:
        masks["eyeballs"] = masks["left_eyeball"] | masks["right_eyeball"]
    return masks
