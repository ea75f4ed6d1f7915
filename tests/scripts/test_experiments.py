"""`tofssm experiments`: what it leaves, how it goes on, how it fails."""

import contextlib
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

from bvh_writer import write_bvh
from cluster_in_process import connect_in_process
from distributed import Client
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tofssm_drake.diagrams import campaign_run
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.paper import campaign_figures, campaign_report
from tofssm_drake.paper.cells import list_variants, make_plan
from tofssm_drake.recording.samples import read_samples
from tofssm_drake.recording.tables import write_table
import tofssm_drake.scripts.campaign as mut
import tofssm_drake.scripts.main as main
import tofssm_drake.scripts.paper_experiment as paper_experiment

# Two cells, one person, and the run without anybody.
ROOT = Path(__file__).parents[2]
SMALL = (
    *("--sensing", "ideal", "--sensing", "lidar", "--ssm", "vo"),
    *("--trials", "1", "--duration", "0.4"),
    *("--scenario-text", "{task: {products: 1}}"),
)
KEYS = ["alone", "ideal-vo-1", "lidar-vo-1"]
COMMAND = (sys.executable, "-m", "tofssm_drake.scripts.main", "experiments")


def write_no_report(folder, *, failures, **options):
    """Stands in for the report, which takes longer than all the runs."""
    path = Path(folder) / "report.html"
    path.write_text(f"{failures}")
    return path


def run_in_process(*arguments, report=False):
    """Runs without other processes; returns the exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mut, "connect", connect_in_process)
        if not report:
            patch.setattr(
                paper_experiment, "write_campaign_report", write_no_report
            )
        return main.run(["experiments", *map(str, arguments)])


def read_table(folder):
    return pq.read_table(folder / "results.parquet")


def list_tree(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A campaign that nothing interrupted."""
    out = tmp_path_factory.mktemp("campaign") / "a" / "b"
    assert run_in_process(*SMALL, "--out", out, report=True) == 0
    return out


def check_equal(out, whole):
    """Checks that a campaign came out as the uninterrupted one did."""
    name = "results.parquet"
    assert (out / name).read_bytes() == (whole / name).read_bytes()
    for key in KEYS:
        for name in ("samples.parquet", "scans.parquet", "row.parquet"):
            path = Path("runs") / key / name
            assert (out / path).read_bytes() == (whole / path).read_bytes()
    parts = [path for path in list_tree(out) if path.endswith(".part")]
    assert parts == []


class TestResults:
    def test_one_row_per_run(self, whole):
        table = read_table(whole)
        assert table["run"].to_pylist() == KEYS
        assert table["trial"].to_pylist() == [0, 1, 1]
        seeds = table["seed"].to_pylist()
        assert seeds[0] == 0 != seeds[1] == seeds[2]
        for name in ("productivity", "min_true_distance_m", "latency_s"):
            assert name in table.column_names

    def test_samples_of_every_run(self, whole):
        for key in KEYS:
            samples = read_samples(whole / "runs" / key)
            assert len(samples) == 51
        distance = read_samples(whole / "runs" / "alone")["true_distance"]
        assert (distance == float("inf")).all()

    def test_report(self, whole):
        page = (whole / "report.html").read_text("utf-8")
        assert page.rstrip().endswith("</html>")
        for word in ("Ideal Vo", "Lidar Vo", "not run", "1.12 m"):
            assert word in page
        names = {path.suffix for path in (whole / "figures").iterdir()}
        assert names == {".svg", ".png"}

    def test_people_from_recordings(self, tmp_path):
        folder = tmp_path / "motions"
        folder.mkdir()
        write_bvh(folder / "b.bvh")
        write_bvh(folder / "a.BVH")
        (folder / "notes.txt").write_text("not a recording")
        out = tmp_path / "out"
        code = run_in_process(
            *("--sensing", "ideal", "--ssm", "vo", "--trials", 2),
            *("--duration", 0.2, "--human-motions", folder, "--out", out),
        )
        assert code == 0
        for trial, name in ((1, "a.BVH"), (2, "b.bvh")):
            samples = read_samples(out / "runs" / f"ideal-vo-{trial}")
            assert f"filename: {name}" in samples.metadata["scenario"]
        # A recording that has changed makes another campaign.
        with (folder / "b.bvh").open("a") as file:
            file.write("\n")
        code = run_in_process(
            *("--sensing", "ideal", "--ssm", "vo", "--trials", 2),
            *("--duration", 0.2, "--human-motions", folder, "--out", out),
        )
        assert code == 2


class TestGoingOn:
    def test_finished_runs_are_not_repeated(self, whole, tmp_path, capsys):
        out = tmp_path / "out"
        shutil.copytree(whole, out)
        for path in ("results.parquet", "report.html"):
            (out / path).unlink()
        # As a kill leaves it: samples without their row, and half a file.
        torn = out / "runs" / "lidar-vo-1"
        (torn / "row.parquet").unlink()
        (torn / "samples.parquet").write_bytes(b"half")
        (torn / ".scans.parquet.a1b2.part").write_bytes(b"half")
        shutil.rmtree(out / "runs" / "alone")
        kept = out / "runs" / "ideal-vo-1" / "row.parquet"
        before = kept.stat().st_mtime_ns
        assert run_in_process(*SMALL, "--out", out) == 0
        check_equal(out, whole)
        assert kept.stat().st_mtime_ns == before
        assert str(out / "report.html") in capsys.readouterr().out

    @pytest.mark.long
    def test_killed(self, whole, tmp_path):
        """By kill -9, on processes of their own, as a user runs it."""
        out = tmp_path / "out"
        command = [*COMMAND, *SMALL, "--workers", "1", "--out", out]
        own = tmp_path / "tmp"
        own.mkdir()
        process = subprocess.Popen(
            command,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | {"TMPDIR": str(own)},
        )
        try:
            while not list(out.glob("runs/*/row.parquet")):
                assert process.poll() is None, process.stderr.read()
                time.sleep(0.05)
            process.send_signal(signal.SIGKILL)
            process.wait()
            done = {path.parent.name for path in out.glob("runs/*/row.*")}
            assert done < set(KEYS)
            # Its workers leave by themselves.
            deadline = time.monotonic() + 60
            while is_group_alive(process.pid):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            process.stderr.close()
        # What its processes could not take away is in the campaign's folder.
        assert list_tree(own) == []
        assert (out / ".scratch").is_dir()
        assert not (out / "results.parquet").exists()
        assert run_in_process(*SMALL, "--out", out) == 0
        check_equal(out, whole)
        assert not (out / ".scratch").exists()

    def test_missing_samples(self, whole, tmp_path, capfd):
        out = tmp_path / "out"
        shutil.copytree(whole, out)
        run = out / "runs" / "lidar-vo-1"
        for spoil in (
            lambda path: path.write_bytes(b"half"),
            # Of something else.
            lambda path: write_table(pa.table({"t": [0.0]}), path),
            lambda path: path.unlink(),
        ):
            spoil(run / "samples.parquet")
            assert run_in_process(*SMALL, "--out", out, report=True) == 2
            (line,) = capfd.readouterr().err.splitlines()
            assert str(run / "samples.parquet") in line
            assert f"remove {run} to have the run repeated" in line

    def test_failed_run(self, whole, tmp_path, monkeypatch, capfd):
        out = tmp_path / "out"
        execute = campaign_run.execute

        def fail(base, run, *arguments):
            if run.key == "lidar-vo-1":
                raise RuntimeError("the plant\nblew up")
            return execute(base, run, *arguments)

        monkeypatch.setattr(mut, "execute", fail)
        assert run_in_process(*SMALL, "--out", out) == 1
        seed = str(read_table(whole)["seed"].to_pylist()[2])
        lines = capfd.readouterr().err.splitlines()
        message = f"failed: Lidar Vo, trial 1 (seed {seed}): the plant blew up"
        assert f"tofssm: {message}" in lines
        keys = read_table(out)["run"].to_pylist()
        assert keys == [key for key in KEYS if key != "lidar-vo-1"]
        assert "the plant blew up" in (out / "report.html").read_text()
        # Once it works, only it is run.
        monkeypatch.setattr(mut, "execute", execute)
        rows = [out / "runs" / key / "row.parquet" for key in keys]
        before = [path.stat().st_mtime_ns for path in rows]
        assert run_in_process(*SMALL, "--out", out) == 0
        assert [path.stat().st_mtime_ns for path in rows] == before
        check_equal(out, whole)

    def test_terminated_while_the_report_is_written(
        self, whole, tmp_path, monkeypatch, capfd
    ):
        out = tmp_path / "out"
        shutil.copytree(whole, out)
        for path in ("figures/fig10_productivity_safety.png", "report.html"):
            (out / path).unlink()
        before = list_tree(out)
        make = campaign_report.render_page

        def terminate(*arguments, **values):
            os.kill(os.getpid(), signal.SIGTERM)
            return make(*arguments, **values)

        # The figures are drawn by then.
        monkeypatch.setattr(campaign_report, "render_page", terminate)
        monkeypatch.setattr(campaign_figures, "list_figures", lambda *_: {})
        assert run_in_process(*SMALL, "--out", out, report=True) == 130
        assert (
            "run the same command again to continue" in capfd.readouterr().err
        )
        assert list_tree(out) == before
        # The handler is gone with the command.
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL

    def test_interrupted(self, tmp_path, monkeypatch, capfd):
        def interrupt(folder, run, row, files):
            raise KeyboardInterrupt

        monkeypatch.setattr(mut, "store_run", interrupt)
        out = tmp_path / "out"
        code = run_in_process(
            *("--sensing", "ideal", "--ssm", "vo", "--trials", 1),
            *("--duration", 0.2, "--out", out),
        )
        assert code == 130
        error = capfd.readouterr().err
        assert "Traceback" not in error
        assert "tofssm: interrupted" in error


def is_group_alive(pid):
    try:
        os.killpg(pid, 0)
    except ProcessLookupError:
        return False
    return True


@contextlib.contextmanager
def start(module, *arguments):
    """Runs a module of distributed as a process."""
    process = subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{module}", *arguments],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env=os.environ | {"DASK_DISTRIBUTED__DASHBOARD__LINK": ""},
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=60)


class TestScheduler:
    def test_two_workers_started_by_hand(self, whole, tmp_path, monkeypatch):
        """The same tables as in one process, to the last bit."""
        monkeypatch.setattr(
            paper_experiment, "write_campaign_report", write_no_report
        )
        contact = tmp_path / "scheduler.json"
        out = tmp_path / "out"
        worker = ("--scheduler-file", contact, "--nthreads", "1", "--no-nanny")
        with start(
            "dask_scheduler",
            *("--host", "127.0.0.1", "--port", "0", "--no-dashboard"),
            *("--scheduler-file", contact),
        ) as scheduler:
            address = None
            for line in scheduler.stderr:
                if "Scheduler at:" in line:
                    address = line.split()[-1]
                    break
            assert address.startswith("tcp://127.0.0.1:")
            # Nobody works there yet.
            assert self.run_at(address, tmp_path / "none") == 2
            assert not (tmp_path / "none").exists()
            with (
                start("dask_worker", *worker, "--local-directory", tmp_path),
                start("dask_worker", *worker, "--local-directory", tmp_path),
            ):
                with Client(address) as client:
                    client.wait_for_workers(2, timeout=60)
                assert self.run_at(address, out) == 0
        check_equal(out, whole)

    def run_at(self, address, out):
        return main.run(
            ["experiments", *SMALL, "--scheduler", address, "--out", str(out)]
        )


# What a user wrote, and what the line on stderr must tell.
NO_RINGS = ("--sensing", "lidar")
BAD_INPUT = {
    "no_folder": (("--out", ""), "must not be empty"),
    "variant_twice": (
        ("--variant", "all", "--variant", "all"),
        "names one of them",
    ),
    "none_and_more": (
        ("--variant", "none", "--variant", "late"),
        "none excludes",
    ),
    "no_cell": (
        (*NO_RINGS, "--variant", "exact"),
        "--variant: exact needs one of the sensings tof with one of the config",
    ),
    "no_cell_of_all": (
        (*NO_RINGS, "--variant", "all", "--variant", "late"),
        "--variant: late needs one of the sensings ideal",
    ),
    "sensing": (("--sensing", "radar"), "--sensing: 'radar' is unknown"),
    "twice": (("--ssm", "vo", "--ssm", "vo"), "--ssm: vo, vo names one"),
    "ssm": (("--ssm", "vx"), "--ssm: 'vx' is unknown, use one of vo, vr, sm"),
    "variant": (
        ("--variant", "odd"),
        "--variant: 'odd' is unknown, use one of lit",
    ),
    "trials": (("--trials", "0"), "--trials: 0 must be from 1 to 1000"),
    "seed": (("--seed", "-3"), "--seed: -3 must be from 0"),
    "workers": (("--workers", "0"), "--workers: 0 must be from 1"),
    "duration": (("--duration", "0"), "--duration: 0.0 must"),
    "text": (("--scenario-text", "{law: {C_dc: 1}}"), "did you mean 'C_dC'?"),
    "fixed": (("--scenario-text", "{random_seed: 5}"), "random_seed: is deci"),
    "nobody": (
        ("--scenario-text", "{people: {visitor: null}}"),
        "people: is decid",
    ),
    "law": (
        (
            "--scenario-text",
            "{law: !Custom {factory: 'examples.my_law:MyLaw', "
            "parameters: {stop: 0.6, slow: 1.2}}}",
        ),
        "--scenario-text: law: must be !TriSsm",
    ),
    "person": (
        (
            "--scenario-text",
            "{people: {visitor: !CustomMotion {factory: "
            "'examples.my_person:sway', "
            "parameters: {distance: 1.3, swing: 0.5}}}}",
        ),
        "--scenario-text: people: is decided by",
    ),
    "all": (
        ("--variant", "all", "--variant", "foo"),
        "--variant: 'foo' is unknown",
    ),
    "figure": (
        (
            "--scenario-text",
            "{people: {visitor: {figure_eight: {half_width: 0.1}}}}",
        ),
        "half_width",
    ),
    "no_motions": (("--human-motions", "gone"), "there is no folder gone"),
    "empty_motions": (("--human-motions", "."), "no .bvh files are in ."),
    "scheduler": (
        ("--scheduler", "tcp://127.0.0.1:9"),
        "--scheduler: no Dask scheduler answers at tcp://127.0.0.1:9",
    ),
    "scheduler_name": (("--scheduler", "nonsense://x"), "--scheduler: no Da"),
}


class TestBadInput:
    @pytest.mark.parametrize("name", BAD_INPUT)
    def test_one_line_and_nothing_written(
        self, name, tmp_path, monkeypatch, capfd
    ):
        arguments, message = BAD_INPUT[name]
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(ROOT)
        monkeypatch.setattr("tofssm_drake.scripts.cluster.TIMEOUT", 0.3)
        code = main.run(["experiments", "--out", "made/anew", *arguments])
        captured = capfd.readouterr()
        assert code == 2
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        assert line.startswith("tofssm: ")
        assert message in line
        assert list_tree(tmp_path) == []

    def test_nobody_walks_in_a_recording(self, tmp_path, capfd):
        (tmp_path / "broken.bvh").write_text("HIERARCHY\nROOT Hips\n{\n")
        code = main.run(
            [
                *("experiments", "--human-motions", str(tmp_path)),
                *("--out", str(tmp_path / "out")),
            ]
        )
        assert code == 2
        assert "broken.bvh" in capfd.readouterr().err
        assert not (tmp_path / "out").exists()

    def test_a_pipe_is_no_recording(self, tmp_path, capfd):
        """It would be waited for."""
        os.mkfifo(tmp_path / "pipe.bvh")
        code = main.run(["experiments", "--human-motions", str(tmp_path)])
        assert code == 2
        assert "pipe.bvh is not a file" in capfd.readouterr().err

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("--scenario-text", "{}"), "scenario.task.products: 1 then"),
            (("--seed", "1"), "seed: 0 then, 1 now"),
            (("--duration", "0.5"), "scenario.simulation_duration: 0.4 then"),
        ],
    )
    def test_another_campaign_in_the_folder(
        self, arguments, message, whole, capfd
    ):
        before = list_tree(whole)
        code = run_in_process(*SMALL, *arguments, "--out", whole)
        assert code == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "holds another campaign" in line
        assert message in line
        assert list_tree(whole) == before

    @pytest.mark.parametrize(
        "name", ["", "runs", "runs/alone", "runs/lidar-vo-1", "figures"]
    )
    def test_a_file_where_a_folder_belongs(self, name, tmp_path, capfd):
        path = tmp_path / "out" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("in the way")
        before = list_tree(tmp_path)
        for out in (tmp_path / "out", tmp_path / "out" / "x"):
            if out.name == "x" and name:
                continue
            assert run_in_process(*SMALL, "--out", out, report=True) == 2
            (line,) = capfd.readouterr().err.splitlines()
            assert line.startswith("tofssm: --out: cannot write into")
            assert f"{path} is not a folder" in line
        assert list_tree(tmp_path) == before

    @pytest.mark.parametrize(
        "name", ["campaign.json", "results.parquet", "report.html"]
    )
    def test_a_folder_where_a_file_belongs(self, name, tmp_path, capfd):
        (tmp_path / name).mkdir()
        assert run_in_process(*SMALL, "--out", tmp_path) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert f"{tmp_path / name} is a folder" in line


class TestVariants:
    def test_the_literal_law_is_run_unless_told_otherwise(self):
        possible = list_variants(["tof", "lidar"], ["vo"])
        assert possible == ["literal", "exact", "subtracted", "piecewise"]
        assert paper_experiment.choose_variants(None, possible) == ["literal"]
        assert paper_experiment.choose_variants(None, ["late"]) == []
        assert paper_experiment.choose_variants(["none"], possible) == []
        assert paper_experiment.choose_variants(["all"], possible) == possible
        assert paper_experiment.choose_variants(["exact"], possible) == [
            "exact"
        ]

    def test_the_command_tells_the_variants(self):
        for asked, studies, told in (
            (None, ["literal"], " --variant literal"),
            (None, [], " --variant none"),
            (["all"], ["late", "exact"], ""),
        ):
            command = paper_experiment.make_command(
                ["experiments"], asked, studies
            )
            assert command == "tofssm experiments" + told

    def test_they_are_in_the_default_plan(self, tmp_path):
        for variants, keys in (
            (None, ["tof-vo-literal", "tof-vr-literal", "tof-sm-literal"]),
            (["none"], []),
        ):
            campaign = paper_experiment.make_paper_campaign(
                out=tmp_path,
                trials=1,
                seed=0,
                duration=900.0,
                sensings=None,
                configurations=None,
                variants=variants,
                human_motions=None,
                scenario_text="",
            )
            cells = campaign.plan.cells
            assert [c.key for c in cells if c.variant] == keys


class TestParameters:
    def test_all_of_the_papers_table(self):
        plan = make_plan(
            seed=0,
            trials=1,
            sensings=["tof", "lidar"],
            configurations=["vo"],
            variants=[],
            scenario={},
        )
        rows = dict(paper_experiment.list_parameters(load_scenario(), plan))
        (V_hmax,) = [v for name, v in rows.items() if "V_hmax" in name]
        assert V_hmax["tof"] == "1.6 m/s"
        (r_o,) = [v for name, v in rows.items() if name.startswith("r_o")]
        assert r_o == {"tof": "\u2013", "lidar": "0.82 m"}
        told = " ".join(v["tof"] for n, v in rows.items() if "\u03c1" in n)
        assert told == "1, 0.5, 0 3.33 1/s, 33.3 1/s\u00b2"
