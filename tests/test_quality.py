"""FLIP beside PSNR: limits, order and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from kernels.quality import flip, psnr
from traces.errors import InputError

MASK = np.ones((24, 32), bool)


def a_picture(seed=0):
    return np.random.default_rng(seed).random((24, 32, 3), np.float32)


def test_equal_pictures_have_no_error():
    assert flip(a_picture(), a_picture(), MASK) == 0


def test_black_against_white_is_nearly_the_largest_error():
    assert 0.9 < flip(np.zeros_like(a_picture()), np.ones_like(a_picture()), MASK) <= 1


def test_more_noise_is_a_larger_error_by_both_measures():
    picture = np.full((24, 32, 3), 0.5, np.float32)
    noise = a_picture(1) - 0.5
    errors = [flip(picture + share * noise, picture, MASK) for share in (0.05, 0.2, 0.8)]
    values = [psnr(picture + share * noise, picture, MASK) for share in (0.05, 0.2, 0.8)]
    assert errors == sorted(errors) and values == sorted(values, reverse=True)


def test_only_the_masks_pixels_count():
    changed = a_picture()
    changed[:, 20:] = 0
    left = np.zeros_like(MASK)
    # FLIP's filters reach a few pixels over the border of the change.
    left[:, :4] = True
    assert flip(changed, a_picture(), left) < 1e-3 < flip(changed, a_picture(), MASK)


@pytest.mark.parametrize("measure", (flip, psnr))
def test_shapes_that_differ_and_empty_masks_are_refused(measure):
    with pytest.raises(InputError, match="do not match"):
        measure(a_picture(), a_picture()[:-1], MASK)
    with pytest.raises(InputError, match="the mask is empty"):
        measure(a_picture(), a_picture(), ~MASK)
