"""Head models from files: what is read, where UVs and masks come from, and what each kind of bad file is told."""

from __future__ import annotations

import dataclasses
import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ball_head import ball_head
from flame_pickles import dump, flame_content
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mgavatar.errors import DataError
from mgavatar.files import atomic_write, read_json, read_npz
from mgavatar.head.load import read_head_model, save_head_model
from mgavatar.head.model import HeadModel

HEAD = ball_head()
FLAME_HEAD = ball_head(n_shape=300, n_expr=100)


def refusal(action: Callable[[], object], *parts: str) -> None:
    """``action`` raises a ``DataError`` of one line that has all the parts."""
    with pytest.raises(DataError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def edited(path: Path, **changes: object) -> Path:
    """A head file with some keys changed; None removes a key."""
    save_head_model(path, HEAD)
    with np.load(path) as content:
        arrays = {**content, **changes}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def changed(values: np.ndarray, index: object, value: float) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


def assert_same(one: HeadModel, other: HeadModel, *, but: tuple[str, ...] = ()) -> None:
    for field in dataclasses.fields(HeadModel):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name in but:
            continue
        if isinstance(a, np.ndarray):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7, err_msg=field.name)
            assert a.dtype == b.dtype, field.name
        elif field.name == "masks":
            assert a.keys() == b.keys()
            assert all(np.array_equal(a[key], b[key]) for key in a)
        else:
            assert a == b, field.name


def write_obj(path: Path, head: HeadModel, *, end: str = "\r\n") -> None:
    """An OBJ with displaced positions and the head's faces and texture coordinates, as FLAME's template mesh has."""
    lines = ["# a template", *(f"v {x} {y + 1.3} {z}" for x, y, z in head.v_template)]
    lines += [f"vt {u} {v}" for u, v in head.vt] + ["s off", "usemtl none"]
    corners = zip(head.faces + 1, head.ft + 1, strict=True)
    lines += ["f " + " ".join(f"{v}/{t}" for v, t in zip(face, ft, strict=True)) for face, ft in corners]
    path.write_text(end.join(lines) + end, newline="")


def flame_folder(folder: Path, *, name: str = "generic_model.pkl", protocol: int | str = "python2") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(dump(flame_content(FLAME_HEAD), protocol=protocol, old_modules=protocol == "python2"))
    return folder / name


def test_what_is_saved_is_loaded(tmp_path):
    save_head_model(tmp_path / "ball", HEAD)
    (tmp_path / "ball").rename(tmp_path / "ball.npz")
    assert_same(read_head_model(tmp_path / "ball.npz"), HEAD, but=("name",))
    assert read_head_model(tmp_path / "ball.npz").name == "ball.npz"


def test_other_types_are_converted(tmp_path):
    parents = np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32)
    path = edited(
        tmp_path / "head.npz",
        v_template=np.asfortranarray(HEAD.v_template.astype(np.float64)),
        f=HEAD.faces.astype(">u4"),
        kintree_table=parents,
        mask_face=HEAD.masks["face"].astype(np.uint8),
        weights=HEAD.lbs_weights * np.float32(1.001),
        comment="ignored",
        things=np.array([{}], object),
    )
    assert_same(read_head_model(path), HEAD, but=("name",))


def test_names_and_basis_are_optional(tmp_path):
    head = read_head_model(edited(tmp_path / "head.npz", expr_names=None, expr_basis=None, mask_face=None))
    assert head.expr_basis == "unknown"
    assert head.expr_names == ()
    assert set(head.masks) == {"neck"}


@pytest.mark.parametrize("key", ["vt", "ft"])
def test_head_without_texture_coordinates(tmp_path, key):
    path = edited(tmp_path / "head.npz", **{key: None})
    refusal(lambda: read_head_model(path), f"{path}: no texture coordinates (vt, ft); add vt (U, 2)")


@pytest.mark.parametrize(
    "key", ["v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "n_shape", "n_expr"]
)
def test_incomplete_head(tmp_path, key):
    path = edited(tmp_path / "head.npz", **{key: None})
    refusal(lambda: read_head_model(path), f"{path}: not a complete head model: {key} missing")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"v_template": HEAD.v_template[:, :2]}, "v_template has shape (42, 2), (n, 3) is needed"),
        ({"v_template": HEAD.v_template[:0]}, "v_template has shape (0, 3)"),
        ({"v_template": 1.0}, "v_template has shape (), (n, 3) is needed"),
        ({"shapedirs": 1.0}, "shapedirs has shape ()"),
        ({"vt": 1.0}, "vt has shape ()"),
        ({"mask_face": True}, "mask_face has shape ()"),
        ({"v_template": HEAD.v_template * 1000}, "v_template spans 346 units; vertices must be in metres"),
        ({"v_template": HEAD.v_template * 0}, "v_template spans 0 units"),
        ({"v_template": changed(HEAD.v_template, (3, 1), np.nan)}, "v_template holds 1 values that are NaN"),
        ({"v_template": np.full((42, 3), "x")}, "v_template holds <U1, numbers are needed"),
        ({"v_template": np.full((42, 3), 1j)}, "not plain numbers"),
        ({"f": HEAD.faces[:0]}, "f has no faces"),
        ({"f": HEAD.faces.astype(float)}, "f has shape (80, 3) and type float64, (F, 3) integers"),
        ({"f": changed(HEAD.faces, (0, 0), 42)}, "f has index 42, but there are 42 vertices"),
        ({"f": changed(HEAD.faces, (0, 0), -1)}, "f has index -1"),
        ({"f": changed(HEAD.faces.astype(np.uint64), (0, 0), 2**64 - 1)}, "f has index 18446744073709551615"),
        ({"f": changed(HEAD.faces, 0, 3)}, "f has faces that use a vertex twice"),
        ({"n_expr": 4, "expr_names": None}, "shapedirs has shape (42, 3, 7), (42, 3, 8) is needed"),
        ({"n_shape": -1}, "n_shape must be one number"),
        ({"n_shape": 4.0}, "n_shape must be one number"),
        ({"posedirs": HEAD.posedirs[..., :9]}, "posedirs has shape (42, 3, 9), (42, 3, 36) is needed"),
        ({"J_regressor": HEAD.J_regressor.T}, "J_regressor has shape (42, 5), (5, 42) is needed"),
        ({"J_regressor": HEAD.J_regressor * 2}, "J_regressor's rows sum to 2..2, each must sum to 1"),
        ({"weights": HEAD.lbs_weights * 2}, "rows sum to 2..2"),
        ({"weights": changed(HEAD.lbs_weights, (0, 0), -1.0)}, "weights are as low as -1"),
        ({"kintree_table": np.zeros((2, 5), int)}, "joints must come after their parents: root, neck, jaw"),
        ({"kintree_table": np.array([[-1, 2, 1, 1, 1], [0, 1, 2, 3, 4]])}, "joints must come after their parents"),
        ({"kintree_table": np.zeros((2, 24), int)}, "kintree_table has shape (2, 24)"),
        ({"ft": HEAD.ft[:-1]}, "ft has 79 faces, but the head has 80"),
        ({"ft": changed(HEAD.ft, (0, 0), 99)}, "ft has index 99, but there are 45 texture coordinates"),
        ({"vt": HEAD.vt + 1.0}, "one atlas within 0..1 is needed"),
        ({"mask_face": np.ones(5, bool)}, "mask_face has shape (5,) and type bool, (42,) true or false is needed"),
        ({"mask_face": np.arange(42)}, "mask_face has shape (42,) and type int64"),
        ({"expr_names": np.array(["a"])}, "expr_names has shape (1,)"),
        ({"expr_basis": np.array([1, 2])}, "expr_basis must be one word"),
        ({"shapedirs": np.array([None])}, "shapedirs.npy holds object, not plain numbers or strings"),
    ],
)
def test_inconsistent_head(tmp_path, changes, words):
    path = edited(tmp_path / "head.npz", **changes)
    refusal(lambda: read_head_model(path), f"{path}: ", words)


def test_not_a_head(tmp_path):
    refusal(lambda: read_head_model(tmp_path / "none.npz"), "none.npz: no such file")
    refusal(lambda: read_head_model(tmp_path / "none.pkl"), "none.pkl: no such file")
    refusal(lambda: read_head_model(tmp_path / "head.obj"), "head.obj: a head model is a .npz with FLAME's keys")
    np.savez(tmp_path / "seq.npz", expr=np.zeros((3, 4)))
    refusal(lambda: read_head_model(tmp_path / "seq.npz"), "seq.npz: not a head model: it has none of v_template")
    (tmp_path / "folder.npz").mkdir()
    refusal(lambda: read_head_model(tmp_path / "folder.npz"), "folder.npz: is a folder")


@pytest.mark.parametrize("file", ["FLAME_texture.npz", "flame_uv.npz", "head_template_mesh.obj"])
def test_flame_pickle_takes_uvs_from_beside(tmp_path, file):
    """Each of the three sources gives the same head; positions of the OBJ are not looked at."""
    path = flame_folder(tmp_path / "FLAME2020")
    if file.endswith(".obj"):
        write_obj(path.with_name(file), FLAME_HEAD)
    else:
        np.savez(
            path.with_name(file), vt=FLAME_HEAD.vt.astype(float), ft=FLAME_HEAD.ft.astype(np.uint32), mean=np.ones(9)
        )
    head = read_head_model(path)
    assert_same(head, FLAME_HEAD, but=("masks", "expr_basis", "expr_names", "name"))
    assert (head.n_shape, head.n_expr, head.expr_basis, head.name) == (300, 100, "flame2020", "generic_model.pkl")
    assert head.masks == {}


def test_flame_pickle_without_uvs_says_which_files_to_add(tmp_path):
    path = flame_folder(tmp_path / "flame")
    refusal(
        lambda: read_head_model(path),
        f"{path}: no texture coordinates (vt, ft)",
        "FLAME_texture.npz",
        "flame_uv.npz",
        "head_template_mesh.obj",
    )


def test_uvs_beside_that_do_not_fit(tmp_path):
    path = flame_folder(tmp_path / "flame")
    obj, npz = path.with_name("head_template_mesh.obj"), path.with_name("flame_uv.npz")
    write_obj(obj, dataclasses.replace(FLAME_HEAD, faces=FLAME_HEAD.faces[::-1]))
    refusal(lambda: read_head_model(path), f"{obj}: its faces are not those of the head, in the same order")
    for line in ("f 1/1 2/2 3/3 4/4", "f 1 2 3", "f a/b c/d e/f", "vt 0.5", "f 1//1 2//2 3//3"):
        obj.write_text(line)
        refusal(lambda: read_head_model(path), f"{obj}: not an OBJ of triangles with texture coordinates")
    np.savez(npz, vt=FLAME_HEAD.vt)
    refusal(lambda: read_head_model(path), f"{npz}: no texture coordinates (vt, ft)")
    np.savez(npz, vt=FLAME_HEAD.vt, ft=FLAME_HEAD.ft[1:])
    refusal(lambda: read_head_model(path), f"{npz}: ft has 79 faces, but the head has 80")


def test_flame_masks_beside(tmp_path):
    path = flame_folder(tmp_path / "flame")
    write_obj(path.with_name("head_template_mesh.obj"), FLAME_HEAD)
    masks = {"face": np.array([1, 5]), "left_eyeball": np.array([7]), "right_eyeball": np.array([9, 11])}
    beside = path.with_name("FLAME_masks.pkl")
    beside.write_bytes(dump(masks, protocol="python2", old_modules=True))
    head = read_head_model(path)
    assert {name: np.flatnonzero(mask).tolist() for name, mask in head.masks.items()} == {
        "face": [1, 5],
        "left_eyeball": [7],
        "right_eyeball": [9, 11],
        "eyeballs": [7, 9, 11],
    }
    beside.write_bytes(dump({"face": np.array([42])}))
    refusal(lambda: read_head_model(path), f"{beside}: face is no list of vertices of a head with 42")
    beside.write_bytes(b"cos\nsystem\n(U\x02lstR.")
    refusal(lambda: read_head_model(path), f"{beside}: refused, because it asks for os.system")


@pytest.mark.parametrize(
    ("name", "basis"),
    [
        ("flame/generic_model.pkl", "flame2020"),
        ("FLAME2020/generic_model.pkl", "flame2020"),
        ("FLAME2023/generic_model.pkl", "flame2023"),
        ("assets/flame2023.pkl", "flame2023"),
        ("assets/flame2023_no_jaw.pkl", "flame2023_no_jaw"),
        ("assets/FLAME2023-Open.pkl", "flame2023_open"),
        ("assets/mine.pkl", "unknown"),
    ],
)
def test_basis_by_name(tmp_path, name, basis):
    path = flame_folder(tmp_path / Path(name).parent, name=Path(name).name, protocol=4)
    write_obj(path.with_name("head_template_mesh.obj"), FLAME_HEAD, end="\n")
    assert read_head_model(path).expr_basis == basis


def test_pickle_of_another_model(tmp_path):
    path = tmp_path / "head.pkl"
    path.write_bytes(dump(flame_content(HEAD)))
    refusal(lambda: read_head_model(path), f"{path}: shapedirs has 7 directions, FLAME's pickles have 400")
    path.write_bytes(dump({**flame_content(HEAD), "v_template": np.float64(1.0)}))
    refusal(lambda: read_head_model(path), f"{path}: v_template has shape ()")
    path.write_bytes(dump({"f": np.arange(3)}))
    refusal(lambda: read_head_model(path), f"{path}: not a complete head model: v_template, shapedirs")


def test_npz_that_would_inflate_to_more_than_is_allowed(tmp_path):
    """Refused by its header: 40 MB of zeros in 40 kB."""
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, v_template=np.zeros(5_000_000), other=np.zeros(5_000_000))
    assert path.stat().st_size < 100_000
    refusal(
        lambda: read_npz(path, wanted=lambda key: True, max_bytes=60 << 20), f"{path}: its arrays need more than 60 MiB"
    )
    assert read_npz(path, wanted=lambda key: key == "other", max_bytes=60 << 20).ignored == ("v_template",)


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (0, -1), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': __import__('os').getcwd(), }",
        "(" * 2000,
        "{",
    ],
)
def test_npz_headers_that_lie(tmp_path, header):
    path = tmp_path / "head.npz"
    text = header.encode() + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(8)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("v_template.npy", member)
    refusal(lambda: read_head_model(path), f"{path}: ")


def test_unusual_compression_is_refused(tmp_path):
    path = tmp_path / "head.npz"
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("v_template.npy", stream.getvalue())
    refusal(lambda: read_head_model(path), f"{path}: v_template.npy is compressed in a way that numpy does not write")


@pytest.fixture(scope="module")
def whole_file(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("fuzz") / "head.npz"
    save_head_model(path, HEAD)
    with np.load(path) as content:
        np.savez(path, **content)  # stored, so that damage reaches the numbers too
    return path.read_bytes()


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_npz_raises_data_errors(tmp_path, whole_file, data):
    seed = bytearray(whole_file)
    headers = [i for i in range(len(seed)) if seed[i : i + 2] in (b"PK", b"\x93N")]
    for _ in range(data.draw(st.integers(1, 6))):
        start = data.draw(st.sampled_from([0, *headers]))  # near the headers, where damage matters
        position = min(start + data.draw(st.integers(0, 150)), len(seed) - 1)
        seed[position] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del seed[data.draw(st.integers(0, len(seed))) :]
    path = tmp_path / "fuzz.npz"
    path.write_bytes(bytes(seed))
    try:
        head = read_head_model(path)
    except DataError as error:
        message = str(error)
    else:
        message = f"{path}: "
        assert_same(head, HEAD, but=("name", "masks", "expr_names", "expr_basis"))
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


@pytest.mark.parametrize("text", ["", "{", "[1,", '{"a": 1}}', "[" * 100_000, "9" * 5000, "\udcff"])
def test_damaged_json(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    refusal(lambda: read_json(path), f"{path}: not valid JSON")
    refusal(lambda: read_json(path, max_bytes=0) if text else read_json(path), f"{path}: ")


def test_a_write_is_whole_or_absent(tmp_path):
    path = tmp_path / "out.bin"
    with atomic_write(path) as file:
        file.write(b"one")

    def write(path: Path, *, divisor: int) -> None:
        with atomic_write(path) as file:
            file.write(b"two")
            file.write(bytes(1 // divisor))

    with pytest.raises(ZeroDivisionError):
        write(path, divisor=0)
    assert path.read_bytes() == b"one"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.bin"]
    refusal(lambda: write(tmp_path / "nowhere/out.bin", divisor=1), "nowhere/out.bin: cannot be written: No such file")


def test_real_head(real_data):
    head = read_head_model(real_data / "head_models/ict_head.npz")
    assert (len(head.v_template), len(head.faces), head.n_shape, head.n_expr) == (16976, 33728, 100, 57)
    assert (head.expr_basis, len(head.expr_names), head.name) == ("unknown", 57, "ict_head.npz")
    np.testing.assert_array_equal(head.parents, [-1, 0, 1, 1, 1])
    assert head.masks["eyeballs"].sum() == 2 * 770
    eyes = head.J_regressor[3:] @ head.v_template
    np.testing.assert_allclose(eyes, [[0.0311, 0.0232, 0.0237], [-0.0311, 0.0232, 0.0237]], atol=2e-4)
