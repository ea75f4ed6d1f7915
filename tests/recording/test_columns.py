"""Every column of every table says what it is."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.messages import LinkSignal, Reading
import tofssm_drake.recording.columns as mut
from tofssm_drake.recording.samples import (
    Samples,
    read_samples,
    write_samples,
)

_EARLIER = Path(__file__).parent / "earlier_run"
_EXAMPLES = Path(__file__).parents[2] / "examples"

_CELLS = {
    "default": {},
    "lidar": {"name": "PlanarLidar"},
    "motion capture": {"name": "MotionCapture"},
    "own law": {"filename": _EXAMPLES / "my_law.yaml"},
}


def simulate(*, filename=None, name="Default"):
    scenario = load_scenario(
        filename=filename, name=name, text="{simulation_duration: 0.2}"
    )
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not run.advance().finished:
        pass
    return run.make_samples()


@pytest.fixture(scope="module", params=_CELLS)
def run(request, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        # The examples' modules are looked for at the repository's root.
        patch.syspath_prepend(_EXAMPLES.parent)
        samples = simulate(**_CELLS[request.param])
    folder = tmp_path_factory.mktemp("run")
    write_samples(samples, folder)
    return samples, folder


def test_each_column_has_a_unit_and_a_meaning(run):
    _, folder = run
    for name in ("samples.parquet", "scans.parquet"):
        for field in pq.read_schema(folder / name):
            column = mut.read_description(field)
            assert column.unit in mut.UNITS, field.name
            assert column.meaning, field.name


def test_codes_are_categories_and_come_back(run):
    samples, folder = run
    table = pq.read_table(folder / "samples.parquet")
    for field in table.schema:
        if mut.read_description(field).codes:
            assert pa.types.is_dictionary(field.type), field.name
    states = table["robot_state"].to_pylist()
    assert set(states) <= {"stop", "reduced", "normal"}
    assert states[0] == "stop"
    back = read_samples(folder)
    for name, values in samples.column.items():
        np.testing.assert_array_equal(back[name], values)
        assert back[name].dtype == values.dtype
    for ring, scan in samples.scan.items():
        for name, values in scan.items():
            np.testing.assert_array_equal(back.scan[ring][name], values)
            assert back.scan[ring][name].dtype == values.dtype


def make_samples(**column):
    return Samples(
        column={"t": np.arange(2) * 0.008, **column},
        metadata={"rings": ["a", "a_b"]},
    )


class TestCodes:
    def test_none_is_null(self, tmp_path):
        samples = make_samples(deciding_link=np.array([-1, 1], dtype=np.int8))
        write_samples(samples, tmp_path)
        table = pq.read_table(tmp_path / "samples.parquet")
        assert table["deciding_link"].to_pylist() == [None, "a_b"]
        back = read_samples(tmp_path)["deciding_link"]
        assert back.tolist() == [-1, 1]

    @pytest.mark.parametrize("bodies", [["arm"], ["arm", "arm"], []])
    def test_without_a_name_for_each_they_stay_numbers(self, tmp_path, bodies):
        samples = make_samples(robot_body=np.array([0, 1], dtype=np.int16))
        samples.metadata["robot_bodies"] = bodies
        write_samples(samples, tmp_path)
        table = pq.read_table(tmp_path / "samples.parquet")
        assert table["robot_body"].to_pylist() == [0, 1]
        assert read_samples(tmp_path)["robot_body"].tolist() == [0, 1]

    def test_other_order_of_the_names(self, tmp_path):
        """Other programs write only the names that occur, as they come."""
        samples = make_samples(robot_state=np.array([2, 0], dtype=np.int8))
        write_samples(samples, tmp_path)
        path = tmp_path / "samples.parquet"
        table = pq.read_table(path)
        field = table.schema.field("robot_state")
        names = pa.array(table["robot_state"].to_pylist()).dictionary_encode()
        pq.write_table(table.set_column(1, field, names.cast(field.type)), path)
        assert read_samples(tmp_path)["robot_state"].tolist() == [2, 0]


class TestEarlierRecord:
    """A record of before columns had units, with codes as numbers."""

    def test_is_read(self):
        samples = read_samples(_EARLIER)
        assert samples.rings == ("base", "elbow", "tool")
        assert set(samples["robot_state"].tolist()) == {0, 1, 2}
        assert samples["robot_body"].dtype == np.int16
        reading = samples.scan["tool"]["reading"]
        assert reading.shape[1] == 8
        assert set(np.unique(reading)) <= set(Reading)

    def test_written_again_it_has_units(self, tmp_path):
        samples = read_samples(_EARLIER)
        write_samples(samples, tmp_path)
        for field in pq.read_schema(tmp_path / "samples.parquet"):
            assert mut.read_description(field).unit in mut.UNITS, field.name
        back = read_samples(tmp_path)
        for name, values in samples.column.items():
            np.testing.assert_array_equal(back[name], values)


class TestDescribeColumns:
    def describe(self, *names, **metadata):
        return mut.describe_columns(
            names,
            links=("a", "a_b"),
            signals={"force": LinkSignal(unit="N")},
            metadata=metadata,
        )

    def test_sliding_joint(self):
        columns = self.describe("q_0", "qd_1", joint_units=["rad", "m"])
        assert columns["q_0"].unit == "rad"
        assert columns["qd_1"].unit == "m/s"

    def test_link_whose_name_begins_with_another_s(self):
        columns = self.describe("a_b_state", "a_state")
        assert columns["a_b_state"].meaning.startswith("a_b: ")
        assert columns["a_state"].meaning.startswith("a: ")

    def test_states_are_the_law_s(self):
        columns = self.describe("a_state", law={"states": ["near", "far"]})
        assert columns["a_state"].codes == ("near", "far")

    def test_signal_without_words(self):
        column = self.describe("a_force")["a_force"]
        assert column.unit == "N"
        assert "force" in column.meaning

    def test_what_is_not_known_is_not_made_up(self):
        column = self.describe("a_old")["a_old"]
        assert (column.unit, column.meaning) == ("", "")
