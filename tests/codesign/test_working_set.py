"""Which plants of a set stay in the working set: theorems of the rule, on random rows."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ccd_casadi.codesign.working_set import WorkingSetOptions, holding

EQUAL, NEAR = WorkingSetOptions().equal, WorkingSetOptions().near
ROW = st.tuples(st.integers(0, 7), st.integers(0, 2), st.floats(-1.0, 1.0), st.floats(-NEAR, NEAR))


def columns(rows):
    rows = sorted(rows, key=lambda row: -row[3])
    plant, gain, log_v, value = (np.array(column) for column in zip(*rows, strict=True))
    return plant, [(int(g),) for g in gain], log_v, value


@given(st.lists(ROW, min_size=1, max_size=60))
def test_every_row_lies_below_a_near_one_of_a_plant_that_stays(rows):
    plant, gain, log_v, value = columns(rows)
    kept = holding(plant, gain, log_v, value)
    stays = np.isin(plant, list(kept))
    assert plant[0] in kept
    for row in range(len(plant)):
        alike = stays & np.array([one == gain[row] for one in gain])
        near = alike & ((np.abs(log_v - log_v[row]) < NEAR) | (np.arange(len(plant)) == row))
        assert (value[near] >= value[row] - EQUAL).any()


@given(st.lists(ROW, min_size=1, max_size=30))
def test_a_plant_with_rows_of_another_goes(rows):
    plant, gain, log_v, value = columns(rows)
    alone = holding(plant, gain, log_v, value)
    doubled = [(p, *rest) for p, *rest in zip(plant.tolist(), [g[0] for g in gain],
               log_v.tolist(), value.tolist(), strict=True)]  # fmt: skip
    doubled += [(p + 8, g, v, c - 0.5 * EQUAL) for p, g, v, c in doubled]
    assert holding(*columns(doubled)) == alone
