"""The report of one run: a single file that any browser opens, offline."""

import dataclasses as dc
import math
from pathlib import Path

import numpy as np

from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.approach import (
    USUAL_DELAY,
    Approach,
    RingApproach,
)
from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.metrics import (
    Contact,
    Episode,
    StateEvent,
    find_contacts,
    find_episodes,
    find_state_events,
    never_started,
)
from tofssm_drake.metrics.sensor_faults import (
    calc_ages,
    find_faulted_links,
    find_faulted_sensors,
)
from tofssm_drake.metrics.task_progress import TaskSteps
from tofssm_drake.recording.samples import Samples, write_atomically
from tofssm_drake.reports import figures
from tofssm_drake.reports.page import Picture, make_picture, render_page

_MOST_CONTACTS = 20
_ROWS_SHOWN = 30
# A page of hours must stay one that a browser opens.
_MOST_ROWS = 1000
_NONE = "\u2013"
_MINUS = "\u2212"
_BEHIND = "nearer to the link than the sensors sit"
_NOUN = {"rings": "ring", "motion capture": "link"}


@dc.dataclass(frozen=True, kw_only=True)
class Headline:
    """One number in the row at the top."""

    value: str
    label: str
    note: str = ""


def format_number(value, digits: int = 2, unit: str = "") -> str:
    """Returns a number for a reader.

    Args:
        value: The number; None and NaN become an en dash, infinities
            "clear", because that is what an infinite distance means here.
        digits: Digits after the decimal point.
        unit: Appended after a no-break space.
    """
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return _NONE
    if isinstance(value, float) and math.isinf(value):
        return "clear"
    text = f"{value:.{digits}f}".replace("-", _MINUS)
    return f"{text}\u00a0{unit}" if unit else text


def count_of(count: int, noun: str) -> str:
    """Returns "no stops", "1 stop", "2 stops"."""
    if count == 1:
        return f"1 {noun}"
    return f"{count or 'no'} {noun}s"


def make_verdict(
    summary: dict, *, watcher: str = "the rings"
) -> list[tuple[str, str]]:
    """Returns in plain words how the run went.

    Args:
        summary: What `calc_summary` returned.
        watcher: What watched the person, in words.

    Returns:
        (grade, sentence) pairs; grade is `good`, `bad` or `note`.
    """
    late = summary.get("late_stops", 0)
    return [
        _judge_contacts(summary),
        _judge_task(summary),
        _describe_slowing(summary, watcher),
        *(
            [
                (
                    "note",
                    f"A stop came late {_times(late)}: "
                    f"{_name_somebody(summary)} was truly "
                    "within the distance at which a link stops the robot for "
                    f"more than {USUAL_DELAY:.2f} s before a stop was asked "
                    "for.",
                )
            ]
            if late
            else []
        ),
    ]


def _judge_contacts(summary):
    contacts = summary["contact_while_moving_events"]
    least = summary["min_true_distance_m"]
    if contacts:
        return (
            "bad",
            f"The moving robot touched {_name_touched(summary)}: "
            f"{count_of(contacts, 'contact')}, at up to "
            f"{summary['contact_while_moving_max_mps']:.3f} m/s.",
        )
    if not summary.get("person_is_known", True):
        return (
            "note",
            "A run on real sensors: where people truly were is not known, so "
            "there is nothing to report on contacts and true distances.",
        )
    if least is None:
        return "note", "Nobody was in the cell."
    who, nearest = _name_nearest(summary)
    if least <= 0.0:
        return (
            "good",
            f"The robot never touched {who} while it moved. They did touch "
            f"while it stood still: {nearest} walked into it.",
        )
    if nearest != who:
        return (
            "good",
            f"The robot never touched {who}. The nearest was {nearest}, at "
            f"{least:.2f} m.",
        )
    return (
        "good",
        f"The robot never touched {who}. The nearest they came was "
        f"{least:.2f} m.",
    )


def _are_several(summary):
    return len(summary.get("people", ())) > 1


def _name_touched(summary):
    """Returns who was touched, of several people with the number of times."""
    if not _are_several(summary):
        return "the person"
    counts = summary["contacts_by_person"].items()
    return _join([f"{name} {_times(n)}" for name, n in counts if n])


def _name_nearest(summary):
    """Returns who was there, and who of them was nearest."""
    if not _are_several(summary):
        return "the person", "the person"
    return (
        _join(summary["people"], "or"),
        summary["nearest_person"] or "a person",
    )


def _name_somebody(summary):
    return "a person" if _are_several(summary) else "the person"


def _join(words, last="and"):
    """Returns "a", "a and b", "a, b and c"."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def _judge_task(summary):
    task, time = _read_task(summary), summary["task_time_s"]
    simulated = f"{summary['simulated_s']:.1f} s"
    due = _describe_due(summary)
    if not task.step:
        return "note", f"{simulated} without a task that counts.{due}"
    clause = task.tell(summary["steps_done"])
    if time is None:
        return "note", f"{clause} in the {simulated} that were simulated.{due}"
    return "good", f"{clause} in {time:.1f} s."


def _read_task(summary):
    return TaskSteps(step=summary["step"], steps=summary["steps"])


def _describe_slowing(summary, watcher):
    if never_started(summary):
        return "bad", (
            "The robot never started: it was told to stop from the beginning "
            f"to the end, for {summary['simulated_s']:.1f} s."
        )
    episodes, standstills = summary["slow_episodes"], summary["standstills"]
    if not episodes and summary["reduced_s"] > 0.0:
        return "note", (
            "No person slowed the robot, but it ran at reduced speed for "
            f"{summary['reduced_s']:.1f} s."
        )
    if not episodes:
        return "note", "Nothing stopped or slowed the robot."
    stood = (
        f"brought it to a standstill {_times(standstills)}"
        if standstills
        else "never brought it to a standstill"
    )
    return (
        "note",
        f"{watcher[0].upper()}{watcher[1:]} slowed the robot in "
        f"{count_of(episodes, 'episode')} and {stood}. It was told to stop "
        f"for {summary['stopped_s']:.1f} s and to run slower for "
        f"{summary['reduced_s']:.1f} s in all.",
    )


def _describe_due(summary):
    """Returns for how long a stop was due, if most of the time."""
    due, simulated = summary.get("stop_due_s"), summary["simulated_s"]
    if due is None or due <= 0.5 * simulated:
        return ""
    return (
        f" For {100 * due / simulated:.0f} % of that time "
        f"{_name_somebody(summary)} was truly within the distance at which "
        "this law stops the robot."
    )


def _times(count):
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


def _make_headlines(summary):
    return [
        _make_task_headline(summary),
        *_make_safety_headlines(summary),
        *_make_event_headlines(summary),
        *_make_sensing_headlines(summary),
    ]


def _make_task_headline(summary):
    task = _read_task(summary)
    simulated = format_number(summary["simulated_s"], 1, "s")
    if not task.step:
        return Headline(value=simulated, label="without a task that counts")
    time = summary["task_time_s"]
    noun, _, verb = task.step.partition(" ")
    return Headline(
        value=f"{summary['steps_done']} of {task.steps}",
        label=f"{noun}s {verb}",
        note=(
            f"in {simulated}, not finished"
            if time is None
            else f"in {format_number(time, 1, 's')}"
        ),
    )


def _make_safety_headlines(summary):
    return [
        Headline(
            value=(
                str(summary["contact_while_moving_events"])
                if summary.get("person_is_known", True)
                else "unknown"
            ),
            label="contacts while moving",
            note=(
                ", ".join(
                    f"{name} {n}"
                    for name, n in summary["contacts_by_person"].items()
                )
                if _are_several(summary)
                else "touching faster than 0.01 m/s"
            ),
        ),
        Headline(
            value=format_number(summary["min_true_distance_m"], 2, "m"),
            label="least true distance",
            note=_describe_least(summary),
        ),
    ]


def _describe_least(summary):
    """Returns between whom the least true distance was."""
    several = _are_several(summary) and summary["nearest_person"]
    if summary["min_true_distance_m"] == 0.0:
        return f"{several} touched it" if several else "they touched"
    return f"robot's surface to {several or 'person'}'s"


def _make_event_headlines(summary):
    stopped = format_number(summary.get("stopped_s"), 1, "s")
    reduced = format_number(summary.get("reduced_s"), 1, "s")
    return [
        Headline(
            value=str(summary["stop_events"]),
            label="changes to stop",
            note=f"{stopped} stopped in all",
        ),
        Headline(
            value=str(summary["reduce_events"]),
            label="changes from normal to reduced",
            note=f"{reduced} reduced in all",
        ),
        Headline(
            value=format_number(summary.get("max_tcp_speed_mps"), 2, "m/s"),
            label="highest tool speed",
        ),
    ]


def _make_sensing_headlines(summary):
    rmse = summary.get("distance_rmse_m")
    shares = [
        share
        for share in summary.get("detection_share_by_ring", {}).values()
        if share is not None
    ]
    return [
        Headline(
            value=_NONE if rmse is None else f"{1000 * rmse:.0f}\u00a0mm",
            label="distance error (RMSE)",
            note="measured against truth, in range",
        ),
        Headline(
            value=f"{100 * np.mean(shares):.0f}\u00a0%" if shares else _NONE,
            label="person in range and seen",
            note="mean of the links, over time",
        ),
    ]


def _call(link, noun):
    return f"{link} {noun}".strip()


def describe_contact(
    contact: Contact, noun: str = "ring", who: str = "the person"
) -> list[str]:
    """Describes one contact in sentences: what, how fast, and who saw it.

    Args:
        contact: Which.
        noun: What follows the name of a watched link.
        who: Was touched.
    """
    text = [
        f"At {contact.time:.2f} s the robot's {_words(contact.robot_body)} "
        f"touched {who}'s {_words(contact.person_part)} while moving at "
        f"{contact.first_speed:.3f} m/s (at most {contact.max_speed:.3f} m/s "
        f"over the {contact.duration:.2f} s of the contact). The robot was "
        f"in state {figures.STATE_NAME[contact.robot_state]}."
    ]
    text.append(describe_cause(contact.approach, contact, noun))
    text += [describe_ring(ring, noun) for ring in contact.approach.rings]
    if not contact.blind:
        seen = " and ".join(v.ring for v in contact.views if v.seen)
        text.append(f"At the contact itself the person was seen (by {seen}):")
    else:
        ago = (
            "and none had seen the person before"
            if math.isinf(contact.last_seen)
            else f"and the last time was {contact.last_seen:.2f} s before"
        )
        text.append(f"At the contact itself no sensor saw the person, {ago}:")
    text += [describe_view(view, noun) for view in contact.views]
    return text


def describe_cause(
    approach: Approach, contact: Contact, noun: str = "ring"
) -> str:
    """Explains why the robot was still moving; noun: see describe_contact."""
    if math.isfinite(approach.stop):
        late = f"the stop came late by {approach.late:.2f} s"
    else:
        late = "the robot was not told to stop before the contact"
    where = _describe_gap_place(approach)
    if approach.cause == "unjudged":
        return (
            "Why: not judged, because this law has no distance at which it "
            "stops the robot."
        )
    if approach.cause == "gap":
        return f"Why: {late}, because of {where}."
    if approach.cause == "unseen":
        at = f" It was in {where}." if approach.sensors is not None else ""
        return f"Why: the person was never seen by any {noun or 'ray'}.{at}"
    if approach.cause == "late":
        return (
            f"Why: {late}, although the person was inside a beam of the "
            f"{_call(approach.ring, noun)}: its reading or the law came "
            "too late."
        )
    if approach.cause == "beyond":
        return (
            f"Why: the touching part is farther from every "
            f"{noun or 'sensor'}'s centre than the distance at which that one "
            f"stops the robot: no {noun or 'stop'} was due."
        )
    return _describe_short_distance(approach)


def _describe_gap_place(approach):
    """Returns which gap between the beams the person was in."""
    if approach.sensors is None:
        return "a gap"
    ring = approach.ring
    i, j = approach.sensors
    (view,) = [r for r in approach.rings if r.ring == ring]
    if math.isnan(view.off_around):
        return (
            f"the space nearer to the link than the sensors of the {ring} "
            "ring sit"
        )
    if view.off_along > max(view.off_around, 0.0):
        return (
            f"the gap above and below the plane of the {ring} ring, at its "
            f"sensors {i} and {j}"
        )
    return f"the gap between sensors {i} and {j} of the {ring} ring"


def _describe_short_distance(approach):
    """Returns why a person who was seen in time was still touched."""
    text = (
        "Why: the person was seen in time, but the distance that this law "
        "keeps is too short"
    )
    if not math.isnan(approach.person_speed):
        speed = format_number(approach.person_speed, 2, "m/s")
        text += f" for a person at {speed}"
    if not math.isnan(approach.needed):
        needed = math.ceil(1000 * approach.needed - 1e-6) / 1000
        text += f" (it needs at least {needed:.3f} m here)"
    return f"{text}."


def describe_ring(ring: RingApproach, noun: str = "ring") -> str:
    """Describes how one ring followed the approach, see describe_contact."""
    name = _call(ring.ring, noun)
    if math.isinf(ring.due):
        text = f"{name}: the person was never within its stop distance"
        if math.isfinite(ring.reacted):
            text += f"; it said stop at {ring.reacted:.2f} s all the same"
        return f"{text}."
    text = (
        f"{name}: the person came within its stop distance of "
        f"{ring.d_C:.2f} m at {ring.due:.2f} s; it "
    )
    if ring.late == 0.0:
        return f"{text}said stop by then."
    if math.isinf(ring.late):
        text += "did not say stop before the contact"
    else:
        text += f"said stop {ring.late:.2f} s later"
    if math.isinf(ring.nearest_reading):
        text += ". Until then it read clear"
    else:
        text += f". Until then it read {ring.nearest_reading:.2f} m or more"
    if ring.sensors is not None:
        if math.isnan(ring.off_around):
            return f"{text}, the person {_BEHIND}."
        text += (
            f", the person between sensors {ring.sensors[0]} and "
            f"{ring.sensors[1]}, {_off(ring.off_around)} around the link and "
            f"{_off(ring.off_along)} along it"
        )
    return f"{text}."


def _off(angle):
    if angle > 0:
        return f"{math.degrees(angle):.0f}° outside the nearest beam"
    return f"{-math.degrees(angle):.0f}° inside"


def describe_view(view, noun: str = "ring") -> str:
    """Describes how one ring saw the person; noun: see describe_contact."""
    if math.isnan(view.measured_distance):
        read = "had no scan"
    elif math.isinf(view.measured_distance):
        read = "read clear"
    else:
        read = f"read {view.measured_distance:.2f} m"
    text = (
        f"{_call(view.ring, noun)} {read}; the person's nearest point was "
        f"{max(view.true_distance, 0):.2f} m from its centre"
    )
    if view.sensors is not None and math.isnan(view.off_beam):
        return f"{text}, {_BEHIND}."
    if view.sensors is not None:
        azimuth = math.degrees(view.azimuth) % 360
        elevation = f"{math.degrees(view.elevation):+.0f}"
        text += (
            f", at {azimuth:.0f}° around the link and "
            f"{elevation.replace('-', _MINUS)}° along it, between sensors "
            f"{view.sensors[0]} and {view.sensors[1]}"
        )
        off = math.degrees(view.off_beam)
        if off > 0:
            text += f", {off:.0f}° outside the nearest beam"
        else:
            text += f", {-off:.0f}° inside a beam"
    return f"{text}."


def _words(name):
    return name.replace("_link", "").replace("_", " ").strip()


def _pick_worst(contacts):
    """Returns the contacts that are told, in the order of time."""
    fastest = sorted(contacts, key=lambda c: c.max_speed)[-_MOST_CONTACTS:]
    return sorted(fastest, key=lambda c: c.time)


def _make_contact(contact, samples):
    geometry = samples.metadata.get("ring_geometry", {})
    diagrams = [
        figures.to_data_uri(
            figures.make_ring_diagram(
                beam_azimuth=np.array(geometry[view.ring]["azimuth"]),
                fov=geometry[view.ring]["fov"],
                radius=geometry[view.ring]["radius"],
                azimuth=view.azimuth,
                distance=view.true_distance,
                label=f"{view.ring} ring",
            )
        )
        for view in contact.views
        if view.sensors is not None
    ]
    several = len(samples.metadata.get("people", ())) > 1
    text = describe_contact(
        contact,
        _NOUN.get(samples.metadata.get("sensing", "rings"), ""),
        contact.person if several and contact.person else "the person",
    )
    rings = len(contact.approach.rings)
    return {
        "time": contact.time,
        "lead": text[0],
        "cause": text[1],
        "approach": text[2 : 2 + rings],
        "at_contact": text[2 + rings],
        "views": text[3 + rings :],
        "diagrams": diagrams,
    }


def _format_true(distance, is_known):
    if not is_known:
        return "not known"
    if math.isinf(distance):
        return "nobody"
    return format_number(max(distance, 0.0))


def _make_event_row(event: StateEvent, is_known: bool):
    name = figures.STATE_NAME
    return {
        "time": event.time,
        "kind": event.kind,
        "change": f"{name[event.before]} → {name[event.after]}",
        "ring": event.ring or _NONE,
        "measured": format_number(event.measured_distance),
        "true": _format_true(event.true_distance, is_known),
        "speed": format_number(event.tcp_speed),
        "duration": f"{event.duration:.2f}",
        "reason": event.reason,
    }


def _make_episode_row(episode: Episode, is_known: bool):
    if episode.rest:
        lowest = "stopped, stood still"
    elif episode.lowest == RobotState.STOP:
        lowest = "stopped, not yet still"
    else:
        lowest = "reduced"
    return {
        "time": episode.time,
        "kind": "stop" if episode.lowest == RobotState.STOP else "reduce",
        "lowest": lowest,
        "duration": f"{episode.duration:.2f}",
        "stopped": f"{episode.stopped:.2f}" if episode.stopped else _NONE,
        "ring": episode.first.ring or _NONE,
        "measured": format_number(episode.first.measured_distance),
        "true": _format_true(episode.first.true_distance, is_known),
        "least": _format_true(episode.least_true_distance, is_known),
        "speed": format_number(episode.first.tcp_speed),
        "changes": episode.changes,
    }


def _make_figures(samples, events, contacts, is_known):
    distances = (
        "measured and true distance" if is_known else "measured distance"
    )
    thresholds = ""
    if samples.find_bound("stop") or samples.find_bound("slow"):
        thresholds = " with the thresholds"
    result: dict[str, Picture | str] = {
        "timeline": make_picture(
            figures.make_timeline,
            f"Robot state, tool speed with speed fraction, and {distances}"
            f"{thresholds}, over the time of the run.",
            samples,
        ),
        "plan": make_picture(
            figures.make_plan,
            "The cell from above: tables, robot base, path of the tool, and "
            "path of the person drawn in the colour of the robot's state; of "
            "several people each one's path, and what else moves.",
            samples,
        ),
        "rings": make_picture(
            figures.make_rings,
            f"For each watched link: {distances}{thresholds}, and "
            "with rings every sensor's readings over time.",
            samples,
        ),
    }
    if figures.find_drawn_signals(samples):
        result["signals"] = make_picture(
            figures.make_signals,
            "What the law says of each watched link, over time.",
            samples,
        )
    closeup = figures.find_closeup(events, contacts)
    if closeup is not None:
        time, what = closeup
        result["closeup"] = make_picture(
            figures.make_closeup,
            f"The same three curves around {what}.",
            samples,
            time,
        )
        result["closeup_title"] = what
    return result


def make_report(
    samples: Samples, summary: dict, *, recording: str | None = None
) -> str:
    """Returns the report as one HTML document.

    Args:
        samples: The run. Of `metadata` it reads, where present,
            `scenario_name`, `title`, `scenario` (text), `law`, `human`,
            `task`, `seed`, `sensors_per_ring`, `versions`, `command`,
            `plan`, `ring_geometry`, `robot_bodies`, `person_parts`,
            `interrupted`, `sensing`, `audit`, `dead_sensors`,
            `self_hit_coverage`.
        summary: What `calc_summary` returned, with whatever else the run's
            `summary.json` holds (`real_time_factor`).
        recording: Path of the replay relative to the report; instants then
            link to it. The report needs no other file.
    """
    metadata = samples.metadata
    events = find_state_events(samples)
    contacts = find_contacts(samples)
    episodes = find_episodes(samples, events)
    has_samples = len(samples) > 1
    is_known = summary.get("person_is_known", True)
    return render_page(
        "report.html.jinja",
        interrupted=bool(metadata.get("interrupted")),
        scenario=metadata.get("scenario", ""),
        versions=metadata.get("versions", {}),
        name=metadata.get("title", metadata.get("scenario_name", "run")),
        summary=summary,
        verdict=[
            *make_verdict(summary, watcher=figures.get_watcher(samples)),
            *_describe_dead_sensors(metadata.get("dead_sensors", {})),
            *(
                ("note", f"{line}.")
                for line in metadata.get("self_hit_coverage", ())
            ),
        ],
        sensing=metadata.get("sensing", "rings"),
        audit=make_audit_section(samples) if is_known else None,
        person_is_known=is_known,
        people=metadata.get("people", []),
        obstacles=metadata.get("plan", {}).get("obstacles", []),
        headlines=_make_headlines(summary),
        law=_describe_law(samples),
        figures=(
            _make_figures(samples, events, contacts, is_known)
            if has_samples
            else {}
        ),
        has_samples=has_samples,
        recording=recording,
        episodes=[
            _make_episode_row(e, is_known) for e in episodes[:_MOST_ROWS]
        ],
        rows_shown=_ROWS_SHOWN,
        never_started=never_started(summary),
        last_reason=str(samples["reason"][-1]) if has_samples else "",
        is_alone=summary["min_true_distance_m"] is None,
        events=[_make_event_row(e, is_known) for e in events[:_MOST_ROWS]],
        rows_left_out={
            "episodes": max(len(episodes) - _MOST_ROWS, 0),
            "events": max(len(events) - _MOST_ROWS, 0),
        },
        contacts=[_make_contact(c, samples) for c in _pick_worst(contacts)],
        contacts_left_out=max(len(contacts) - _MOST_CONTACTS, 0),
        rings=_make_ring_rows(samples, summary),
        faults=_make_fault_rows(samples),
        link_faults=find_faulted_links(samples),
        facts=_make_facts(samples, summary),
    )


def _describe_law(samples):
    """Returns what the page says about the law."""
    law = samples.metadata.get("law", {})
    return {
        "title": law.get("title", ""),
        "about": law.get("about", ""),
        "guide": law.get("guide", []),
        "limits": law.get("limits", ""),
        "has_thresholds": bool(samples.find_bound("stop"))
        or bool(samples.find_bound("slow")),
        "stops": bool(samples.find_bound("stop")),
    }


def make_audit_section(samples: Samples) -> dict | None:
    """Puts the audit of a run into words and rows.

    Args:
        samples: The run, see `calc_audit`.

    Returns:
        `shortfall` rows, `sentences`, `latency` rows and its `total`; None if
        the run cannot be audited.
    """
    audit = calc_audit(samples)
    if audit is None or not len(audit.walking_in.values):
        return None
    rows = [
        _make_shortfall_row(
            f"walking in at {audit.walking_in.v_h:.1f} m/s", audit.walking_in
        )
    ]
    if audit.monitors_person:
        rows += [
            _make_shortfall_row("as monitored", audit.as_reckoned),
            _make_shortfall_row(
                "as measured, links that measure", audit.measuring
            ),
        ]
    late = audit.total_latency - audit.T_R
    return {
        "shortfall": rows,
        "sentences": _describe_audit(samples, audit),
        "latency": [
            (name, f"{1000 * part:.0f}") for name, part in audit.latency.items()
        ],
        "total": f"{1000 * audit.total_latency:.0f}",
        "T_R": f"{1000 * audit.T_R:.0f}",
        "late": f"{1000 * abs(late):.0f}",
        "is_late": late > 1e-9,
    }


def _describe_audit(samples, audit):
    worst = audit.walking_in
    link = figures.name_link(samples, worst.link)
    sentences = [
        f"At worst, at {worst.time:.2f} s ({link}, "
        f"{_describe_motion(worst.v_r)}), the standard asks "
        f"for {worst.S_p:.2f} m where the law stops at {worst.d_C:.2f} m: "
        f"{_describe_gap(worst.worst)}.",
        f"For {audit.inside:.1f} s the robot was not told to stop though the "
        "person was truly nearer to a watched link than the standard's "
        "distance for a person who walks in.",
        f"The tool reached {audit.tcp_speed:.2f} m/s. From there "
        f"{audit.stop_time_of} may take {1000 * audit.stop_time:.0f} ms to "
        "stop (category 0, worst case), the law assumes "
        f"{1000 * audit.T_stop:.0f} ms; the robot's time was the longer one "
        f"for {100 * audit.slow_share:.0f} % of the run.",
    ]
    clear = audit.as_reckoned.clear_share
    if audit.monitors_person and math.isfinite(clear):
        sentences.append(
            f"In {100 * clear:.0f} % of the time that is too short as "
            "monitored, the link that decides measured nothing: there the "
            "speed of the person is assumed."
        )
    return sentences


def _describe_motion(v_r):
    if round(v_r, 2) == 0.0:
        return "not moving along the line to the person"
    way = "towards" if v_r > 0.0 else "away from"
    return f"moving {way} the person at {abs(v_r):.2f} m/s"


def _describe_gap(gap):
    if gap > 0.0:
        return f"{gap:.2f} m too short"
    return f"{-gap:.2f} m to spare"


def _make_shortfall_row(name, shortfall):
    return {
        "name": name,
        "quantiles": [format_number(q) for q in shortfall.quantiles],
        "worst": format_number(shortfall.worst),
        "share": (
            f"{100 * shortfall.share:.0f} %"
            if len(shortfall.values)
            else "\u2013"
        ),
    }


def _make_ring_rows(samples, summary):
    rows = []
    for ring in samples.rings:
        share = summary.get("detection_share_by_ring", {}).get(ring)
        rmse = summary.get("distance_rmse_by_ring_m", {}).get(ring)
        state = samples[f"{ring}_state"]
        masked = samples[f"{ring}_masked"].astype(float)
        rows.append(
            {
                "name": figures.name_link(samples, ring),
                "rmse": _NONE if rmse is None else f"{1000 * rmse:.0f} mm",
                "share": _NONE if share is None else f"{100 * share:.0f} %",
                "ghost": format_number(
                    summary.get("ghost_s_by_ring", {}).get(ring), 1, "s"
                ),
                "masked": format_number(
                    float(masked.mean()) if len(masked) else None, 1
                ),
                "faulted": int(samples[f"{ring}_faulted"].max(initial=0)),
                "stop": _percent(state == RobotState.STOP),
                "age": "{} / {}".format(
                    *(
                        format_number(1e3 * age, 0)
                        for age in calc_ages(samples, ring)
                    )
                ),
            }
        )
    return rows


def _describe_dead_sensors(dead_sensors):
    """Returns the verdict on sensors that the scenario declares dead."""
    if not any(dead_sensors.values()):
        return []
    names = ", ".join(
        f"{ring} {i}" for ring, sensors in dead_sensors.items() for i in sensors
    )
    return [
        (
            "note",
            f"Sensors declared dead: {names}. Because of that the robot was "
            "never faster than reduced.",
        )
    ]


def _make_fault_rows(samples):
    """Returns what went wrong with which sensor, as the report shows it."""
    return [
        {
            "ring": figures.name_link(samples, row.ring),
            "sensor": row.sensor,
            "cause": row.cause,
            "scans": row.scans,
            "longest": f"{row.longest:.2f}",
            "first": row.first,
        }
        for row in find_faulted_sensors(samples)
    ]


def _percent(flags):
    return f"{100 * np.mean(flags):.0f} %" if len(flags) else _NONE


def _make_facts(samples, summary):
    """Returns what was run, as (term, value) pairs."""
    metadata = samples.metadata
    facts = [("Scenario", metadata.get("scenario_name"))]
    for term, key in (
        ("Person", "human"),
        ("Sensing", "sensing"),
        ("Seed", "seed"),
        ("Command", "command"),
    ):
        if (
            key == "sensors_per_ring"
            and metadata.get("sensing", "rings") != "rings"
        ):
            continue
        value = metadata.get(key)
        if isinstance(value, dict):
            value = ", ".join(f"{name} {n}" for name, n in value.items())
        facts.append((term, value))
    facts.append(("Simulated", format_number(summary["simulated_s"], 1, "s")))
    factor = summary.get("real_time_factor")
    if factor is not None:
        facts.append(("Computed", f"{factor:.0f} times faster than real time"))
    return [(term, str(value)) for term, value in facts if value is not None]


def write_report(
    samples: Samples,
    summary: dict,
    path: Path,
    *,
    recording: str | None = None,
) -> None:
    """Writes `make_report` to a file, whole or not at all.

    Args:
        samples: The run.
        summary: Its numbers, see `make_report`.
        path: The HTML file.
        recording: See `make_report`.

    Raises:
        UserError: if it cannot be written.
    """
    text = make_report(samples, summary, recording=recording)
    write_atomically(Path(path), lambda p: p.write_text(text, "utf-8"))
