"""A study of one's own, read from YAML."""

import dataclasses as dc
import hashlib
from pathlib import Path

from tofssm_drake.diagrams.scenario import (
    Scenario,
    change_settings,
    dump_scenario,
    load_scenario,
)
from tofssm_drake.diagrams.yaml_check import (
    MOST_CHARACTERS,
    check_yaml,
    parse_yaml,
)
from tofssm_drake.errors import UserError, prefix_errors, require
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.studies.study import CellSettings, Study, StudyCell
from tofssm_drake.user_files import read_file


def load_study(filename: Path) -> Study:
    """Reads a study.

    Args:
        filename: YAML file, see `Study`.

    Returns:
        The study, checked; its scenarios are not.

    Raises:
        UserError: Something is unknown, misspelt, of the wrong type or out of
            range; the message says where and what would be right.
    """
    try:
        text = read_file(filename, most=4 * MOST_CHARACTERS).decode("utf-8")
    except OSError as error:
        raise UserError(
            f"{filename}: cannot read the study: {error.strerror}"
        ) from None
    except UnicodeDecodeError:
        raise UserError(f"{filename}: is not text in UTF-8") from None
    source = str(filename)
    # A name without settings is a mistake here, and would be left out below.
    check_yaml(parse_yaml(text, source), Study, source, "study")
    study = change_settings(Study(), text, source=source, where="study")
    study.check(str(filename))
    return study


def make_study_scenarios(
    study: Study,
    filename: Path,
    *,
    text: str = "",
    duration: float | None = None,
) -> dict[StudyCell, Scenario]:
    """Makes the scenarios that a study compares.

    Args:
        study: Checked.
        filename: Its file; scenarios are looked for beside it.
        text: Further settings to change in all of them, as YAML.
        duration: Instead of their own longest simulated time, s.

    Raises:
        UserError: One of them is wrong; see `load_study`.
    """
    changes = [
        (study.text, f"{filename}: text"),
        (text, "--scenario-text"),
    ]
    scenarios = {}
    for name, settings in study.cells.items():
        where = f"{filename}: cells.{name}"
        plain = (settings.text, f"{where}.text")
        for variant, further in {"": "", **settings.variants}.items():
            at = f"{where}.variants.{variant}" if variant else where
            own = [plain, (further, at)]
            scenario = _load(settings, filename, where)
            for part, source in [changes[0], *own, changes[1]]:
                scenario = change_settings(scenario, part, source=source)
            if duration is not None:
                scenario = dc.replace(scenario, simulation_duration=duration)
            with prefix_errors(at):
                scenario.check()
                cell = make_study_cell(name, scenario, variant=variant)
            scenarios[cell] = scenario
    return scenarios


def _load(settings: CellSettings, filename: Path, where: str) -> Scenario:
    """Returns the scenario that a cell starts from."""
    file, _, name = settings.scenario.partition("#")
    with prefix_errors(f"{where}.scenario"):
        return load_scenario(
            filename=filename.parent / file if file else None,
            name=name or "Default",
        )


def make_study_cell(
    name: str, scenario: Scenario, *, variant: str = ""
) -> StudyCell:
    """Returns a cell with all that determines its results.

    Args:
        name: Of the cell: letters, digits and _.
        scenario: Checked.
        variant: Name of the variant; empty: as it is.

    Raises:
        UserError: A recording cannot be read, or nobody walks in it.
    """
    contents = read_recordings(scenario)
    return StudyCell(
        name=name,
        variant=variant,
        scenario=dump_scenario(scenario),
        recordings={
            file: hashlib.sha256(content).hexdigest()
            for file, content in contents.items()
        },
    )


def read_recordings(scenario: Scenario) -> dict[str, bytes]:
    """Returns the recordings that the people of a scenario replay, by name.

    Raises:
        UserError: One cannot be read, or nobody walks in it.
    """
    contents = {}
    for name, person in scenario.people.items():
        if not isinstance(person, BvhRecording):
            continue
        where, file = f"people.{name}", person.filename
        # Reading a pipe would block.
        require(Path(file).is_file(), f"{where}.filename: {file} is not a file")
        person.make_motion(scenario.control_period, where)
        contents[file] = Path(file).read_bytes()
    return contents
