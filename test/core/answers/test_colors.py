"""The colour scale runs from cold to hot, whatever it is given."""

import numpy as np

from fus3dmaps_core.answers.colors import similarity_colors


def test_similarity_colors_run_from_cold_to_hot():
    colors = similarity_colors(np.array([0.0, 0.5, 1.0])).astype(int)
    assert colors[0, 2] > colors[0, 1]
    assert colors[1].argmax() == 1
    assert colors[2].argmax() == 0
    assert len(similarity_colors(np.zeros(0))) == 0
    assert len(np.unique(similarity_colors(np.full(4, 3.0)), axis=0)) == 1
