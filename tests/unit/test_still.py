import numpy as np
import pytest

from vdms_rt.measure.still import is_still, noise_px

RNG = np.random.default_rng(7)


def centres(noise: float, motion_px: np.ndarray | float = 0.0, pictures: int = 30) -> np.ndarray:
    rest = np.array([[200.0, 150], [500, 150], [200, 350], [500, 350]])
    out = rest + RNG.normal(0, noise, (pictures, 4, 2))
    out[:, :, 0] += np.broadcast_to(motion_px, (pictures,))[:, None]
    return out


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.02])
def test_a_marker_at_rest_is_still(noise: float) -> None:
    assert sum(is_still(centres(noise), 0.3) for _ in range(200)) >= 198


@pytest.mark.parametrize("amplitude_px", [0.2, 1.0, 20.0])
@pytest.mark.parametrize("frequency_hz", [0.3, 1.0, 4.7])
def test_a_harmonic_marker_is_not(amplitude_px: float, frequency_hz: float) -> None:
    t_s = np.arange(30) / 29.97
    phases = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    motions = [amplitude_px * np.sin(2 * np.pi * frequency_hz * t_s + p) for p in phases]
    assert not any(is_still(centres(0.01, m), 0.3) for m in motions)


def test_a_slow_drift_is_not_still() -> None:
    assert not any(is_still(centres(0.004, np.linspace(0, 0.05, 30)), 0.3) for _ in range(50))


def test_one_circle_that_moves_is_enough() -> None:
    moving = centres(0.004)
    moving[:, 2, 1] += np.linspace(0, 0.5, 30)
    assert not is_still(moving, 0.3)


def test_the_first_picture_alone_counts_as_still() -> None:
    assert is_still(centres(0.01, pictures=1), 0.3)


def test_noise_is_that_of_one_coordinate() -> None:
    assert noise_px(centres(0.02, pictures=3000)) == pytest.approx(0.02, rel=0.02)
    slow = 5 * np.sin(np.arange(3000) / 500)
    assert noise_px(centres(0.02, slow, pictures=3000)) == pytest.approx(0.02, rel=0.05)
