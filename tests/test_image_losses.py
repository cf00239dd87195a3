"""How far images are apart: the derivatives, the pyramid as Burt and Adelson define it, and what it is for."""

import numpy as np
import pytest

from cortado.errors import InputError
from cortado.losses.image_losses import Pyramid, SquaredDifference, psnr, reduce, reduce_transposed

SIZES = [(7, 10), (1, 9), (16, 5), (1, 1)]
LOSSES = [SquaredDifference(), Pyramid(), Pyramid(levels=3), Pyramid(weights=(0.0, 1.5, 4.0))]


def image_of(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """(rows, columns, 3) from 0 to 1"""
    return np.random.default_rng(seed).random((*size, 3))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_adjoint_is_the_limit_of_differences(loss, size):
    image, target, step = image_of(size), image_of(size, 1), 1e-3  # the losses are quadratic: no truncation error
    differences = np.empty_like(image)
    for place in np.ndindex(image.shape):
        shift = np.zeros_like(image)
        shift[place] = step
        differences[place] = (loss.value(image + shift, target) - loss.value(image - shift, target)) / (2.0 * step)
    adjoint = loss.adjoint(image, target)
    assert np.abs(adjoint).max() > 1e-3
    assert np.linalg.norm(adjoint - differences) < 1e-8 * np.linalg.norm(adjoint)


@pytest.mark.parametrize("size", [*SIZES, (33, 64)])
def test_reduce_and_its_transpose(size):
    image = image_of(size)
    next_level = reduce(image)
    bar = image_of(next_level.shape[:2], 1)
    forward, backward = np.sum(bar * next_level), np.sum(reduce_transposed(bar, size) * image)
    assert forward == pytest.approx(backward, rel=1e-13)


def weights_by_hand(size: int, place: int) -> dict[int, float]:
    """Pixel -> weight in the pixel `place` of the next level, of those that are there."""
    if size % 2:
        weights = {2 * place + k: w for k, w in {-2: 1.0, -1: 4.0, 0: 6.0, 1: 4.0, 2: 1.0}.items()}
    else:
        weights = {2 * place + k: w for k, w in {-1: 1.0, 0: 3.0, 1: 3.0, 2: 1.0}.items()}
    return {pixel: weight for pixel, weight in weights.items() if 0 <= pixel < size}


def reduced_by_hand(image: np.ndarray) -> np.ndarray:
    """The next level, pixel by pixel: the weighted mean of the pixels that are there."""
    rows, columns, _ = image.shape
    level = np.zeros(((rows + 1) // 2, (columns + 1) // 2, 3))
    for i, j in np.ndindex(level.shape[:2]):
        total = 0.0
        for row, down in weights_by_hand(rows, i).items():
            for column, right in weights_by_hand(columns, j).items():
                level[i, j] += down * right * image[row, column]
                total += down * right
        level[i, j] /= total
    return level


@pytest.mark.parametrize("size", SIZES)
def test_reduce_is_the_binomial(size):
    image = image_of(size)
    assert np.allclose(reduce(image), reduced_by_hand(image), rtol=1e-14, atol=0.0)


@pytest.mark.parametrize("size", SIZES)
def test_both_ends_of_an_image_are_treated_alike(size):
    image = image_of(size)
    assert np.allclose(reduce(image[::-1, ::-1]), reduce(image)[::-1, ::-1], rtol=1e-14, atol=0.0)


@pytest.mark.parametrize("size", [*SIZES, (33, 64)])
def test_a_constant_stays_constant(size):
    colour = np.array([0.2, 0.5, 0.9])
    assert np.allclose(reduce(np.ones((*size, 3)) * colour), colour, rtol=1e-14, atol=0.0)


def test_a_pyramid_adds_its_levels():
    image, target = image_of((16, 12)), image_of((16, 12), 1)
    squares = []
    for _ in range(4):  # 16 x 12, 8 x 6, 4 x 3, 2 x 2
        squares.append(np.mean((image - target) ** 2))
        image, target = reduce(image), reduce(target)
    assert Pyramid().value(image_of((16, 12)), image_of((16, 12), 1)) == pytest.approx(
        np.dot((1.0, 2.0, 4.0, 8.0), squares)
    )
    weights = (0.5, 0.0, 3.0, 1.0)
    weighted = np.dot(weights, squares)
    assert Pyramid(weights=weights).value(image_of((16, 12)), image_of((16, 12), 1)) == pytest.approx(weighted)


def disc(place: np.ndarray, size: int) -> np.ndarray:
    """(size, size, 3) black, with a white disc of radius 5 at (x, y), whose edge is three pixels wide"""
    rows, columns = np.mgrid[:size, :size]
    inside = np.clip((5.0 - np.hypot(columns - place[0], rows - place[1])) / 3.0 + 0.5, 0.0, 1.0)
    return np.repeat(inside[..., None], 3, axis=2)


def pull(loss, place: np.ndarray, target: np.ndarray, size: int) -> np.ndarray:
    """(2,) the way on which the loss falls fastest when the disc moves"""
    motions = [0.5 * (disc(place + step, size) - disc(place - step, size)) for step in np.eye(2)]
    adjoint = loss.adjoint(disc(place, size), disc(target, size))
    return -np.array([np.sum(adjoint * motion) for motion in motions])


@pytest.mark.parametrize("size", [64, 65, 60])
def test_only_the_pyramid_pulls_a_disc_towards_a_target_far_away(size):
    random, directions = np.random.default_rng(0), []
    while len(directions) < 20:
        place, target = random.uniform(8.0, size - 8.0, (2, 2))
        way = target - place
        distance = np.linalg.norm(way)
        if distance < 16.0:  # they would overlap
            continue
        near_sighted, far_sighted = (pull(loss, place, target, size) for loss in (SquaredDifference(), Pyramid()))
        strength = np.linalg.norm(far_sighted)
        assert np.linalg.norm(near_sighted) < 1e-12 * strength
        directions.append(way @ far_sighted / (distance * strength))
    assert min(directions) > 0.4 and np.mean(directions) > 0.85


def test_noise_ratio():
    target = image_of((4, 5))
    assert psnr(target + 0.1, target) == pytest.approx(20.0)
    assert psnr(target, target) == np.inf


def test_fingerprints_tell_losses_apart():
    assert len({loss.fingerprint for loss in LOSSES}) == len(LOSSES)
    assert Pyramid(weights=[1, 2]).fingerprint == Pyramid(weights=(1.0, 2.0)).fingerprint


@pytest.mark.parametrize(
    "settings", [{"levels": 0}, {"weights": ()}, {"weights": (1.0, -1.0)}, {"weights": (0.0,)}, {"weights": (np.nan,)}]
)
def test_wrong_settings_are_a_sentence(settings):
    with pytest.raises(InputError, match="must be"):
        Pyramid(**settings)


def test_weights_for_other_levels_are_a_sentence():
    with pytest.raises(InputError, match="2 weights for 3 levels"):
        Pyramid(levels=3, weights=(1.0, 1.0))


@pytest.mark.parametrize("loss", LOSSES[:2], ids=str)
@pytest.mark.parametrize(
    "shapes", [((4, 4, 3), (4, 5, 3)), ((4, 4), (4, 4)), ((4, 4, 3), (3,)), ((0, 4, 3), (0, 4, 3))]
)
def test_other_shapes_are_a_sentence(loss, shapes):
    for function in (loss.value, loss.adjoint):
        with pytest.raises(InputError, match="has shape"):
            function(*(np.zeros(shape) for shape in shapes))
