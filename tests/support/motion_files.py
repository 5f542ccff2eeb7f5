"""Writers of motion in the formats of other programs, from one made-up performance; no code is shared with readers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Performance:
    """FLAME parameters of T frames, rotation vectors in radians: what every writer writes as far as its format can."""

    expr: np.ndarray
    root: np.ndarray
    neck: np.ndarray
    jaw: np.ndarray
    left_eye: np.ndarray
    right_eye: np.ndarray
    place: np.ndarray

    @property
    def eyes(self) -> np.ndarray:
        return np.hstack([self.left_eye, self.right_eye])


def performance(n_frames: int = 7, *, n_expr: int = 100, seed: int = 5) -> Performance:
    """A performance of random, smooth enough numbers."""
    rng = np.random.default_rng(seed)

    def joint(scale: float) -> np.ndarray:
        return rng.normal(0.0, scale, (n_frames, 3))

    return Performance(
        rng.normal(0.0, 0.5, (n_frames, n_expr)),
        joint(0.2),
        joint(0.1),
        joint(0.05),
        joint(0.1),
        joint(0.1),
        joint(0.05),
    )


def write_emoca(path: Path, made: Performance) -> Path:
    """EMOCA's and DECA's codes: 50 expressions, a pose of root and jaw, 100 shape coefficients, and pictures' codes."""
    n = len(made.expr)
    np.savez(
        path,
        shapecode=np.zeros((n, 100), np.float32),
        expcode=made.expr[:, :50].astype(np.float32),
        posecode=np.hstack([made.root, made.jaw]).astype(np.float32),
        detailcode=np.zeros((n, 128), np.float32),
    )
    return path


def write_smirk(path: Path, made: Performance) -> Path:
    """SMIRK's outputs, as its users save them: root and jaw apart, and two eyelids."""
    np.savez(
        path,
        expression_params=made.expr[:, :50].astype(np.float32),
        pose_params=made.root.astype(np.float32),
        jaw_params=made.jaw.astype(np.float32),
        eyelid_params=np.zeros((len(made.expr), 2), np.float32),
        shape_params=np.zeros((len(made.expr), 300), np.float32),
    )
    return path


def write_diffposetalk(path: Path, made: Performance) -> Path:
    """DiffPoseTalk's coefficients: 50 expressions, a pose of root and jaw, one identity."""
    pose = np.concatenate([made.root, made.jaw], axis=-1)
    np.savez(path, exp=made.expr[:, :50].astype(np.float32), pose=pose.astype(np.float32), shape=np.zeros(100))
    return path


ARKIT_ORDER = """
    EyeBlinkLeft EyeLookDownLeft EyeLookInLeft EyeLookOutLeft EyeLookUpLeft EyeSquintLeft EyeWideLeft
    EyeBlinkRight EyeLookDownRight EyeLookInRight EyeLookOutRight EyeLookUpRight EyeSquintRight EyeWideRight
    JawForward JawRight JawLeft JawOpen MouthClose MouthFunnel MouthPucker MouthRight MouthLeft MouthSmileLeft
    MouthSmileRight MouthFrownLeft MouthFrownRight MouthDimpleLeft MouthDimpleRight MouthStretchLeft
    MouthStretchRight MouthRollLower MouthRollUpper MouthShrugLower MouthShrugUpper MouthPressLeft
    MouthPressRight MouthLowerDownLeft MouthLowerDownRight MouthUpperUpLeft MouthUpperUpRight BrowDownLeft
    BrowDownRight BrowInnerUp BrowOuterUpLeft BrowOuterUpRight CheekPuff CheekSquintLeft CheekSquintRight
    NoseSneerLeft NoseSneerRight TongueOut
""".split()  # noqa: SIM905  shorter to read than a list
"""The blendshapes as the phone's app writes them."""


def camel(name: str) -> str:
    """ARKit's own spelling of a name of the app."""
    return name[0].lower() + name[1:]


@dataclass(frozen=True)
class Face:
    """Weights by ARKit's own names, shape [T] each, and the turns of head and eyes in degrees: to the subject's left,
    downwards, and with the left ear up.
    """

    weights: dict[str, np.ndarray]
    head: np.ndarray
    left_eye: np.ndarray
    right_eye: np.ndarray

    def __len__(self) -> int:
        return len(self.head)


def face(n_frames: int = 12, *, seed: int = 2) -> Face:
    """A face of smooth weights; the head turns by up to 30 degrees."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 2.0, n_frames)[:, None]
    waves = 0.5 + 0.5 * np.sin(time * rng.uniform(0.5, 3.0, 52) + rng.uniform(0.0, 6.0, 52))
    turns = [np.sin(time + rng.uniform(0.0, 6.0, 3)) * [limit, limit / 2, limit / 3] for limit in (30.0, 12.0, 12.0)]
    return Face({camel(name): wave for name, wave in zip(ARKIT_ORDER, waves.T, strict=True)}, *turns)


def timecode(frame: float, rate: int, start: str = "10:21:33") -> str:
    """The app's time code of a frame after a start of whole seconds; days have 24 hours."""
    hours, minutes, seconds = map(int, start.split(":"))
    total = (hours * 60 + minutes) * 60 + seconds
    whole, part = divmod(frame, rate)
    total = (total + int(whole)) % 86400
    return f"{total // 3600:02d}:{total // 60 % 60:02d}:{total % 60:02d}:{int(part):02d}.{int(part % 1 * 1000):03d}"


def write_live_link(
    path: Path,
    made: Face,
    *,
    rate: int = 60,
    start: str = "10:21:33",
    frames: list[float] | None = None,
    count: str = "BlendShapeCount",
    order: list[str] | None = None,
    degrees: bool = False,
    angles: bool = True,
    lost: tuple[int, ...] = (),
) -> Path:
    """A take of the Live Link Face app: weights with eight digits, angles in radians or degrees."""
    names = order or ARKIT_ORDER
    parts = ("Head", "LeftEye", "RightEye")
    turns = [f"{part}{angle}" for part in parts for angle in ("Yaw", "Pitch", "Roll")] if angles else []
    lines = [",".join(["Timecode", count, *names, *turns])]
    unit = 1.0 if degrees else np.pi / 180.0
    for t in range(len(made)):
        code = timecode(frames[t] if frames else t, rate, start)
        if t in lost:
            lines.append(f"{code},0")
            continue
        values = [made.weights[camel(name)][t] for name in names]
        if angles:
            values += [unit * angle for part in (made.head, made.left_eye, made.right_eye) for angle in part[t]]
        lines.append(",".join([code, "61", *(f"{value:.8f}" for value in values)]))
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    return path


def write_lam(path: Path, made: Face, *, fps: float = 30.0, times: bool = True) -> Path:
    """LAM's and LAM_Audio2Expression's JSON."""
    names = sorted(made.weights)
    frames = []
    for t in range(len(made)):
        frame = {"weights": [float(made.weights[name][t]) for name in names], "rotation": []}
        frames.append({**frame, "time": t / fps} if times else frame)
    metadata = {"fps": fps, "frame_count": len(made), "blendshape_names": names}
    path.write_text(json.dumps({"names": names, "metadata": metadata, "frames": frames}))
    return path


def write_audio2face_csv(path: Path, made: Face, *, fps: float = 30.0) -> Path:
    """``animation_frames.csv`` of Audio2Face-3D: a first column without a name, times in seconds."""
    names = ARKIT_ORDER[:-1]
    header = ["", "timeCode", *(f"blendShapes.{name}" for name in names)]
    return _write_rows(path, header, made, names, lambda t: [str(t), f"{t / fps:.6f}"])


def write_audio2face_output(path: Path, made: Face, *, fps: float = 60.0) -> Path:
    """``output_blendshape.csv`` of Audio2Face-3D's samples: ``timecode`` in seconds and plain names."""
    return _write_rows(path, ["timecode", *ARKIT_ORDER], made, ARKIT_ORDER, lambda t: [f"{t / fps:.4f}"])


def _write_rows(path: Path, header: list[str], made: Face, names: list[str], first: Callable[[int], list[str]]) -> Path:
    rows = [[*first(t), *(f"{made.weights[camel(name)][t]:.7f}" for name in names)] for t in range(len(made))]
    path.write_text("".join(",".join(row) + "\n" for row in [header, *rows]))
    return path


def write_audio2face_json(path: Path, made: Face, *, fps: float = 30.0) -> Path:
    """Omniverse's JSON of blendshape weights."""
    names = [camel(name) for name in ARKIT_ORDER]
    matrix = [[float(made.weights[name][t]) for name in names] for t in range(len(made))]
    content = {"exportFps": fps, "trackPath": "a.wav", "numPoses": 52, "numFrames": len(made)}
    path.write_text(json.dumps({**content, "facsNames": names, "weightMat": matrix}))
    return path


def turn_matrix(degrees: np.ndarray) -> np.ndarray:
    """The rotation by yaw, pitch and roll of a ``Face``, written out, x to the subject's left, y up, z forward."""
    (sy, sp, sr), (cy, cp, cr) = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    yaw = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])  # forward goes to the left
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])  # forward goes down
    roll = np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]])  # the left goes up
    return yaw @ pitch @ roll


def write_mediapipe(
    path: Path,
    made: Face,
    *,
    style: Literal["categories", "python", "javascript", "lines"] = "python",
    matrices: bool = True,
    fps: float = 30.0,
    lost: tuple[int, ...] = (),
) -> Path:
    """Results of FaceLandmarker: ``_neutral`` first, no ``tongueOut``, in the ways that programs dump them."""
    frames = []
    for t in range(len(made)):
        scores = [("_neutral", 1e-6), *((name, float(made.weights[name][t])) for name in sorted(made.weights))][:-1]
        key = "categoryName" if style == "javascript" else "category_name"
        faces = [[{"index": i, "score": s, key: name, "display_name": ""} for i, (name, s) in enumerate(scores)]]
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn_matrix(made.head[t]), (1.5, -2.0, -45.0)
        stamp = round(1000.0 * t / fps)
        if t in lost:
            faces = []
        if style == "categories":
            frames.append(faces[0] if faces else [])
        elif style == "javascript":
            entry = {"faceBlendshapes": [{"categories": face, "headIndex": -1, "headName": ""} for face in faces]}
            data = {"rows": 4, "columns": 4, "data": matrix.T.ravel().tolist()}  # column after column
            frames.append({**entry, "facialTransformationMatrixes": [data] if faces else [], "timestampMs": stamp})
        else:
            frames.append({"timestamp_ms": stamp, "face_blendshapes": faces})
            if matrices:
                frames[-1]["facial_transformation_matrixes"] = [matrix.tolist()] if faces else []
    path.write_text("\n".join(map(json.dumps, frames)) + "\n" if style == "lines" else json.dumps(frames))
    return path


def matrix_of(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula, written out."""
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def two_rows(vector: np.ndarray) -> np.ndarray:
    """A rotation in six numbers, as pytorch3d writes it: the first two rows of its matrix."""
    return matrix_of(vector)[:2].ravel()


FLIP = np.diag([1.0, -1.0, -1.0])
"""From camera axes of OpenGL to those of OpenCV, and back."""


def write_cap4d(path: Path, made: Performance, *, camera: bool = True) -> Path:
    """CAP4D's fit: FLAME in its own axes about the origin, exchanged into OpenCV's, seen by a camera somewhere."""
    n = len(made.expr)
    extrinsics = np.eye(4)
    if camera:
        extrinsics[:3, :3], extrinsics[:3, 3] = matrix_of(np.array([0.1, 2.9, -0.3])), (0.2, 0.1, 0.9)
    turn, place = FLIP @ extrinsics[:3, :3].T @ FLIP, -FLIP @ extrinsics[:3, :3].T @ extrinsics[:3, 3]
    world = [turn @ matrix_of(vector) for vector in made.root]
    rot = np.stack([Rotation.from_matrix(matrix).as_rotvec() for matrix in world])
    expr = made.expr[:, :65].copy()
    expr[:, 64] = 0.8
    arrays = {"expr": expr, "rot": rot, "tra": made.place @ turn.T + place, "eye_rot": made.left_eye}
    arrays = {key: value.astype(np.float32) for key, value in arrays.items()}
    lens = {key: np.full((1, 1), 2.0) for key in ("fx", "fy", "cx", "cy")}
    if camera:
        arrays["extr"] = extrinsics[None].astype(np.float32)
    np.savez(path, shape=np.zeros(150), **arrays, neck_rot=np.zeros((n, 3)), **lens, fps=30.0)
    return path


def write_nersemble(path: Path, made: Performance, *, scale: float = 1.7) -> Path:
    """The benchmark's tracking: Euler angles beside matrices, a scale for the whole head."""
    matrices = np.stack([matrix_of(vector) for vector in made.root])
    np.savez(
        path,
        shape=np.zeros((1, 300)),
        expression=made.expr,
        rotation=Rotation.from_matrix(matrices).as_euler("xyz"),
        rotation_matrices=matrices,
        translation=scale * made.place,
        jaw=made.jaw,
        neck=made.neck,
        eyes=made.eyes,
        frames=np.arange(len(made.expr)),
        scale=np.full((1, 1), scale),
    )
    return path


def write_metrical(folder: Path, made: Performance, *, without: tuple[int, ...] = ()) -> Path:
    """metrical-tracker's frames: the head stands still, and OpenCV's camera moves; numbers have five digits."""
    (folder / "checkpoint").mkdir(parents=True)
    for t in set(range(len(made.expr))) - set(without):
        flame = {
            "exp": made.expr[t][None].astype(np.float32),
            "shape": np.zeros((1, 300), np.float32),
            "eyes": np.concatenate([two_rows(made.left_eye[t]), two_rows(made.right_eye[t])])[None],
            "jaw": two_rows(made.jaw[t])[None],
            "eyelids": np.full((1, 2), 0.3, np.float32),
        }
        opencv = {"R": (FLIP @ matrix_of(made.root[t]))[None], "t": (FLIP @ made.place[t])[None], "K": np.eye(3)[None]}
        content = {"flame": flame, "opencv": opencv, "img_size": np.array([512, 512]), "frame_id": f"{t:05d}"}
        torch.save(content, folder / f"checkpoint/{t:05d}.frame")
    return folder


def write_pixel3dmm(folder: Path, made: Performance) -> Path:
    """Pixel3DMM's frames: joints in six numbers, then R and t about the origin, then a still camera of OpenGL."""
    folder.mkdir(parents=True)
    base, shift = matrix_of(np.array([0.05, 0.3, -0.1])), np.array([0.1, -0.2, -1.5])
    for t in range(len(made.expr)):
        turn = base.T @ matrix_of(made.root[t])
        flame = {
            "exp": made.expr[t][None].astype(np.float32),
            "eyes": np.concatenate([two_rows(made.left_eye[t]), two_rows(made.right_eye[t])])[None],
            "jaw": two_rows(made.jaw[t])[None],
            "neck": two_rows(made.neck[t])[None],
            "eyelids": np.zeros((1, 2), np.float32),
            "R": turn[:2].reshape(1, 6),
            "R_rotation_matrix": turn[None],
            "t": (base.T @ (made.place[t] - shift))[None],
        }
        camera = {"R_base_0": base[None], "t_base_0": shift[None], "fl": np.ones((1, 1)), "pp": np.zeros((1, 2))}
        torch.save({"flame": flame, "camera": camera, "img_size": np.array([256, 256])}, folder / f"{t:05d}.frame")
    return folder


def write_flame_head_tracker(folder: Path, made: Performance, *, without: tuple[int, ...] = ()) -> Path:
    """flame-head-tracker's frames: camera to world in Euler angles, pictures, and nothing where no face was found."""
    folder.mkdir()
    for t in set(range(len(made.expr))) - set(without):
        camera = matrix_of(made.root[t]).T
        # R = Rz(c2) Ry(c0) Rx(c1), solved from the elements of the matrix
        c0, c1, c2 = -np.arcsin(camera[2, 0]), np.arctan2(*camera[2, [1, 2]]), np.arctan2(camera[1, 0], camera[0, 0])
        cam = np.array([c0, c1, c2, *(-camera @ made.place[t])])
        np.savez(
            folder / f"{t}.npz",
            shape=np.zeros((1, 300), np.float32),
            exp=made.expr[t][None],
            jaw_pose=made.jaw[t][None],
            eye_pose=made.eyes[t][None],
            cam=cam[None],
            fov=np.array([20.0]),
            K=np.eye(3)[None],
            img=np.zeros((1, 64, 64, 3), np.uint8),
            blendshape_scores=np.zeros((1, 52)),
        )
    return folder


def write_artalk(path: Path, made: Performance) -> Path:
    """ARTalk's motion: one tensor."""
    torch.save(torch.tensor(np.hstack([made.expr, made.root, made.jaw]), dtype=torch.float32), path)
    return path
