import numpy as np

from cosp.matching.refit import refit_camera, refit_sigma_mm

from .conftest import moved


def control(camera, rng, count=300):
    film_mm = rng.uniform(-1, 1, (count, 2)) * (camera.half_length_mm, camera.half_width_mm)
    return film_mm, camera.locate(film_mm, rng.uniform(200, 3000, count))


def lattice(camera):
    return np.stack(np.meshgrid(np.linspace(-195, 195, 15), np.linspace(-27, 27, 3)), -1).reshape(-1, 2)


def test_refit_finds_the_camera_from_a_displaced_start(camera):
    film_mm, ground = control(camera, np.random.default_rng(1))
    start = moved(camera, 2000.0, -1500.0)
    fitted = refit_camera(start, film_mm, ground, np.full(len(film_mm), 0.01)).camera
    points = lattice(camera)
    error = fitted.project(camera.locate(points, 1000.0)) - points
    assert np.abs(error).max() < 5e-4


def test_refit_survives_a_third_of_gross_errors(camera):
    rng = np.random.default_rng(2)
    film_mm, ground = control(camera, rng)
    wrong = rng.random(len(film_mm)) < 0.33
    film_mm = film_mm + 0.01 * rng.standard_normal(film_mm.shape)
    film_mm[wrong] += rng.uniform(-3, 3, (wrong.sum(), 2))
    found = refit_camera(moved(camera, 500.0, 800.0), film_mm, ground, np.full(len(film_mm), 0.01))
    points = lattice(camera)
    error = found.camera.project(camera.locate(points, 1000.0)) - points
    assert np.sqrt((error**2).mean()) < 0.01
    assert found.weights[~wrong].mean() > 0.6
    assert np.median(found.weights[wrong]) < 0.05


def test_few_points_leave_the_camera_where_it_was_expected(camera):
    film_mm, ground = control(camera, np.random.default_rng(3), count=4)
    fitted = refit_camera(camera, film_mm, ground, np.full(4, 0.1)).camera
    np.testing.assert_allclose(fitted.parameters(), camera.parameters(), atol=1e-4)


def test_sigma_says_how_far_a_fit_to_one_end_misses_the_other(camera):
    rng = np.random.default_rng(7)
    film_mm, ground = control(camera, rng, 120)
    near = film_mm[:, 0] < 0
    film_mm, ground, sigma = film_mm[near], ground[near], np.full(near.sum(), 0.05)
    elsewhere = camera.locate(lattice(camera), 1000.0)
    errors = []
    for _ in range(20):
        noisy = film_mm + sigma[:, None] * rng.standard_normal(film_mm.shape)
        fitted = refit_camera(camera, noisy, ground, sigma).camera
        errors.append(fitted.project(elsewhere) - lattice(camera))
    said = refit_sigma_mm(camera, ground, sigma, elsewhere)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / said
    assert 0.6 < np.median(ratio) < 1.4
    far = lattice(camera)[:, 0] > 150
    assert said[far].max() > 5 * said[~far].min()
