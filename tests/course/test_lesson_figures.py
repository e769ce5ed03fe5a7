"""Figures of the lessons."""

import numpy as np

from stad_course.figures import plot_mixture


def test_the_density_of_a_mixture_integrates_to_one_and_widens_with_the_temperature():
    figure = plot_mixture(np.log([0.7, 0.3]), np.array([-1.0, 2.0]), np.log([0.5, 1.0]), [1.0, 4.0])
    widths = []
    for line in figure.axes[0].lines:
        z, density = line.get_data()
        assert abs(np.trapezoid(density, z) - 1) < 0.01
        middle = np.trapezoid(z * density, z)
        widths.append(np.trapezoid((z - middle) ** 2 * density, z))
    weights = (
        np.array([0.7, 0.3]) ** 0.25 / (np.array([0.7, 0.3]) ** 0.25).sum()
    )  # as Mixture.sample has it
    spread = weights @ np.array([-1.0, 2.0]) ** 2 - (weights @ np.array([-1.0, 2.0])) ** 2
    assert np.allclose(
        widths, [0.7 * 0.25 + 0.3 + 9 * 0.21, weights @ [1.0, 4.0] + spread], rtol=0.02
    )
