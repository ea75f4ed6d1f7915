from synthetic_run import make_run

import tofssm_drake.metrics.metric_columns as mut
from tofssm_drake.metrics.run_metrics import calc_run_metrics
from tofssm_drake.recording.columns import UNITS

# How a metric's name ends, by unit.
_ENDS = {
    "_m": "m",
    "_s": "s",
    "_mps": "m/s",
    "_m2_per_mps": "m s",
    "_per_min": "1/min",
}


def test_each_metric_is_described():
    metrics = set(calc_run_metrics(make_run()))
    assert metrics <= set(mut.METRIC_COLUMNS)


def test_units():
    for name, column in mut.METRIC_COLUMNS.items():
        assert column.unit in UNITS
        assert column.meaning
        ends = [unit for end, unit in _ENDS.items() if name.endswith(end)]
        assert column.unit == (ends[-1] if ends else "1"), name
