"""FLAME's pickles: every dialect gives the same arrays; nothing that a pickle asks for is ever run."""

from __future__ import annotations

import pickle
import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from ball_head import ball_head
from flame_pickles import Ch, Select, dump, flame_content
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mgavatar.errors import DataError
from mgavatar.head.flame_pickle import read_flame_pickle
from mgavatar.head.load import read_head_model

DIALECTS = [(0, False), (1, False), (2, True), (2, False), ("python2", True), (3, False), (4, False), (5, False)]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.pkl"


@pytest.fixture
def calls(monkeypatch) -> list[tuple]:
    """Calls of ``payload.run``, the code that hostile pickles here try to run."""
    found: list[tuple] = []
    module = types.ModuleType("payload")
    module.run = lambda *args: found.append(args)
    monkeypatch.setitem(sys.modules, "payload", module)
    return found


def refusal(path: Path, data: bytes, *parts: str) -> None:
    """Reading ``data`` raises a ``DataError`` of one line that names the file and has all the parts."""
    path.write_bytes(data)
    with pytest.raises(DataError) as caught:
        read_flame_pickle(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def text(value: str) -> bytes:
    return pickle.BINUNICODE + struct.pack("<I", len(value.encode())) + value.encode()


def call(module: str, name: str, argument: bytes = b"I1\n") -> bytes:
    """A pickle of protocol 0 whose loading would call ``module.name(argument)``."""
    return f"c{module}\n{name}\n".encode() + b"(" + argument + b"tR."


@pytest.mark.parametrize(("protocol", "old_modules"), DIALECTS)
def test_every_dialect_gives_the_same_arrays(file, protocol, old_modules):
    head = ball_head(n_shape=300, n_expr=100)
    file.write_bytes(dump(flame_content(head), protocol=protocol, old_modules=old_modules))
    keys = ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table")
    arrays = read_flame_pickle(file, keys=keys)
    assert set(arrays) == set(keys)
    for key, field in (("v_template", "v_template"), ("f", "faces"), ("weights", "lbs_weights")):
        np.testing.assert_array_equal(arrays[key], getattr(head, field))
    for key in ("shapedirs", "posedirs", "J_regressor"):
        np.testing.assert_array_equal(arrays[key], getattr(head, key))
        assert arrays[key].dtype == np.float64
    assert arrays["kintree_table"][0, 0] == 2**32 - 1


@pytest.mark.parametrize(("protocol", "old_modules"), DIALECTS)
def test_masks_and_other_values(file, protocol, old_modules):
    content = {"face": np.array([1, 5, 9]), "ids": [3, 4], "big": np.arange(3, dtype=">i4"), "n": np.int64(7), "t": "x"}
    file.write_bytes(dump(content, protocol=protocol, old_modules=old_modules))
    arrays = read_flame_pickle(file)
    assert set(arrays) == {"face", "ids", "big", "n"}
    np.testing.assert_array_equal(arrays["face"], [1, 5, 9])
    np.testing.assert_array_equal(arrays["ids"], [3, 4])
    np.testing.assert_array_equal(arrays["big"], [0, 1, 2])
    assert arrays["n"] == 7


def test_old_pickles_of_scipy_itself(file):
    """A csc matrix with unsorted, repeated entries, as scipy allows them."""
    matrix = scipy.sparse.csc_matrix(
        (np.array([1.0, 2.0, 3.0]), np.array([2, 0, 0]), np.array([0, 2, 3])), shape=(3, 2)
    )
    file.write_bytes(dump({"m": matrix}, old_modules=True))
    np.testing.assert_array_equal(read_flame_pickle(file)["m"], matrix.toarray())


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("payload", "run"),
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("__builtin__", "eval"),
        ("builtins", "getattr"),
        ("numpy", "load"),
        ("numpy", "fromfile"),
        ("numpy.core.multiarray", "fromfile"),
        ("io", "open"),
        ("scipy.sparse", "load_npz"),
        ("chumpy.ch", "os.system"),
        ("chumpy.ch", "Other"),
        ("copyreg", "__newobj__"),
        ("mgavatar.head.flame_pickle", "_Record"),
    ],
)
def test_other_names_are_refused_and_named(file, calls, module, name):
    refusal(file, call(module, name), f"refused, because it asks for {module}.{name}, which no FLAME file needs")
    stacked = pickle.PROTO + b"\x04" + text(module) + text(name) + pickle.STACK_GLOBAL + b"I1\n" + b"\x85R."
    refusal(file, stacked, f"{module}.{name}")
    assert not calls


def test_a_real_payload_is_not_run(file, calls):
    """The same bytes run code in Python's own unpickler, so the test would notice."""
    data = call("payload", "run")
    pickle.loads(data)
    assert calls == [(1,)]
    refusal(file, data, "payload.run")
    refusal(file, b"(ipayload\nrun\n.", "payload.run")
    refusal(file, b"\x80\x02\x82\x07.", "extension code 7")
    assert calls == [(1,)]


def test_names_with_line_feeds_stay_on_one_line(file):
    stacked = (
        pickle.PROTO + b"\x04" + text("os\nmgavatar: all is well") + text("x\r\n\x1b[2J") + pickle.STACK_GLOBAL + b"."
    )
    refusal(file, stacked, "refused")


def array_pickle(
    shape: object, *, dtype: bytes = b"\x8c\x02f8", state: object = None, data: bytes = b"\0" * 16
) -> bytes:
    """A dictionary with one numpy array that claims ``shape``, a type and a type's state, and has ``data``."""

    def inner(value: object) -> bytes:
        return pickle.dumps(value, protocol=2)[2:-1]  # without the header and the full stop

    kind = b"cnumpy\ndtype\n" + dtype + b"\x85R" + (b"" if state is None else inner(state) + b"b")
    blank = b"cnumpy.core.multiarray\n_reconstruct\n(tR"
    content = b"(K\x01" + inner(shape) + kind + b"\x89" + b"B" + struct.pack("<I", len(data)) + data + b"t"
    return b"\x80\x04}\x8c\x01a" + blank + content + b"bs."


def test_array_by_hand(file):
    file.write_bytes(array_pickle((2,)))
    np.testing.assert_array_equal(read_flame_pickle(file)["a"], [0.0, 0.0])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (array_pickle((3,)), "16 bytes do not make an array of shape (3,)"),
        (array_pickle((2**62,)), "do not make an array"),
        (array_pickle((-2, -1)), "without a shape"),
        (array_pickle([2]), "without a shape"),
        (array_pickle((2,), dtype=b"\x8c\x01O"), "arrays of type O are refused"),
        (array_pickle((2,), dtype=b"\x8c\x02O8"), "arrays of type O8 are refused"),
        (array_pickle((2,), dtype=b"\x8c\x05f8,f8"), "arrays of type f8,f8 are refused"),
        (array_pickle((2,), state=(3, "<", None, ("x",), {"x": 1}, -1, -1, 63)), "structured type"),
        (array_pickle((2,), state=(3, "<", (1,), None, None, -1, -1, 0)), "structured type"),
        (array_pickle((2,), state=(3, "!", None, None, None, -1, -1, 0)), "byte order"),
        (b"\x80\x04}\x8c\x01a" + b"cnumpy\nndarray\n(K\x7ftR" + b"s.", "an array without content"),
    ],
)
def test_arrays_that_lie(file, data, words):
    refusal(file, data, "a is damaged", words)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.array([None, 1]), "type"),
        (np.zeros(2, [("x", "f8")]), "refused"),
        (np.array(["text"]), "arrays of type U4 are refused"),
        (Select(Ch(np.zeros(3)), np.array([0, 3]), (2,)), "indices out of range"),
        (Select(Ch(np.zeros(3)), np.array([-1]), (1,)), "indices out of range"),
        (Select(Ch(np.zeros(3)), np.array([0, 1]), (7,)), "damaged"),
        (Ch(Ch(Ch(Ch(Ch(Ch(Ch(Ch(np.zeros(1))))))))), "wrapped too deep"),
        (Ch("no array"), "unexpected"),
        ([1, "two"], "something other than integers"),
        ([[1, 2], [3, 4]], "something other than integers"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
@pytest.mark.parametrize("protocol", [2, 5])
def test_values_that_are_refused(file, value, words, protocol):
    refusal(file, dump({"a": value}, protocol=protocol), "a is damaged", words)


def test_an_object_that_holds_itself(file):
    loop = Ch(np.zeros(1))
    loop.x = loop
    refusal(file, dump({"a": loop}), "wrapped too deep")


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("indices", np.array([0, 9], np.int32)),
        ("indptr", np.array([0, 5, 2], np.int32)),
        ("indptr", np.array([[0, 1, 2]], np.int32)),
        ("indptr", np.array([0, 1, -9], np.int32)),
        ("indptr", np.array([0, 1], np.int32)),
        ("indptr", np.array([0, 1, 3], np.int32)),
        ("indptr", np.array([1, 1, 2], np.int32)),
        ("indptr", np.array([0, 1, 2**63], np.uint64)),
        ("indices", np.array([0, -1], np.int32)),
        ("indices", np.array([0, 2**63], np.uint64)),
        ("indices", np.array([0], np.int32)),
        ("_shape", (3, True)),
        ("_shape", (10**9, 10**9)),
        ("_shape", (-3, -2)),
        ("_shape", "square"),
        ("data", np.zeros((2, 2))),
        ("indices", np.array([0.0, 1.0])),
    ],
)
def test_sparse_matrices_that_lie(file, part, value):
    matrix = scipy.sparse.csc_matrix(np.eye(3, 2))
    matrix.__dict__[part] = value
    refusal(file, dump({"a": matrix}), "a is damaged")


def test_not_a_pickle(file):
    refusal(file, b"", "not a readable pickle")
    refusal(file, b"<html>not found</html>", "not a readable pickle")
    refusal(file, pickle.dumps([1, 2]), "holds a list, FLAME's files hold a dictionary")
    refusal(file, dump(flame_content(ball_head()))[:3000], "not a readable pickle")
    file.unlink()
    with pytest.raises(DataError, match="no such file"):
        read_flame_pickle(file)


def test_claims_of_size_take_no_memory(file):
    """Lengths and places that a file makes up are not made room for; a deep key does not overflow the stack."""
    huge = struct.pack("<Q", 1 << 40)
    refusal(file, b"\x80\x05}\x8c\x01a" + b"\x96" + huge + b"x", "not a readable pickle")
    refusal(file, b"\x80\x04}\x8c\x01a" + b"\x8e" + huge + b"x", "not a readable pickle")
    refusal(file, b"\x80\x04}r\xff\xff\xff\xff" + b"\x8c\x01a", "not a readable pickle")
    refusal(file, b"\x80\x04})" + b"\x85" * 300_000 + b"K\x01s.", "neither text nor a number")
    refusal(file, b"\x80\x04\x8f()" + b"\x85" * 300_000 + b"\x90.", "neither text nor a number")


def test_building_on_a_name_changes_nothing(file):
    """State that is given to a class itself, not to an object of it, is refused and does not stay for the next file."""
    good = dump({"a": np.arange(3)})
    for name in (b"cnumpy\nndarray\n", b"ccopy_reg\n_reconstructor\n", b"cchumpy.ch\nCh\n"):
        refusal(file, b"\x80\x02}(U\x01a" + name + b"(N}U\x05stateK\x01stb" + b"u.", "not a readable pickle")
        file.write_bytes(good)
        np.testing.assert_array_equal(read_flame_pickle(file)["a"], [0, 1, 2])


SEEDS = [
    dump({"a": Ch(np.arange(4.0)), "m": scipy.sparse.csc_matrix(np.eye(3)), "b": [1, 2]}, protocol=p, old_modules=o)
    for p, o in DIALECTS
] + [b"\x80\x02}U\x01acpayload\nrun\n(I1\ntRs."]


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_raise_data_errors_and_run_nothing(tmp_path, calls, data):
    seed = bytearray(data.draw(st.sampled_from(SEEDS)))
    for _ in range(data.draw(st.integers(1, 8))):
        position = data.draw(st.integers(0, len(seed) - 1))
        kind = data.draw(st.sampled_from(["set", "insert", "remove", "cut"]))
        if kind == "set":
            seed[position] = data.draw(st.integers(0, 255))
        elif kind == "insert":
            seed[position:position] = data.draw(st.binary(min_size=1, max_size=8))
        elif len(seed) > 20:
            del seed[position : position + data.draw(st.integers(1, 9)) if kind == "remove" else max(position, 10) :]
    path = tmp_path / "fuzz.pkl"
    path.write_bytes(bytes(seed))
    try:
        arrays = read_flame_pickle(path)
    except DataError as error:
        message = str(error)
    else:
        message = f"{path}: "
        assert all(value.dtype.kind in "biuf" for value in arrays.values())
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert not calls


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"<!DOCTYPE html><html><body>Sign in</body></html>", "a web page (HTML), perhaps a login page"),
        (b"\xef\xbb\xbf\n <html lang='en'>", "a web page (HTML), perhaps a login page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:abc\nsize 53023716\n", "a pointer file of Git LFS"),
        (b'{"error": "not logged in"}', "the error message of a server"),
        (b"/annex/objects/SHA256E-s53023716--abc.pkl", "a pointer file of git-annex"),
        (b"PK\x03\x04" + bytes(40), "a zip archive; unpack it"),
        (b"\x1f\x8b" + bytes(40), "a gzip archive; unpack it"),
        (b"", "the file is empty; download it again"),
    ],
    ids=["page", "page with a mark", "lfs", "json", "annex", "zip", "gzip", "empty"],
)
@pytest.mark.parametrize("suffix", ["pkl", "npz"])
def test_what_a_failed_download_leaves_is_named(tmp_path, content, words, suffix):
    """In place of a head model, in plain words with the remedy."""
    path = tmp_path / f"generic_model.{suffix}"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_head_model(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    if suffix == "pkl" or "archive" not in words:
        assert words in message
