"""A study of one's own, from its file to the report."""

from pathlib import Path

from cluster_in_process import connect_in_process
import pyarrow.parquet as pq
import pytest

from tofssm_drake.diagrams.study_file import load_study
import tofssm_drake.scripts.campaign as campaign
from tofssm_drake.scripts.main import run

ROOT = Path(__file__).parents[2]
FILE = ROOT / "examples" / "my_study.yaml"
KEYS = [
    *("TriSsm-alone", "Nearer_is_slower-alone"),
    "Nearer_is_slower-cautious-alone",
    *("TriSsm-1", "Nearer_is_slower-1", "Nearer_is_slower-cautious-1"),
]


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture
def run_study(monkeypatch, tmp_path):
    """Returns a function that runs the study for a moment; the exit code."""
    monkeypatch.setattr(campaign, "connect", connect_in_process)

    def run_for_a_moment(*arguments):
        return run(
            [
                *("experiments", "--study", str(FILE)),
                *("--duration", "0.2", "--out", str(tmp_path), *arguments),
            ]
        )

    return run_for_a_moment


def test_run_and_its_report(run_study, tmp_path, capfd, monkeypatch):
    assert run_study("--trials", "1") == 0
    table = pq.read_table(tmp_path / "results.parquet").to_pylist()
    assert [row["run"] for row in table] == KEYS
    for row in table:
        assert row["time_lost_share"] == 1.0 - row["productivity"]
    # The same person in every cell.
    assert len({(row["seed"], row["speed"]) for row in table[3:]}) == 1
    page = (tmp_path / "report.html").read_text("utf-8")
    assert page.rstrip().endswith("</html>")
    for words in (
        *("Two laws in one cell", "time lost", "touched nobody in 3 runs"),
        "Nearer_is_slower (cautious) \u2212 Nearer_is_slower",
        "Nearer_is_slower \u2212 TriSsm",
        "cautious: <code>{law: {parameters:",
    ):
        assert words in page
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {
        *("study.png", "study.svg"),
    }
    # Going on repeats no finished run, and makes the same table.
    before = (tmp_path / "results.parquet").read_bytes()
    monkeypatch.setattr(campaign, "execute", None)
    assert run_study("--trials", "1") == 0
    assert (tmp_path / "results.parquet").read_bytes() == before
    # Another scenario in a cell makes another campaign.
    capfd.readouterr()
    text = FILE.read_text("utf-8").replace("{stop: 0.8,", "{stop: 0.9,")
    other = tmp_path / "other.yaml"
    other.write_text(
        text.replace("my_law.yaml", str(ROOT / "examples/my_law.yaml"))
    )
    assert (
        run(
            [
                *("experiments", "--study", str(other), "--trials", "1"),
                *("--duration", "0.2", "--out", str(tmp_path)),
            ]
        )
        == 2
    )
    (line,) = capfd.readouterr().err.splitlines()
    assert "holds another campaign (cell Nearer_is_slower cautious" in line
    assert "scenario.law.parameters.stop: 0.8 then, 0.9 now" in line


def test_the_papers_options_are_refused(run_study, capfd):
    for option in ("--sensing", "--ssm", "--variant"):
        assert run_study(option, "tof") == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith(f"tofssm: {option}: chooses cells of the paper")


def test_the_file():
    study = load_study(FILE)
    assert list(study.cells) == ["TriSsm", "Nearer_is_slower"]
    assert study.baseline == "TriSsm"
