import numpy as np

from cosp.matching.kernels import highest_sums


def test_the_highest_sum_of_shifted_surfaces_is_what_padding_and_adding_give():
    rng = np.random.default_rng(0)
    surfaces = rng.standard_normal((3, 12, 15)).astype(np.float32)
    offsets = rng.integers(-18, 18, (6, 3, 2))
    offsets[0] = 0
    padded = np.pad(surfaces, ((0, 0), (20, 20), (20, 20)))
    sums = np.array(
        [
            sum(padded[b, 20 + down : 32 + down, 20 + right : 35 + right] for b, (down, right) in enumerate(guess))
            for guess in offsets
        ]
    )
    highest, guess = highest_sums(surfaces, offsets)
    np.testing.assert_allclose(highest, sums.max(axis=0), atol=1e-5)
    np.testing.assert_array_equal(guess, sums.argmax(axis=0))
