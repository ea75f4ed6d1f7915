"""Audit of a run against ISO/TS 15066 and the robot's stopping time.

From the samples only: the settings it needs are in
`Samples.metadata["audit"]`, see `make_audit_metadata`.

The protective separation distance S_p is computed for each link at each tick
with v_r, the directed speed of the link as the monitor had it, and the law's
own C, T_R and T_S. The *shortfall* is S_p - d_C, where positive means that the
law lets the person come nearer than the standard does, and that of a tick is
the greatest of its links. It is given for two speeds of the person:

- *walking in*: 1.6 m/s towards the robot at all times, which the standard
  asks for where the person's speed is not monitored;
- *as monitored*: the directed speed of the person as the monitor had it, which
  the standard allows where it is monitored, as some laws do. A link that is
  clear measures no speed: the monitor then assumes V_hmax, and so does this.
  It is therefore also given *as measured*, over the links that measure a
  distance only, and then says nothing about the others. (In the first frame
  of a measurement the speed is still the assumed one.)

Neither ticks before the end of start-up nor links without any data count.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.arms.stop_time import STATED_FOR, calc_stated_stop_time
from tofssm_drake.laws.law import LawTraits
from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.metrics import calc_periods, find_start
from tofssm_drake.metrics.standards import (
    AuditConfig,
    calc_protective_distance,
)
from tofssm_drake.recording.samples import Samples

QUANTILES = (0.05, 0.5, 0.95)


def make_audit_metadata(
    *,
    config: AuditConfig,
    law: LawTraits,
    offset: dict[str, float],
    latency: dict[str, float],
) -> dict:
    """Returns what `calc_audit` reads, as plain values (JSON).

    Args:
        config: Of the audit.
        law: What the law says of itself.
        offset: By how much its distances are greater at each link, m.
        latency: From `make_latency_budget`, s.
    """
    return {
        "V_h": config.V_h,
        "T_R": law.T_R,
        "T_stop": law.T_stop,
        # Exact in decimals: 0.3 + 0.82 is 1.12.
        "C_dC": {link: round(law.C + d, 12) for link, d in offset.items()},
        "monitors_person": law.monitors_person,
        "latency_s": dict(latency),
    }


@dc.dataclass(frozen=True, kw_only=True)
class Shortfall:
    """How much shorter than S_p d_C was, over the ticks that count."""

    values: np.ndarray
    """Of each tick, m, (k,), in order; negative: d_C was longer."""
    quantiles: tuple[float, ...]
    """5 %, 50 % and 95 % of the time, m; NaN without any tick."""
    share: float
    """Share of the time with a shortfall above 0; NaN without any tick."""
    worst: float
    """The greatest, m; NaN without any tick."""
    time: float
    """When that first was, s."""
    link: str
    """Of which link."""
    v_h: float
    """Speed of the person in it, m/s."""
    v_r: float
    """Directed speed of the link in it, m/s."""
    S_p: float
    """Protective separation distance there, m."""
    d_C: float
    """Critical distance there, m."""
    clear_share: float
    """Share of the time with a shortfall above 0 in which the link that
    decides measured no distance; NaN if there is no such time."""


@dc.dataclass(frozen=True, kw_only=True)
class Audit:
    """What the standards say about a run."""

    walking_in: Shortfall
    as_reckoned: Shortfall
    measuring: Shortfall
    """The same over the links that measure a distance only."""
    monitors_person: bool
    """Whether the law takes the person's speed into account."""
    inside: float
    """Time in which the robot was not told to stop though the true distance
    of a link was below its S_p (walking in), s."""
    latency: dict[str, float]
    """Parts of the worst latency by name, s."""
    T_R: float
    """Reaction time that the law assumes, s."""
    T_stop: float
    """Stopping time that the law assumes, s."""
    tcp_speed: float
    """Highest speed of the tool, m/s."""
    stop_time: float
    """Stated worst-case stopping time from that speed, s."""
    stop_time_of: str
    """Of which arm that is, for a sentence."""
    slow_share: float
    """Share of the time in which the stated worst-case stopping time from
    the tool's speed is above T_stop."""

    @property
    def total_latency(self) -> float:
        """Worst latency, s."""
        return float(sum(self.latency.values()))

    def make_row(self) -> dict[str, float]:
        """Returns the audit as one flat row of numbers, names with units."""
        row: dict[str, float] = {}
        for name, shortfall in (
            ("walking_in", self.walking_in),
            ("as_reckoned", self.as_reckoned),
            ("measuring", self.measuring),
        ):
            row |= {
                f"shortfall_{name}_p{round(100 * q):02d}_m": value
                for q, value in zip(QUANTILES, shortfall.quantiles, strict=True)
            }
            row[f"shortfall_{name}_max_m"] = shortfall.worst
            row[f"shortfall_{name}_share"] = shortfall.share
        return row | {
            "shortfall_as_reckoned_clear_share": self.as_reckoned.clear_share,
            "inside_protective_s": self.inside,
            "latency_s": self.total_latency,
            "latency_over_T_R_s": self.total_latency - self.T_R,
            "stated_stop_time_s": self.stop_time,
            "stated_stop_over_T_stop_s": self.stop_time - self.T_stop,
        }


def calc_audit(samples: Samples) -> Audit | None:
    """Audits a run.

    Args:
        samples: The run, with `metadata["audit"]` of `make_audit_metadata`.

    Returns:
        The audit; None if the law has no distance at which it stops, or if
        the metadata or a column is missing, as in records of an earlier
        version.
    """
    about = samples.metadata.get("audit")
    if not samples.find_bound("stop"):
        return None
    columns = [f"{link}_link_closing_speed" for link in samples.rings]
    if not about or any(name not in samples for name in columns):
        return None
    periods = calc_periods(samples["t"])
    v_r = samples.ring("link_closing_speed")
    d_C = samples.ring(samples.find_bound("stop"))
    is_known = np.isfinite(d_C) & (samples.ring("sequence") >= 0)
    is_known[: find_start(samples["robot_state"])] = False
    measures = np.isfinite(samples.ring("measured_distance"))

    def find_shortfall(v_h, counts):
        S_p = _calc_S_p(samples, about, v_h, v_r)
        return _find_shortfall(samples, periods, counts, S_p, v_h)

    walking_in = np.full(v_r.shape, about["V_h"])
    monitored = samples.ring("closing_speed") - v_r
    inside = (
        is_known
        & (
            samples.ring("true_distance")
            < _calc_S_p(samples, about, walking_in, v_r)
        )
        & (samples["robot_state"] != RobotState.STOP)[:, None]
    ).any(axis=1)
    speed = samples["tcp_speed"]
    highest = float(speed.max(initial=0.0))
    slow = calc_stated_stop_time(speed) > about["T_stop"]
    total = periods.sum()
    return Audit(
        walking_in=find_shortfall(walking_in, is_known),
        as_reckoned=find_shortfall(monitored, is_known),
        measuring=find_shortfall(monitored, is_known & measures),
        monitors_person=bool(about["monitors_person"]),
        inside=float(periods[inside].sum()),
        latency=dict(about["latency_s"]),
        T_R=float(about["T_R"]),
        T_stop=float(about["T_stop"]),
        tcp_speed=highest,
        stop_time=float(calc_stated_stop_time(highest)),
        stop_time_of=STATED_FOR,
        slow_share=float(periods[slow].sum() / total) if total else np.nan,
    )


def _calc_S_p(samples, about, v_h, v_r):
    """Returns protective separation distances, m, with the law's numbers."""
    C = about["C_dC"]
    # Older records have one number for all links.
    if isinstance(C, dict):
        C = np.array([C[link] for link in samples.rings])
    return calc_protective_distance(
        v_h=v_h,
        v_r=v_r,
        T_R=about["T_R"],
        T_S=about["T_stop"],
        C=C,
    )


def _find_shortfall(samples, periods, counts, S_p, v_h):
    """Returns the shortfall of S_p against d_C, where it counts; (k, m)."""
    d_C = samples.ring(samples.find_bound("stop"))
    rows = np.flatnonzero(counts.any(axis=1))
    if not len(rows):
        nothing = dict.fromkeys(
            (
                *("share", "worst", "time", "v_h", "v_r", "S_p", "d_C"),
                "clear_share",
            ),
            np.nan,
        )
        return Shortfall(
            values=np.empty(0),
            quantiles=(np.nan,) * len(QUANTILES),
            link="",
            **nothing,
        )
    gap = np.full(S_p.shape, -np.inf)
    np.subtract(S_p, d_C, out=gap, where=counts)
    deciding = gap[rows].argmax(axis=1)
    values = gap[rows, deciding]
    row = int(rows[np.argmax(values)])
    link = int(np.argmax(gap[row]))
    # A critical distance in decimals may miss S_p by the last digit.
    above = values > 1e-9
    time_above = periods[rows][above].sum()
    distance = samples.ring("measured_distance")[rows, deciding]
    time_clear = periods[rows][above & ~np.isfinite(distance)].sum()
    return Shortfall(
        values=values,
        quantiles=tuple(np.quantile(values, QUANTILES).tolist()),
        share=float(time_above / periods[rows].sum()),
        worst=float(gap[row, link]),
        time=float(samples["t"][row]),
        link=samples.rings[link],
        v_h=float(v_h[row, link]),
        v_r=float(samples.ring("link_closing_speed")[row, link]),
        S_p=float(S_p[row, link]),
        d_C=float(d_C[row, link]),
        clear_share=(float(time_clear / time_above) if time_above else np.nan),
    )
