"""Ray bundles as a system in a Diagram."""

from collections.abc import Sequence
import dataclasses as dc
import math

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import QueryObject
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Scan:
    """What was seen at one moment."""

    time: float = math.nan
    """When, s; NaN: no scan yet."""
    X_WF: np.ndarray | None = None
    """Poses of the caster's frames."""
    distance: np.ndarray
    """See `RayCaster.cast_bundles`, shape (m, k)."""
    index: np.ndarray
    """Likewise."""

    def __deepcopy__(self, memo) -> "_Scan":
        return self


class RayCasterSensor(LeafSystem):
    """Casts bundles of rays against the SceneGraph of a Diagram.

    .. pydrake_system::

        name: RayCasterSensor
        input_ports:
        - geometry_query
        output_ports:
        - ranges
        - geometry_index
        - normals
        - scan_time

    The bundles may be those of any sensor: `fan` has the patterns of a narrow
    cone, of lidars and of a camera. The first three outputs are arrays in the
    shape of the pattern:

      - `ranges`: distances along the rays, m, inf where there is nothing
        within range; shape `shape`.
      - `geometry_index`: indices into `caster.geometry_ids`, -1 where there
        is nothing; int64, shape `shape`.
      - `normals`: unit normals in the world that face the rays, NaN where
        there is no hit or the ray starts inside; shape (*shape, 3).
      - `scan_time`: when the rays were cast, s.

    They show the present, as Drake's RgbdSensor does, or with a `period` the
    newest scan, as RgbdSensorAsync does: the scene is captured at
    `capture_offset` and every period after it, and appears on the ports
    `output_delay` later. Before the first scan the ranges are NaN, not inf:
    not yet known, which is not clear. A forced unrestricted update
    captures and shows a scan at once; with an infinite period that is the
    only trigger.
    """

    def __init__(
        self,
        *,
        caster: RayCaster,
        bundles: RayBundles,
        shape: Sequence[int] | None = None,
        period: float | None = None,
        capture_offset: float = 0.0,
        output_delay: float = 0.0,
    ):
        """Constructs the system.

        Args:
            caster: Of the SceneGraph that is connected to `geometry_query`.
            bundles: m bundles of k rays, made by it.
            shape: Of the outputs, with m k numbers; None: (m, k).
            period: From one scan to the next, s, > 0; inf: only forced
                updates scan; None: outputs show the present.
            capture_offset: Time of the first scan, s.
            output_delay: From a scan to its appearance on the ports, s, less
                than the period.

        Raises:
            ValueError: If a setting is out of range, or the shape does not
                fit the bundles.
        """
        super().__init__()
        rays = bundles.num_bundles, len(bundles.fan_S)
        self._shape = tuple(rays if shape is None else shape)
        if math.prod(self._shape) != math.prod(rays):
            raise ValueError(
                f"shape: {self._shape} does not have {math.prod(rays)} rays"
            )
        self._caster = caster
        self._bundles = bundles
        self._geometry_query = self.DeclareAbstractInputPort(
            "geometry_query", Value(QueryObject())
        )
        if period is None:
            if capture_offset != 0.0 or output_delay != 0.0:
                raise ValueError("capture_offset, output_delay: need a period")
            ticket = self._declare_present()
        else:
            _check_times(period, capture_offset, output_delay)
            ticket = self._declare_held(period, capture_offset, output_delay)
        self._declare_outputs(ticket)

    def _declare_present(self):
        self._present = self.DeclareCacheEntry(
            "scan",
            ValueProducer(
                allocate=lambda: Value(self._make_empty()),
                calc=lambda context, scan: scan.set_value(
                    self._capture(context)
                ),
            ),
            {self._geometry_query.ticket(), self.time_ticket()},
        )
        return self._present.ticket()

    def _declare_held(self, period, capture_offset, output_delay):
        self._present = None
        empty = Value(self._make_empty())
        self._pending = self.DeclareAbstractState(empty)
        self._shown = self.DeclareAbstractState(empty)
        self.DeclareForcedUnrestrictedUpdateEvent(self._scan_now)
        if math.isfinite(period):
            capture = self._scan_now if output_delay == 0.0 else self._start
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                period, capture_offset, capture
            )
            if output_delay > 0.0:
                self.DeclarePeriodicUnrestrictedUpdateEvent(
                    period, capture_offset + output_delay, self._show
                )
        return self.abstract_state_ticket(self._shown)

    def _declare_outputs(self, ticket):
        empty = self._make_empty()
        for name, value, calc in (
            ("ranges", empty.distance, self._calc_ranges),
            ("geometry_index", empty.index, self._calc_index),
            ("normals", np.zeros((*self._shape, 3)), self._calc_normals),
        ):
            model = Value(value)
            self.DeclareAbstractOutputPort(
                name, model.Clone, calc, prerequisites_of_calc={ticket}
            )
        self.DeclareVectorOutputPort(
            "scan_time", 1, self._calc_time, prerequisites_of_calc={ticket}
        )

    def _make_empty(self) -> _Scan:
        rays = self._bundles.num_bundles, len(self._bundles.fan_S)
        return _Scan(
            distance=np.full(rays, np.nan), index=np.full(rays, -1, np.int64)
        )

    def _capture(self, context: Context) -> _Scan:
        X_WF = self._caster.poses_from_query_object(
            self._geometry_query.Eval(context)
        )
        distance, index = self._caster.cast_bundles(self._bundles, X_WF)
        return _Scan(
            time=context.get_time(), X_WF=X_WF, distance=distance, index=index
        )

    def _scan_now(self, context: Context, state: State) -> EventStatus:
        """Takes a scan and shows it."""
        scan = self._capture(context)
        state.get_mutable_abstract_state(self._shown).set_value(scan)
        return EventStatus.Succeeded()

    def _start(self, context: Context, state: State) -> EventStatus:
        """Takes a scan that is shown later."""
        scan = self._capture(context)
        state.get_mutable_abstract_state(self._pending).set_value(scan)
        return EventStatus.Succeeded()

    def _show(self, context: Context, state: State) -> EventStatus:
        """Shows the scan that was taken last."""
        scan = state.get_mutable_abstract_state(self._pending).get_value()
        state.get_mutable_abstract_state(self._shown).set_value(scan)
        return EventStatus.Succeeded()

    def _get_scan(self, context: Context) -> _Scan:
        if self._present is not None:
            return self._present.Eval(context)
        return context.get_abstract_state(int(self._shown)).get_value()

    def _calc_ranges(self, context: Context, output):
        scan = self._get_scan(context)
        output.set_value(scan.distance.reshape(self._shape))

    def _calc_index(self, context: Context, output):
        output.set_value(self._get_scan(context).index.reshape(self._shape))

    def _calc_normals(self, context: Context, output):
        scan = self._get_scan(context)
        normals = np.full((*self._shape, 3), np.nan)
        if scan.X_WF is not None:
            p_WR, n_WR = self._caster.calc_rays(self._bundles, scan.X_WF)
            normals = self._caster.calc_normals(
                scan.X_WF,
                p_WR,
                n_WR,
                scan.distance,
                scan.index,
                min_range=self._bundles.min_range[:, np.newaxis],
            ).reshape(normals.shape)
        output.set_value(normals)

    def _calc_time(self, context: Context, output: BasicVector):
        output[0] = self._get_scan(context).time


def _check_times(period, capture_offset, output_delay):
    if not period > 0.0:
        raise ValueError(f"period: {period} is not > 0")
    if not 0.0 <= capture_offset < math.inf:
        raise ValueError(f"capture_offset: {capture_offset} is not >= 0")
    if not 0.0 <= output_delay < period:
        raise ValueError(
            f"output_delay: {output_delay} is not at least 0 and less than the"
            f" period {period}"
        )
