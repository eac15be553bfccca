"""Which photos may show the same."""

import numpy as np

from sc3d.geometry.shortlist import neighbors_by_look, neighbors_by_place, neighbors_in_order


def test_neighbors_in_order_and_by_place_are_those_of_a_slow_search():
    assert neighbors_in_order(4, 2) == {(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)}
    places = np.random.default_rng(0).uniform(0, 100, (30, 3))
    rows = np.random.default_rng(1).permutation(60)[:30].tolist()
    slow = set()
    for row, place in zip(rows, places, strict=True):
        near = np.argsort(np.linalg.norm(places - place, axis=1))[1:5]
        slow |= {tuple(sorted((row, rows[other]))) for other in near}
    assert neighbors_by_place(dict(zip(rows, places, strict=True)), 4) == slow
    assert neighbors_by_place({3: places[0]}, 4) == set()


def test_neighbors_by_look_share_features_and_are_the_same_every_time():
    rng = np.random.default_rng(2)
    kinds = np.repeat(2 * rng.normal(size=(30, 128)), 10, axis=0)  # of things, which all sites have
    sites = (kinds + rng.normal(size=(5, 300, 128))).astype(np.float32)
    photos = []
    for row in range(40):
        some = sites[row % 5][rng.permutation(300)[:150]]
        some = some + 0.1 * rng.normal(size=some.shape).astype(np.float32)
        photos.append(some / np.linalg.norm(some, axis=1, keepdims=True))
    found = neighbors_by_look(photos, 7)
    assert found == {
        (one, other) for one in range(40) for other in range(one + 1, 40) if (other - one) % 5 == 0
    }
    photos[3] = photos[3][:0]  # a photo without features
    assert found - neighbors_by_look(photos, 7) <= {rows for rows in found if 3 in rows}
    assert neighbors_by_look([photos[3]] * 3, 7) == set()
