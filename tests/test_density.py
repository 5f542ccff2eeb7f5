"""Density control of face-bound Gaussians: clone, split, prune, and the optimizer's rows."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from tiny import tiny_config

from mgavatar.appearance.density import DensityControl
from mgavatar.appearance.face_gaussians import PARAMETERS, FaceGaussians
from mgavatar.config import DensityConfig
from mgavatar.kernels.rasterize import Rendering

N_FACES = 6
EXTENT = 1.0
FACE_SCALES = torch.full((N_FACES,), 0.1)
HUGE = 2.0
"""A gradient far above the threshold."""


class Scene:
    """One Gaussian on each of six faces, with an optimizer that has moments."""

    def __init__(self, *, seed: int = 0, **config: float) -> None:
        self.config = DensityConfig(**{"gradient": 1.0, "split_scale": 0.03, "min_opacity": 0.005, **config})
        self.gaussians = FaceGaussians(N_FACES, tiny_config().appearance, torch.device("cpu"))
        rng = torch.Generator().manual_seed(1)
        with torch.no_grad():
            self.gaussians.local_means += 0.1 * torch.randn(N_FACES, 3, generator=rng)
            self.gaussians.quats += 0.3 * torch.randn(N_FACES, 4, generator=rng)
            self.gaussians.log_scales.copy_(math.log(0.2) + 0.01 * torch.randn(N_FACES, 3, generator=rng))
        self.optimizer = torch.optim.Adam([{"params": [getattr(self.gaussians, name)]} for name in PARAMETERS])
        for name in PARAMETERS:
            parameter = getattr(self.gaussians, name)
            parameter.grad = torch.rand(parameter.shape, generator=rng)
        self.optimizer.step()
        self.density = DensityControl(self.gaussians, self.config, extent=EXTENT, seed=seed)

    def values(self) -> dict[str, torch.Tensor]:
        """Copies of all rows."""
        return {name: getattr(self.gaussians, name).detach().clone() for name in PARAMETERS}

    def refine(self, gradients: list[float]) -> None:
        """Refine after one view in which each Gaussian had such a gradient."""
        self.density.total = torch.tensor(gradients)
        self.density.seen = torch.ones(len(gradients))
        self.density.refine(self.optimizer, FACE_SCALES)

    def make_large(self, index: int) -> None:
        """Give one Gaussian a size that is split, not cloned."""
        with torch.no_grad():
            self.gaussians.log_scales[index] += math.log(5.0)

    def set_opacity(self, index: int, opacity: float) -> None:
        with torch.no_grad():
            self.gaussians.opacity_logits[index] = math.log(opacity / (1.0 - opacity))


def test_nothing_happens_below_the_threshold():
    """Gaussians whose gradient is small keep their rows, to the bit."""
    scene = Scene()
    before = scene.values()
    scene.refine([0.99] * N_FACES)
    assert scene.gaussians.face_ids.tolist() == list(range(N_FACES))
    for name, value in scene.values().items():
        assert torch.equal(value, before[name]), name


def test_a_small_gaussian_is_cloned_onto_its_face():
    """The copy has every value of its parent and its face; the parent stays."""
    scene = Scene()
    before = scene.values()
    scene.refine([0.0, 0.0, HUGE, 0.0, 0.0, 0.0])
    assert scene.gaussians.face_ids.tolist() == [0, 1, 2, 3, 4, 5, 2]
    for name, value in scene.values().items():
        assert torch.equal(value[:N_FACES], before[name]), name
        assert torch.equal(value[-1], before[name][2]), name


def test_a_large_gaussian_is_split_in_two():
    """It gives way to two on its face, each 1.6 times smaller and moved inside it; the rest stays."""
    scene = Scene()
    scene.make_large(1)
    before = scene.values()
    scene.refine([0.0, HUGE, 0.0, 0.0, 0.0, 0.0])
    assert scene.gaussians.face_ids.tolist() == [0, 2, 3, 4, 5, 1, 1]
    after = scene.values()
    for name in PARAMETERS:
        assert torch.equal(after[name][:5], before[name][[0, 2, 3, 4, 5]]), name
    assert torch.allclose(after["log_scales"][5:], before["log_scales"][1] - math.log(1.6), atol=1e-6)
    for name in ("quats", "opacity_logits"):
        assert torch.equal(after[name][5:], before[name][[1, 1]]), name
    moved = after["local_means"][5:] - before["local_means"][1]
    assert not torch.allclose(moved[0], moved[1])
    assert 0.0 < moved.abs().max() < 5.0 * before["log_scales"][1].exp().max()


def test_the_step_of_a_split_is_drawn_from_the_gaussian():
    """Over many splits, offsets have the Gaussian's standard deviations along its own turned axes."""
    n = 4000
    gaussians = FaceGaussians(n, tiny_config().appearance, torch.device("cpu"))
    sigma = torch.tensor([0.6, 0.2, 0.05])
    quarter = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])  # x to y about z
    with torch.no_grad():
        gaussians.log_scales.copy_(sigma.log().expand(n, 3))
        gaussians.quats.copy_(3.0 * quarter.expand(n, 4))
    optimizer = torch.optim.Adam([getattr(gaussians, name) for name in PARAMETERS])
    config = DensityConfig(gradient=1.0, split_scale=0.01)
    density = DensityControl(gaussians, config, extent=EXTENT, seed=0)
    density.total, density.seen = torch.full((n,), HUGE), torch.ones(n)
    density.refine(optimizer, torch.full((n,), 0.1))
    assert len(gaussians) == 2 * n
    spread = gaussians.local_means.detach().std(0)
    assert torch.allclose(spread, torch.tensor([0.2, 0.6, 0.05]), rtol=0.05)
    assert gaussians.local_means.detach().mean(0).abs().max() < 0.03


def test_split_or_clone_goes_by_the_size_on_the_mesh():
    """The same local scale is large on a large face and small on a small one; the yardstick is the extent."""
    scene = Scene()
    scales = torch.full((N_FACES,), 0.1)
    scales[3] = 0.2
    scene.density.total, scene.density.seen = torch.full((N_FACES,), HUGE), torch.ones(N_FACES)
    scene.density.refine(scene.optimizer, scales)
    ids = scene.gaussians.face_ids
    smaller = scene.gaussians.log_scales.detach().amax(1) < math.log(0.2) - 0.3
    assert ids[smaller].tolist() == [3, 3]
    assert torch.bincount(ids).tolist() == [2] * N_FACES


def test_a_larger_extent_splits_fewer():
    """Nothing but the mesh's diagonal says what is large."""
    for extent, expected in ((1.0, 2), (100.0, 0)):
        scene = Scene()
        scene.make_large(4)
        scene.density.extent = extent
        scene.refine([0.0] * 4 + [HUGE, 0.0])
        smaller = scene.gaussians.log_scales.detach().amax(1) < math.log(1.0) - 0.3
        assert int((smaller & (scene.gaussians.face_ids == 4)).sum()) == expected
        assert int((scene.gaussians.face_ids == 4).sum()) == 2


@pytest.mark.parametrize(("seed", "same"), [(0, True), (1, False)])
def test_the_noise_comes_from_the_seed(seed, same):
    """Two runs with one seed split alike, to the bit; another seed splits otherwise."""
    results = []
    for each in (0, seed):
        scene = Scene(seed=each)
        scene.make_large(0)
        torch.manual_seed(each + 17)
        scene.refine([HUGE] + [0.0] * 5)
        results.append(scene.values()["local_means"])
    assert torch.equal(*results) is same


def test_the_noise_goes_on_where_a_saved_state_left_it():
    """After saving and loading, the next split draws what it would have drawn."""
    scene = Scene()
    scene.make_large(0)
    scene.refine([HUGE] + [0.0] * 5)
    state = {name: value.clone() for name, value in scene.density.state_dict().items()}
    first = scene.density._children(torch.tensor([0]), torch.ones(len(scene.gaussians), dtype=torch.bool))
    other = DensityControl(scene.gaussians, scene.config, extent=EXTENT, seed=99)
    other.load_state_dict(state)
    second = other._children(torch.tensor([0]), torch.ones(len(scene.gaussians), dtype=torch.bool))
    assert torch.equal(first["local_means"], second["local_means"])


def test_faint_gaussians_go_but_no_face_is_left_bare():
    """Below the threshold only the most opaque of a face stays, the first of equals."""
    scene = Scene()
    scene.refine([HUGE, HUGE] + [0.0] * 4)
    assert scene.gaussians.face_ids.tolist() == [0, 1, 2, 3, 4, 5, 0, 1]
    scene.set_opacity(0, 0.001)  # its clone is opaque: goes
    scene.set_opacity(1, 0.001)
    scene.set_opacity(7, 0.002)  # both of face 1 are faint: the better one stays
    scene.set_opacity(5, 0.0001)  # alone on its face: stays
    expected = scene.values()
    scene.refine([0.0] * 8)
    assert scene.gaussians.face_ids.tolist() == [2, 3, 4, 5, 0, 1]
    for name, value in scene.values().items():
        assert torch.equal(value, expected[name][[2, 3, 4, 5, 6, 7]]), name


@pytest.mark.parametrize(("opacity", "stays"), [(0.0051, True), (0.0049, False)])
def test_the_threshold_of_opacity(opacity, stays):
    """Beside an opaque Gaussian on its face, the configured opacity decides."""
    scene = Scene(min_opacity=0.005)
    scene.refine([HUGE] + [0.0] * 5)
    scene.set_opacity(0, opacity)
    scene.refine([0.0] * 7)
    assert (len(scene.gaussians) == 7) is stays


def test_of_equally_faint_ones_the_first_stays():
    """Ties are broken by index, so runs repeat."""
    scene = Scene()
    scene.set_opacity(2, 0.001)
    scene.refine([0.0, 0.0, HUGE, 0.0, 0.0, 0.0])
    assert scene.gaussians.face_ids.tolist() == list(range(N_FACES))


def test_moments_follow_their_rows():
    """Survivors keep what Adam knows of them, newcomers start with nothing, and the next step works."""
    scene = Scene()
    scene.make_large(1)
    old = {name: scene.optimizer.state[getattr(scene.gaussians, name)] for name in PARAMETERS}
    old = {name: {key: state[key].clone() for key in ("exp_avg", "exp_avg_sq", "step")} for name, state in old.items()}
    scene.refine([HUGE, HUGE, 0.0, 0.0, 0.0, 0.0])
    assert scene.gaussians.face_ids.tolist() == [0, 2, 3, 4, 5, 0, 1, 1]
    assert len(scene.optimizer.state) == len(PARAMETERS)
    for name, group in zip(PARAMETERS, scene.optimizer.param_groups, strict=True):
        parameter = getattr(scene.gaussians, name)
        assert group["params"][0] is parameter
        state = scene.optimizer.state[parameter]
        for key in ("exp_avg", "exp_avg_sq"):
            assert state[key].shape == parameter.shape
            assert torch.equal(state[key][:5], old[name][key][[0, 2, 3, 4, 5]]), (name, key)
            assert not state[key][5:].any(), (name, key)
        assert torch.equal(state["step"], old[name]["step"])
        parameter.grad = torch.ones_like(parameter)
    before = scene.values()
    scene.optimizer.step()
    for name, value in scene.values().items():
        assert (value != before[name]).all(), name


@pytest.mark.parametrize(("room", "expected"), [(0, []), (1, [4]), (2, [1, 4]), (6, [0, 1, 2, 3, 4, 5])])
def test_the_largest_gradients_get_the_room_that_is_left(room, expected):
    """Never more than ``max_gaussians``; who wants it most is refined."""
    scene = Scene(max_gaussians=N_FACES + room)
    scene.refine([2.0, 5.0, 3.0, 4.0, 6.0, 2.5])
    added = sorted(scene.gaussians.face_ids[N_FACES:].tolist())
    assert len(scene.gaussians) <= N_FACES + room
    assert added == expected


def test_equal_gradients_do_not_exceed_the_room():
    """Ties at the border of the room are no way around the limit."""
    scene = Scene(max_gaussians=N_FACES + 2)
    scene.refine([HUGE] * N_FACES)
    assert len(scene.gaussians) <= N_FACES + 2


def test_gradients_are_averaged_over_the_views_that_see_a_gaussian():
    """In half image sizes; views that do not show it do not count."""
    scene = Scene()
    seen = torch.tensor([True, False, True, False, True, True])
    rendering = Rendering(torch.zeros(3, 20, 40), torch.zeros(20, 40), torch.zeros(20, 40), seen)
    grads = torch.zeros(N_FACES, 2)
    grads[0] = torch.tensor([0.03, 0.04])
    grads[1] = 100.0
    scene.density.collect(grads, rendering)
    scene.density.collect(torch.zeros(N_FACES, 2), Rendering(*[torch.zeros(20, 40)] * 3, ~seen))
    assert scene.density.total[0].item() == pytest.approx(math.hypot(0.03 * 20, 0.04 * 10))
    assert scene.density.total[1].item() == 0.0
    assert scene.density.seen.tolist() == [1.0] * N_FACES


def test_the_mean_decides_not_the_sum():
    """Four views with three quarters of the threshold each refine nothing; one with twice as much does."""
    scene = Scene()
    scene.density.total = torch.tensor([3.0, 0.0, 0.0, 6.0, 1.01, 0.0])
    scene.density.seen = torch.tensor([4.0, 0.0, 0.0, 4.0, 1.0, 9.0])
    scene.density.refine(scene.optimizer, FACE_SCALES)
    assert scene.gaussians.face_ids.tolist() == [*range(N_FACES), 3, 4]


def test_refining_forgets_what_was_collected():
    """The next round starts anew, with a row for every Gaussian there now is."""
    scene = Scene()
    scene.refine([HUGE] * N_FACES)
    assert scene.density.total.shape == scene.density.seen.shape == (2 * N_FACES,)
    assert not scene.density.total.any()
    assert not scene.density.seen.any()


def test_when_it_is_due():
    """Every so often between start and stop, both included."""
    density = Scene(start=10, stop=30, every=10).density
    assert [i for i in range(50) if density.due(i - 1, i)] == [10, 20, 30]
    density = Scene(start=11, stop=39, every=10).density
    assert [i for i in range(50) if density.due(i - 1, i)] == [20, 30]


def test_when_it_is_due_in_a_schedule_of_another_length():
    """Each round once, at the first step that reaches it, whether steps are a quarter or several iterations long."""
    density = Scene(start=10, stop=30, every=10).density
    for step in (0.25, 0.3, 0.99, 3.7, 7.0):
        places = [step * i for i in range(int(50 / step) + 1)]
        due = [now for before, now in itertools.pairwise(places) if density.due(before, now)]
        assert [now // 10 * 10 for now in due] == [10, 20, 30]
        assert all(now % 10 < step + 1e-9 for now in due)
